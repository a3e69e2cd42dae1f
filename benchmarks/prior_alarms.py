"""How often an audit cautions that a prior decides a parameter of the base model, where nothing is wrong.

    python benchmarks/prior_alarms.py [--datasets 10] [--seed 7] [--spread 0.3] [--out reports/audit_power/prior_alarms]

Data sets of the study of audits' power with nothing hidden (`python -m studies audit`, condition null). The base model
is fitted under the known noise, from the truth on, and cautioned about as at an audit's end; no candidate is screened.
``spread`` is how far truths lie from the middle of their priors, in deviations of these: the study's 0.3, or 1 for
truths as the priors have them. A line of the ledger for each data set; one that is in it is not fitted again.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from rfdropo_bayes.bayes.noise.autoregression import STATED, Autoregression
from rfdropo_bayes.bayes.noise.stacked import Stacked
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.discrepancy.audit_problem import measurements_of, simulated
from rfdropo_bayes.discrepancy.fit import FitTarget, optimise
from rfdropo_bayes.discrepancy.prior_ends import decided_by_priors
from rfdropo_bayes.files import read_lines
from rfdropo_bayes.model.experiment import AuditTable
from rfdropo_bayes.model.model_spec import spec_of
from rfdropo_bayes.verbs.audit import Workshop, build_problem
from studies.fits import Job, run_fits
from studies.hidden_effects import MEMORY, NOISE, REPEATS, Setting, experiment_tables, hide

DRAWS = 1000  # as many as an audit's
_WORKSHOP: Workshop = {}  # of this process


def alarmed(job: Job, spread: float) -> dict[str, Any]:
    """Cautions about one data set, and where the base parameters are: truth, median and deviation."""
    began, setting, seed = time.process_time(), Setting(spread=spread), [int(job["seed"]), int(job["index"])]
    number = int(np.random.SeedSequence(seed).generate_state(1)[0])
    with tempfile.TemporaryDirectory() as place:
        hidden = hide(setting, [], 0.0, number, Path(place), workshop=_WORKSHOP)
        assert hidden is not None
        names = [*(f"fit_{k + 1}" for k in range(REPEATS)), "screen"]
        fitted = [Trajectory.load(Path(place) / f"{name}.nc") for name in names]
        spec = spec_of(experiment_tables(setting), Path(place))
        problem = build_problem(spec, AuditTable(), fitted, [], number, workshop=_WORKSHOP)
    measurements = measurements_of(problem, range(len(fitted)), fitted)
    forward = simulated(problem, False, measurements, [group[0] for group in measurements.members])
    widths = [channel.valid.shape[-1] for channel in measurements.channels]
    noise = [Autoregression(np.full(n, NOISE), np.array([1.0, MEMORY]), STATED, np.inf) for n in widths]
    target, own = FitTarget(forward, measurements, Stacked(tuple(noise))), problem.coordinates
    fit = optimise(target, own.encode(hidden.values), np.arange(own.base))
    draws = fit.draws(np.random.default_rng(number), DRAWS, *own.bounds)
    values = own.values(draws)[:, : own.base]
    return {
        "cautions": [caution.sentence for caution in decided_by_priors(target, draws)],
        "converged": fit.converged,
        "parameters": {
            name: [hidden.values[name], float(np.median(column)), float(np.std(column))]
            for name, column in zip(own.names[: own.base], values.T, strict=True)
        },
        "core_seconds": round(time.process_time() - began, 1),
    }


def told(rows: Sequence[dict[str, Any]], spread: float) -> str:
    """How many of the data sets were cautioned about."""
    count = sum(bool(row["cautions"]) for row in rows)
    interval = binomtest(count, len(rows)).proportion_ci(0.95, "exact")
    share = f"[{100 * interval.low:.0f}, {100 * interval.high:.0f}] %"
    return f"truths within {spread:g} of a prior deviation: {count} of {len(rows)} cautioned about, {share}"


def main() -> None:
    """Fit what the ledger lacks, and count."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--datasets", type=int, default=10)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--spread", type=float, default=0.3)
    parser.add_argument("--out", type=Path, default=Path("reports/audit_power/prior_alarms"))
    given = parser.parse_args()
    jobs = [{"seed": given.seed, "index": k, "spread": given.spread} for k in range(given.datasets)]
    run_fits(jobs, partial(alarmed, spread=given.spread), given.out / "alarms.jsonl", resume=True)
    kept = [{**row["job"], **row["result"]} for row in read_lines(given.out / "alarms.jsonl")]
    for spread in sorted({row["spread"] for row in kept}):
        rows = [row for row in kept if row["spread"] == spread]
        print(told(rows, spread))
        print(json.dumps([sentence for row in rows for sentence in row["cautions"]]))


if __name__ == "__main__":
    main()
