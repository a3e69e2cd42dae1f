"""How well a distribution explains a trajectory: by rollouts of its own, or by those of others, weighted anew.

Eq. 2 and 3 of RF-DROPO: at every time step a Gaussian with the mean and covariance of the rollouts. A rollout depends
on its parameters, not on the distribution that they came from: drawn under one phi it counts under another by the ratio
of the densities. With several sources the ratio is to their mixture (the balance heuristic). The effective sample size
says how far that carries.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray
from scipy.special import logsumexp
from scipy.stats import qmc

from rfdropo_bayes.bayes.problem import RolloutProblem
from rfdropo_bayes.inference.evaluations import Ledger
from rfdropo_bayes.inference.rfdropo.families import Family
from rfdropo_bayes.inference.smc.moves import host_generator

LEAST_ESS = 30.0  # rollouts behind a mean and a covariance
FORBIDDEN = 1e9


class Plan(NamedTuple):
    """Sizes fixed at the start.

    Attributes:
        space: what is searched.
        population: candidates per generation.
        horizons: of every generation, in rows; the shortest that is allowed where the schedule adapts.
        finalists: how many are scored again.
        fixed: values of the parameters that are not searched.
        scale: unit of the features [unit of the problem's features].
        floor: added to the variance of each feature, in squares of that unit.
    """

    space: Family
    population: int
    horizons: tuple[int, ...]
    finalists: int
    fixed: dict[str, float]
    scale: float
    floor: Float[np.ndarray, " f"]


def uniforms(key: PRNGKeyArray, m: int, d: int, *, stratified: bool) -> Float[np.ndarray, "m d"]:
    """Uniform numbers that all candidates of a generation share; stratified ones (Latin hypercube) scatter less."""
    generator = host_generator(key)
    return qmc.LatinHypercube(d, rng=generator).random(m) if stratified else generator.uniform(size=(m, d))


class Simulated(NamedTuple):
    """Rollouts of some candidates, features in units of the motion."""

    values: Float[np.ndarray, "c m d"]
    features: Float[np.ndarray, "c m time f"]
    alive: Bool[np.ndarray, "c m"]


def simulate(
    problem: RolloutProblem,
    plan: Plan,
    candidates: Float[np.ndarray, "c k"],
    uniform: Float[np.ndarray, "m u"],
    simulated: int,
    ledger: Ledger,
) -> Simulated:
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
    return Simulated(drawn, features.reshape(c, m, *features.shape[1:]), alive)


def target_features(problem: RolloutProblem, plan: Plan, horizon: int) -> tuple[np.ndarray, np.ndarray]:
    """The measured rows in units of the motion, zero where masked, and the mask."""
    mask = np.asarray(problem.observed_mask)[:horizon]
    return np.where(mask, np.asarray(problem.observed, dtype=float)[:horizon], 0.0) / plan.scale, mask


def row_scores(problem: RolloutProblem, plan: Plan, found: Simulated, horizon: int) -> Float[np.ndarray, "c horizon"]:
    """Log likelihood (eq. 3) of each row under every candidate; minus infinity where half of its rollouts failed."""
    observed, mask = target_features(problem, plan, horizon)
    c, m = found.alive.shape
    rows = np.full((c, horizon), -np.inf)
    for index in range(c):
        if found.alive[index].sum() >= max(2, m / 2):
            features = found.features[index, :, :horizon]
            rows[index] = step_log_likelihood(features, found.alive[index], observed, mask, plan.floor)
    return rows


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


@dataclass(frozen=True)
class Pool:
    """Rollouts of several distributions at the full horizon.

    Attributes:
        family: theirs.
        values: parameter sets, physical units.
        features: rollouts, in units of the motion.
        log_source: log density of each set under the mixture of all sources.
        observed, mask: the trajectory, likewise.
        recordings: how many lie side by side in the features.
        floor: as in the search.
    """

    family: Family
    values: Float[np.ndarray, "n d"]
    features: Float[np.ndarray, "n time f"]
    log_source: Float[np.ndarray, " n"]
    observed: Float[np.ndarray, "time f"]
    mask: Bool[np.ndarray, "time f"]
    recordings: int
    floor: Float[np.ndarray, " f"]

    def weights(self, vector: Float[np.ndarray, " k"]) -> tuple[Float[np.ndarray, " n"], float]:
        """Normalised weights of the pool under a distribution, and their effective sample size."""
        logs = self.family.log_density(vector, self.values) - self.log_source
        total = logsumexp(logs)
        if not np.isfinite(total):
            return np.zeros(len(logs)), 0.0
        weights = np.exp(logs - total)
        return weights, float(1.0 / np.sum(weights**2))

    def loss(self, vector: Float[np.ndarray, " k"], counts: Float[np.ndarray, " recordings"]) -> float:
        """Minus the log likelihood, every recording counted so often; forbidden where too few rollouts matter."""
        weights, effective = self.weights(vector)
        if effective < LEAST_ESS:
            return FORBIDDEN * (1.0 + LEAST_ESS - effective)
        kept = weights > 1e-6 * weights.max()
        blocks = np.array_split(np.arange(self.features.shape[2]), self.recordings)
        total = 0.0
        for count, columns in zip(counts, blocks, strict=True):
            if count:
                rows = step_log_likelihood(
                    self.features[kept][:, :, columns],
                    np.ones(int(kept.sum()), dtype=bool),
                    self.observed[:, columns],
                    self.mask[:, columns],
                    self.floor[columns],
                    weights[kept] / weights[kept].sum(),
                )
                total -= count * float(rows.sum())
        return total


def make_pool(
    family: Family,
    candidates: Float[np.ndarray, "c k"],
    values: Float[np.ndarray, "c m d"],
    features: Float[np.ndarray, "c m time f"],
    alive: Bool[np.ndarray, "c m"],
    observed: Float[np.ndarray, "time f"],
    mask: Bool[np.ndarray, "time f"],
    recordings: int,
    floor: Float[np.ndarray, " f"],
) -> Pool:
    """Pool of the live rollouts of some candidates; each counts as a source by the rollouts of it that are alive."""
    flat = values[alive]
    with np.errstate(divide="ignore"):
        share = np.log(alive.sum(axis=1) / max(alive.sum(), 1))
    logs = np.stack([family.log_density(c, flat) for c in candidates]) + share[:, None]
    return Pool(family, flat, features[alive], logsumexp(logs, axis=0), observed, mask, recordings, floor)
