"""One stage of a tempered sequential Monte Carlo sampler along a path of targets: reweight, resample, move.

The path is ``log target(x; s) = base(x) + rows(x)[:s]`` with a real ``s``: whole rows, and a share of the next one. The
target before a stage is reweighted to the target after it, particles are resampled, and moved UNDER THE NEW target;
weights never mix two targets. Log-likelihood rows travel with their particles, so nothing is evaluated twice.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from blackjax.smc import resampling
from jaxtyping import Bool, Float, Int, PRNGKeyArray
from scipy.optimize import brentq
from scipy.special import logsumexp

from rfdropo_bayes.inference.smc.moves import (
    Reference,
    accept,
    adapt_scale,
    distinct_size,
    fit_reference,
    host_generator,
    propose,
    slowest_correlation,
)

DEGREES = 8.0  # of freedom of the Student-t behind proposals
EFFECTIVE = 0.5  # share of the live particles that stays effective from one target to the next
MOST_MOVES = 20  # of a stage
ACCEPTANCE = 0.3  # that step sizes are adapted to
CORRELATION = 0.3  # moves continue until no direction has a larger correlation with the start of the stage

Evaluate = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


class Population(NamedTuple):
    """Weighted particles on their way along a path."""

    position: Float[np.ndarray, "n d"]  # unconstrained particles
    base: Float[np.ndarray, " n"]  # log density of the path's starting target
    # log density still to come in, and already in, row by row; minus infinity is a dead particle
    rows: Float[np.ndarray, "n h"]
    log_weights: Float[np.ndarray, " n"]  # normalised
    progress: float  # position s on the path, in rows
    scale: float  # step size of the proposals, carried from stage to stage


class StageInfo(NamedTuple):
    """Facts about one stage."""

    progress: float  # position on the path at its end
    log_evidence_increment: float  # its increment of the log evidence
    # log evidence, relative to the start of the stage, at each whole row it passed
    row_log_evidence: Float[np.ndarray, " passed"]
    passed: Int[np.ndarray, " passed"]  # these rows, as prefix lengths
    ess: float  # effective sample size before resampling, as a share of all particles
    moves: int  # number of moves of every particle, 0 if weights were kept instead
    acceptance: float  # mean acceptance over the moves
    scale: float  # step size at the end
    correlation: float  # slowest remaining correlation after the moves


def path_density(rows: Float[np.ndarray, "n h"], progress: float) -> Float[np.ndarray, " n"]:
    """Sum of the first ``progress`` rows, of which the last may be a share."""
    whole = int(progress)
    share = progress - whole
    total = rows[:, :whole].sum(axis=1)
    return total + share * rows[:, whole] if share > 0.0 else total


def advance(population: Population, stop: float, *, leap: bool) -> tuple[Population, StageInfo, bool]:
    """Reweight to the next target of the path, at most to ``stop``.

    Args:
        population: particles at ``population.progress``.
        stop: end of the path.
        leap: go to the end with any weights (for an exhausted budget).

    Returns:
        the reweighted population, the facts about the stage so far, and whether the end was reached with the effective
        sample size kept.
    """
    start = population.progress
    first = int(start)
    # Columns: density at whole rows from the row at or before the start, relative to it.
    whole = np.cumsum(population.rows[:, first : int(np.ceil(stop))], axis=1)
    whole = np.concatenate([np.zeros((len(whole), 1)), whole], axis=1)

    def density_at(progress: float) -> np.ndarray:
        index = int(progress) - first
        share = progress - int(progress)
        return whole[:, index] + share * population.rows[:, first + index] if share > 0.0 else whole[:, index]

    origin = density_at(start)
    origin = np.where(np.isfinite(origin), origin, 0.0)  # dead already, weight zero: not -inf - -inf

    def log_weights_at(step: float) -> np.ndarray:
        return population.log_weights + density_at(min(start + step, stop)) - origin

    if leap:
        step, kept = stop - start, False
    else:
        step, kept = next_step(log_weights_at, stop - start, EFFECTIVE)
    progress = stop if step >= stop - start else start + step
    weights = log_weights_at(progress - start)
    increment = float(logsumexp(weights))
    passed = np.arange(int(start) + 1, int(progress) + 1)
    row_evidence = np.array([logsumexp(log_weights_at(row - start)) for row in passed])
    ess = np.exp(log_effective_sample_size(weights)) / len(weights)
    info = StageInfo(progress, increment, row_evidence, passed, float(ess), 0, np.nan, population.scale, np.nan)
    normalised = weights - increment if np.isfinite(increment) else weights
    moved = population._replace(log_weights=normalised, progress=progress)
    return moved, info, kept


def cross_references(population: Population) -> tuple[Reference, Reference]:
    """References for the moves of the first and of the second half of the particles, each fitted to the other half.

    A proposal that is fitted to the particles that it moves depends on them. Errors of its d (d + 1) / 2 covariances
    then bias the evidence by about -20 / N nats a stage in 8 dimensions (measured). With references from the other
    half, a fifth of this remains, the effect of scatter alone.
    """
    n = len(population.log_weights)
    weights = np.exp(population.log_weights)
    halves = (slice(n // 2, n), slice(0, n // 2))
    whole = fit_reference(population.position, weights / weights.sum())
    references = []
    for half in halves:
        share = weights[half].sum()
        usable = share > 0.0 and distinct_size(population.position[half], weights[half]) > 2.0
        references.append(fit_reference(population.position[half], weights[half] / share) if usable else whole)
    return references[0], references[1]


def resample(key: PRNGKeyArray, population: Population) -> tuple[Population, Int[np.ndarray, " n"]]:
    """Systematic resampling to equal weights; also the ancestor of each particle, in ascending order."""
    n = len(population.log_weights)
    weights = jnp.asarray(np.exp(population.log_weights))
    index = np.asarray(resampling.systematic(key, weights / weights.sum(), n))
    resampled = population._replace(
        position=population.position[index],
        base=population.base[index],
        rows=population.rows[index],
        log_weights=np.full(n, -np.log(n)),
    )
    return resampled, index


def move(
    key: PRNGKeyArray,
    population: Population,
    references: tuple[Reference, Reference],
    second: Bool[np.ndarray, " n"],
    evaluate: Evaluate,
    moves: int,
) -> tuple[Population, dict[str, Any]]:
    """Metropolis moves of equal-weight particles under the target at ``population.progress``.

    Args:
        key: random key.
        population: resampled particles.
        references: location and spread that shape the proposals of the two halves.
        second: particles that belong to the second half.
        evaluate: proposals to (base, rows).
        moves: most moves the budget allows; at least one is made.

    Returns:
        moved population and ``moves``, ``acceptance``, ``correlation`` of the stage.
    """
    first, scale, rates = population.position, population.scale, []
    density = population.base + path_density(population.rows, population.progress)
    correlation = 1.0
    for count in range(max(1, moves)):
        generator = host_generator(jax.random.fold_in(key, count))
        proposal, ratio = _by_halves(generator, population.position, references, second, scale)
        base, rows = evaluate(proposal)
        proposed = base + path_density(rows, population.progress)
        chosen = accept(generator, ratio + proposed - density)
        population = population._replace(
            position=np.where(chosen[:, None], proposal, population.position),
            base=np.where(chosen, base, population.base),
            rows=np.where(chosen[:, None], rows, population.rows),
        )
        density = np.where(chosen, proposed, density)
        rates.append(float(chosen.mean()))
        scale = adapt_scale(scale, rates[-1], ACCEPTANCE)
        correlation = slowest_correlation(first, population.position, references[0])
        if correlation <= CORRELATION:
            break
    done = {"moves": len(rates), "acceptance": float(np.mean(rates)), "correlation": correlation, "scale": scale}
    return population._replace(scale=scale), done


def _by_halves(
    generator: np.random.Generator,
    position: Float[np.ndarray, "n d"],
    references: tuple[Reference, Reference],
    second: Bool[np.ndarray, " n"],
    scale: float,
) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, " n"]]:
    proposal, ratio = np.empty_like(position), np.empty(len(position))
    for members, reference in zip((~second, second), references, strict=True):
        proposal[members], ratio[members] = propose(generator, position[members], reference, scale, DEGREES)
    return proposal, ratio


def stage(
    key: PRNGKeyArray, population: Population, stop: float, evaluate: Evaluate, moves: int
) -> tuple[Population, StageInfo]:
    """Reweight towards ``stop``; resample and move unless the end was reached with enough effective particles.

    ``moves`` = 0 means that the budget is spent: the stage leaps to the end of the path and only resamples.
    """
    population, info, kept = advance(population, stop, leap=moves == 0)
    if kept or not np.isfinite(info.log_evidence_increment):
        return population, info
    return refresh(key, population, info, evaluate, moves)


def refresh(
    key: PRNGKeyArray, population: Population, info: StageInfo, evaluate: Evaluate, moves: int
) -> tuple[Population, StageInfo]:
    """Resample to equal weights and move under the present target."""
    resample_key, move_key = jax.random.split(key)
    references = cross_references(population)
    population, index = resample(resample_key, population)
    # Each particle moves by the statistics of the OTHER half: see cross_references.
    halves = index >= len(index) // 2
    if moves == 0:
        return population, info
    population, done = move(move_key, population, references, halves, evaluate, moves)
    return population, info._replace(**done)


def prolong(key: PRNGKeyArray, population: Population, evaluate: Evaluate, moves: int, rounds: int) -> Population:
    """Equal-weight particles, with their positions after each round of moves under the same target.

    All are draws of the target; a hundred particles give coarse quantiles, even more so with copies from resampling.

    The key must differ from the key of the `refresh` before: ``fold_in(key, i)`` is the i-th part of ``split(key)``,
    and moves with the same random numbers end near their start.
    """
    populations = [population]
    for index in range(rounds):
        second = np.arange(len(population.base)) >= len(population.base) // 2
        round_key = jax.random.fold_in(key, 1 + index)
        populations.append(
            move(round_key, populations[-1], cross_references(populations[-1]), second, evaluate, moves)[0]
        )
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(p, name) for p in populations]) for name in ("position", "base", "rows")
    }
    count = len(joined["base"])
    return population._replace(log_weights=np.full(count, -np.log(count)), **joined)


def next_step(
    log_weights_at: Callable[[float], Float[np.ndarray, " n"]], longest: float, target: float
) -> tuple[float, bool]:
    """Longest step along a path of targets that keeps the effective sample size.

    Args:
        log_weights_at: log weights of the particles after a step of the given length; 0 gives the present weights.
        longest: length of the step to the end of the path.
        target: effective sample size to keep, as a share of the particles that have weight at the end of the path.

    Returns: the length, and whether the end of the path is reached at the target effective size.
    """
    end = log_weights_at(longest)
    alive = np.isfinite(end)
    if not alive.any():
        return longest, False
    now = log_weights_at(0.0)
    survivors = log_effective_sample_size(np.where(alive, now, -np.inf))
    # Carried weights may already be just above the target, or below it once dead particles are gone: always advance.
    wanted = min(math.log(target * max(alive.sum(), 1)), survivors + math.log(0.95))

    def excess(step: float) -> float:
        return log_effective_sample_size(log_weights_at(step)) - wanted

    if excess(longest) >= 0.0:
        return longest, True
    # Relative, not absolute, precision: precise data make the first steps as short as 1e-8 of the path.
    return float(brentq(excess, 0.0, longest, xtol=1e-300, rtol=1e-6, maxiter=500)), False


def log_effective_sample_size(log_weights: Float[np.ndarray, " n"]) -> float:
    """Logarithm of ``(sum w)^2 / sum w^2``; minus infinity when no weight is left."""
    top = logsumexp(log_weights)
    return float(2.0 * top - logsumexp(2.0 * log_weights)) if np.isfinite(top) else -math.inf
