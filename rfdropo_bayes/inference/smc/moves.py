"""Moves of SMC's particles: self-tuning proposals, and suitable coordinates.

- `propose`: preconditioned Crank-Nicolson steps, shaped by the covariance of the particles.
- `StraightProblem`: logarithms of positive parameters, in which ridges are straight.
- `BlockProblem`: whole blocks of rows as rows, which a pilot run tempers in sequence.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from scipy.linalg import solve_triangular

from rfdropo_bayes.bayes.batches import padded
from rfdropo_bayes.bayes.problem import ProblemDefaults, ResidualProblem, Values
from rfdropo_bayes.inference.modes.optimisation import Laplace

POSITIVE_DRAWS = 1000  # from the prior, which show the positive parameters


class Reference(NamedTuple):
    """Location and spread of a population, which shape its proposals."""

    mean: Float[np.ndarray, " d"]  # weighted mean
    cholesky: Float[np.ndarray, "d d"]  # lower Cholesky factor of the weighted covariance


def fit_reference(position: Float[np.ndarray, "n d"], weights: Float[np.ndarray, " n"]) -> Reference:
    """Weighted mean and covariance.

    The covariance is shrunk towards its diagonal only if too few particles are effective to span the space. A ridge,
    such as stiffness and mass, is a correlation near one; even a little shrinkage makes proposals across it fail.
    """
    d = position.shape[1]
    mean = weights @ position
    centred = position - mean
    covariance = (weights[:, None] * centred).T @ centred
    shrinkage = max(0.0, 1.0 - distinct_size(position, weights) / (2.0 * (d + 1)))
    diagonal = np.diag(covariance)
    # Per coordinate: units may differ by powers of ten. Copies of one particle spread by rounding.
    rounding = np.finfo(float).eps * np.max(np.abs(position), axis=0)
    floor = np.maximum(1e-12 * diagonal, np.maximum(rounding**2, 1e-200))
    covariance = (1.0 - shrinkage) * covariance + np.diag(shrinkage * diagonal + floor)
    return Reference(mean, np.linalg.cholesky(covariance))


def distinct_size(position: Float[np.ndarray, "n d"], weights: Float[np.ndarray, " n"]) -> float:
    """Effective number of particles with copies from resampling counted once."""
    _, group = np.unique(position, axis=0, return_inverse=True)
    merged = np.bincount(group.ravel(), weights)
    return float(merged.sum() ** 2 / np.sum(merged**2))


def initial_scale(d: int) -> float:
    """Initial step size: 2.38 / sqrt(d) as for a random walk, at most 1."""
    return float(min(2.38 / np.sqrt(d), 1.0))


def adapt_scale(scale: float, acceptance: float, target: float) -> float:
    """Next step size from the acceptance of the whole population (Robbins-Monro on its logarithm)."""
    return float(np.clip(scale * np.exp(1.5 * (acceptance - target)), 1e-4, 1.0))


def host_generator(key: PRNGKeyArray) -> np.random.Generator:
    """NumPy generator that is a function of a JAX key.

    Population bookkeeping runs in NumPy: the shapes change from run to run, and compilation would take longer than the
    computation.
    """
    return np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel().tolist())


def propose(
    generator: np.random.Generator,
    position: Float[np.ndarray, "n d"],
    reference: Reference,
    scale: float,
    degrees: float,
) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, " n"]]:
    """Propose for all particles at once.

    ``x' = m + sqrt(1 - scale^2) (x - m) + scale sqrt(s) L z`` with ``s`` inverse gamma, reversible with respect to a
    Student-t of the reference's location and spread (the t-preconditioned Crank-Nicolson proposal of Grumitt, Karamanis
    and Seljak 2024). At scale 1 it is nearly independent of the old position, so a single move decorrelates a nearly
    normal population; at small scales it is a random walk.

    Returns:
        proposals, and the log of the proposal's part of the acceptance ratio.
    """
    n, d = position.shape
    step = generator.standard_normal((n, d)) @ reference.cholesky.T
    centred = position - reference.mean
    distance = squared_distance(reference.cholesky, centred)
    mixing = 0.5 * (degrees + distance) / generator.standard_gamma(0.5 * (d + degrees), n)
    moved = np.sqrt(1.0 - scale**2) * centred + scale * np.sqrt(mixing)[:, None] * step
    change = np.log1p(squared_distance(reference.cholesky, moved) / degrees) - np.log1p(distance / degrees)
    return reference.mean + moved, 0.5 * (d + degrees) * change


def accept(generator: np.random.Generator, log_ratio: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Metropolis decision for every particle; a ratio that is not a number is a refusal."""
    return np.log(generator.uniform(size=log_ratio.shape)) < np.where(np.isnan(log_ratio), -np.inf, log_ratio)


def slowest_correlation(
    before: Float[np.ndarray, "n d"], after: Float[np.ndarray, "n d"], reference: Reference
) -> float:
    """Largest correlation, over the whitened directions, between a population before and after some moves."""
    first, second = (np.linalg.solve(reference.cholesky, (x - reference.mean).T) for x in (before, after))
    first, second = (x - x.mean(axis=1, keepdims=True) for x in (first, second))
    norms = np.sqrt(np.sum(first**2, axis=1) * np.sum(second**2, axis=1))
    return float(np.max(np.sum(first * second, axis=1) / np.maximum(norms, 1e-300)))


def squared_distance(factor: Float[np.ndarray, "d d"], centred: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
    """Squared Mahalanobis distance of each point, from the Cholesky factor of the covariance."""
    return np.sum(solve_triangular(factor, centred.T, lower=True) ** 2, axis=0)


class StraightProblem:
    """The same posterior in other coordinates: logarithms of positive parameters, the problem's own for the others.

    Args:
        problem: problem whose coordinates belong to one parameter each, possibly in units of a positive parameter.
        key: random key of the prior draws that show which parameters are positive.
    """

    def __init__(self, problem: ResidualProblem, key: PRNGKeyArray) -> None:
        self.problem = problem
        self.names, self.units, self.bounds, self.n_rows = problem.names, problem.units, problem.bounds, problem.n_rows
        self.fingerprint, self.status_names = problem.fingerprint, problem.status_names
        self.prior_ends = problem.prior_ends
        drawn = problem.sample_prior(key, POSITIVE_DRAWS)
        self.logarithmic = np.array([np.min(np.asarray(drawn[name])) > 0.0 for name in self.names])
        self._stand_in = {name: float(np.median(np.asarray(drawn[name]))) for name in self.names}

    def sample_prior(self, key: PRNGKeyArray, n: int) -> dict[str, Float[Any, " n"]]:
        """Independent prior draws."""
        return self.problem.sample_prior(key, n)

    def to_unconstrained(self, values: Values) -> Float[Any, "n d"]:
        """Coordinates of values: logarithms of positive parameters, the problem's own for the others."""
        own = jnp.asarray(self.problem.to_unconstrained(values))
        value = jnp.stack([jnp.asarray(values[name]) for name in self.names], axis=-1)
        return jnp.where(self.logarithmic, jnp.log(jnp.where(self.logarithmic, value, 1.0)), own)

    def from_unconstrained(self, v: Float[Any, "n d"]) -> dict[str, Float[Any, " n"]]:
        """Inverse of `to_unconstrained`; values beyond a bound are returned as they are."""
        v = jnp.asarray(v)
        rest = self.problem.from_unconstrained(jnp.where(self.logarithmic, 0.0, v))
        positive = {name: jnp.exp(v[:, j]) for j, name in enumerate(self.names) if self.logarithmic[j]}
        # A deviation in units of a standard deviation depends on that deviation's own coordinate.
        u = jnp.asarray(self.problem.to_unconstrained({**rest, **positive}))
        return {**self.problem.from_unconstrained(jnp.where(self.logarithmic, u, v)), **positive}

    def log_prior(self, v: Float[Any, "n d"]) -> Float[Any, " n"]:
        """Log density in these coordinates; not a number beyond a bound."""
        own, slope = self._own_and_slope(v)
        with np.errstate(divide="ignore"):
            return np.asarray(self.problem.log_prior(jnp.asarray(own))) + np.log(slope).sum(axis=1)

    def row_log_likelihood(self, values: Values, horizon: int) -> tuple[Float[Any, "n horizon"], Int[Any, " n"]]:
        """The problem's; minus infinity for values beyond a bound, which are not simulated."""
        inside = np.isfinite(np.asarray(self.problem.to_unconstrained(values))).all(axis=1)
        safe = {name: np.where(inside, np.asarray(values[name]), self._stand_in[name]) for name in self.names}
        rows, status = self.problem.row_log_likelihood(safe, horizon)
        return np.where(inside[:, None], np.asarray(rows), -np.inf), np.where(inside, np.asarray(status), 0)

    def mode(self, mode: Laplace) -> Laplace:
        """A normal approximation of the problem in these coordinates."""
        v = np.asarray(
            self.to_unconstrained(self.problem.from_unconstrained(jnp.asarray(mode.mean[None]))), dtype=float
        )
        slope = np.asarray(self._own_and_slope(v)[1], dtype=float)[0]
        information = None if mode.information is None else mode.information * np.outer(slope, slope)
        return Laplace(
            v[0],
            mode.covariance / np.outer(slope, slope),
            mode.log_density + float(np.log(slope).sum()),
            information,
            None if mode.slope is None else mode.slope * slope,
        )

    def _own_and_slope(self, v: Float[Any, "n d"]) -> tuple[Float[Any, "n d"], Float[Any, "n d"]]:
        """The problem's own coordinates, and their derivatives by the coordinates of this problem."""
        return padded(self._compiled, v)

    @cached_property
    def _compiled(self) -> Callable:
        def own(v: Array) -> Array:
            return jnp.asarray(self.problem.to_unconstrained(self.from_unconstrained(v)))

        def both(v: Array) -> tuple[Array, Array]:
            value, slope = jax.jvp(own, (v,), (jnp.ones_like(v),))
            return value, jnp.abs(slope)

        return jax.jit(both)


class BlockProblem(ProblemDefaults):
    """A problem whose rows are blocks of another problem's rows; a sampler tempers a whole block at once."""

    def __init__(self, problem: StraightProblem, horizons: tuple[int, ...]) -> None:
        self.problem, self.horizons = problem, horizons
        self.names, self.units, self.bounds = problem.names, problem.units, problem.bounds
        self.status_names = problem.status_names
        self.fingerprint = f"{problem.fingerprint} {horizons}"
        self.n_rows = len(horizons)
        self.sample_prior, self.log_prior = problem.sample_prior, problem.log_prior
        self.to_unconstrained, self.from_unconstrained = problem.to_unconstrained, problem.from_unconstrained

    def row_log_likelihood(self, values: Values, horizon: int) -> tuple[Float[Any, "n horizon"], Int[Any, " n"]]:
        """Log density of the rows of each block together."""
        rows, status = self.problem.row_log_likelihood(values, self.horizons[horizon - 1])
        return np.add.reduceat(np.asarray(rows), [0, *self.horizons[: horizon - 1]], axis=1), status
