"""``python -m studies audit``: how often the audit is right, on data sets with effects hidden in them."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from rfdropo_bayes.discrepancy.audit_problem import measurements_of, simulated
from rfdropo_bayes.discrepancy.audit_record import STIFFNESS
from rfdropo_bayes.discrepancy.fit import optimise
from rfdropo_bayes.discrepancy.pipeline import Answer
from rfdropo_bayes.discrepancy.verdict import DESCRIBED, EQUIVALENT, EXPLAINED, NO_DISCREPANCY, PARTLY, UNEXPLAINED
from rfdropo_bayes.errors import InputError, Interrupted
from rfdropo_bayes.files import output_folder, read_lines, write_json, write_text
from rfdropo_bayes.inference.progress import Progress
from rfdropo_bayes.interrupts import running
from rfdropo_bayes.mechanisms import REGISTRY
from rfdropo_bayes.model.experiment import CommandsTable
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.verbs.audit import JOURNAL, Workshop, audit
from studies.fits import Job, run_fits, uninterrupted
from studies.hidden_effects import EARLIER, Hidden, Setting, hide

RESULT, TABLE, LEDGER = "audit_power.json", "audit_power.md", "datasets.jsonl"
NEAR = 1.3  # times the error of the model that knows what is hidden
ONCE = 'data.fit=["fit_1.nc", "screen.nc"]'  # an override that leaves the repeats out
WHOLE = "with_whole_library"
LEARNT = 0.5  # of a prior's deviation that a posterior's is below where the data, not the prior, say the size
TRIES = 8  # mechanisms that are tried until one reaches the wanted size
FAMILIES = {
    "actuator_lag": "cable_lag",
    "command_delay": "cable_delay",
    "command_gain": "cable_gain",
    "command_gain_drift": "cable_gain_drift",
    "camera_offset": "marker_offset",
}
"""Families that contain a mechanism: the same effect if their parameters are equal."""


SHARED = 0.8  # of the noise's variance
# SOFA's trunk on its own mesh, which lies under $RFDROPO_DATA; made and audited on it and with one time step.
BODY = {
    "body": "tetrahedra",
    "time_step": 0.02,
    "tetrahedra": {"mesh": "sofa_trunk/trunk.vtk", "unit": "mm", "clamp_height": 0.02},
}
MESH = Setting(
    robot="trunk_sofa_mesh",
    commands=CommandsTable(
        duration=3.0, interval=0.2, step=0.005, low=0.0, high=0.02, sample_time=0.1, recordings=["any"]
    ),
    audited=BODY,
    made=BODY,
    priors={
        "young_modulus": {"distribution": "LogNormal", "median": 4.5e6, "sigma": 0.5},
        "trunk_mass": {"distribution": "LogNormal", "median": 0.42, "sigma": 0.5},
        "rayleigh_stiffness": {"distribution": "LogNormal", "median": 0.1, "sigma": 0.7},
    },
)

# A hundred and twenty poses a recording, of a body with four times the elements; the zeros of its cables are unknown.
REST = Setting(
    commands=CommandsTable(
        duration=60.0, interval=2.0, step=0.005, low=0.0, high=0.01, sample_time=0.5, recordings=["any"]
    ),
    audited={"motion": "quasi-static"},
    made={"motion": "quasi-static", "refine": 4},
    priors={
        "young_modulus": {"distribution": "LogNormal", "median": 2e6, "sigma": 0.5},
        "initial_displacement": {"distribution": "Normal", "loc": 0.0, "scale": 5e-4},
    },
)


@dataclass(frozen=True)
class Condition:
    """One kind of data set: how many effects of which size, whether the library has them, whether the audit is given
    repeats, from which it takes the noise, whether markers share most of that, and whether the body is a mesh or at
    rest."""

    name: str
    effects: int
    rho: float
    removed: bool = False
    repeats: bool = True
    shared: bool = False
    mesh: bool = False
    rest: bool = False

    @property
    def right(self) -> tuple[str, ...]:
        """Verdicts that are right."""
        if self.effects == 0:
            return (NO_DISCREPANCY,)
        return (PARTLY, UNEXPLAINED, DESCRIBED) if self.removed else (EXPLAINED, EQUIVALENT)

    @property
    def setting(self) -> Setting:
        """Meshes and time steps; where nothing is to be found, such that they differ by a rho of at most .02."""
        if self.mesh:
            return MESH
        if self.rest:
            return REST
        if self.effects:
            return Setting()
        audited, made = {"refine": 4, "time_step": 0.005}, {"refine": 5, "time_step": 0.05 / 11}
        return Setting(audited=EARLIER | audited, made=EARLIER | made, shared=SHARED if self.shared else 0.0)


CONDITIONS = (
    Condition("null", 0, 0.0),
    Condition("rho_0.5", 1, 0.5),
    Condition("rho_0.15", 1, 0.15),
    Condition("two_effects_rho_1", 2, 1.0),
    Condition("removed_rho_0.5", 1, 0.5, removed=True),
    Condition("null_without_repeats", 0, 0.0, repeats=False),
    Condition("null_shared_noise", 0, 0.0, shared=True),
    Condition("null_mesh", 0, 0.0, mesh=True),
    Condition("rest_rho_0.5", 1, 0.5, rest=True),
    Condition("rest_rho_0.3", 1, 0.3, rest=True),
    Condition("null_rest", 0, 0.0, rest=True),
)


def run_study(
    out: Path,
    datasets: int,
    seed: int,
    *,
    conditions: Sequence[str] = (),
    mechanisms: Sequence[str] = (),
    exclude: Sequence[str] = (),
    cluster: str | None = None,
) -> dict[str, Any]:
    """Hide, audit and count; a data set that is already in the ledger is not run again.

    Args:
        out: folder for the ledger, audit_power.json and the table.
        datasets: per condition; 0 only counts what the ledger has.
        seed: of the study.
        conditions: names of `CONDITIONS`; all by default.
        mechanisms: that are hidden, by registry name; all by default.
        exclude: mechanisms that are neither hidden nor tried.
        cluster: see `run_fits`.

    Raises:
        InputError: an unknown condition or mechanism.
    """
    out = output_folder(out)
    chosen = _conditions(conditions)
    unknown = [name for name in [*mechanisms, *exclude] if name not in REGISTRY]
    if unknown:
        raise InputError(f"unknown mechanism {unknown[0]!r}", where="--hide")
    library = [name for name in (mechanisms or REGISTRY) if name not in exclude]
    jobs = [{"condition": c.name, "index": k, "seed": seed} for k in range(datasets) for c in chosen]
    one = partial(_one, library=library, exclude=list(exclude), folder=out / "data")
    try:
        with running(checks=True), Progress("audits", show=None) as progress:
            run_fits(jobs, one, out / LEDGER, resume=True, cluster=cluster, progress=progress)
    except KeyboardInterrupt:
        raise Interrupted(str(out), "") from None
    finally:  # a study that is interrupted counts what it has
        done = _kept(out / LEDGER, seed)
        content = {
            "seed": seed,
            "hours": round(sum(row["seconds"] for row in done) / 3600.0, 3),
            "core_hours": round(sum(row["core_seconds"] for row in done) / 3600.0, 3),
            "library": library,
            "excluded": list(exclude),
            "conditions": {c.name: summarise(c, _rows_of(c, done)) for c in chosen},
            "schema_version": 1,
        }
        write_json(out / RESULT, content)
        write_text(out / TABLE, as_table(content))
    return content


def _kept(ledger: Path, seed: int) -> list[dict[str, Any]]:
    """The data sets of a seed that are in the ledger."""
    rows = [{**row["job"], **row["result"]} for row in read_lines(ledger)]
    return [row for row in rows if row["seed"] == seed]


def _rows_of(condition: Condition, done: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The audits of a condition; those with the whole library that came before one with less are of the first kind."""
    before = [c.name for c in CONDITIONS if c.removed and replace(c, name=condition.name, removed=False) == condition]
    whole = [{**row, **row[WHOLE]} for row in done if row["condition"] in before]
    return [row for row in done if row["condition"] == condition.name] + whole


def _conditions(names: Sequence[str]) -> list[Condition]:
    known = {c.name: c for c in CONDITIONS}
    for name in names:
        if name not in known:
            raise InputError(f"unknown condition {name!r}", where="--condition", remedy=f"one of {', '.join(known)}")
    return [known[name] for name in names] if names else list(CONDITIONS)


_WORKSHOP: Workshop = {}  # of this process


def _one(job: Job, library: Sequence[str], exclude: Sequence[str], folder: Path) -> dict[str, Any]:
    """One data set: hidden, audited, judged."""
    condition, index = _conditions([job["condition"]])[0], int(job["index"])
    began, processor = time.monotonic(), time.process_time()
    place = folder / f"{condition.name}_{index}"
    number = int(np.random.SeedSequence([job["seed"], index, CONDITIONS.index(condition)]).generate_state(1)[0])
    turn = _turn(library, condition.effects, [job["seed"], CONDITIONS.index(condition)], index)
    hidden, names, unreached = _hidden(condition, turn, number, library, exclude, place, _WORKSHOP)
    given = [] if condition.repeats else [ONCE]
    model = Model.read(hidden.experiment, given)
    found = uninterrupted(audit(model, out=place / "audit", workshop=_WORKSHOP, overwrite=True))
    content, answer = found.content, found.answer
    assert answer is not None
    prior = answer.problem.coordinates.prior_deviations
    judged = {**judge(content, names, hidden, prior), "error_over_oracle": error_over_oracle(answer, names, hidden)}
    if condition.removed:
        # What the base model does is the same in both.
        shutil.copytree(place / "audit" / JOURNAL, place / "removed" / JOURNAL, dirs_exist_ok=True)
        less = [_without(content, names, exclude)]
        lacking = Model.read(hidden.experiment, less)
        content = uninterrupted(audit(lacking, out=place / "removed", workshop=_WORKSHOP, resume=True)).content
        judged = {**judge(content, names, hidden, prior), "error_over_oracle": None, WHOLE: judged}
    return {
        "hidden": names,
        "unreached": unreached,
        "rho": hidden.rho,
        "ideal": hidden.ideal,
        "truth": hidden.values,
        **judged,
        "seconds": round(time.monotonic() - began, 1),
        "core_seconds": round(time.process_time() - processor, 1),
    }


def _turn(library: Sequence[str], effects: int, seed: Sequence[int], index: int) -> list[str]:
    """The mechanisms of a data set: each of the library has its turn before any has its second."""
    places = range(index * effects, (index + 1) * effects)
    count = len(library)
    return [np.random.default_rng([*seed, p // count]).permutation(library)[p % count].item() for p in places]


def _hidden(
    condition: Condition,
    turn: Sequence[str],
    seed: int,
    library: Sequence[str],
    exclude: Sequence[str],
    place: Path,
    workshop: Workshop,
) -> tuple[Hidden, list[str], list[str]]:
    """A data set with the mechanisms whose turn it is, or with others at random where these cannot reach the size or
    their truth does not roll out; what is hidden; and what could not be."""
    rng = np.random.default_rng(seed)
    chosen, unreached = list(turn), list[str]()
    for _ in range(TRIES if condition.effects else 1):
        names = sorted(set(chosen), key=list(REGISTRY).index)
        if len(names) == condition.effects:
            found = hide(condition.setting, names, condition.rho, seed, place, exclude=exclude, workshop=workshop)
            if found is not None:
                return found, names, unreached
            unreached.append(" + ".join(names))
        chosen = rng.choice(library, condition.effects, replace=False).tolist()
    why = "no mechanism reaches the wanted size" if condition.effects else "the truth does not roll out"
    raise InputError(why, where=condition.name)


def _without(content: Mapping[str, Any], names: Sequence[str], exclude: Sequence[str]) -> str:
    """An override that takes the hidden mechanism, its family and its class out of the library."""
    alike = {c["mechanism"]: c["cosines"] for c in content["candidates"]}
    out = set(names) | set(exclude) | {FAMILIES[name] for name in names if name in FAMILIES}
    for name in names:
        out |= {pair["mechanism"] for pair in alike.get(name, []) if pair["cosine"] > 0.95}
    return f"audit.exclude={json.dumps(sorted(out & set(REGISTRY)))}"


def judge(
    content: Mapping[str, Any], names: Sequence[str], hidden: Hidden, prior: Mapping[str, float]
) -> dict[str, Any]:
    """What the audit said, against what is there.

    ``named_first``: the first finding is a hidden mechanism, or has it in its class. ``covered``: the 90 % interval of
    each parameter of a mechanism named itself holds the truth, in the identifiable form where there is one.
    ``undetermined``: those of them whose interval is the prior's rather than the data's. A hidden size is what reaches
    rho, not a draw from the prior, so that such an interval holds it or not as the prior happens to lie.

    Args:
        content: of audit.json.
        names: what is hidden.
        hidden: see `Hidden`.
        prior: standard deviations of the priors, by parameter.
    """
    findings = content["findings"]
    classes = [set(f["equivalence_class"]) for f in findings]
    covered, undetermined = {}, []
    for finding in findings:
        if finding["mechanism"] in names:
            forms = dict(finding["parameters"])
            for title, row in finding["relative"].items():
                name = row["parameter"]
                forms.pop(name, None)
                truth = hidden.values[name] * hidden.values[STIFFNESS] ** -row["power"]
                covered[title] = bool(row["q05"] <= truth <= row["q95"])
            covered |= {n: bool(r["q05"] <= hidden.values[n] <= r["q95"]) for n, r in forms.items()}
            undetermined += [n for n, row in forms.items() if row["sd"] > LEARNT * prior[n]]
    return {
        "verdict": content["verdict"],
        "named": [f["mechanism"] for f in findings],
        "class_sizes": [len(c) for c in classes],
        "named_first": bool(classes and any(n in classes[0] for n in names)),
        "all_named": bool(names) and all(any(n in c for c in classes) for n in names),
        "explained_fraction": content["gain"]["explained_fraction"] if content["gain"] else None,
        "covered": covered,
        "undetermined": undetermined,
        "law": (content.get("law") or {}).get("formula"),
        "audit_seconds": content["seconds"],
    }


def error_over_oracle(answer: Answer, names: Sequence[str], hidden: Hidden) -> float | None:
    """Root mean square error of the extended model against the noise-free truth of untouched commands, over that of the
    model that knows which mechanisms are hidden; None where nothing is hidden or named."""
    unseen, predictions = answer.validation.unseen, answer.validation.predictions
    if not names or predictions is None or unseen is None:
        return None
    problem, coordinates = answer.problem, answer.problem.coordinates
    own = [i for c in problem.candidates if c.name in names for i in c.indices]
    start = coordinates.encode(hidden.values)
    oracle = optimise(answer.target, start, np.array([*range(coordinates.base), *own]))
    untouched = range(len(problem.trajectories), len(problem.model.recordings.names))
    tested = measurements_of(problem, untouched)
    predicted = simulated(problem, False, tested, untouched).observe_one(oracle.x)["position"]

    def error(position: np.ndarray) -> float:
        return float(np.sqrt(np.mean((position - hidden.clean) ** 2)))

    return error(unseen.predicted(predictions[1])) / error(predicted.reshape(hidden.clean.shape))


def summarise(condition: Condition, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Counts over the data sets of one condition; ``confusions`` counts hidden -> named first."""
    verdicts: dict[str, int] = {}
    confusions: dict[str, int] = {}
    for row in rows:
        verdicts[row["verdict"]] = verdicts.get(row["verdict"], 0) + 1
        if row["hidden"] and not row["named_first"]:
            key = f"{' + '.join(row['hidden'])} -> {row['named'][0] if row['named'] else 'none'}"
            confusions[key] = confusions.get(key, 0) + 1
    covered = [value for row in rows for name, value in row["covered"].items() if name not in row["undetermined"]]
    every = [value for row in rows for value in row["covered"].values()]
    ratios = [r["error_over_oracle"] for r in rows if r["error_over_oracle"] is not None and r["named_first"]]
    sizes = [row["class_sizes"][0] for row in rows if row["class_sizes"]]
    ideal = [min(row["ideal"].values()) for row in rows if row.get("ideal")]
    return {
        "datasets": len(rows),
        "verdicts": verdicts,
        "right_verdict": sum(row["verdict"] in condition.right for row in rows),
        "unreached": sorted({name for row in rows for name in row["unreached"]}),
        "named_first": sum(row["named_first"] for row in rows),
        "ideal": float(np.mean(ideal)) if ideal else None,
        "all_named": sum(row["all_named"] for row in rows),
        "median_class_size": float(np.median(sizes)) if sizes else None,
        "intervals": [sum(covered), len(covered)],
        "intervals_of_undetermined_sizes": [sum(every) - sum(covered), len(every) - len(covered)],
        "within_1.3_of_the_oracle": float(np.mean(np.array(ratios) <= NEAR)) if ratios else None,
        "discretisation_rho": [round(row["rho"]["discretisation"], 4) for row in rows],
        "median_audit_seconds": float(np.median([row["audit_seconds"] for row in rows])) if rows else None,
        "confusions": confusions,
    }


def as_table(content: Mapping[str, Any]) -> str:
    """The study as a Markdown table."""
    without = ", ".join(content["excluded"]) or "none"
    lines = [
        f"Seed {content['seed']}; {content['hours']} hours, {content['core_hours']} of them processor time; mechanisms "
        f"neither hidden nor tried: {without}. In brackets: exact 95 % intervals of the rates, in %.",
        "",
        "| condition | data sets | verdicts | right verdict | named first | found by an ideal test | all named | "
        "median class | 90 % intervals cover | error within 1.3 of the oracle's | largest discretisation rho |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, row in content["conditions"].items():
        verdicts = ", ".join(f"{verdict} {count}" for verdict, count in sorted(row["verdicts"].items()))
        share = "{} of {}".format(*row["intervals"]) if row["intervals"][1] else "-"
        near = "-" if row["within_1.3_of_the_oracle"] is None else f"{100 * row['within_1.3_of_the_oracle']:.0f} %"
        ideal = "-" if row["ideal"] is None else f"{100 * row['ideal']:.0f} %"
        rho = max(row["discretisation_rho"], default=0.0)
        right, first, every = (_rate(row, key) for key in ("right_verdict", "named_first", "all_named"))
        lines.append(
            f"| {name} | {row['datasets']} | {verdicts} | {right} | {first} | {ideal} | {every} | "
            f"{row['median_class_size'] or '-'} | {share} | {near} | {rho:.3f} |"
        )
    confusions = ((name, row["confusions"]) for name, row in content["conditions"].items())
    wrong = [f"- {name}: {pair} ({count})" for name, pairs in confusions for pair, count in pairs.items()]
    return "\n".join([*lines, "", "Not named first (hidden -> named):", "", *(wrong or ["- none"])]) + "\n"


def _rate(row: Mapping[str, Any], what: str) -> str:
    """A count with its exact binomial interval."""
    if row["datasets"] == 0:
        return "-"
    interval = binomtest(row[what], row["datasets"]).proportion_ci(0.95, "exact")
    return f"{row[what]} [{100 * interval.low:.0f}, {100 * interval.high:.0f}]"
