"""Residuals as they would be if the model were right: the reference that all p-values are taken from.

Noise is drawn for every recording, its model is estimated from it as it was from the data, and the base model is
refitted linearly. No rollouts are needed.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.audit.measurements import Measurements
from rfdropo_bayes.audit.noise import STATED, NoiseModel
from rfdropo_bayes.audit.score import project_out


def null_residuals(
    measurements: Measurements,
    noise: NoiseModel,
    base: Float[np.ndarray, "n rank"],
    rng: np.random.Generator,
    count: int,
) -> Float[np.ndarray, "count n"]:
    """Whitened residuals of ``count`` data sets without discrepancy, after the base model is fitted to each."""
    found = np.empty((count, len(base)))
    for row in range(count):
        single = noise.draw(rng, measurements.single.shape)
        estimated = noise
        if noise.source != STATED:
            estimated = measurements.noise(single, base.shape[1], noise)
        found[row] = measurements.whiten(measurements.mean_of(single), estimated)
    return project_out(base, found.T).T


def tail(observed: float, simulated: Float[np.ndarray, " count"]) -> float:
    """Share of simulated statistics at least as large, the observed one among them."""
    return float((1 + np.sum(simulated >= observed)) / (1 + len(simulated)))
