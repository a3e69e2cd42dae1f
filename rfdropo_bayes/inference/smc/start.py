"""Sequential Monte Carlo from where it can be afforded: the prior, or the optima of a sharp posterior.

From a prior that is thousands of times wider than the posterior the way takes dozens of stages, and a budget that is
used up on it ends in a leap that leaves a few particles alive. A posterior that sharp is close to its Laplace
approximation, which costs some hundred rollouts to find: the sampler then starts there, inflated, with a share of
particles at the prior, and the evidence is as exact as before. What a start at the prior passes on its way, the
evidence of the blocks of rows, is then taken by importance sampling around the optima of the prefixes.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import TypeGuard

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from rfdropo_bayes.bayes.problem import Problem, ResidualProblem
from rfdropo_bayes.errors import InputError, NoLikelihoodError
from rfdropo_bayes.inference.checkpoints import run_digest
from rfdropo_bayes.inference.evaluations import Ledger
from rfdropo_bayes.inference.logbook import UNRECORDED, Logbook
from rfdropo_bayes.inference.modes.search import LaplaceConfig, Modes, find_modes
from rfdropo_bayes.inference.plain import refinement
from rfdropo_bayes.inference.plain.problem import NumpyroProblem
from rfdropo_bayes.inference.result import InferenceResult
from rfdropo_bayes.inference.schedules import block_boundaries
from rfdropo_bayes.inference.smc import bridge
from rfdropo_bayes.inference.smc import sampler as horizon_smc
from rfdropo_bayes.inference.smc.prefix_scores import PrefixEvidence, block_scores, prefix_evidence
from rfdropo_bayes.inference.smc.sampler import FEWEST_PARTICLES, MOST_REPLICATES, WORTH_A_REPLICATE, SmcConfig
from rfdropo_bayes.inference.smc.sharpness import Way, way_from_prior

CLIMBING = 0.25  # share of the budget that climbs to optima may take
SURVEY_OF_ALL = 0.4  # and the survey before them
PER_SURVEYOR = 32.0  # rollouts that a particle of the survey takes, typically
# With fewer, more than half of the surveys of a rugged ridge missed the summit.
MOST_SURVEYORS, FEWEST_SURVEYORS = 128, 64
CLOSE = 1e-2  # nats below its optimum that a climb may end: the sampler starts from a wider distribution
STEPS = 12.0  # that a climb takes at each horizon, typically
SURVEYED_STEPS = 7.0  # of the length of the whole recording that a climb after a survey takes, typically
SURVEYED_STARTS = 8  # at most
CLIMBED = 0.6  # share of the work that is done when climbs have ended, for a progress bar
SCORING = 0.1  # and the evidence of the blocks
MARGIN = 3.0  # what real posteriors cost over the estimate, which takes them to be normal and data to be even
ENOUGH = 200  # particles per replicate that a start at the prior must allow


def run(
    problem: Problem,
    config: SmcConfig,
    key: PRNGKeyArray,
    logbook: Logbook = UNRECORDED,
) -> InferenceResult:
    """Sample a posterior, from the start that ``config.start`` names or that the budget allows.

    Raises:
        InputError: as `horizon_smc.run`; or a start at the optima is asked for and the problem has no residuals.
    """
    if _refinable(problem, config):
        return refinement.run(problem, config, key, logbook)
    if config.start == "prior" or (config.start == "auto" and not _worth_climbing(problem, config)):
        return horizon_smc.run(problem, config, key, logbook)
    if not isinstance(problem, ResidualProblem):
        raise InputError(
            'start = "optimum" is for problems with residuals, and this one has no residuals',
            where="[inference] start",
            remedy='start = "prior", or method = "bridge"',
        )
    climb_key, way_key, sample_key = jax.random.split(key, 3)
    climbing = _climbing(problem, config)
    digest = run_digest(problem, "smc_climbs", config, key)
    checkpoint = logbook.checkpoint("smc_climbs", digest)
    spent = Ledger()
    try:
        found = find_modes(problem, climbing, climb_key, checkpoint, logbook.part(0.0, CLIMBED), spent)
    except NoLikelihoodError:
        if config.start == "optimum":
            raise
        # No draw to climb from had a likelihood: whether the prior excludes the data is for more particles to say.
        left = None if config.rollouts is None else config.rollouts - spent.rollouts
        return _with_cost(horizon_smc.run(problem, replace(config, rollouts=left), key, logbook), spent)
    logbook = logbook.part(CLIMBED, 1.0)
    horizons = block_boundaries(problem.n_rows, config.blocks, config.spacing)
    way = way_from_prior(problem, found.modes[0], horizons, config.target_ess, way_key)
    left = None if config.rollouts is None else config.rollouts - found.climbs.ledger.rollouts
    if config.start == "auto" and _affordable(way, config, left):
        result = horizon_smc.run(problem, _several(way, config, left), sample_key, logbook)
        return _with_climbs(result, found, way)
    return _from_optima(problem, config, found, way, sample_key, logbook)


def _climbing(problem: Problem, config: SmcConfig) -> LaplaceConfig:
    """A survey, where the budget allows one and no earlier posterior knows where to start; and as many climbs as the
    budget can bring to an optimum: one that stops on the way misleads what starts from it."""
    if config.rollouts is None:
        return LaplaceConfig()
    surveyors = min(int(SURVEY_OF_ALL * config.rollouts / PER_SURVEYOR), MOST_SURVEYORS)
    if surveyors < FEWEST_SURVEYORS or getattr(problem, "earlier", None):
        surveyors = 0
    budget = CLIMBING * config.rollouts
    # Three horizons that double cost 1.75 times the last; after a survey few summits are left at the second of them. A
    # step is a Jacobian by differences and 6 dampings.
    steps, most = (SURVEYED_STEPS, SURVEYED_STARTS) if surveyors else (1.75 * STEPS, LaplaceConfig().starts)
    starts = int(np.clip(budget / (steps * (4.0 * len(problem.names) + 7.0)), 1, most))
    limit = budget + surveyors * PER_SURVEYOR
    return LaplaceConfig(starts=starts, survey=surveyors, tolerance=CLOSE, rollouts=limit)


def _refinable(problem: Problem, config: SmcConfig) -> TypeGuard[NumpyroProblem]:
    """A plain model: it has gradients, and rows that are no rollouts, so that nothing limits a second pass."""
    return config.start == "auto" and config.rollouts is None and isinstance(problem, NumpyroProblem)


def _worth_climbing(problem: Problem, config: SmcConfig) -> bool:
    """Without a budget a start at the prior never leaps; a small one is better spent on particles than on climbs."""
    if not isinstance(problem, ResidualProblem) or config.rollouts is None:
        return False
    return config.rollouts >= 40.0 * config.chains * max(FEWEST_PARTICLES, len(problem.names))


def _affordable(way: Way, config: SmcConfig, left: float | None) -> bool:
    if left is None:
        return True
    return MARGIN * max(config.particles or ENOUGH, FEWEST_PARTICLES) * config.chains * way.rollouts <= left


def _several(way: Way, config: SmcConfig, left: float | None) -> SmcConfig:
    """Settings of a start at the prior: unless it is said how many, as many replicates as can go all the way."""
    config = replace(config, rollouts=left)
    if config.replicates is not None or left is None:
        return config
    one = MARGIN * max(config.particles or WORTH_A_REPLICATE, FEWEST_PARTICLES) * way.rollouts
    replicates = int(np.clip(left / one, 1, MOST_REPLICATES))
    if replicates > 1 and config.particles is None:
        config = replace(config, particles=int(left / (replicates * MARGIN * way.rollouts)))
    return replace(config, replicates=replicates)


def _with_climbs(result: InferenceResult, found: Modes, way: Way) -> InferenceResult:
    return replace(
        _with_cost(result, found.climbs.ledger),
        seconds=result.seconds + found.climbs.seconds,
        details=result.details | {"start": "prior", "expected_stages": way.stages, "information_nats": way.information},
    )


def _with_cost(result: InferenceResult, ledger: Ledger) -> InferenceResult:
    """What was spent before the sampler began, too."""
    return replace(
        result,
        rollouts=result.rollouts + ledger.rollouts,
        evaluations=result.evaluations + ledger.evaluations,
        excluded=dict(Counter(result.excluded) + ledger.excluded),
    )


def _from_optima(
    problem: ResidualProblem,
    config: SmcConfig,
    found: Modes,
    way: Way,
    key: PRNGKeyArray,
    logbook: Logbook,
) -> InferenceResult:
    sample_key, score_key = jax.random.split(key)
    left = None if config.rollouts is None else config.rollouts - found.climbs.ledger.rollouts
    prefixed = len(block_boundaries(problem.n_rows, config.blocks, config.spacing)) > 1
    scoring = None if left is None else SCORING * prefixed * config.rollouts  # type: ignore[operator]
    sampling = None if left is None else left - scoring  # type: ignore[operator]
    settings = bridge.BridgeConfig(
        rollouts=sampling,
        particles=config.particles,
        replicates=horizon_smc.decided(1, replace(config, rollouts=sampling, blocks=1)).chains,
        target_ess=config.target_ess,
        draws=config.draws,
    )
    result = bridge.sample_from_modes(problem, settings, found, sample_key, logbook)
    prefixes, ledger = _prefixes(problem, config, found, scoring, score_key)
    value, sd = result.log_evidence or (np.nan, np.nan)
    whole = PrefixEvidence(problem.n_rows, value, 0.0 if np.isnan(sd) else sd, 1.0)
    every = np.full(problem.n_rows, np.nan)
    for prefix in (*prefixes, whole):
        every[prefix.horizon - 1] = prefix.value
    return replace(
        result,
        method="smc",
        prefix_log_evidence=every,
        block_scores=block_scores([*prefixes, whole]),
        rollouts=result.rollouts + ledger.rollouts,
        evaluations=result.evaluations + ledger.evaluations,
        details=result.details
        | {
            "start": "optimum",
            "expected_stages": way.stages,
            "information_nats": way.information,
            "prefix_ess": [prefix.ess for prefix in prefixes],
        },
    )


def _prefixes(
    problem: ResidualProblem, config: SmcConfig, found: Modes, scoring: float | None, key: PRNGKeyArray
) -> tuple[list[PrefixEvidence], Ledger]:
    """Evidence at the ends of all blocks but the last, whose evidence is the sampler's."""
    ledger = Ledger()
    horizons = block_boundaries(problem.n_rows, config.blocks, config.spacing)[:-1]
    assert found.climbs.noise is not None
    if not horizons:
        return [], ledger
    return prefix_evidence(problem, found.modes[0], found.climbs.noise, horizons, scoring, key, ledger), ledger
