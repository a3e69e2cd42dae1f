"""How often 90 % intervals of an effect's size hold the truth, if the right mechanism is in the model; resumable.

    python benchmarks/size_coverage.py [--datasets 100] [--rho 0.5] [--seed 0] [--made finer|same]
                                       [--noise repeats|known] [--out reports/size_coverage]

Every data set has one effect of the library in it, as in the study of audits (`studies/hidden_effects.py`). Nothing is
looked for: base parameters and the effect's own are climbed together from the truth, so that what is left to go wrong
is the interval itself. ``--made same`` takes the mesh and time step of the fit for the data, too, and ``--noise known``
the noise that made them: each takes one reason for misses away. Deviations are those that an audit reports, with forces
and masses over Young's modulus.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

import rfdropo_bayes as rb
from rfdropo_bayes.bayes.noise.autoregression import STATED, Autoregression
from rfdropo_bayes.bayes.noise.stacked import Stacked
from rfdropo_bayes.discrepancy.audit_record import STIFFNESS, relative_sizes
from rfdropo_bayes.discrepancy.base_fit import first_target
from rfdropo_bayes.discrepancy.coordinates import Coordinates
from rfdropo_bayes.discrepancy.fit import Fit, optimise, widened
from rfdropo_bayes.discrepancy.journal import Journal
from rfdropo_bayes.files import append_line, read_lines
from rfdropo_bayes.mechanisms import REGISTRY
from rfdropo_bayes.model.experiment import AuditTable
from rfdropo_bayes.verbs.audit import Workshop, build_problem
from studies.hidden_effects import MEMORY, NOISE, Hidden, Setting, hide

WITHIN = 1.645  # deviations of a normal to the ends of its central 90 %
LEARNT = 0.5  # of a prior's deviation that a size is known better than, to count


def one(name: str, number: int, given: argparse.Namespace, workshop: Workshop) -> dict[str, Any]:
    """One data set: deviations of the sizes from the truth, in the deviations that are reported."""
    setting = Setting() if given.made == "finer" else replace(Setting(), made=Setting().audited)
    began = time.process_time()
    place = given.out / "data" / f"{name.replace(' ', '_')}_{number}"
    hidden = hide(setting, [name], given.rho, number, place, workshop=workshop)
    if hidden is None:
        return {"verdict": "no size reaches this rho, or the truth does not roll out"}
    model = rb.Model.read(hidden.experiment)
    runs, test = model.runs(None, ())
    problem = build_problem(model.spec, AuditTable(), runs, test, number, workshop=workshop)
    target = first_target(problem, Journal())
    estimated = [float(np.mean(part.scale)) for part in target.noise.parts]
    if given.noise == "known":
        widths = [len(part.scale) for part in target.noise.parts]
        parts = (Autoregression(np.full(n, NOISE), np.array([1.0, MEMORY]), STATED, np.inf) for n in widths)
        target = replace(target, noise=Stacked(tuple(parts)))
    own = [i for c in problem.candidates if c.name == name for i in c.indices]
    free = np.array([*range(problem.coordinates.base), *own])
    fit = optimise(target, problem.coordinates.encode(hidden.values), free)
    sizes = widened(target, fit)
    rows = [row for i in own if (row := deviation(problem.coordinates, sizes, i, hidden))]
    done = {"converged": fit.converged, "discretisation": hidden.rho["discretisation"], "estimated": estimated}
    return {**done, "misfit": float(np.mean(fit.residual**2)), "sizes": rows, "cpu": time.process_time() - began}


def deviation(coordinates: Coordinates, fit: Fit, index: int, hidden: Hidden) -> dict[str, Any] | None:
    """A size less its truth in its deviations, as an audit reports it; None if the data hardly say it."""
    name, k = coordinates.names[index], list(fit.free).index(index)
    row = next(iter(relative_sizes(coordinates, fit, [index]).values()), None)
    if row is not None:
        truth = hidden.values[name] * hidden.values[STIFFNESS] ** -row["power"]
        return {"name": name, "deviations": (row["mean"] - truth) / row["sd"], "sd": row["sd"]}
    sd = float(np.sqrt(fit.covariance[k, k]))
    if sd > LEARNT * coordinates.prior_sd[index]:
        return None
    return {"name": name, "deviations": float(fit.x[index] - coordinates.encode(hidden.values)[index]) / sd, "sd": sd}


def main() -> None:
    """Run what the ledger lacks, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--datasets", type=int, default=100)
    parser.add_argument("--rho", type=float, default=0.5)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--made", choices=["finer", "same"], default="finer")
    parser.add_argument("--noise", choices=["repeats", "known"], default="repeats")
    parser.add_argument("--out", type=Path, default=Path("reports/size_coverage"))
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    ledger = given.out / "ledger.jsonl"
    lines = read_lines(ledger)
    kind = {"rho": given.rho, "seed": given.seed, "made": given.made, "noise": given.noise}
    known = {line["index"] for line in lines if all(line[key] == value for key, value in kind.items())}
    workshop: Workshop = {}
    names = list(REGISTRY)
    for index in range(given.datasets):
        if index in known:
            continue
        rng = np.random.default_rng([given.seed, index // len(names)])
        name = rng.permutation(names)[index % len(names)].item()
        number = int(np.random.SeedSequence([given.seed, index]).generate_state(1)[0])
        lines.append({**kind, "index": index, "effect": name, **one(name, number, given, workshop)})
        append_line(ledger, json.dumps(lines[-1]))
        print(f"{index} {name}: {[round(row['deviations'], 2) for row in lines[-1].get('sizes', [])]}", flush=True)
    show(lines)


def show(lines: list[dict[str, Any]]) -> None:
    """A row for every kind of data set."""
    print("\n| rho | data from | noise | data sets | sizes | intervals hold, 95 % interval | deviations, rms | mean |")
    print("|---|---|---|---|---|---|---|---|")
    for kind in sorted({(line["rho"], line["made"], line["noise"]) for line in lines}):
        own = [line for line in lines if (line["rho"], line["made"], line["noise"]) == kind]
        away = np.array([row["deviations"] for line in own for row in line.get("sizes", [])])
        if not len(away):
            continue
        held = int(np.sum(np.abs(away) <= WITHIN))
        ends = binomtest(held, len(away)).proportion_ci(0.95, method="exact")
        words = [*kind, len(own), len(away), f"{held} [{100 * ends.low:.0f}, {100 * ends.high:.0f}] %"]
        print(f"| {' | '.join(map(str, words))} | {np.sqrt(np.mean(away**2)):.2f} | {np.mean(away):.2f} |")


if __name__ == "__main__":
    main()
