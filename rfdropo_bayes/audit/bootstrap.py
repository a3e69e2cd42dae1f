"""Residuals as they would be if the model were right: the reference that all p-values are taken from.

Noise is drawn for every recording, its model is estimated from it as it was from the data, and the base model is
refitted linearly. No rollouts are needed.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.audit.measurements import Measurements
from rfdropo_bayes.audit.score import project_out
from rfdropo_bayes.bayes.noise.autoregression import MISFIT, RESIDUALS, STATED
from rfdropo_bayes.bayes.noise.stacked import Stacked


def null_residuals(
    measurements: Measurements,
    noise: Stacked,
    base: Float[np.ndarray, "n rank"],
    parameters: int,
    rng: np.random.Generator,
    count: int,
) -> Float[np.ndarray, "count n"]:
    """Whitened residuals of ``count`` data sets without discrepancy, after the base model is fitted to each.

    Args:
        measurements: the data, for their times, gaps and repeats.
        noise: that is drawn.
        base: orthonormal basis of what the base parameters do to whitened data.
        parameters: how many of them were fitted.
        rng: of the noise.
        count: data sets.
    """
    found = np.empty((count, len(base)))
    drawn = noise.draw(rng, (count, *measurements.spread.shape))
    if noise.source == RESIDUALS:
        drawn = _fitted(measurements, noise, base, drawn)
    for row, single in enumerate(drawn):
        estimated = noise
        if noise.source not in (STATED, MISFIT):
            estimated = measurements.noise(single, parameters, noise)
        found[row, : measurements.count.size] = measurements.whiten(measurements.mean_of(single), estimated)
    weighed = measurements.size - measurements.count.size  # whose errors are known
    found[:, measurements.count.size :] = rng.standard_normal((count, weighed))
    return project_out(base, found.T).T


def _fitted(measurements: Measurements, noise: Stacked, base: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """What the base model leaves of data sets without repeats: where the noise is estimated from that, it is estimated
    from that here, too; the noise before a fit would be a little larger in most of them, and give itself away."""
    order = [group[0] for group in measurements.members]
    white = measurements.whiten(drawn[:, order], noise)
    rows = base[: measurements.count.size]
    left = (white - white @ rows @ rows.T).reshape(len(drawn), *measurements.count.shape)
    fitted = np.empty_like(drawn)
    fitted[:, order] = noise.colour(left, measurements.valid)
    return fitted


def tail(observed: float, simulated: Float[np.ndarray, " count"]) -> float:
    """Share of simulated statistics at least as large, the observed one among them."""
    return float((1 + np.sum(simulated >= observed)) / (1 + len(simulated)))


def p_in_words(p: float, simulated: int) -> str:
    """A bootstrap's p-value, "= 0.02"; "< 0.001" where none of the simulated statistics was as large."""
    least = 1.0 / (1 + simulated)
    return f"= {p:.2g}" if p > 1.5 * least else f"< {least:.2g}"
