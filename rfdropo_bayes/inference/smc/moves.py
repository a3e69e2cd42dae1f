"""Metropolis proposals that a population of particles tunes by itself."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray
from scipy.linalg import solve_triangular

KERNELS = ("auto", "crank_nicolson", "random_walk", "hamiltonian")
FOLLOWED = 0.75  # acceptance that trajectories are adapted to


class Reference(NamedTuple):
    """Location and spread of a population, which shape its proposals.

    Attributes:
        mean: weighted mean.
        cholesky: lower Cholesky factor of the weighted covariance.
    """

    mean: Float[np.ndarray, " d"]
    cholesky: Float[np.ndarray, "d d"]


def fit_reference(position: Float[np.ndarray, "n d"], weights: Float[np.ndarray, " n"]) -> Reference:
    """Weighted mean and covariance.

    Shrunk towards its diagonal only where too few particles are effective to span the space: a ridge, such as that of
    stiffness and mass, is a correlation near one, and a little shrinkage makes proposals across it hopeless.
    """
    d = position.shape[1]
    mean = weights @ position
    centred = position - mean
    covariance = (weights[:, None] * centred).T @ centred
    shrinkage = max(0.0, 1.0 - distinct_size(position, weights) / (2.0 * (d + 1)))
    diagonal = np.diag(covariance)
    # Of each coordinate: units may differ by powers of ten. Copies of one particle spread by what is rounded off.
    rounding = np.finfo(float).eps * np.max(np.abs(position), axis=0)
    floor = np.maximum(1e-12 * diagonal, np.maximum(rounding**2, 1e-200))
    covariance = (1.0 - shrinkage) * covariance + np.diag(shrinkage * diagonal + floor)
    return Reference(mean, np.linalg.cholesky(covariance))


def distinct_size(position: Float[np.ndarray, "n d"], weights: Float[np.ndarray, " n"]) -> float:
    """Effective number of particles where copies of one, which resampling leaves, count together."""
    _, group = np.unique(position, axis=0, return_inverse=True)
    merged = np.bincount(group.ravel(), weights)
    return float(merged.sum() ** 2 / np.sum(merged**2))


def initial_scale(kernel: str, d: int) -> float:
    """Step before anything is known of the acceptance: 2.38 / sqrt(d) for a random walk, d^(-1/4) for a trajectory, at
    most 1 for Crank-Nicolson."""
    if kernel == "hamiltonian":
        return float(d**-0.25)
    walk = 2.38 / np.sqrt(d)
    return float(walk if kernel == "random_walk" else min(walk, 1.0))


def adapt_scale(kernel: str, scale: float, acceptance: float, target: float) -> float:
    """Next step size from the acceptance of the whole population (Robbins-Monro on its logarithm)."""
    longer = scale * np.exp(1.5 * (acceptance - (FOLLOWED if kernel == "hamiltonian" else target)))
    return float(np.clip(longer, 1e-4, 10.0 if kernel == "random_walk" else 1.0))


def host_generator(key: PRNGKeyArray) -> np.random.Generator:
    """NumPy generator that is a function of a JAX key.

    Population bookkeeping runs on the host: it is cheap, and its shapes change from run to run, so that compiling it
    would take longer than running it.
    """
    return np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel().tolist())


def propose(
    generator: np.random.Generator,
    position: Float[np.ndarray, "n d"],
    reference: Reference,
    scale: float,
    degrees: float,
    kernel: str,
) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, " n"]]:
    """Propose for all particles at once.

    ``random_walk``: ``x' = x + scale L z``.
    ``crank_nicolson``: ``x' = m + sqrt(1 - scale^2) (x - m) + scale sqrt(s) L z`` with ``s`` inverse gamma, reversible
    with respect to a Student-t of the reference's location and spread (the t-preconditioned Crank-Nicolson proposal of
    Grumitt, Karamanis and Seljak 2024). At scale 1 it nearly forgets where it came from, so that one move decorrelates
    a population that is close to normal; at small scales it is a random walk.

    Returns:
        proposals, and the log of the proposal's part of the acceptance ratio.
    """
    n, d = position.shape
    step = generator.standard_normal((n, d)) @ reference.cholesky.T
    if kernel == "random_walk":
        return position + scale * step, np.zeros(n)
    centred = position - reference.mean
    distance = squared_distance(reference.cholesky, centred)
    spread = 0.5 * (degrees + distance) / generator.standard_gamma(0.5 * (d + degrees), n)
    moved = np.sqrt(1.0 - scale**2) * centred + scale * np.sqrt(spread)[:, None] * step
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
    spread = np.sqrt(np.sum(first**2, axis=1) * np.sum(second**2, axis=1))
    return float(np.max(np.sum(first * second, axis=1) / np.maximum(spread, 1e-300)))


def squared_distance(factor: Float[np.ndarray, "d d"], centred: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
    """Of each point from the centre, in deviations of the covariance whose Cholesky factor is given."""
    return np.sum(solve_triangular(factor, centred.T, lower=True) ** 2, axis=0)
