"""``python -m studies table2``: the paper's Table II. Policies of every method meet a robot they never touched.

The robot is a simulated one that differs from its model: the target. A row of the table is a way to choose the
parameters that a policy is trained under. A cell is one row, task and seed: a fit, a training and an evaluation, each
in a folder of its own, so that a study goes on where it stopped, and grows.
"""

from __future__ import annotations

import copy
import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.stats import binomtest

from rfdropo_bayes.discrepancy.verdict import NO_VERDICT
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import output_folder, write_json, write_text
from rfdropo_bayes.inference.progress import Progress
from rfdropo_bayes.model.experiment_file import describe, read_tables, self_contained
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.run_folder import CHECKPOINTS, COMMANDS, LOG, RUN, RunKind, run_ended, run_folder
from rfdropo_bayes.report import software_versions
from rfdropo_bayes.report.style import CYCLE, WIDTH, styled
from rfdropo_bayes.results.audited import AUDIT, EXTENDED
from rfdropo_bayes.verbs.audit import audit
from rfdropo_bayes.verbs.calibrate import calibrate
from rfdropo_bayes.verbs.evaluate import CSV, evaluate
from rfdropo_bayes.verbs.train import POLICY, train
from studies import rivals  # noqa: F401 - it adds its methods to the table of the package

COMMANDS["table2"] = RunKind(("table2.json", "table2.md", "table2.png"), resumable=True, shared=True)

THRESHOLDS = (0.01525, 0.02157, 0.030)  # m, those of the paper's Table II
PAPER = {"15.25": 0.32, "21.57": 0.56, "30": 0.60}  # RF-DROPO, TrunkPush on hardware
CLAIMED = "15.25"
ALMOST = 0.9  # of the oracle's success
RESAMPLES = 4000
ASKED = "asked.toml"
"""What a finished part of the study was made from."""


@dataclass(frozen=True)
class TrainingRow:
    """How the parameters of a row's trainings are chosen.

    Attributes:
        method: of inference; empty where nothing is fitted.
        options: of the method, beside the budget.
        randomisation: that the policy is trained under.
        each: every seed has a fit of its own, as chance chooses what is fitted.
        extended: the model has what the audit found missing.
        on_target: trained on the target itself.
    """

    method: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    randomisation: str = "none"
    each: bool = False
    extended: bool = False
    on_target: bool = False


ROWS = {
    "no randomisation": TrainingRow(),
    "UDR": TrainingRow("udr", {}, "posterior", each=True),
    "BayesSim": TrainingRow("bayessim", {}, "posterior"),
    "NPDR": TrainingRow("npdr", {"rounds": 10}, "posterior"),
    "RF-DROPO as published": TrainingRow("rfdropo", {"mended": False}, "phi"),
    "ours": TrainingRow("laplace", {}, "posterior"),
    "ours after the audit": TrainingRow("laplace", {}, "posterior", extended=True),
    "oracle": TrainingRow(on_target=True),
}
OURS, ORACLE = "ours after the audit", "oracle"
WITHOUT_CUBE = ("no randomisation", "ours", "oracle")
"""Rows of a task without a cube, which feedback alone solves."""


@dataclass(frozen=True)
class Table2Size:
    """How large the study is; seeds and steps may grow when it is resumed.

    Attributes:
        seeds: policies of every row.
        steps: environment steps of a training.
        episodes: of an evaluation, the same for all policies.
        budget: rollouts of a fit.
        minutes: bound of the audit.
        exact_oracle: the oracle is trained on the target's own mesh and time step; else on those of its model, with the
            target's values and mechanisms.
    """

    seeds: int = 3
    steps: int = 1_000_000
    episodes: int = 200
    budget: int = 10_000
    minutes: float = 65.0
    exact_oracle: bool = False

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if name != "exact_oracle" and value <= 0:
                raise InputError(f"{name} = {value} is too small", where="table2")


@dataclass(frozen=True)
class Study:
    """The files of a study: experiments, one for each task; the target; the audit; where results go."""

    experiments: Mapping[str, Path]
    target: Path
    audit: Path
    out: Path
    size: Table2Size


def run_table2(
    experiments: Sequence[Path],
    target: Path,
    audit: Path,
    out: Path,
    size: Table2Size,
    *,
    rows: Sequence[str] = (),
    resume: bool = False,
    only_done: bool = False,
    overwrite: bool = False,
    command: str = "",
) -> dict[str, Any]:
    """Do what is left of the study and write ``table2.json``, ``table2.md`` and ``table2.png``.

    Args:
        experiments: one file for each task: recording, model and table [training] that all rows share.
        target: experiment file of the robot that policies are evaluated on, with its true values.
        audit: experiment file of the audit that extends the model.
        out: folder to write to; one folder for each experiment in it.
        size: see `Table2Size`.
        rows: names of `ROWS` to do, in this order; by default all where there is a cube, and `WITHOUT_CUBE` elsewhere.
            The tables hold all that is done.
        resume: keep what an interrupted study has done.
        only_done: tables of the cells that are done; nothing is computed.
        overwrite: start anew; the folder's fits, policies and evaluations go.
        command: for the record.

    Returns:
        the content of table2.json.

    Raises:
        InputError: an unknown row, or bad input.
    """
    for name in rows:
        if name not in ROWS:
            raise InputError(f"unknown row {name!r}", where="--row", remedy=f"some of {', '.join(ROWS)}")
    options = {"episodes": size.episodes, "budget": size.budget, "target": target.name}
    going_on = resume or only_done
    with run_folder(out, "table2", options=options, resume=going_on, overwrite=overwrite) as out:
        study = Study({path.stem: path for path in experiments}, target, audit, out, size)
        if overwrite:
            _clear(study)
        jobs = list_jobs(study, rows)
        failed: dict[str, str] = {}
        if not only_done:
            with Progress("table2", show=None, log=out / LOG) as progress:
                for count, job in enumerate(jobs):
                    try:
                        _do(study, *job)
                    except InputError as error:  # a method that cannot is a row with its reason
                        failed[" ".join(map(str, job))] = str(error)
                    progress.stage((count + 1) / len(jobs), task=job[0], row=job[1], seed=job[2])
        known = [(task, row, seed) for task in study.experiments for row in ROWS for seed in range(size.seeds)]
        found = [cell for job in known if (cell := _cell(study, *job)) is not None]
        summaries = [summarise(task, row, found) for task, row in dict.fromkeys((c["task"], c["row"]) for c in found)]
        content = {
            "schema_version": 1,
            "command": command,
            "size": asdict(size),
            "cells": found,
            "rows": summaries,
            "failed": failed,
            "not_done": sum(_cell(study, *job) is None for job in list_jobs(study)),
            "paper": PAPER,
            "versions": software_versions(),
            "claims": claims(summaries),
        }
        write_json(out / "table2.json", content)
        write_text(out / "table2.md", as_markdown(content))
        if summaries:
            draw_figure(content).savefig(out / "table2.png", dpi=150)
    return content


def list_jobs(study: Study, rows: Sequence[str] = ()) -> list[tuple[str, str, int]]:
    """Task, row and seed of every cell; the first seed of all rows comes before the second of any."""
    jobs = []
    for seed in range(study.size.seeds):
        for task, path in study.experiments.items():
            jobs += [(task, row, seed) for row in rows or (ROWS if has_cube(read_tables(path)) else WITHOUT_CUBE)]
    return jobs


def _clear(study: Study) -> None:
    """Remove all that an earlier study has left."""
    kinds = ("experiments", "fits", "policies", "evaluations")
    for place in [study.out / "audit", *(study.out / task / kind for task in study.experiments for kind in kinds)]:
        shutil.rmtree(place, ignore_errors=True)


def _ran(out: Path, asked: str) -> bool:
    """Whether a part of the study has come to its end, made from what is asked now."""
    try:
        return run_ended(out) and (out / ASKED).read_text(encoding="utf-8") == asked
    except OSError:
        return False


def has_cube(tables: Mapping[str, Any]) -> bool:
    """Whether an experiment's task pushes a cube."""
    return bool(tables.get("simulator", {}).get("push", False))


def _do(study: Study, task: str, row: str, seed: int) -> None:
    """Fit, training and evaluation of a cell, as far as they are not done."""
    done = _cell(study, task, row, seed)
    if done is not None and done["steps"] >= study.size.steps:
        return
    policy = _trained(study, task, row, seed)
    out = _place(study, task, "evaluations", row, seed)
    tables = _on_target(study, _tables(study, task))
    path = _written(tables, study.out / task / "experiments" / "target.toml")
    evaluate(Model.read(path), [policy], out, episodes=study.size.episodes, film=False, overwrite=True)
    made = {"sha256": _digest(policy / POLICY), **_learning(policy), **_judged_on(study, row)}
    write_json(out / "policy.json", made)


def _trained(study: Study, task: str, row: str, seed: int) -> Path:
    """Folder of a cell's policy."""
    chosen = ROWS[row]
    tables = _tables(study, task)
    training = tables["training"] | {"steps": study.size.steps, "randomisation": chosen.randomisation}
    training.pop("source", None)
    if chosen.method:
        fit, model = _fitted(study, task, row, seed if chosen.each else None)
        training["source"] = str(fit)
        tables = model
    if chosen.on_target:
        tables = _on_target(study, tables)
        if not study.size.exact_oracle:
            tables["simulator"] = {k: v for k, v in tables["simulator"].items() if k not in ("refine", "time_step")}
    tables["training"], tables["seed"] = training, int(tables.get("seed", 0)) + seed
    tables["simulator"] = {**tables.get("simulator", {}), "precision": "float32"}
    tables.pop("data", None)
    path = _written(tables, study.out / task / "experiments" / f"{_slug(row)}_{seed}.toml")
    out, asked = _place(study, task, "policies", row, seed), path.read_text(encoding="utf-8")
    if not _ran(out, asked):
        train(Model.read(path), out, resume=(out / CHECKPOINTS).exists(), page=False)
        write_text(out / ASKED, asked)
    return out


def _fitted(study: Study, task: str, row: str, seed: int | None) -> tuple[Path, dict[str, Any]]:
    """Folder of a row's fit, or of the one of a seed, and the tables of the model that was fitted."""
    chosen, tables = ROWS[row], _tables(study, task)
    if chosen.extended:
        tables = _with_causes(study, tables)
    ranges = {n: p for n, p in tables["model"]["priors"].items() if p.get("distribution") == "Uniform"}
    search = {name: [prior["low"], prior["high"]] for name, prior in ranges.items()}
    own = {"parameters": list(search), "search": search} if chosen.method == "rfdropo" else {}
    budget = {} if chosen.method == "udr" else {"rollouts": study.size.budget}
    tables["inference"] = {"method": chosen.method, **chosen.options, **own, **budget}
    if seed is not None:
        tables["seed"] = int(tables.get("seed", 0)) + seed
    out = _place(study, task, "fits", row, seed)
    path = _written(tables, study.out / task / "experiments" / f"fit_{out.name}.toml")
    asked = path.read_text(encoding="utf-8")
    if not _ran(out, asked):
        calibrate(Model.read(path), out=out, resume=(out / CHECKPOINTS).exists())
        write_text(out / ASKED, asked)
    return out, tables


def _with_causes(study: Study, tables: dict[str, Any]) -> dict[str, Any]:
    """The model with the mechanisms that the audit adopted, their priors, and the laws that it found at ports."""
    out, minutes = study.out / "audit", f"audit.minutes={study.size.minutes}"
    asked = f"# {minutes}\n{study.audit.read_text(encoding='utf-8')}"
    if not _ran(out, asked):
        begun = (out / CHECKPOINTS).exists()
        # A verdict alone, as a repository keeps it, is no run that could be gone on with.
        audit(
            Model.read(study.audit, [minutes]), out=out, resume=begun, overwrite=not begun and not (out / RUN).exists()
        )
        write_text(out / ASKED, asked)
    found = json.loads((out / AUDIT).read_text(encoding="utf-8"))
    if found["out_of_time"]:  # what it says so far depends on the machine
        raise InputError(found["sentence"], where=str(out), remedy="give the audit more minutes, and go on")
    if found["verdict"] == NO_VERDICT:
        raise InputError(found["sentence"], where=str(out), remedy="mend the audit's file, then remove this folder")
    before, after = read_tables(study.audit), read_tables(out / EXTENDED)
    model = tables["model"]
    for key in ("mechanisms", "laws"):
        model[key] = [*model.get(key, []), *after["model"].get(key, [])]
    known = before["model"].get("priors", {})
    added = {name: prior for name, prior in after["model"]["priors"].items() if name not in known}
    model["priors"] = {**added, **model["priors"]}
    finer = {key: after["simulator"][key] for key in ("refine", "time_step") if key in after.get("simulator", {})}
    tables["simulator"] = {**tables.get("simulator", {}), **finer}
    return tables


def _tables(study: Study, task: str) -> dict[str, Any]:
    path = study.experiments[task]
    return self_contained(read_tables(path), path.resolve().parent)


def _on_target(study: Study, tables: Mapping[str, Any]) -> dict[str, Any]:
    """The target with an experiment's task; it starts its episodes by its own rules."""
    target = self_contained(read_tables(study.target), study.target.resolve().parent)
    training = {**tables["training"], "randomisation": "none"}
    training.pop("source", None)
    kept = {
        key: copy.deepcopy(value) for key, value in target.items() if key in ("robot", "adapter", "model", "simulator")
    }
    return {**kept, "seed": int(tables.get("seed", 0)), "training": training}


def _written(tables: Mapping[str, Any], path: Path) -> Path:
    output_folder(path.parent)
    write_text(path, describe(tables))
    return path


def _slug(row: str) -> str:
    return row.lower().replace(" ", "_").replace("-", "_")


def _place(study: Study, task: str, kind: str, row: str, seed: int | None = None) -> Path:
    return study.out / task / kind / (_slug(row) if seed is None else f"{_slug(row)}_{seed}")


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def target_digest(path: Path) -> str:
    """SHA-256 of what a target's file means: another comment is no other target."""
    return hashlib.sha256(describe(read_tables(path)).encode("utf-8")).hexdigest()


def _judged_on(study: Study, row: str) -> dict[str, Any]:
    """What an evaluation is of, beside its policy."""
    exact = {"exact_oracle": study.size.exact_oracle} if ROWS[row].on_target else {}
    return {"target_sha256": target_digest(study.target), **exact}


def _learning(policy: Path) -> dict[str, float]:
    """What a training took, and how its policy does at home: reward, and final distances [m]."""
    found = json.loads((policy / "summary.json").read_text(encoding="utf-8"))
    home = {f"home_{name}": found["evaluation"][name] for name in ("reward", "distance_median", "distance_q95")}
    return {"steps": found["steps"], "seconds": found["seconds"], "diverged": found["diverged_episodes"], **home}


def _cell(study: Study, task: str, row: str, seed: int) -> dict[str, Any] | None:
    """What a cell's evaluation found; None if there is none, or it is of another policy, target or size."""
    out = _place(study, task, "evaluations", row, seed)
    policy = _place(study, task, "policies", row, seed) / POLICY
    try:
        known = json.loads((out / "policy.json").read_text(encoding="utf-8"))
        episodes = pd.read_csv(out / CSV)
    except (OSError, ValueError):
        return None
    same = all(known.get(name) == value for name, value in _judged_on(study, row).items())
    if len(episodes) != study.size.episodes or not same or (policy.exists() and _digest(policy) != known["sha256"]):
        return None
    distance = episodes["distance"].to_numpy(dtype=float)
    return {
        "task": task,
        "row": row,
        "seed": seed,
        "steps": known["steps"],
        "seconds": known["seconds"],
        "hits": {f"{1e3 * threshold:g}": int(np.sum(distance <= threshold)) for threshold in THRESHOLDS},
        "episodes": len(distance),
        "distance_mm": [round(1e3 * value, 3) for value in distance.tolist()],
        "diverged": int(episodes["diverged"].sum()),
    }


def summarise(task: str, row: str, cells: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Success of a row's policies together and of each seed, with 95 % intervals that know chance in both the episodes
    and the trainings, see `share_of`."""
    own = [cell for cell in cells if (cell["task"], cell["row"]) == (task, row)]
    distance = np.array([cell["distance_mm"] for cell in own])
    success = {name: share_of(distance <= float(name)) for name in own[0]["hits"]}
    return {
        "task": task,
        "row": row,
        "seeds": len(own),
        "episodes": distance.size,
        "steps": min(cell["steps"] for cell in own),
        "training_seconds": float(np.mean([cell["seconds"] for cell in own])),
        "success": success,
        "by_seed": [cell["hits"][CLAIMED] / cell["episodes"] for cell in own],
        "median_mm": float(np.median(distance)),
    }


def share_of(hit: Bool[np.ndarray, "seed episode"]) -> dict[str, float]:
    """Share of hits, with a 95 % interval: Wilson's for one seed; for more the wider of Wilson's over all episodes and
    a bootstrap over seeds and, within them, over the episodes that all seeds share.

    Episodes of one policy succeed or fail together, so that those of all seeds are no independent trials.
    """
    seeds, episodes = hit.shape
    interval = binomtest(int(hit.sum()), hit.size).proportion_ci(0.95, method="wilson")
    low, high = float(interval.low), float(interval.high)
    if seeds > 1:
        rng = np.random.default_rng(0)
        chosen, played = (
            rng.integers(seeds, size=(RESAMPLES, seeds)),
            rng.integers(episodes, size=(RESAMPLES, episodes)),
        )
        shares = [hit[np.ix_(a, b)].mean() for a, b in zip(chosen, played, strict=True)]
        ends = np.quantile(shares, [0.025, 0.975])
        low, high = min(low, float(ends[0])), max(high, float(ends[1]))
    return {"share": float(hit.mean()), "low": low, "high": high}


def claims(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """What ours after the audit is meant to achieve at the smallest threshold, checked against what was found."""
    checked = []
    for task in dict.fromkeys(row["task"] for row in rows):
        known = {row["row"]: row["success"][CLAIMED] for row in rows if row["task"] == task}
        if OURS not in known:
            continue
        own = known[OURS]
        if ORACLE in known:
            ratio = own["share"] / max(known[ORACLE]["share"], 1e-9)
            words = f"succeeds at {CLAIMED} mm at least {ALMOST:g} times as often as the oracle"
            checked.append({"task": task, "claim": words, "value": ratio, "holds": ratio >= ALMOST})
        for name, rival in known.items():
            if name in (OURS, ORACLE):
                continue
            words = f"succeeds more often than {name}, intervals apart"
            apart = own["low"] - rival["high"]
            checked.append({"task": task, "claim": words, "value": apart, "holds": apart > 0.0})
    return checked


def as_markdown(content: Mapping[str, Any]) -> str:
    """The table for people."""
    size = content["size"]
    lines = [
        "# Table II on a robot that no policy has seen",
        "",
        f"`{content['command']}`",
        "",
        f"Share of episodes that end within a distance of the goal, {size['episodes']} of each policy, the same for "
        "all. The 95 % intervals know chance in episodes and, where a row has several seeds, in trainings.",
        "",
    ]
    for task in dict.fromkeys(row["task"] for row in content["rows"]):
        rows = [row for row in content["rows"] if row["task"] == task]
        names = list(rows[0]["success"])
        heads = ["row", *(f"{name} mm" for name in names), "median [mm]", "seeds", "15.25 mm by seed", "steps", "s"]
        lines += [f"## {task}", "", f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
        lines += [_row(row) for row in rows]
        lines.append("")
    if content["claims"]:
        lines += ["## Claims", "", "| task | claim | value | holds |", "|---|---|---|---|"]
        lines += [
            f"| {c['task']} | {c['claim']} | {c['value']:.2f} | {'yes' if c['holds'] else 'no'} |"
            for c in content["claims"]
        ]
        lines.append("")
    if content["failed"] or content["not_done"]:
        lines += [f"{content['not_done']} cells are not done.", ""]
        lines += [f"- {cell}: {why}" for cell, why in content["failed"].items()]
    paper = ", ".join(f"{100 * share:.0f} % within {name} mm" for name, share in content["paper"].items())
    lines += ["", f"The paper, RF-DROPO on hardware, TrunkPush: {paper}."]
    return "\n".join(lines) + "\n"


def _row(row: Mapping[str, Any]) -> str:
    cells = [f"{100 * s['share']:.0f} % [{100 * s['low']:.0f}, {100 * s['high']:.0f}]" for s in row["success"].values()]
    by_seed = ", ".join(f"{100 * share:.0f}" for share in row["by_seed"])
    entries = [row["row"], *cells, f"{row['median_mm']:.1f}", row["seeds"], by_seed, f"{row['steps']:,}"]
    return f"| {' | '.join(map(str, entries))} | {row['training_seconds']:.0f} |"


@styled
def draw_figure(content: Mapping[str, Any]) -> Figure:
    """Success of every row at every distance, with its interval; there is a row at least."""
    tasks = list(dict.fromkeys(row["task"] for row in content["rows"]))
    heights = [1.0 + 0.4 * sum(row["task"] == task for row in content["rows"]) for task in tasks]
    figure = Figure(figsize=(WIDTH, sum(heights)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(tasks), 1, squeeze=False, height_ratios=heights)[:, 0]
    for task, axes in zip(tasks, panels, strict=True):
        rows = [row for row in content["rows"] if row["task"] == task]
        names = list(rows[0]["success"])
        for k, (name, colour) in enumerate(zip(names, CYCLE, strict=False)):
            for place, row in enumerate(rows):
                found = row["success"][name]
                share, low, high = (100.0 * found[key] for key in ("share", "low", "high"))
                axes.errorbar(
                    share, place + 0.2 * (k - 1), xerr=[[share - low], [high - share]], fmt="o", ms=4, color=colour,
                    label=f"within {name} mm" if place == 0 else None,
                )  # fmt: skip
        axes.set(xlim=(-2, 102), xlabel="episodes [%]", title=task)
        axes.set_yticks(range(len(rows)), [row["row"] for row in rows])
        axes.invert_yaxis()
        axes.legend(loc="best")
    return figure
