"""Whether repeats differ by constants: a frame or a start that was not the same each time, which is no noise."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import chi2

from rfdropo_bayes.bayes.noise.autoregression import REPEATS, Autoregression, estimate_noise

SURE = 1e-4  # p-value under the noise within recordings, below which shifts are there
LEAST = 0.5  # of the noise's standard deviation: what is smaller changes no conclusion
ROWS = 10  # fewer tell no constant from slow noise


def repeat_shift(
    deviations: Float[np.ndarray, "series time column"], valid: Bool[np.ndarray, "series time column"], share: float
) -> float | None:
    """Root mean square distance of a marker that constants, one for each repeat and column, make [m].

    The noise within recordings is an autoregression; the means of such recordings have a variance that it predicts, and
    of which the means that were found are a chi-squared multiple. Noise so slow that it differs little from a constant
    within a recording counts as one.

    Args:
        deviations: of repeats from their mean.
        valid: which may be used.
        share: degrees of freedom per value.

    Returns:
        None where the noise within the recordings accounts for all that they differ by, or nearly all.
    """
    rows = valid.sum(axis=1, keepdims=True)
    if rows.max(initial=0) < ROWS:
        return None
    mean = np.where(valid, deviations, 0.0).sum(axis=1, keepdims=True) / np.maximum(rows, 1)
    within = np.where(valid, deviations - mean, 0.0)
    noise = estimate_noise(within, valid, share, source=REPEATS, shared=None)
    predicted = _variance_of_mean(noise, int(rows.max()))
    known = rows[:, 0] > 0
    white = noise.separate(mean[:, 0] / np.sqrt(predicted), known)
    freedom = known.sum() * share
    if chi2.sf(np.sum(white[known] ** 2), freedom) > SURE:
        return None
    excess = float(np.sum(mean[:, 0] ** 2 * known)) / freedom - float(np.mean(predicted))
    return float(np.sqrt(3.0 * excess)) if excess > LEAST**2 * float(np.mean(noise.scale**2)) else None


def _variance_of_mean(noise: Autoregression, rows: int) -> Float[np.ndarray, " column"]:
    """Of the mean of so many successive rows of the process."""
    memory = np.zeros(rows)
    memory[: len(noise.autocorrelation)] = noise.autocorrelation[:rows]
    coefficients = noise.predictors[0][-1][: noise.order]
    for lag in range(len(noise.autocorrelation), rows):
        memory[lag] = coefficients @ memory[lag - 1 : lag - 1 - noise.order : -1] if noise.order else 0.0
    weight = (rows - np.arange(rows)) / rows**2
    return noise.scale**2 * (weight[0] + 2.0 * float(weight[1:] @ memory[1:]))
