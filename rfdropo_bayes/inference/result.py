"""What every inference method returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.problem import Problem

Draws = dict[str, Float[np.ndarray, "chain draw"]]


@dataclass(frozen=True)
class InferenceResult:
    """Draws of equal weight, and how they came about.

    Attributes:
        method: registry name of the method.
        draws: one array (chain, draw) per parameter, physical units; independent repetitions are chains.
        log_evidence: value and standard deviation in nats, or None; the deviation is NaN where nothing measures it.
        prefix_log_evidence: log p(first h rows) for h = 1 ... n_rows, NaN where the method did not pass h; or None.
        block_scores: prequential scores: per block ``first_row``, ``last_row`` (1-based, inclusive), ``log_score`` =
            log p(block | rows before it) and its ``sd`` over repetitions.
        log_likelihood: (chain, draw, row) log density of each row at each draw, or None.
        trace: one dictionary per stage.
        rollouts: full-length equivalents used; evaluations: parameter sets tried.
        excluded: parameter sets that got no weight, by reason.
        warnings: sentences for the report.
        seconds: time spent, earlier parts of a resumed run included.
        phi: distribution to randomise over, {name: {mean, std, low, high, unit}}, of RF-DROPO; else None.
        optimum: posterior mode {name: value} where the method finds one; else None.
        details: further numbers of the method, plain values.
    """

    method: str
    draws: Draws
    log_evidence: tuple[float, float] | None = None
    prefix_log_evidence: Float[np.ndarray, " n_rows"] | None = None
    block_scores: list[dict[str, Any]] = field(default_factory=list)
    log_likelihood: Float[np.ndarray, "chain draw row"] | None = None
    trace: list[dict[str, Any]] = field(default_factory=list)
    rollouts: float = 0.0
    evaluations: int = 0
    excluded: dict[str, int] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    seconds: float = 0.0
    phi: dict[str, dict[str, Any]] | None = None
    optimum: dict[str, float] | None = None
    details: dict[str, Any] = field(default_factory=dict)


def chains(problem: Problem, positions: list[np.ndarray]) -> Draws:
    """Unconstrained draws, one array per chain, as named values in physical units."""
    values = [problem.from_unconstrained(jnp.asarray(u)) for u in positions]
    return {name: np.stack([np.asarray(v[name], dtype=float) for v in values]) for name in problem.names}


def bound_warnings(
    draws: Mapping[str, np.ndarray],
    bounds: Mapping[str, tuple[float, float]],
    *,
    edge: float = 0.01,
    share: float = 0.1,
    reached: float = 4.0,
) -> list[str]:
    """A sentence for every parameter with more than ``share`` of its draws within ``edge`` of its range from a bound,
    and that bound within ``reached`` standard deviations.

    Draws that pile up on a bound say that the bound, not the data, decides: a uniform posterior has 1 % there. Bounds
    that lie decades apart are compared in logarithms: a linear range would put every ordinary value at the lower one.
    """
    sentences = []
    for name, values in draws.items():
        low, high = bounds[name]
        if not np.isfinite(high - low):
            continue
        if low > 0.0 and high > 100.0 * low:
            values, start, end = np.log(values), np.log(low), np.log(high)
        else:
            start, end = low, high
        reach = edge * (end - start)
        away, spread = np.mean(values), reached * np.std(values)
        for side, near, gap in (
            ("lower", values < start + reach, away - start),
            ("upper", values > end - reach, end - away),
        ):
            if np.mean(near) > share and gap < spread:
                bound = low if side == "lower" else high
                sentences.append(
                    f"{name} sits on its {side} bound {bound:g}: {np.mean(near):.0%} of the draws are there"
                )
    return sentences


def exclusion_warnings(excluded: Mapping[str, int], evaluations: int, *, share: float = 0.05) -> list[str]:
    """A sentence where more than ``share`` of the rollouts had to be left out."""
    total = sum(excluded.values())
    if evaluations == 0 or total / evaluations <= share:
        return []
    reasons = ", ".join(f"{name} {count}" for name, count in sorted(excluded.items()))
    return [f"{total} of {evaluations} rollouts got no weight ({reasons})"]
