"""Draws of normal approximations, weighted by the exact posterior, which corrects the approximation of curved ridges.

The first candidates come from the approximations. A normal has little density on a curved ridge, and weights cannot
reveal regions without candidates. So the next rounds come from Student-t distributions with the weighted covariance of
all earlier candidates, added to the normal's covariance (adaptive multiple importance sampling, Cornuet et al. 2012).
All together have the density ``q``. A candidate's weight for optimum k is ``p(u) / q(u)`` times the share of k in
``q(u)``; the weights of each optimum are scaled to the same sum. Draws of equal weight are
then resampled, and the effective number ``(sum w)^2 / sum w^2`` measures the number of effective candidates.

If the first candidates have nearly equal weights, the normals describe the posterior: the draws are then unweighted,
and no further rollouts are needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray
from numpyro.distributions import Distribution, MultivariateNormal, MultivariateStudentT
from scipy.special import logsumexp

from rfdropo_bayes.bayes.problem import Problem
from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.inference.evaluations import Ledger, evaluate_prior, evaluate_rows
from rfdropo_bayes.inference.modes.mixture import draw_mixture, shares
from rfdropo_bayes.inference.modes.optimisation import Laplace

CANDIDATE_SHARE = 0.25  # of a budget that optimisations leave to candidates
FEWEST_CANDIDATES = 20
ROUNDS = 4
FIRST = 100  # candidates that decide whether the normals need weights
ALIKE = 0.98  # effective share of the first candidates at or above which their weights count as equal
DEGREES = 5.0  # of freedom of the wide candidates
ENOUGH, TOO_FEW = 100.0, 20.0  # effective draws: fewer are reported; below the second limit they must not be used
LIKE = 0.1  # share of the candidates that counts if the normal describes the posterior


class Reweighted(NamedTuple):
    """Draws of equal weight."""

    position: Float[np.ndarray, "draw d"]  # unconstrained
    # log density of each data row at each of them; None for draws of the normals, which no rollout has seen
    rows: Float[np.ndarray, "draw row"] | None
    effective: float  # number of independent draws that they are worth
    candidates: int  # number of candidates with a posterior density


def reweighted(
    problem: Problem, modes: Sequence[Laplace], candidates: int, key: PRNGKeyArray, ledger: Ledger, count: int
) -> Reweighted | None:
    """Draws from a mixture of approximations, as the exact posterior has them.

    Args:
        problem: problem with this posterior.
        modes: normal approximations.
        candidates: number of rollouts, at most.
        key: random key.
        ledger: counts rollouts, and candidates without a likelihood.
        count: number of draws.

    Returns: None for too few candidates, or if no candidate has a posterior density.
    """
    if candidates < FEWEST_CANDIDATES:
        return None
    draw_key, order_key = jax.random.split(key)
    # By Cholesky factors: sizes of a law in metres have variances of 1e-11 beside 1 of others, and are no less known.
    normals = [MultivariateNormal(mode.mean, scale_tril=np.linalg.cholesky(mode.covariance)) for mode in modes]
    sources: list[Sequence[Distribution]] = [normals]
    u, rows, posterior = np.empty((0, len(modes[0].mean))), np.empty((0, problem.n_rows)), np.empty(0)
    for widened, size in _batches(candidates):
        if widened:
            by_mode = _weights(posterior, sources, u)
            sources.append([_widened(mode, u, by_mode[:, k]) for k, mode in enumerate(modes)])
        own_keys = jax.random.split(jax.random.fold_in(draw_key, len(u)), len(modes))
        sizes = zip(sources[-1], own_keys, shares(len(modes), size), strict=True)
        drawn = [np.asarray(source.sample(own, (int(n),))) for source, own, n in sizes]
        more_rows, more = _exact(problem, np.concatenate(drawn), ledger)
        u, rows = np.concatenate([u, *drawn]), np.concatenate([rows, more_rows])
        posterior = np.concatenate([posterior, more])
        if len(u) == size and size >= FEWEST_CANDIDATES and np.isfinite(posterior).all():
            worth = _effective(_by_share(_weights(posterior, sources, u))) / len(u)
            if worth >= ALIKE:
                return Reweighted(draw_mixture(modes, count, order_key), None, worth * count, len(u))
    if not np.isfinite(posterior).any():
        return None
    weight = _by_share(_weights(posterior, sources, u))
    chosen = _systematic(weight, count, order_key)
    return Reweighted(u[chosen], rows[chosen], _effective(weight), candidates)


def _batches(candidates: int) -> list[tuple[bool, int]]:
    """Numbers of candidates, and whether they come from the widened distributions: the first, the rest of the first
    round, and the next rounds."""
    rounds = np.diff(np.linspace(0, candidates, ROUNDS + 1).astype(int)).tolist()
    first = min(FIRST, rounds[0])
    narrow = [(False, size) for size in (first, rounds[0] - first) if size]
    return narrow + [(True, size) for size in rounds[1:]]


def _by_share(by_mode: Float[np.ndarray, "n mode"]) -> Float[np.ndarray, " n"]:
    """Weights of candidates: every optimum gets the same share."""
    mass = by_mode.sum(axis=0)
    reached = mass > 0.0
    return by_mode[:, reached] @ (1.0 / reached.sum() / mass[reached])


def _effective(weight: Float[np.ndarray, " n"]) -> float:
    """Number of independent draws that weighted candidates are worth."""
    return float(weight.sum() ** 2 / np.sum(weight**2))


def _exact(
    problem: Problem, u: Float[np.ndarray, "n d"], ledger: Ledger
) -> tuple[Float[np.ndarray, "n row"], Float[np.ndarray, " n"]]:
    """Log density of each row, and of the posterior; minus infinity for rollouts that are left out."""
    rows = evaluate_rows(problem, u, problem.n_rows, ledger)
    return rows, evaluate_prior(problem, u) + rows.sum(axis=1)


def _weights(
    posterior: Float[np.ndarray, " n"], sources: Sequence[Sequence[Distribution]], u: Float[np.ndarray, "n d"]
) -> Float[np.ndarray, "n mode"]:
    """``p / q`` times the share of each mode in ``q``, the largest of them 1; zero throughout if ``p`` is."""
    each = np.array([[np.asarray(source.log_prob(u)) for source in of_round] for of_round in sources])
    with np.errstate(divide="ignore"):
        parts = logsumexp(np.reshape(each, (len(sources), len(sources[0]), -1)), axis=0).T - np.log(len(sources[0]))
    logs = posterior[:, None] + parts - 2.0 * logsumexp(parts, axis=1, keepdims=True)
    return np.exp(logs - logs.max()) if np.isfinite(logs).any() else np.zeros_like(logs)


def _widened(mode: Laplace, u: Float[np.ndarray, "n d"], weight: Float[np.ndarray, " n"]) -> Distribution:
    """Student-t around the weighted mean; around the mode if nothing has a weight."""
    mean, covariance = mode.mean, mode.covariance
    if weight.sum() > 0.0:
        mean = weight @ u / weight.sum()
        covariance = (weight * (u - mean).T) @ (u - mean) / weight.sum()
    return MultivariateStudentT(DEGREES, mean, np.linalg.cholesky(covariance + mode.covariance))


def _systematic(weight: Float[np.ndarray, " n"], count: int, key: PRNGKeyArray) -> Int[np.ndarray, " draw"]:
    """Indices in proportion to the weights, in random order; equal weights give every index its share exactly."""
    first_key, order_key = jax.random.split(key)
    ticks = (np.arange(count) + float(jax.random.uniform(first_key))) / count
    chosen = np.searchsorted(np.cumsum(weight) / weight.sum(), ticks, side="left")
    return np.minimum(chosen, len(weight) - 1)[np.asarray(jax.random.permutation(order_key, count))]


def reweighting_cautions(comparison: Reweighted | None) -> list[Caution]:
    """Cautions from the comparison of the normal approximation with the exact posterior; None means no comparison."""
    remedy = "allow more rollouts, or use SMC"
    if comparison is None:
        sentence = f"no rollouts were left to check the normal approximation that the draws are from: {remedy}"
        return [Caution(Code.NORMAL_DIFFERS, sentence)]
    if comparison.effective >= ENOUGH:
        return []
    unlike = ": a normal distribution does not describe this posterior" * (
        comparison.effective < LIKE * comparison.candidates
    )
    sentence = (
        f"the draws are worth {comparison.effective:.0f} of {comparison.candidates} independent ones{unlike}; {remedy}"
    )
    return [Caution(Code.NORMAL_DIFFERS, sentence, grave=comparison.effective < TOO_FEW)]
