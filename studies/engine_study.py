"""``python -m studies audit --truth ENGINE``: effects in an arm that another engine moves, audited with our body.

The two engines differ where nothing is hidden, too. That difference is audited once, on recordings of its own, and what
the audit names is adopted: the model with it is the base of all audits that follow. Three repeats of one random
command and three recordings of others are fitted, four more are untouched.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.stats import binomtest

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.discrepancy.verdict import DESCRIBED, EQUIVALENT, EXPLAINED, NEGLIGIBLE, NO_DISCREPANCY, NO_VERDICT
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import output_folder, read_lines, write_text
from rfdropo_bayes.inference.progress import Progress
from rfdropo_bayes.mechanisms import REGISTRY
from rfdropo_bayes.model.experiment import AuditTable, Experiment
from rfdropo_bayes.model.experiment_file import describe
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.model_spec import spec_of
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.tables import parse_table
from rfdropo_bayes.verbs.audit import Workshop, audit, build_problem
from studies.fits import Job, run_fits, uninterrupted
from studies.hidden_effects import Setting, absorbing, blank_recordings, experiment_tables, noisy
from studies.mujoco_truth import ENGINE_EFFECTS, EngineArm, EngineEffect, MuJoCoArm
from studies.pyelastica_truth import ELASTICA_EFFECTS, ElasticaArm

REPEATS, OTHERS, UNTOUCHED = 3, 3, 4
FITTED = REPEATS + OTHERS
LEDGER, TABLE, BASE = "engines.jsonl", "engines.md", "engine_difference"
NOTHING = "nothing"
STEPS = 8  # of the search for a size: rho is proportional to it but for large effects
CLOSE = 0.1  # of rho, within which a size is the one that was looked for
AUDITED = {"refine": 2, "time_step": 0.005}
MINUTES = 300.0
"""Of an audit by the clock on the wall: a study shares its machine, and an audit takes 9 minutes of a processor."""
CENTRE = {"young_modulus": 2e6, "trunk_mass": 0.0911}


class Truth(NamedTuple):
    """An engine that makes recordings.

    Attributes:
        arm: the arm in it: of the robot's file, values and an effect.
        effects: by name.
        centre: values about which those of data sets lie.
        setting: of data sets, see `Setting`.
    """

    arm: type[EngineArm]
    effects: Mapping[str, EngineEffect]
    centre: Mapping[str, float]
    setting: Setting


TRUTHS = {
    "mujoco": Truth(MuJoCoArm, ENGINE_EFFECTS, {**CENTRE, "rayleigh_stiffness": 0.05}, Setting(audited=AUDITED)),
    "pyelastica": Truth(
        ElasticaArm,
        ELASTICA_EFFECTS,
        {**CENTRE, "rayleigh_mass": 10.0},
        Setting(
            audited=AUDITED,
            priors={
                **Setting().priors,
                "rayleigh_mass": {"distribution": "LogNormal", "median": 10.0, "sigma": 0.5},
                "rayleigh_stiffness": {"distribution": "LogNormal", "median": 2e-3, "sigma": 1.0},
            },
        ),
    ),
}
"""By name of the engine. The rod's damping is in proportion to mass, and has none to stiffness."""

_WORKSHOP: Workshop = {}  # of this process


def run_engine_study(
    out: Path, datasets: int, seed: int, *, engine: str = "mujoco", rho: float = 0.5, effects: Sequence[str] = ()
) -> list[dict[str, Any]]:
    """Hide, audit and count; a data set that is in the ledger is not run again.

    Args:
        out: folder for ledger, table and the audit of the engines' difference.
        datasets: of every effect, and of nothing.
        seed: of the study.
        engine: one of `TRUTHS`.
        rho: see `hidden_effects`.
        effects: names of the engine's; all, and nothing, by default.

    Raises:
        InputError: an unknown effect.
    """
    truth = TRUTHS[engine]
    known = [NOTHING, *truth.effects]
    unknown = [name for name in effects if name not in known]
    if unknown:
        raise InputError(f"unknown effect {unknown[0]!r}", where="--hide", remedy=f"one of {', '.join(known)}")
    out = output_folder(out)
    base = _adopted(truth, out, seed)
    jobs = [
        {"effect": name, "rho": 0.0 if name == NOTHING else rho, "index": k, "seed": seed}
        for k in range(datasets)
        for name in effects or known
    ]
    with Progress("audits", show=None) as progress:
        found = run_fits(
            jobs, partial(_one, truth=truth, base=base, folder=out), out / LEDGER, resume=True, progress=progress
        )
    write_text(out / TABLE, as_table([{**row["job"], **row["result"]} for row in read_lines(out / LEDGER)]))
    return found


def _adopted(truth: Truth, out: Path, seed: int) -> dict[str, Any]:
    """The experiment that what the engines differ by has extended, as its tables; audited if that was not done yet."""
    stored = out / BASE / "extended.json"
    if not stored.exists():
        own = experiment_tables(truth.setting, fit=["fit_*.nc"]).model_dump(exclude_none=True, exclude_defaults=True)
        place = _recorded(truth, own, None, 0.0, [seed, 0], out / BASE / "data")
        assert place is not None
        asked = Model.read(place / "audit.toml", ["audit.ports=false"])  # laws are not adopted
        found = uninterrupted(audit(asked, out=out / BASE / "audit", workshop=_WORKSHOP, overwrite=True))
        stored.write_text(json.dumps(_with_findings(own, found.content["findings"])), encoding="utf-8")
        (out / BASE / "sentence.txt").write_text(found.sentence + "\n", encoding="utf-8")
    return dict(json.loads(stored.read_text(encoding="utf-8")))


def _with_findings(tables: Mapping[str, Any], findings: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """An experiment whose model has every mechanism that was named: the engines are known to differ, and so unseen
    recordings need not support it."""
    named = [row for row in findings if row["mechanism"] in REGISTRY]
    model = dict(tables["model"])
    model["mechanisms"] = [row["mechanism"] for row in named]
    model["priors"] = {**model["priors"], **{name: {} for row in named for name in row["parameters"]}}
    return {**tables, "model": model}


def _one(job: Job, truth: Truth, base: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """One data set: hidden, audited, judged."""
    began, processor = time.monotonic(), time.process_time()
    name = str(job["effect"])
    effect = truth.effects.get(name)
    number = seed_of(truth, name, int(job["seed"]), int(job["index"]))
    place = folder / "data" / f"{name.replace(' ', '_')}_{job['index']}"
    hidden = _recorded(truth, base, effect, float(job["rho"]), number, place)
    if hidden is None:
        return {"verdict": "no size reaches this rho"}
    asked = Model.read(hidden / "audit.toml")
    found = uninterrupted(audit(asked, out=place / "audit", workshop=_WORKSHOP, overwrite=True))
    classes = [row["equivalence_class"] for row in found.content["findings"]]
    right = set(effect.right) if effect else set()
    return {
        **json.loads((hidden / "hidden.json").read_text(encoding="utf-8")),
        "verdict": found.verdict,
        "named": [row["mechanism"] for row in found.content["findings"]],
        "law": (found.content.get("law") or {}).get("formula"),
        "named_rightly": any(right & set(each) for each in classes),
        "sentence": found.sentence,
        "seconds": round(time.monotonic() - began, 1),
        "core_seconds": round(time.process_time() - processor, 1),
    }


def drawn_arm(truth: Truth, effect: EngineEffect | None, seed: Sequence[int]) -> tuple[EngineArm, list[Trajectory]]:
    """The arm of a data set, and its recordings without positions: repeats first, other fitted ones, untouched ones."""
    rng = np.random.default_rng(list(seed))
    spread = np.exp(0.2 * rng.standard_normal(len(truth.centre)))
    values = {name: float(v * s) for (name, v), s in zip(truth.centre.items(), spread, strict=True)}
    names = [*(f"fit_{k + 1}" for k in range(FITTED)), *(f"test_{k + 1}" for k in range(UNTOUCHED))]
    blank = blank_recordings(truth.setting, rng, names, [*([0] * REPEATS), *range(1, 1 + OTHERS + UNTOUCHED)])
    return truth.arm(Robot.load(truth.setting.robot), values, effect), blank


def seed_of(truth: Truth, effect: str, seed: int, index: int) -> list[int]:
    """Of a data set of the study, in which nothing or an effect is hidden."""
    return [seed, 1 + [NOTHING, *truth.effects].index(effect), index]


def _recorded(
    truth: Truth, base: Mapping[str, Any], effect: EngineEffect | None, rho: float, seed: Sequence[int], out: Path
) -> Path | None:
    """Write a data set; None where no size of the effect reaches rho."""
    out = output_folder(out)
    arm, blank = drawn_arm(truth, effect, seed)
    size, reached = 0.0, 0.0
    if effect is not None:
        sized = _sized(base, arm, effect, rho, blank, out)
        if sized is None:
            return None
        size, reached = sized
    key = jax.random.key(int(np.random.SeedSequence(list(seed)).generate_state(1)[0]))
    for index, (recording, clean) in enumerate(zip(blank, arm.positions(blank, size), strict=True)):
        noisy(recording, clean, jax.random.fold_in(key, index), truth.setting).save(out / f"{recording.name}.nc")
    tables = {**base, "seed": int(seed[-1]), "audit": {"minutes": MINUTES}}
    (out / "audit.toml").write_text(describe(tables), encoding="utf-8")
    told = {"size": size, "unit": effect.unit if effect else "-", "reached": reached, "values": arm.values}
    (out / "hidden.json").write_text(json.dumps(told), encoding="utf-8")
    return out


def _sized(
    base: Mapping[str, Any], arm: EngineArm, effect: EngineEffect, rho: float, blank: Sequence[Any], out: Path
) -> tuple[float, float] | None:
    """The size of an effect that a refit of the base model cannot absorb, ``rho`` deviations of the noise of it."""
    fitted = list(blank[:FITTED])
    spec = spec_of(parse_table(Experiment, base, where=BASE), out)
    problem = build_problem(spec, AuditTable(), fitted, list(blank[FITTED:]), 0, workshop=_WORKSHOP)
    model = absorbing(problem, problem.coordinates.null, fitted)
    still = arm.positions(model.recordings, 0.0)
    return size_of(lambda size: model.rho(arm.positions(model.recordings, size) - still), effect.usual, rho)


def size_of(rho_at: Callable[[float], float], usual: float, rho: float) -> tuple[float, float] | None:
    """The size at which an effect has ``rho``, within `CLOSE`, and what it has there; None where none is found.

    Args:
        rho_at: rho of a size; an `InputError` says that the engine does not bear the size.
        usual: where the search begins.
        rho: wanted.
    """
    size = usual
    for _ in range(STEPS):
        try:
            found = rho_at(size)
        except InputError:
            return None
        if abs(found - rho) <= CLOSE * rho:
            return size, found
        if found == 0.0:
            return None
        size *= rho / found
    return None


def as_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The study as a Markdown table."""
    lines = ["| hidden | data sets | named rightly | described | silent | verdicts |", "|---|---|---|---|---|---|"]
    silent = (NO_DISCREPANCY, NEGLIGIBLE)
    for name in dict.fromkeys(row["effect"] for row in rows):
        own = [row for row in rows if row["effect"] == name and "named" in row]
        verdicts = ", ".join(sorted({str(row["verdict"]) for row in own}))
        counts = [sum(bool(row["named_rightly"]) for row in own)]
        counts += [sum(row["verdict"] == DESCRIBED for row in own), sum(row["verdict"] in silent for row in own)]
        lines.append(f"| {name} | {len(own)} | {' | '.join(map(str, counts))} | {verdicts} |")
    hidden = [row for row in rows if row["effect"] != NOTHING and "named" in row]
    found = sum(bool(row["named_rightly"]) or row["verdict"] == DESCRIBED for row in hidden)
    wrong = sum(row["verdict"] in (EXPLAINED, EQUIVALENT) and not row["named_rightly"] for row in hidden)
    unsaid = sum(row["verdict"] == NO_VERDICT for row in hidden)
    if hidden:
        interval = binomtest(found, len(hidden)).proportion_ci(0.95, "exact")
        share = f"[{100 * interval.low:.0f}, {100 * interval.high:.0f}] %"
        told = f"Named rightly or described: {found} of {len(hidden)} {share} (exact 95 % interval)"
        lines += ["", f"{told}; explained by another cause: {wrong}; no verdict: {unsaid}."]
    return "\n".join(lines) + "\n"
