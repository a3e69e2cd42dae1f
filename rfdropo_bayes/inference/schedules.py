"""How far to look: horizons that grow during inference, and the steps of tempering between two of them."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq
from scipy.special import logsumexp

from rfdropo_bayes.errors import InputError

SPACINGS = ("geometric", "linear", "every")


def paper_horizon(iteration: int, iterations: int, n_rows: int, *, mended: bool = True) -> int:
    """Horizon of RF-DROPO at one iteration, ``max(1, floor(n (1 - exp(-(2 / K) ln(10) i))))``.

    Args:
        iteration: i, from 0 to K.
        iterations: K, the number of iterations.
        n_rows: n, rows of data.
        mended: as published the last horizon is 99 of 100 rows, so that the whole recording is never looked at;
            mended, the curve is stretched by 1 / 0.99 and ends at n when ``i = K - 1``.
    """
    if not mended:
        return max(1, math.floor(n_rows * (1.0 - 10.0 ** (-2.0 * iteration / iterations))))
    last = max(iterations - 1, 1)
    share = (1.0 - 10.0 ** (-2.0 * min(iteration / last, 1.0))) / 0.99
    return min(n_rows, max(1, math.floor(n_rows * share + 1e-9)))


def linear_horizon(iteration: int, iterations: int, n_rows: int) -> int:
    """Horizon that grows evenly from 1 and is ``n_rows`` at the last iteration, ``iterations - 1``."""
    return min(n_rows, max(1, math.ceil(n_rows * (iteration + 1) / iterations)))


def adaptive_horizon(row_scores: Float[np.ndarray, "n rows"], horizon: int, target: float) -> int:
    """Longest horizon at which candidates still agree: weighted by the likelihood of the rows after ``horizon``, the
    share ``target`` of them is effective.

    Args:
        row_scores: log likelihood of each row for each candidate; minus infinity for those that failed.
        horizon: present one; the answer is not shorter.
        target: share of effective candidates among those that did not fail.
    """
    alive = row_scores[np.isfinite(row_scores).all(axis=1)]
    if len(alive) == 0:
        return horizon
    ahead = np.cumsum(alive[:, horizon:], axis=1)
    for rows, weights in enumerate(ahead.T):
        if log_effective_sample_size(weights) < math.log(target * len(weights)):
            return horizon + rows
    return horizon + ahead.shape[1]


def block_boundaries(n_rows: int, blocks: int, spacing: str = "geometric") -> tuple[int, ...]:
    """Prefix lengths at which a sequential method looks further ahead; strictly increasing, the last one ``n_rows``.

    Args:
        n_rows: rows of data.
        blocks: number of blocks wanted; fewer where rows do not suffice.
        spacing: ``"geometric"`` doubles (the sum of all prefixes stays below ``2 n_rows``), ``"linear"`` has equal
            blocks, ``"every"`` has one block per row whatever ``blocks`` says.
    """
    if n_rows < 1 or blocks < 1:
        raise InputError("a schedule needs at least one row and one block", where="[inference] blocks")
    if spacing == "every":
        return tuple(range(1, n_rows + 1))
    if spacing == "linear":
        raw = [n_rows * (k + 1) / blocks for k in range(blocks)]
    elif spacing == "geometric":
        raw = [n_rows * 2.0 ** (k + 1 - blocks) for k in range(blocks)]
    else:
        raise InputError(f"unknown spacing {spacing!r}", where="[inference] spacing", remedy=f"one of {SPACINGS}")
    return tuple(sorted({max(1, math.ceil(value - 1e-9)) for value in raw}))


def log_effective_sample_size(log_weights: Float[np.ndarray, " n"]) -> float:
    """Logarithm of ``(sum w)^2 / sum w^2``; minus infinity when no weight is left."""
    top = logsumexp(log_weights)
    return float(2.0 * top - logsumexp(2.0 * log_weights)) if np.isfinite(top) else -math.inf


def next_step(
    log_weights_at: Callable[[float], Float[np.ndarray, " n"]], longest: float, target: float
) -> tuple[float, bool]:
    """Longest step along a path of targets that keeps the effective sample size.

    Args:
        log_weights_at: log weights of the particles after a step of the given length; 0 gives the present ones.
        longest: length of the step to the end of the path.
        target: effective sample size to keep, as a share of the particles that have weight at the end of the path.

    Returns:
        the length, and whether it reaches the end of the path with the target kept.
    """
    end = log_weights_at(longest)
    alive = np.isfinite(end)
    if not alive.any():
        return longest, False
    now = log_weights_at(0.0)
    survivors = log_effective_sample_size(np.where(alive, now, -np.inf))
    # Carried weights may already be just above the target, or below it once dead particles are gone: always advance.
    wanted = min(math.log(target * max(alive.sum(), 1)), survivors + math.log(0.95))

    def excess(step: float) -> float:
        return log_effective_sample_size(log_weights_at(step)) - wanted

    if excess(longest) >= 0.0:
        return longest, True
    # Relative, not absolute, precision: precise data make the first steps as short as 1e-8 of the path.
    return float(brentq(excess, 0.0, longest, xtol=1e-300, rtol=1e-6, maxiter=500)), False
