"""Draws of normal approximations, weighted by the exact posterior, which corrects the approximation of curved ridges.

The first candidates come from the approximations. A normal has little density on a curved ridge, and weights cannot
reveal regions without candidates. So the next rounds come from Student-t distributions with the weighted covariance of
all earlier candidates, added to the normal's covariance (adaptive multiple importance sampling, Cornuet et al. 2012).
All together have the density ``q``. A candidate's weight for optimum k is ``p(u) / q(u)`` times the share of k in
``q(u)``; the weights of each optimum are scaled to the same sum. Draws of equal weight are
then resampled, and the effective number ``(sum w)^2 / sum w^2`` measures the number of effective candidates.

If the first candidates have nearly equal weights, the normals describe the posterior: the draws are then unweighted,
and no further rollouts are needed.

Several optima: selection of the optima that explain the data about equally well, and their weights in a posterior.

Densities alone do not decide this. Errors of a simulator are correlated between rows. Under white noise, optima that
explain the data equally well then differ by hundreds of nats. Optima are therefore compared by sums over rows of
differences of log densities, with standard errors that include the autocorrelation (Vehtari, Gelman & Gabry 2017, for
series).

Standard deviations of groups of coordinates, integrated out of a normal approximation instead of optimised.

A hierarchy cannot be approximated at its joint mode, at which a standard deviation is zero or at the end of its prior.
Given the standard deviations, the group parameters are as normal as the others. The optimisation therefore fixes the
standard deviations. Their posterior follows from the likelihood's quadratic form at the mode, which does not depend on
them (nested Laplace approximation, Rue, Martino & Chopin 2009).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray
from numpyro.diagnostics import effective_sample_size
from scipy.optimize import minimize
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, multivariate_t

from rfdropo_bayes.bayes.problem import Problem
from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.inference.evaluations import Ledger, evaluate_prior, evaluate_rows
from rfdropo_bayes.inference.modes.optimisation import Laplace
from rfdropo_bayes.inference.smc.moves import host_generator

DRAWS = 4000  # of the proposal, from which the scales are resampled
FREEDOM = 5.0  # of the proposal, a Student-t around the mode of the scales' logarithms: it has to have their tails
DIFFERENCE = 1e-2  # of a logarithm, for second differences
WIDEST = 2.0  # deviation of the proposal's logarithms: beyond it the prior is as narrow


class Mixed(NamedTuple):
    """A normal approximation with its scales integrated out."""

    scales: Float[np.ndarray, "draw scale"]  # draws of the standard deviations
    position: Float[np.ndarray, "draw d"]  # draws of the coordinates, given each
    log_evidence: float  # log evidence with the scales integrated out


CERTAIN = 2.0  # standard errors by which an optimum must be worse to be left out
STRONG = 3.0  # nats by which it must also be worse: less is no strong evidence under any noise (Kass & Raftery 1995)

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
    generator = host_generator(draw_key)
    sources = [[multivariate_normal(mode.mean, mode.covariance) for mode in modes]]
    u, rows, posterior = np.empty((0, len(modes[0].mean))), np.empty((0, problem.n_rows)), np.empty(0)
    for widened, size in _batches(candidates):
        if widened:
            by_mode = _weights(posterior, sources, u)
            sources.append([_widened(mode, u, by_mode[:, k]) for k, mode in enumerate(modes)])
        sizes = zip(sources[-1], shares(len(modes), size), strict=True)
        drawn = [np.reshape(source.rvs(int(n), random_state=generator), (n, -1)) for source, n in sizes if n]
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
    posterior: Float[np.ndarray, " n"], sources: Sequence[Sequence[Any]], u: Float[np.ndarray, "n d"]
) -> Float[np.ndarray, "n mode"]:
    """``p / q`` times the share of each mode in ``q``, the largest of them 1; zero throughout if ``p`` is."""
    each = np.array([[source.logpdf(u) for source in of_round] for of_round in sources])
    with np.errstate(divide="ignore"):
        parts = logsumexp(np.reshape(each, (len(sources), len(sources[0]), -1)), axis=0).T - np.log(len(sources[0]))
    logs = posterior[:, None] + parts - 2.0 * logsumexp(parts, axis=1, keepdims=True)
    return np.exp(logs - logs.max()) if np.isfinite(logs).any() else np.zeros_like(logs)


def _widened(mode: Laplace, u: Float[np.ndarray, "n d"], weight: Float[np.ndarray, " n"]) -> Any:
    """Student-t around the weighted mean; around the mode if nothing has a weight."""
    if weight.sum() == 0.0:
        return multivariate_t(mode.mean, 2.0 * mode.covariance, DEGREES)
    mean = weight @ u / weight.sum()
    covariance = (weight * (u - mean).T) @ (u - mean) / weight.sum()
    return multivariate_t(mean, covariance + mode.covariance, DEGREES)


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


def alternatives(rows: Float[np.ndarray, "mode row"]) -> Bool[np.ndarray, " mode"]:
    """Mask of the optima that explain the data about as well as the best, from the log density of rows.

    An optimum is excluded if its sum over rows is lower by more than 3 nats and by more than two standard errors of
    that sum. The standard error takes the autocorrelation of the differences into account. The best is always kept.
    """
    best = int(np.argmax(rows.sum(axis=1)))
    difference = rows[best] - rows
    return np.array([i == best or _uncertain(each) for i, each in enumerate(difference)])


def _uncertain(difference: Float[np.ndarray, " row"]) -> bool:
    count = len(difference)
    if not np.isfinite(difference).all():
        return False
    if count < 4 or difference.sum() <= STRONG:
        return bool(difference.sum() <= STRONG)
    size = float(effective_sample_size(difference[None]))
    # Differences that alternate must not count as more rows than there are; a constant one is certain.
    size = np.clip(size, 1.0, count) if np.isfinite(size) else count
    return bool(difference.sum() <= CERTAIN * count * difference.std(ddof=1) / np.sqrt(size))


def shares(modes: int, count: int) -> Int[np.ndarray, " mode"]:
    """Numbers of draws of each mode, equal up to one."""
    return np.diff(np.round(np.arange(1, modes + 1) / modes * count).astype(int), prepend=0)


def draw_mixture(modes: Sequence[Laplace], count: int, key: PRNGKeyArray) -> Float[np.ndarray, "draw d"]:
    """Draws from normals in equal parts, in random order."""
    order_key, draw_key = jax.random.split(key)
    member = np.repeat(np.arange(len(modes)), shares(len(modes), count))
    normal = np.asarray(jax.random.normal(draw_key, (count, len(modes[0].mean))))
    factors = np.stack([np.linalg.cholesky(mode.covariance) for mode in modes])
    means = np.stack([mode.mean for mode in modes])
    drawn = means[member] + np.einsum("nij,nj->ni", factors[member], normal)
    return drawn[np.asarray(jax.random.permutation(order_key, count))]


def mixture_cautions(optima: int) -> list[Caution]:
    """A caution if several optima explain the data about equally well."""
    if optima == 1:
        return []
    sentence = (
        f"{optima} optima explain the data about as well, and they are mixed in equal parts: one normal distribution "
        "does not describe this posterior; use SMC if the noise model is right"
    )
    return [Caution(Code.SEVERAL_OPTIMA, sentence)]


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
