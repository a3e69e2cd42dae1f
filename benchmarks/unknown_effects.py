"""How often an audit says where an effect enters that the library lacks, and by what law; resumable.

    python benchmarks/unknown_effects.py [--out reports/unknown_effects] [--effects crosstalk,bouc_wen] [--seeds 0,1]
                                         [--rho 1.0] [--null 0] [--alone | --force] [--body arm]

Effects are those of `studies/unknown_effects.py`, hidden in recordings of the arm, or, with
``--body mesh``, of SOFA's trunk on its own mesh, whose data and audits have one mesh and one time step; ``--null`` is
the number of data sets with nothing hidden. A line of the ledger for each data set: verdict, port, law, unseen errors,
and seconds. All share compiled simulators. A data set in the ledger is not run again. One takes one to four minutes on
two cores.

``--alone`` leaves all candidates of the library out: laws at ports are all that may be named. That takes a third of the
time, and does not say whether a candidate of the library would have stood in.

``--force`` looks for laws in data sets with nothing hidden, whatever the joint test and the ports say. Lines have the
largest gain of any feature at any port, the gate, and whether a term joined.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

import rfdropo_bayes as rb
from rfdropo_bayes.discrepancy.base_fit import base_model
from rfdropo_bayes.discrepancy.law_search import law_search
from rfdropo_bayes.discrepancy.verdict import DESCRIBED
from rfdropo_bayes.files import append_line, read_lines
from rfdropo_bayes.model.experiment import AuditTable
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.verbs.audit import Workshop, build_problem
from studies.audit_study import MESH
from studies.hidden_effects import Setting
from studies.unknown_effects import EFFECTS, FOREIGN, conceal

ALL, NONE, FORCED = "all", "none", "forced"
WITHIN = 1.15  # of the noise, an unseen error counts as explained
ARM = "arm"
BODIES = {ARM: Setting(), "mesh": MESH}

Case = tuple[str, float, int, str, str]  # effect, rho, seed, library, body


def one(case: Case, folder: Path, workshop: Workshop) -> dict[str, Any]:
    """A data set, audited with a library of all candidates or none."""
    name, rho, seed, library, body = case
    line: dict[str, Any] = {"effect": name, "rho": rho, "seed": seed, "library": library, "body": body}
    place = folder / f"{'' if body == ARM else f'{body}_'}{name or 'nothing'}_{rho:g}_{seed}"
    hidden = conceal(name, rho, seed, place, setting=BODIES[body], workshop=workshop)
    if hidden is None:
        return {**line, "verdict": "no size reaches this rho"}
    model = rb.Model.read(hidden.experiment)
    if library == FORCED:
        return line | forced_search(model, seed, workshop)
    unseen = rb.read(str(hidden.experiment.parent / "test_*.nc"), format="netcdf")
    began, used = time.monotonic(), time.process_time()
    # How busy the machine is must not change a line.
    options = rb.AuditOptions(library=library == ALL, minutes=float("inf"))
    found = rb.audit(model, options=options, test=unseen, seed=seed, workshop=workshop)
    line |= {"size": hidden.size, "verdict": found.verdict, "sentence": found.sentence}
    line |= {"law": found.content["law"], "findings": [row["mechanism"] for row in found.content["findings"]]}
    line |= {"seconds": round(time.monotonic() - began, 1), "cpu_seconds": round(time.process_time() - used, 1)}
    line |= {"profile": found.content["profile"], "ports": leading_ports(found.content["ports"])}
    line |= {"null_quantile_nats": (found.content["ports"] or {}).get("null_quantile_nats")}
    return line | judged(line, name, noise_of(unseen, hidden.clean))


def forced_search(model: rb.Model, seed: int, workshop: Workshop) -> dict[str, Any]:
    """What a search for laws finds where nobody would have asked for one."""
    began = time.process_time()
    problem = build_problem(model.spec, AuditTable(), model.runs(None, ())[0], [], seed, workshop=workshop)
    assert problem.ports is not None
    target, base = base_model(problem, seed)
    simulator: Any = problem.lanes.simulator
    channels, unit = simulator.channel_names, simulator.command_unit
    search = law_search(target, problem.ports, channels, unit, seed, problem.rules.family, lambda line: None)
    found = search.find(target, base, forced=True)
    terms = [[refit.term.port.name, refit.term.feature.formula(channels), refit.score] for refit in found.terms]
    numbers = {"port_p": found.ports[0].adjusted_p, "null_quantile_nats": found.null_quantile}
    seconds = round(time.process_time() - began, 1)
    return {"verdict": "a law" if terms else "no law", **numbers, "terms": terms, "cpu_seconds": seconds}


def noise_of(unseen: Sequence[rb.Trajectory], clean: np.ndarray) -> float:
    """Root mean square distance [mm] by which noise moved the markers."""
    apart = np.stack([recording.position for recording in unseen]) - clean
    return float(1e3 * np.sqrt(3.0 * np.nanmean(apart**2)))


def robot_of(line: dict[str, Any]) -> Robot:
    """The robot of a line's recordings."""
    return Robot.load(BODIES[line["body"]].robot)


def leading_ports(ports: dict[str, Any] | None) -> list[list[Any]]:
    """The first ports by evidence, with their log evidences."""
    return [[row["port"], round(row["log_evidence"], 1)] for row in (ports or {"ports": []})["ports"][:5]]


def judged(line: dict[str, Any], name: str, noise: float) -> dict[str, Any]:
    """Whether port and law of a line are right, and the unseen error over the noise.

    A port is right if the law acts there, or at a port that the law's ties list. A law is right if its first term has
    a kind of feature that says the effect.
    """
    effect, law = (EFFECTS | FOREIGN).get(name), line["law"]
    if effect is None or law is None or line["verdict"] != DESCRIBED:
        return {"port_right": False, "law_right": False} if effect else {}
    ports, right = [law["port"], *(tie["port"] for tie in law["ties"])], effect.ports_of(robot_of(line))
    return {
        "port_right": any(port in right for port in ports),
        "law_right": law["terms"][0]["feature"] in effect.leading,
        "unseen_over_noise": round(law["rmse_after_mm"] / noise, 3),
    }


def main() -> None:
    """Run what the ledger lacks, and print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("reports/unknown_effects"))
    parser.add_argument("--effects", default=",".join(EFFECTS))
    parser.add_argument("--seeds", default="0,1")
    parser.add_argument("--rho", type=float, default=1.0)
    parser.add_argument("--null", type=int, default=0)
    parser.add_argument("--body", choices=BODIES, default=ARM)
    kinds = parser.add_mutually_exclusive_group()
    kinds.add_argument("--alone", action="store_const", const=NONE, default=ALL, dest="library")
    kinds.add_argument("--force", action="store_const", const=FORCED, dest="library")
    given = parser.parse_args()
    cases: list[Case] = [("", 0.0, seed, given.library, given.body) for seed in range(given.null)]
    cases += [
        (name, given.rho, int(seed), given.library, given.body)
        for seed in given.seeds.split(",")
        for name in given.effects.split(",")
        if name and given.library != FORCED
    ]
    given.out.mkdir(parents=True, exist_ok=True)
    ledger = given.out / "ledger.jsonl"
    lines = read_lines(ledger)
    known = {(*(line[key] for key in ("effect", "rho", "seed", "library")), line.get("body", ARM)) for line in lines}
    workshop: Workshop = {}
    for case in cases:
        if case not in known:
            lines.append(one(case, given.out / "data", workshop))
            append_line(ledger, json.dumps(lines[-1]))
            print(f"{case[0] or 'nothing'} {case[2]}: {lines[-1]['verdict']}", flush=True)
    for library in (ALL, NONE):
        show(library, [line for line in lines if line["library"] == library])
    show_forced([line for line in lines if line["library"] == FORCED])


def show(library: str, lines: Sequence[dict[str, Any]]) -> None:
    """A table of the data sets, and rates with exact 95 % intervals (Clopper and Pearson)."""
    print(f"\nlibrary: {library}\n\n| hidden | seed | verdict | port right | law right | unseen over noise | CPU s |")
    print("|---|---|---|---|---|---|---|")
    for line in lines:
        marks = [{True: "yes", False: "no", None: "-"}[line.get(key)] for key in ("port_right", "law_right")]
        numbers = [line.get(key, "-") for key in ("unseen_over_noise", "cpu_seconds")]
        words = [line["effect"] or "nothing", line["seed"], line["verdict"], *marks, *numbers]
        print("| " + " | ".join(map(str, words)) + " |")
    hidden, nothing = [line for line in lines if line["effect"]], [line for line in lines if not line["effect"]]
    rate("port right", [line.get("port_right", False) for line in hidden])
    rate("law right", [line.get("law_right", False) for line in hidden])
    rate("unseen error within 15 % of the noise", [line.get("unseen_over_noise", np.inf) <= WITHIN for line in hidden])
    rate("described where nothing is hidden", [line["verdict"] == DESCRIBED for line in nothing])


def show_forced(lines: Sequence[dict[str, Any]]) -> None:
    """What forced searches found where nothing is hidden."""
    print("\n| seed | smallest p of a port | gate [nat] | terms | CPU s |")
    print("|---|---|---|---|---|")
    for line in lines:
        terms = "; ".join(f"{formula} at {port}" for port, formula, _ in line["terms"]) or "none"
        gate = f"{line['null_quantile_nats']:.1f}"
        print(f"| {line['seed']} | {line['port_p']:.2g} | {gate} | {terms} | {line['cpu_seconds']} |")
    rate("a term joined", [bool(line["terms"]) for line in lines])


def rate(words: str, marks: Sequence[bool]) -> None:
    """A rate in words."""
    if marks:
        ends = binomtest(sum(marks), len(marks)).proportion_ci(0.95, method="exact")
        print(f"{words}: {sum(marks)} of {len(marks)} [{100 * ends.low:.0f}, {100 * ends.high:.0f}] %")


if __name__ == "__main__":
    main()
