"""Candidate distributions of RF-DROPO, rolled out together and scored against the trajectory."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray
from scipy.stats import qmc

from rfdropo_bayes.bayes.problem import RolloutProblem
from rfdropo_bayes.inference.evaluations import Ledger
from rfdropo_bayes.inference.rfdropo.families import Family
from rfdropo_bayes.inference.rfdropo.trajectory_match import step_log_likelihood
from rfdropo_bayes.inference.smc.moves import host_generator


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
