"""Standard deviations of groups of coordinates, integrated out of a normal approximation instead of optimised.

A hierarchy cannot be approximated at its joint mode, at which a standard deviation is zero or at the end of its prior.
Given the standard deviations, the group parameters are as normal as the others. The optimisation therefore fixes the
standard deviations. Their posterior follows from the likelihood's quadratic form at the mode, which does not depend on
them (nested Laplace approximation, Rue, Martino & Chopin 2009).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from scipy.optimize import minimize
from scipy.special import logsumexp
from scipy.stats import multivariate_t

from rfdropo_bayes.inference.modes.optimisation import Laplace

DRAWS = 4000  # of the proposal, from which the scales are resampled
FREEDOM = 5.0  # of the proposal, a Student-t around the mode of the scales' logarithms: it has to have their tails


DIFFERENCE = 1e-2  # of a logarithm, for second differences
WIDEST = 2.0  # deviation of the proposal's logarithms: beyond it the prior is as narrow


class Mixed(NamedTuple):
    """A normal approximation with its scales integrated out."""

    scales: Float[np.ndarray, "draw scale"]  # draws of the standard deviations
    position: Float[np.ndarray, "draw d"]  # draws of the coordinates, given each
    log_evidence: float  # log evidence with the scales integrated out


def integrate_scales(
    mode: Laplace,
    fixed: Float[np.ndarray, " scale"],
    members: Sequence[Sequence[int]],
    log_prior: Callable[[Float[np.ndarray, "n scale"]], Float[np.ndarray, " n"]],
    draws: int,
    key: PRNGKeyArray,
) -> Mixed:
    """Draws of standard deviations and coordinates.

    Args:
        mode: optimum at the fixed standard deviations.
        fixed: standard deviations at the mode.
        members: coordinates of each scale whose prior is Normal(0, scale).
        log_prior: log density of the standard deviations' prior, for rows of them.
        draws: number of draws to return.
        key: random key.
    """
    owner = np.concatenate([np.full(len(m), j) for j, m in enumerate(members)])
    index = np.concatenate([np.asarray(m, dtype=int) for m in members])
    # The rest of the quadratic form is unchanged; it is integrated out once in its coordinates other than the members'.
    precision = np.linalg.inv(mode.covariance)
    precision[index, index] -= 1.0 / fixed[owner] ** 2
    slope = np.zeros(len(mode.mean))
    slope[index] = mode.mean[index] / fixed[owner] ** 2
    other = np.setdiff1d(np.arange(len(slope)), index)
    solved = np.linalg.solve(precision[np.ix_(other, other)], precision[np.ix_(other, index)])
    reduced = precision[np.ix_(index, index)] - precision[np.ix_(index, other)] @ solved
    centre = jnp.asarray(mode.mean[index])

    @jax.jit
    @jax.vmap
    def gain(logarithm: jax.Array) -> jax.Array:
        """Log evidence given the scales, up to a constant."""
        weight = jnp.exp(-2.0 * logarithm)[owner]
        factor = jnp.linalg.cholesky(jnp.asarray(reduced) + jnp.diag(weight))
        linear = jnp.asarray(slope[index]) - weight * centre
        white = jax.scipy.linalg.solve_triangular(factor, linear, lower=True)
        half = 0.5 * jnp.sum(jnp.log(weight)) - jnp.sum(jnp.log(jnp.diag(factor)))
        return 0.5 * jnp.sum(white**2) - 0.5 * jnp.sum(weight * centre**2) + half

    def density(logarithm: np.ndarray) -> np.ndarray:
        density_at = np.asarray(gain(logarithm)) + np.asarray(log_prior(np.exp(logarithm))) + logarithm.sum(axis=1)
        return np.where(np.isfinite(density_at), density_at, -np.inf)

    choice_key, normal_key = jax.random.split(key)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(choice_key)))
    logarithm, log_mean = _drawn(density, np.log(fixed), draws, rng)
    position = np.empty((draws, len(mode.mean)))
    normal = np.asarray(jax.random.normal(normal_key, position.shape))
    for i, scale in enumerate(np.exp(logarithm)):
        whole, pull = precision.copy(), slope.copy()
        whole[index, index] += 1.0 / scale[owner] ** 2
        pull[index] -= mode.mean[index] / scale[owner] ** 2
        factor = np.linalg.cholesky(whole)
        position[i] = mode.mean + np.linalg.solve(factor.T, np.linalg.solve(factor, pull) + normal[i])
    before = float(np.asarray(gain(np.log(fixed)[None]))[0])
    return Mixed(np.exp(logarithm), position, mode.log_evidence + log_mean - before)


def _drawn(
    density: Callable[[np.ndarray], np.ndarray], start: np.ndarray, draws: int, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "draw scale"], float]:
    """Draws of a density in a few dimensions by resampling, and the logarithm of its integral."""
    k = len(start)
    optimum = minimize(lambda x: -float(density(x[None])[0]), start, method="Nelder-Mead")
    mode, unit = optimum.x, DIFFERENCE * np.eye(k)
    corners = [mode + a * p + b * q for p in unit for q in unit for a in (1, -1) for b in (1, -1)]
    value = density(np.stack(corners)).reshape(k, k, 2, 2)
    curvature = -(value[..., 0, 0] - value[..., 0, 1] - value[..., 1, 0] + value[..., 1, 1]) / (4.0 * DIFFERENCE**2)
    values, vectors = np.linalg.eigh(0.5 * (curvature + curvature.T))
    root = vectors / np.sqrt(np.maximum(values, WIDEST**-2))
    white = rng.standard_normal((DRAWS, k)) * np.sqrt(FREEDOM / rng.chisquare(FREEDOM, (DRAWS, 1)))
    proposed = mode + white @ root.T
    tail = multivariate_t(mode, root @ root.T, df=FREEDOM).logpdf(proposed).reshape(-1)
    weight = density(proposed) - tail
    total = float(logsumexp(weight))
    chosen = rng.choice(DRAWS, size=draws, p=np.exp(weight - total))
    return proposed[chosen], total - np.log(DRAWS)
