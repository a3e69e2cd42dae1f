"""How well rollouts of a distribution match a trajectory: a Gaussian per time step (eq. 2 and 3 of RF-DROPO)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float


def step_log_likelihood(
    features: Float[np.ndarray, "m time f"],
    alive: Bool[np.ndarray, " m"],
    observed: Float[np.ndarray, "time f"],
    mask: Bool[np.ndarray, "time f"],
    variance_floor: float | Float[np.ndarray, " f"],
    weights: Float[np.ndarray, " m"] | None = None,
) -> Float[np.ndarray, " time"]:
    """Log density of each observed time step under the Gaussian of the Monte-Carlo rollouts.

    Mean and covariance are those of the live rollouts; ``variance_floor`` is added to the variances, without which the
    density has no maximum (one trajectory, spread to zero).

    Args:
        features: rollouts of ONE parameter distribution.
        alive: rollouts that ended well; at least two.
        observed: the trajectory, in the units of the features.
        mask: observed entries that count.
        variance_floor: in squared units of the features; one for all, or one of each.
        weights: of the live rollouts, summing to one; None for equal ones.
    """
    good = features[alive]
    share = np.full(len(good), 1.0 / len(good)) if weights is None else weights
    mean = np.einsum("m,mtf->tf", share, good)
    deviation = np.where(mask, good - mean, 0.0)
    # Unbiased: for equal weights 1 / (m - 1).
    share = share / (1.0 - np.sum(share**2))
    covariance = np.einsum("mtf,mtg->tfg", share[:, None, None] * deviation, deviation, optimize=True)
    f = observed.shape[1]
    # A masked entry becomes an independent unit normal at its mean: it adds nothing but a constant, left out below.
    covariance[:, np.arange(f), np.arange(f)] += np.where(mask, variance_floor, 1.0)
    factor = np.linalg.cholesky(covariance)
    residual = np.where(mask, observed - mean, 0.0)
    white = np.linalg.solve(factor, residual[..., None])[..., 0]
    log_determinant = np.log(factor[:, np.arange(f), np.arange(f)]).sum(axis=1)
    return -0.5 * np.sum(white**2, axis=1) - log_determinant - 0.5 * np.log(2.0 * np.pi) * mask.sum(axis=1)


def motion_scale(observed: Float[np.ndarray, "time f"], mask: Bool[np.ndarray, "time f"]) -> float:
    """Root mean square motion of the observed features away from where each was first seen, the unit of the match.

    In this unit the paper's variance floor of 1e-5 is a deviation of 0.3 % of the motion, whatever the robot's size.
    """
    squares: list[np.ndarray] = []
    for column, valid in zip(observed.T, mask.T, strict=True):
        seen = column[valid]
        if len(seen):
            squares.append((seen - seen[0]) ** 2)
    total = np.sqrt(np.mean(np.concatenate(squares))) if squares else 0.0
    return float(total) if total > 0.0 else 1.0
