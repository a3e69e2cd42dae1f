"""Starts of SMC: the prior if the budget covers the path, else the optima of a sharp posterior.

From a prior that is thousands of times wider than the posterior the path takes dozens of stages. An exhausted budget
then ends in a leap that leaves a few particles alive. Some fifty rollouts predict the number of stages, from the
likelihood's information at the best of some prior draws (`way_from_prior`). If the stages cost too much, optimisations
find the optima, and the sampler starts around them (`bridge`). The evidence of the blocks of rows is a by-product of a
start at the prior alone.

**The length of the path.** A sampler that keeps a share e of effective particles between targets takes steps of length
sqrt(ln 1/e) in the metric Var(log weight). In coordinates whitened by the prior, direction j has the information
``lambda_j`` about a value ``m_j`` prior deviations away. A likelihood with the exponent b changes the log weights at
the rate

    g(b) = sum_j [ lambda_j^2 / (2 (1 + b lambda_j)^2) + lambda_j^2 m_j^2 / (1 + b lambda_j)^3 ],

so that the number of stages is the integral of sqrt(g / ln(1/e)) over b from 0 to 1. With information that accrues
evenly along the data, b is also the prefix that a stage needs, which sets its cost.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from rfdropo_bayes.bayes.problem import Problem, ResidualProblem, WarmStart
from rfdropo_bayes.errors import InputError, NoLikelihoodError
from rfdropo_bayes.inference.evaluations import Ledger, block_boundaries
from rfdropo_bayes.inference.modes.mode_search import LaplaceConfig, Modes, find_modes, starts_of_draws
from rfdropo_bayes.inference.modes.optimisation import Laplace
from rfdropo_bayes.inference.modes.targets import make_target, prior_derivatives
from rfdropo_bayes.inference.progress import UNRECORDED, Logbook, run_digest
from rfdropo_bayes.inference.result import InferenceResult
from rfdropo_bayes.inference.smc import bridge, sampler
from rfdropo_bayes.inference.smc.sampler import FEWEST_PARTICLES, MOST_REPLICATES, WORTH_A_REPLICATE, SmcConfig
from rfdropo_bayes.inference.smc.tempering import EFFECTIVE

FROM_OPTIMA = "smc_from_optima"
OPTIMISING = 0.25  # share of the budget for optimisations
PILOT_SHARE = 0.4  # and the pilot run before them
PER_PILOT_PARTICLE = 32.0  # rollouts that a particle of the pilot run takes, typically
# With fewer, more than half of the pilot runs on a rugged ridge missed the optimum.
MOST_PILOT_PARTICLES, FEWEST_PILOT_PARTICLES = 128, 64
PILOT_STEPS = 7.0  # typical cost of an optimisation after a pilot run, in rollouts of the whole recording
CLOSE = 1e-2  # nats below its optimum at which an optimisation may end: the sampler starts from a wider distribution
STEPS = 12.0  # typical steps of an optimisation at each horizon
OPTIMISED = 0.6  # share of the work that is done after the optimisations, for a progress bar
PRIOR_DRAWS = 64  # prior draws; the likelihood's information is taken at the best
MARGIN = 3.0  # cost of real posteriors over the estimate, which assumes normality and even data
ENOUGH = 200  # particles per replicate that a start at the prior must allow
MOVES = 4.0  # of a stage: about 3 if the posterior is normal, otherwise more
FARTHEST = 5.0  # prior deviations of a value at most; farther values mean a conflict of prior and data


def run(problem: Problem, config: SmcConfig, key: PRNGKeyArray, logbook: Logbook = UNRECORDED) -> InferenceResult:
    """Sample a posterior, from the start that ``config.start`` names or that the budget allows.

    Raises:
        InputError: as `sampler.run`; or a start at the optima of a problem without residuals.
    """
    if config.start == "prior" or (config.start == "auto" and not _worth_comparing(problem, config)):
        return sampler.run(problem, config, key, logbook)
    if not isinstance(problem, ResidualProblem):
        raise InputError(
            'start = "optimum" needs residuals, but this problem has no residuals',
            where="[inference] start",
            remedy='start = "prior"',
        )
    way_key, search_key, sample_key = jax.random.split(key, 3)
    spent = Ledger()
    way = optima = None
    try:
        if config.start == "auto":
            way = expected_way(problem, config, way_key, spent)
        if way is None or not _affordable(way, config, _remaining(config, spent)):
            checkpoint = logbook.checkpoint("smc_optimisations", run_digest(problem, "smc_optimisations", config, key))
            search, search_log = _optimising(problem, config), logbook.part(0.0, OPTIMISED)
            optima = find_modes(problem, search, search_key, checkpoint, search_log, spent)
    except NoLikelihoodError:
        if config.start == "optimum":
            raise
        # No draw had a likelihood for an optimisation: more particles must show whether the prior excludes the data.
        remaining = replace(config, rollouts=_remaining(config, spent))
        return _with_cost(sampler.run(problem, remaining, key, logbook), spent)
    if optima is not None:
        return _from_optima(problem, config, optima, way, sample_key, logbook.part(OPTIMISED, 1.0))
    assert way is not None
    result = sampler.run(problem, _several(way, config, _remaining(config, spent)), sample_key, logbook)
    facts = {"expected_stages": way.stages, "information_nats": way.information}
    return replace(_with_cost(result, spent), details=result.details | facts)


def _remaining(config: SmcConfig, spent: Ledger) -> float | None:
    return None if config.rollouts is None else config.rollouts - spent.rollouts


def _optimising(problem: Problem, config: SmcConfig) -> LaplaceConfig:
    """Settings of the search for optima. A pilot run is made if the budget allows it and no earlier posterior gives
    starts. The number of optimisations is limited so that each can converge: an unconverged optimum misleads the
    sampler.
    """
    if config.rollouts is None:
        return LaplaceConfig()
    pilot_particles = min(int(PILOT_SHARE * config.rollouts / PER_PILOT_PARTICLE), MOST_PILOT_PARTICLES)
    if pilot_particles < FEWEST_PILOT_PARTICLES or (isinstance(problem, WarmStart) and problem.earlier):
        pilot_particles = 0
    budget = OPTIMISING * config.rollouts
    # Three horizons that double cost 1.75 times the last. A step is a Jacobian by differences and 6 dampings.
    steps = PILOT_STEPS if pilot_particles else 1.75 * STEPS
    starts = int(np.clip(budget / (steps * (4.0 * len(problem.names) + 7.0)), 1, LaplaceConfig().starts))
    limit = budget + pilot_particles * PER_PILOT_PARTICLE
    return LaplaceConfig(starts=starts, pilot_particles=pilot_particles, tolerance=CLOSE, rollouts=limit)


def _worth_comparing(problem: Problem, config: SmcConfig) -> bool:
    """Without a budget a start at the prior never leaps; a small budget is better spent on particles than on
    optimisations.
    """
    if not isinstance(problem, ResidualProblem) or config.rollouts is None:
        return False
    return config.rollouts >= 40.0 * config.chains * max(FEWEST_PARTICLES, len(problem.names))


def _affordable(way: Way, config: SmcConfig, remaining: float | None) -> bool:
    if remaining is None:
        return True
    return MARGIN * max(config.particles or ENOUGH, FEWEST_PARTICLES) * config.chains * way.rollouts <= remaining


def _several(way: Way, config: SmcConfig, remaining: float | None) -> SmcConfig:
    """Settings of a start at the prior: with the largest affordable number of replicates, unless given."""
    config = replace(config, rollouts=remaining)
    if config.replicates is not None or remaining is None:
        return config
    one = MARGIN * max(config.particles or WORTH_A_REPLICATE, FEWEST_PARTICLES) * way.rollouts
    replicates = int(np.clip(remaining / one, 1, MOST_REPLICATES))
    if replicates > 1 and config.particles is None:
        config = replace(config, particles=int(remaining / (replicates * MARGIN * way.rollouts)))
    return replace(config, replicates=replicates)


def _with_cost(result: InferenceResult, ledger: Ledger) -> InferenceResult:
    """Add the cost before the sampler to a result."""
    return replace(result, **(result.spent + ledger).record())


def _from_optima(
    problem: ResidualProblem, config: SmcConfig, optima: Modes, way: Way | None, key: PRNGKeyArray, logbook: Logbook
) -> InferenceResult:
    once = replace(config, rollouts=_remaining(config, optima.search.ledger), blocks=1)
    settings = replace(once, replicates=sampler.decided(1, once).chains)
    result = bridge.sample_from_modes(problem, settings, optima, key, logbook)
    told = {} if way is None else {"expected_stages": way.stages, "information_nats": way.information}
    return replace(result, method="smc", details={**result.details, "algorithm": FROM_OPTIMA, **told})


class Way(NamedTuple):
    """From the prior to the posterior."""

    stages: float  # expected number of targets in between
    rollouts: float  # full-length rollouts that each particle needs for it
    information: float  # entropy lost on the way if both ends are normal [nat]


def expected_way(problem: ResidualProblem, config: SmcConfig, key: PRNGKeyArray, ledger: Ledger) -> Way:
    """The way to a posterior that is as sharp as the likelihood at the best of `PRIOR_DRAWS` prior draws.

    Noise parameters are at the prior median, since the noise that fits a prior draw would make the likelihood far too
    flat. About log scales of noise, m residuals hold the information 2 m.

    Args:
        problem: problem to sample.
        config: settings of the sampler.
        key: random key.
        ledger: counts the rollouts.

    Raises:
        NoLikelihoodError: none of the draws has a positive likelihood.
    """
    draw_key, prior_key, way_key = jax.random.split(key, 3)
    best = starts_of_draws(problem, PRIOR_DRAWS, block_boundaries(problem.n_rows, 3)[0], 1, draw_key, ledger)[0][0]
    target = make_target(problem, problem.n_rows, ledger, best, prior_derivatives(problem))
    mean, covariance = bridge.prior_moments(problem, prior_key)
    point = np.where(target.noise, mean, best)
    residuals, jacobian = target.linearise(point)
    jacobian = np.where(target.noise | ~np.isfinite(jacobian).all(axis=0), 0.0, jacobian)
    information = jacobian.T @ jacobian + np.diag(np.where(target.noise, 2.0 * np.count_nonzero(residuals), 0.0))
    mode = Laplace(point, bridge.joint_covariance(information, covariance), 0.0)
    horizons = block_boundaries(problem.n_rows, config.blocks)
    return way_from_prior(problem, mode, horizons, way_key)


def way_from_prior(problem: Problem, mode: Laplace, horizons: tuple[int, ...], key: PRNGKeyArray) -> Way:
    """Expected stages and rollouts of a sampler that starts at the prior and adds the data at ``horizons``."""
    prior = np.asarray(problem.to_unconstrained(problem.sample_prior(key, 1000)), dtype=float)
    information, offset = _whitened(prior.mean(axis=0), np.atleast_2d(np.cov(prior.T)), mode)
    share = np.geomspace(1e-3 / max(float(information.max()), 1.0), 1.0, 2000)
    growth = 1.0 + share[:, None] * information
    speed = 0.5 * (information / growth) ** 2 + (information * offset) ** 2 / growth**3
    rate = np.sqrt(speed.sum(axis=1) / np.log(1.0 / EFFECTIVE))
    stages = 0.5 * (rate[1:] + rate[:-1]) * np.diff(share)
    prefix = np.asarray(horizons) / problem.n_rows
    cost = prefix[np.minimum(np.searchsorted(prefix, share[1:] - 1e-12), len(prefix) - 1)]
    rollouts = float(prefix.sum() + MOVES * (stages @ cost) + MOVES)
    return Way(float(stages.sum()), rollouts, float(0.5 * np.log1p(information).sum()))


def _whitened(
    mean: Float[np.ndarray, " d"], covariance: Float[np.ndarray, "d d"], mode: Laplace
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
    """Information of the likelihood and distance of its optimum from the prior mean, along its own directions."""
    inverse = np.linalg.inv(np.linalg.cholesky(covariance))
    precision, vectors = np.linalg.eigh(np.linalg.inv(inverse @ mode.covariance @ inverse.T))
    information = np.maximum(precision - 1.0, 0.0)
    moved = vectors.T @ (inverse @ (mode.mean - mean))
    offset = np.where(information > 0.1, moved * (1.0 + information) / np.maximum(information, 0.1), 0.0)
    return information, np.clip(offset, -FARTHEST, FARTHEST)
