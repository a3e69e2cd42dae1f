"""Why a delay of all days but June makes June worse: fits of the audit's days, together and apart (README.md).

    python reports/asl_trunk/shared_body.py [FIT ...]

Each fit is a line of shared_body.jsonl: its optimum, and how far all disks are off [mm] in the fitted rows and in later
rows of each day. Fits that are there are not computed again. A fit takes one minute of a processor.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

import rfdropo_bayes as rb
from rfdropo_bayes.files import append_line, read_lines
from rfdropo_bayes.groups import group_of
from rfdropo_bayes.inference.methods import run

LEDGER = Path(__file__).with_suffix(".jsonl")
EXPERIMENT = "experiments/asl_trunk_audit.toml"
EVERY = ("april", "june", "pulses")
PLAIN = ["model.mechanisms=[]"]  # the experiment has the lag
LATE = ['model.mechanisms=["command_delay"]', 'model.only_in.command_delay=["april", "pulses"]']
# Days that are fitted, what is added to the base model, and the fit that the climb starts from.
FITS: dict[str, tuple[tuple[str, ...], list[str], str]] = {
    "base": (EVERY, PLAIN, ""),
    "delay": (EVERY, LATE, "base"),
    "june alone": (("june",), PLAIN, "base"),
    "april and pulses, delay": (("april", "pulses"), LATE, "delay"),
    "lag": (EVERY, [], "base"),
    "delay, lag": (EVERY, ['model.mechanisms=["command_delay", "actuator_lag"]', LATE[1]], "delay"),
}


def errors(model: rb.Model, days: tuple[str, ...], split: str, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """How far all disks are off [mm] in the recordings of each day, under each set of values."""
    runs = [each for each in model.recordings(split) if group_of(each.name, model.spec.groups) in days]
    problem = model.problem(runs)
    position, _ = problem.predict({name: values[name] for name in problem.names})
    found = {}
    for place, each in enumerate(runs):
        off = np.linalg.norm(position[:, place, : len(each.time)] - each.position, axis=-1)
        squared = np.where(each.position_mask, off**2, 0.0).sum(axis=(1, 2)) / each.position_mask.sum()
        found[group_of(each.name, model.spec.groups)] = 1e3 * np.sqrt(squared)
    return found


def fitted(name: str, known: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The line of a fit."""
    days, overrides, start = FITS[name]
    began, model = time.process_time(), rb.Model.read(EXPERIMENT, overrides)
    runs = [each for each in model.recordings("fit") if group_of(each.name, model.spec.groups) in days]
    earlier = {key: np.full(2, value) for key, value in known[start]["optimum"].items()} if start else None
    method = rb.Laplace(starts=1, prior_draws=8 if start else 24, blocks=1, max_steps=40, draws=50)
    result = run(model.problem(runs, earlier), "laplace", method, jax.random.key(0))
    optimum = {**result.fixed, **(result.optimum or {})}
    values = {key: np.full(1, value) for key, value in optimum.items()}
    off = {split: {k: float(v[0]) for k, v in errors(model, days, split, values).items()} for split in ("fit", "test")}
    said = [caution.sentence for caution in result.cautions]
    spent = time.process_time() - began
    return {"name": name, "error_mm": off, "optimum": optimum, "cautions": said, "processor_s": spent}


def moved(known: dict[str, dict[str, Any]]) -> None:
    """June's error under the base fit, where one shared parameter after the other takes the value that the delay gives
    it, and under the fit with the delay, where one after the other goes back."""
    model = rb.Model.read(EXPERIMENT, PLAIN)
    base, late = known["base"]["optimum"], known["delay"]["optimum"]
    parts: dict[str, list[str]] = {}
    for name in model.problem(model.recordings("fit")).names:
        parts.setdefault("offset" if name.startswith("offset") else name, []).append(name)
    rows = [dict(base), *({**base, **{k: late[k] for k in own}} for own in parts.values())]
    rows += [{name: late[name] for name in base}]
    rows += [{**rows[len(parts) + 1], **{k: base[k] for k in own}} for own in parts.values()]
    values = {name: np.array([row[name] for row in rows]) for name in base}
    off = {split: errors(model, ("june",), split, values)["june"] for split in ("fit", "test")}
    print(f"\nJune [mm], fitted and later rows: base {off['fit'][0]:.2f}, {off['test'][0]:.2f}; ", end="")
    print(f"values of the fit with the delay {off['fit'][len(parts) + 1]:.2f}, {off['test'][len(parts) + 1]:.2f}")
    print("| parameter | base | with the delay | June, this one moved: fitted, later | this one moved back |")
    print("|---|---|---|---|---|")
    for k, (part, own) in enumerate(parts.items()):
        there, back = k + 1, k + 2 + len(parts)
        sizes = " | ".join(f"{v[own[0]]:.4g}" for v in (base, late)) if len(own) == 1 else " | "
        figures = [f"{off['fit'][i]:.2f}, {off['test'][i]:.2f}" for i in (there, back)]
        print(f"| {part} | {sizes} | {figures[0]} | {figures[1]} |")


def main() -> None:
    asked = sys.argv[1:] or list(FITS)
    known = {line["name"]: line for line in read_lines(LEDGER)} if LEDGER.exists() else {}
    for name in asked:
        if name not in known:
            known[name] = fitted(name, known)
            append_line(LEDGER, json.dumps(known[name]))
    for name, line in known.items():
        words = [
            f"{day} {line['error_mm']['fit'][day]:.1f}, {off:.1f}" for day, off in line["error_mm"]["test"].items()
        ]
        print(f"{name}: {'; '.join(words)} ({line['processor_s']:.0f} s) {line['cautions']}")
    if {"base", "delay"} <= set(known):
        moved(known)


if __name__ == "__main__":
    main()
