"""Score of a trajectory under a distribution.

Eq. 2 and 3 of RF-DROPO: at every time step a Gaussian with the mean and covariance of rollouts drawn from it.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray
from scipy.stats import qmc

from rfdropo_bayes.bayes.problem import RolloutProblem
from rfdropo_bayes.inference.evaluations import Ledger
from rfdropo_bayes.inference.rfdropo.phi_space import SearchSpace
from rfdropo_bayes.inference.smc.moves import host_generator


class ScorePlan(NamedTuple):
    """Sizes fixed at the start."""

    space: SearchSpace  # search space
    population: int  # candidates per generation
    horizons: tuple[int, ...]  # horizon of every generation, in rows
    finalists: int  # number of candidates scored again
    fixed: dict[str, float]  # values of fixed parameters
    scale: float  # unit of the features [unit of the problem's features]
    floor: Float[np.ndarray, " f"]  # added to the variance of each feature, in squares of that unit


class CandidateRollouts(NamedTuple):
    """Rollouts of some candidates, features in units of the motion."""

    values: Float[np.ndarray, "c m d"]
    features: Float[np.ndarray, "c m time f"]
    alive: Bool[np.ndarray, "c m"]


def uniforms(key: PRNGKeyArray, m: int, d: int, *, stratified: bool) -> Float[np.ndarray, "m d"]:
    """Uniform numbers that all candidates of a generation share; stratified numbers (Latin hypercube) scatter less."""
    generator = host_generator(key)
    return qmc.LatinHypercube(d, rng=generator).random(m) if stratified else generator.uniform(size=(m, d))


def simulate(
    problem: RolloutProblem,
    plan: ScorePlan,
    candidates: Float[np.ndarray, "c k"],
    uniform: Float[np.ndarray, "m u"],
    simulated: int,
    ledger: Ledger,
) -> CandidateRollouts:
    """Roll candidates out; candidates times rollouts go to the problem as ONE batch."""
    drawn = plan.space.draw(candidates, uniform)
    c, m, _ = drawn.shape
    values = {name: jnp.full(c * m, value) for name, value in plan.fixed.items()}
    values |= {name: jnp.asarray(drawn[..., j].ravel()) for j, name in enumerate(plan.space.names)}
    features, status = (np.asarray(part) for part in problem.rollouts(values, simulated))
    ledger.charge(problem, c * m, simulated)
    features = features.astype(float) / plan.scale
    not_a_number = np.logical_not(np.isfinite(features).all(axis=(1, 2)))
    ledger.exclude(problem, status, not_a_number)
    alive = ((status == 0) & ~not_a_number).reshape(c, m)
    return CandidateRollouts(drawn, features.reshape(c, m, *features.shape[1:]), alive)


def row_scores(
    problem: RolloutProblem, plan: ScorePlan, rollouts: CandidateRollouts, horizon: int
) -> Float[np.ndarray, "c horizon"]:
    """Log likelihood (eq. 3) of each row under every candidate; minus infinity if half of its rollouts failed."""
    mask = np.asarray(problem.observed_mask)[:horizon]
    observed = np.where(mask, np.asarray(problem.observed, dtype=float)[:horizon], 0.0) / plan.scale
    c, m = rollouts.alive.shape
    rows = np.full((c, horizon), -np.inf)
    for index in range(c):
        if rollouts.alive[index].sum() >= max(2, m / 2):
            features = rollouts.features[index, :, :horizon]
            rows[index] = step_log_likelihood(features, rollouts.alive[index], observed, mask, plan.floor)
    return rows


def step_log_likelihood(
    features: Float[np.ndarray, "m time f"],
    alive: Bool[np.ndarray, " m"],
    observed: Float[np.ndarray, "time f"],
    mask: Bool[np.ndarray, "time f"],
    variance_floor: float | Float[np.ndarray, " f"],
) -> Float[np.ndarray, " time"]:
    """Log density of each observed time step under the Gaussian of the Monte-Carlo rollouts.

    Mean and covariance are taken over the live rollouts. ``variance_floor`` is added to the variances; without it the
    density is unbounded as the spread goes to zero.

    Args:
        features: rollouts of ONE parameter distribution.
        alive: rollouts that succeeded; at least two.
        observed: the trajectory, in the units of the features.
        mask: observed entries that count.
        variance_floor: floor of the variance in squared units of the features; a scalar, or one value per feature.
    """
    good = features[alive]
    mean = good.mean(axis=0)
    deviation = np.where(mask, good - mean, 0.0)
    covariance = np.einsum("mtf,mtg->tfg", deviation / (len(good) - 1), deviation, optimize=True)
    f = observed.shape[1]
    # A masked entry becomes an independent unit normal at its mean: it adds nothing but a constant, left out below.
    covariance[:, np.arange(f), np.arange(f)] += np.where(mask, variance_floor, 1.0)
    factor = np.linalg.cholesky(covariance)
    residual = np.where(mask, observed - mean, 0.0)
    white = np.linalg.solve(factor, residual[..., None])[..., 0]
    log_determinant = np.log(factor[:, np.arange(f), np.arange(f)]).sum(axis=1)
    return -0.5 * np.sum(white**2, axis=1) - log_determinant - 0.5 * np.log(2.0 * np.pi) * mask.sum(axis=1)


def motion_scale(observed: Float[np.ndarray, "time f"], mask: Bool[np.ndarray, "time f"]) -> float:
    """Root mean square motion of the observed features from their first observed values, the unit of the match.

    In this unit the paper's variance floor of 1e-5 is a deviation of 0.3 % of the motion, for a robot of any size.
    """
    squares: list[np.ndarray] = []
    for column, valid in zip(observed.T, mask.T, strict=True):
        seen = column[valid]
        if len(seen):
            squares.append((seen - seen[0]) ** 2)
    total = np.sqrt(np.mean(np.concatenate(squares))) if squares else 0.0
    return float(total) if total > 0.0 else 1.0
