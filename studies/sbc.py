"""Simulation-based calibration: does a method return the posterior, on data of which the truth is known?

Truths are drawn from the prior, data from the model; the rank of each truth among the draws of its posterior is then
uniform if the posterior is right (Talts et al. 2018). The rank of the log likelihood, a function of parameters and of
data, finds what the parameters' own ranks cannot, such as a method that returns the prior (Modrak et al. 2023).
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray
from scipy.stats import chisquare

from rfdropo_bayes.bayes.problem import Problem
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import append_line, read_lines, write_text
from rfdropo_bayes.inference import methods
from rfdropo_bayes.inference.progress import Progress, run_digest
from rfdropo_bayes.posteriors import central_interval

DRAWS = 99  # of each posterior, thinned: ranks run from 0 to 99
BINS = 10
LOG_LIKELIHOOD = "log_likelihood"
SIGNIFICANT = 0.01
COVERED = (0.85, 0.95)  # of the 90 % intervals, all parameters together
UNINFORMED = 0.95  # posterior over prior deviation from which on a parameter counts as unchanged

Simulate = Callable[[PRNGKeyArray], tuple[dict[str, float], Problem, int]]


@dataclass(frozen=True)
class SbcRanks:
    """Ranks of one quantity over all data sets.

    Attributes:
        ranks: 0 to `DRAWS`.
        p: of a chi-squared test of their uniformity; p_adjusted: by Holm over all quantities.
        coverage: share of 90 % intervals that hold the truth; None for the log likelihood.
        contraction: mean ratio of posterior to prior deviation, unconstrained; None for the log likelihood.
    """

    ranks: Int[np.ndarray, " n"]
    p: float
    p_adjusted: float
    coverage: float | None
    contraction: float | None


@dataclass(frozen=True)
class SbcResult:
    """Result of the check.

    Attributes:
        checks: by parameter, and of the log likelihood.
        datasets: number of data sets; failed_truths: prior draws whose rollout failed, and were drawn again.
        coverage: of the 90 % intervals of all parameters.
        passed: every adjusted p above 0.01, the coverage within 85-95 % (or what so few data sets scatter to), and a
            posterior that differs from the prior.
        sentence: the same in words.
    """

    checks: dict[str, SbcRanks]
    datasets: int
    failed_truths: int
    coverage: float
    passed: bool
    sentence: str
    rollouts: float = 0.0
    seconds: float = 0.0
    details: dict[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        checks = {
            name: {
                "ranks": check.ranks.tolist(),
                "p": check.p,
                "p_adjusted": check.p_adjusted,
                "coverage_90": check.coverage,
                "contraction": check.contraction,
            }
            for name, check in self.checks.items()
        }
        rest = ("datasets", "failed_truths", "coverage", "passed", "sentence", "rollouts", "seconds", "details")
        return {"schema_version": 1, "quantities": checks, **{name: getattr(self, name) for name in rest}}


def calibrate(
    problem: Problem,
    simulate: Simulate,
    method: str,
    options: Mapping[str, Any] | Any,
    key: PRNGKeyArray,
    datasets: int,
    *,
    log: Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> SbcResult:
    """Check a method.

    Args:
        problem: for its prior and names.
        simulate: from a key to a truth, the problem with data simulated from it, and the failures on the way.
        method, options: as in `methods.run`.
        key: random key; data set i depends on it and on i alone.
        datasets: number of data sets.
        log: file that gets one JSON line per data set.
        resume: keep the data sets that ``log`` has already.
        progress: where to report.

    Raises:
        InputError: fewer than 20 data sets, or a log of another check.
    """
    if datasets < 20:
        raise InputError(f"{datasets} data sets show nothing", where="--datasets", remedy="ask for 20 at least")
    prior_key, data_key = jax.random.split(key)
    prior = np.asarray(problem.to_unconstrained(problem.sample_prior(prior_key, 2000)), dtype=float)
    settings = sorted(options.items()) if isinstance(options, Mapping) else options
    digest = run_digest(problem, f"sbc {method}", settings, key)
    rows = _known(log, digest, resume)[:datasets]
    for index in range(len(rows), datasets):
        began = time.monotonic()
        row = _one(simulate, method, options, jax.random.fold_in(data_key, index), prior.std(axis=0))
        rows.append({**row, "seconds": time.monotonic() - began})
        if log is not None:
            append_line(log, json.dumps({"digest": digest, **rows[-1]}))
        if progress is not None:
            progress.stage((index + 1) / datasets, method="sbc", dataset=index, rollouts=row["rollouts"])
    return _judge(problem.names, rows)


def _known(log: Path | None, digest: str, resume: bool) -> list[dict[str, Any]]:
    """Data sets that the log holds, which is cleared of all else."""
    if log is None or not log.exists():
        return []
    rows = read_lines(log) if resume else []
    if any(row["digest"] != digest for row in rows):
        raise InputError("belongs to another check", where=str(log), remedy="start without --resume")
    write_text(log, "".join(json.dumps(row) + "\n" for row in rows))
    return [{name: value for name, value in row.items() if name != "digest"} for row in rows]


def _one(
    simulate: Simulate, method: str, options: Any, key: PRNGKeyArray, prior_sd: Float[np.ndarray, " d"]
) -> dict[str, Any]:
    """Ranks, coverage and contraction of one data set."""
    data_key, fit_key, thin_key = jax.random.split(key, 3)
    truth, problem, failed = simulate(data_key)
    result = methods.run(problem, method, options, fit_key)
    flat = {name: np.asarray(result.draws[name]).reshape(-1) for name in problem.names}
    size = len(flat[problem.names[0]])
    index = np.asarray(jax.random.choice(thin_key, size, (DRAWS,), replace=size < DRAWS))
    with_truth = {name: np.append(column[index], truth[name]) for name, column in flat.items()}
    density = np.asarray(problem.row_log_likelihood(with_truth, problem.n_rows)[0]).sum(axis=1)
    ranks = {name: int(np.sum(with_truth[name][:-1] < truth[name])) for name in problem.names}
    ranks[LOG_LIKELIHOOD] = int(np.sum(density[:-1] < density[-1]))
    inside = {}
    for name, column in flat.items():
        low, high = central_interval(column)
        inside[name] = bool(low <= truth[name] <= high)
    spread = np.asarray(problem.to_unconstrained(flat), dtype=float).std(axis=0) / prior_sd
    contraction = dict(zip(problem.names, spread.tolist(), strict=True))
    return {
        "truth": truth,
        "ranks": ranks,
        "inside": inside,
        "contraction": contraction,
        "rollouts": float(result.rollouts),
        "failed": failed,
    }


def _judge(names: tuple[str, ...], rows: list[dict[str, Any]]) -> SbcResult:
    quantities = (*names, LOG_LIKELIHOOD)
    ranks = {name: np.array([row["ranks"][name] for row in rows]) for name in quantities}
    raw = {name: uniformity(values) for name, values in ranks.items()}
    adjusted = holm(raw)
    inside = {name: float(np.mean([row["inside"][name] for row in rows])) for name in names}
    spread = {name: float(np.mean([row["contraction"][name] for row in rows])) for name in names}
    checks = {
        name: SbcRanks(ranks[name], raw[name], adjusted[name], inside.get(name), spread.get(name))
        for name in quantities
    }
    coverage = float(np.mean(list(inside.values())))
    # Intervals of one data set go together: the scatter is that of `datasets` draws, not of each parameter's.
    scatter = 2.6 * np.sqrt(0.09 / len(rows))
    covered = min(COVERED[0], 0.9 - scatter) <= coverage <= max(COVERED[1], 0.9 + scatter)
    covered, informed = bool(covered), min(spread.values()) < UNINFORMED
    uneven = [name for name, p in adjusted.items() if p <= SIGNIFICANT]
    passed = covered and informed and not uneven
    problems = [
        *([f"ranks of {', '.join(uneven)} are not uniform"] if uneven else []),
        *([] if covered else [f"90 % intervals hold {100 * coverage:.0f} % of the truths"]),
        *([] if informed else ["the posterior is the prior"]),
    ]
    sentence = (
        f"Calibrated on {len(rows)} data sets: ranks are uniform (smallest adjusted p {min(adjusted.values()):.2g}), "
        f"90 % intervals hold {100 * coverage:.0f} % of the truths."
        if passed
        else f"NOT calibrated on {len(rows)} data sets: {'; '.join(problems)}."
    )
    totals = {name: sum(row[name] for row in rows) for name in ("rollouts", "seconds", "failed")}
    return SbcResult(
        checks, len(rows), int(totals["failed"]), coverage, passed, sentence, totals["rollouts"], totals["seconds"]
    )


def uniformity(ranks: Int[np.ndarray, " n"]) -> float:
    """p value of a chi-squared test that ranks 0 ... `DRAWS` are uniform, in bins that expect five or more."""
    bins = int(np.clip(len(ranks) // 5, 2, BINS))
    counts, _ = np.histogram(ranks, bins=bins, range=(-0.5, DRAWS + 0.5))
    return float(chisquare(counts).pvalue)


def holm(p: Mapping[str, float]) -> dict[str, float]:
    """Holm's adjusted p values."""
    ordered = sorted(p, key=lambda name: p[name])
    adjusted, running = {}, 0.0
    for index, name in enumerate(ordered):
        running = max(running, min(1.0, (len(ordered) - index) * p[name]))
        adjusted[name] = running
    return {name: adjusted[name] for name in p}
