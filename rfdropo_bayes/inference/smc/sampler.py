"""Sequential Monte Carlo whose stages lengthen the horizon: prior, posterior given h1 rows, ..., given all rows.

Inside a block of rows the path is followed row by row, and a very informative row is added in shares. Every target is
then (nearly) the posterior of a prefix, which yields the evidence of EVERY prefix.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from rfdropo_bayes.bayes.problem import Problem
from rfdropo_bayes.errors import InputError, NoLikelihoodError
from rfdropo_bayes.inference.evaluations import (
    Ledger,
    block_boundaries,
    evaluate_prior,
    evaluate_rows,
    representable_draws,
)
from rfdropo_bayes.inference.method_options import MethodOptions
from rfdropo_bayes.inference.progress import UNRECORDED, Checkpoint, Logbook, run_digest
from rfdropo_bayes.inference.result import (
    InferenceResult,
    chains,
    exclusion_cautions,
    prior_cautions,
    replicate_cautions,
    stage_cautions,
    unseen_modes,
)
from rfdropo_bayes.inference.smc.moves import initial_scale
from rfdropo_bayes.inference.smc.tempering import MOST_MOVES, Population, StageInfo, prolong, refresh, stage

PARTICLES_WITHOUT_BUDGET = 1000
ROLLOUTS_PER_PARTICLE = 20.0
FEWEST_PARTICLES = 50
WORTH_A_REPLICATE = 100  # particles
MOST_REPLICATES = 4
STARTS = ("auto", "prior", "optimum")
NOT_REPRESENTABLE = "not_representable"
FROM_PRIOR = "smc_from_prior"


@dataclass(frozen=True, repr=False)
class SmcConfig(MethodOptions, called="SMC"):
    """Horizon SMC: posterior and evidence, by sampling from growing prefixes.

    Attributes:
        rollouts: budget in full-length rollouts, of all replicates together; None for no limit.
        particles: number per replicate; None takes the largest number that the budget allows, or 1000 without a budget.
        replicates: independent repetitions, the chains of the posterior; their scatter is the deviation of the
            evidence. None takes up to four as the budget allows, or 1 without a budget: see `decided`.
        blocks: number of times the horizon is lengthened.
        start: "prior", "optimum", or "auto": see `starts`; this module always starts at the prior.
        draws: least number of draws; fewer particles are moved further with the rest of a budget: see
            `tempering.prolong`.
    """

    rollouts: float | None = None
    particles: int | None = None
    replicates: int | None = None
    blocks: int = 6
    start: str = "auto"
    draws: int = 400

    def __post_init__(self) -> None:
        where = "[inference]"
        if self.start not in STARTS:
            raise InputError(f"unknown start {self.start!r}", where=where, remedy=f"use one of {', '.join(STARTS)}")
        for name in ("replicates", "blocks", "draws"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InputError(f"{name} = {getattr(self, name)} is less than 1", where=where)
        if self.particles is not None and self.particles < 10:
            raise InputError(f"particles = {self.particles} is less than 10", where=where)
        if self.rollouts is not None and self.rollouts <= 0.0:
            raise InputError("rollouts must be positive", where=where)

    @property
    def chains(self) -> int:
        """Replicates that were asked for, or one."""
        return self.replicates or 1


class ReplicatePlan(NamedTuple):
    """Sizes that are fixed before a replicate starts."""

    particles: int  # number of particles
    horizons: tuple[int, ...]  # prefix lengths at the ends of the blocks
    budget: float  # rollouts of this replicate; infinite for no limit
    most_moves: int = MOST_MOVES  # of a stage


class SmcState(NamedTuple):
    """State of a replicate between two stages."""

    population: Population  # particles; their rows reach to the end of the present block
    block: int  # index of the present block; -1 before the first
    stage: int  # number of stages done; random keys derive from it
    log_evidence: float  # log p(rows passed)
    prefix_log_evidence: Float[np.ndarray, " n_rows"]  # log evidence at every prefix passed, NaN elsewhere
    ledger: Ledger  # cost and exclusions
    trace: list[dict[str, Any]]  # one dictionary per stage
    seconds: float  # time spent
    finished: bool  # the last stage is done


def decided(n_rows: int, config: SmcConfig) -> SmcConfig:
    """The settings with a number of replicates: the most that the budget allows with enough particles each."""
    if config.replicates is not None or config.rollouts is None:
        return config
    looks = sum(block_boundaries(n_rows, config.blocks)) / n_rows
    one = (config.particles or WORTH_A_REPLICATE) * max(ROLLOUTS_PER_PARTICLE, 2.0 * looks)
    return replace(config, replicates=int(np.clip(config.rollouts / one, 1, MOST_REPLICATES)))


def make_plan(problem: Problem, config: SmcConfig, horizons: tuple[int, ...] = ()) -> ReplicatePlan:
    """Fix particles and blocks, which end at ``horizons`` if these are given, so that the budget can be kept.

    Raises:
        InputError: the budget is too small for one evaluation of every block and one last move per particle.
    """
    horizons = horizons or block_boundaries(problem.n_rows, config.blocks)
    budget = np.inf if config.rollouts is None else config.rollouts / config.chains
    looks = sum(horizons) / problem.n_rows
    if config.particles is not None:
        particles = config.particles
    elif config.rollouts is None:
        particles = PARTICLES_WITHOUT_BUDGET
    else:
        particles = int(budget / max(ROLLOUTS_PER_PARTICLE, 2.0 * looks))
    least = max(particles, FEWEST_PARTICLES if config.particles is None else 1)
    if least * (looks + 1.0) > budget:
        raise InputError(
            f"{config.rollouts:g} rollouts are too few for {least} particles over {len(horizons)} blocks",
            where="[inference] rollouts",
            remedy=f"allow at least {config.chains * least * (looks + 1.0):.0f}, or use fewer particles",
        )
    return ReplicatePlan(least, horizons, budget)


def init(key: PRNGKeyArray, problem: Problem, plan: ReplicatePlan) -> SmcState:
    """Prior draws, before any rollout.

    Draws outside the range of their coordinates keep their share of the prior, with weight zero.

    Raises:
        InputError: no draw has a finite prior density.
    """
    n = plan.particles
    u, base, drawn = representable_draws(problem, key, n)
    if len(base) == 0:
        raise InputError(
            f"none of {drawn} prior draws has a finite prior density",
            where="[model.priors]",
            remedy="look at the priors",
        )
    ledger = Ledger(excluded=Counter({NOT_REPRESENTABLE: drawn - len(base)} if len(base) < drawn else {}))
    share, alive = len(base) / drawn, min(n, len(base))
    weights = np.where(np.arange(n) < alive, np.log(share / alive), -np.inf)
    stand_in = np.minimum(np.arange(n), alive - 1)
    scale = initial_scale(u.shape[1])
    population = Population(u[stand_in], base[stand_in], np.zeros((n, 0)), weights, 0.0, scale)
    return SmcState(population, -1, 0, 0.0, np.full(problem.n_rows, np.nan), ledger, [], 0.0, False)


def step(
    key: PRNGKeyArray, state: SmcState, problem: Problem, plan: ReplicatePlan, config: SmcConfig
) -> tuple[SmcState, StageInfo]:
    """One stage: look further ahead if the block is used up, reweight, resample, move.

    Args:
        key: key of the whole replicate; the stage's own is derived from it, which makes a resumed run exact.
        state: state of the replicate.
        problem: problem to sample.
        plan: sizes.
        config: settings.
    """
    began = time.monotonic()
    key = jax.random.fold_in(key, state.stage)
    if state.block < 0 or state.population.progress == plan.horizons[state.block]:
        state = _extend(state, problem, plan.horizons[state.block + 1])
    horizon = plan.horizons[state.block]
    evaluate = partial(_evaluate, problem, horizon, state.ledger)
    moves = _affordable_moves(state, plan, horizon, problem.n_rows)
    population, info = stage(key, state.population, float(horizon), evaluate, min(moves, plan.most_moves))
    if not np.isfinite(info.log_evidence_increment):
        raise NoLikelihoodError(
            "the prior excludes the data: no parameter set has a positive likelihood "
            f"up to row {horizon} ({state.ledger.reasons})",
            where="[model.priors]",
            remedy="widen the priors, or look at the simulator's reports for them",
        )
    finished = population.progress == problem.n_rows
    evidence = state.log_evidence + info.log_evidence_increment
    prefix = state.prefix_log_evidence.copy()
    prefix[info.passed - 1] = state.log_evidence + info.row_log_evidence
    facts = {"horizon": horizon, "budget_exhausted": moves == 0, **_facts(info), "log_evidence": evidence}
    state.trace.append(facts | {"rollouts": state.ledger.rollouts})
    if finished:
        moves = max(1, _affordable_moves(state, plan, horizon, problem.n_rows, last=True))
        last_key = jax.random.fold_in(key, 1)
        population, done = refresh(last_key, population, info, evaluate, min(moves, plan.most_moves))
        affordable = (
            _affordable_moves(state, plan, horizon, problem.n_rows, last=True) if np.isfinite(plan.budget) else 0
        )
        rounds = min(affordable // done.moves, -(-config.draws // (plan.particles * config.chains)) - 1)
        population = prolong(jax.random.fold_in(key, 2), population, evaluate, done.moves, rounds)
        state.trace.append(facts | _facts(done) | {"rollouts": state.ledger.rollouts, "final": True})
    state = state._replace(
        population=population,
        stage=state.stage + 1,
        log_evidence=evidence,
        prefix_log_evidence=prefix,
        seconds=state.seconds + time.monotonic() - began,
        finished=finished,
    )
    return state, info


def _extend(state: SmcState, problem: Problem, horizon: int) -> SmcState:
    """Roll every particle out to the next horizon; its earlier rows are kept."""
    known = state.population.rows
    rows = evaluate_rows(problem, state.population.position, horizon, state.ledger)
    rows = np.concatenate([known, rows[:, known.shape[1] :]], axis=1)
    return state._replace(population=state.population._replace(rows=rows), block=state.block + 1)


def _evaluate(problem: Problem, horizon: int, ledger: Ledger, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return evaluate_prior(problem, u), evaluate_rows(problem, u, horizon, ledger)


def _affordable_moves(state: SmcState, plan: ReplicatePlan, horizon: int, n_rows: int, *, last: bool = False) -> int:
    """Moves a stage may make. The minimum for later stages is reserved first; a stage takes at most half of the
    rest.
    """
    if not np.isfinite(plan.budget):
        return 10**9
    looks = sum(plan.horizons[state.block + 1 :]) / n_rows
    remaining = plan.budget - state.ledger.rollouts - (0.0 if last else plan.particles * (looks + 1.0))
    cost = plan.particles * horizon / n_rows
    if remaining < cost:
        return 0
    return max(1, int((remaining if last else 0.5 * remaining) / cost + 1e-9))


def _facts(info: StageInfo) -> dict[str, Any]:
    kept = ("progress", "log_evidence_increment", "ess", "moves", "acceptance", "scale", "correlation")
    return {name: getattr(info, name) for name in kept}


def run(problem: Problem, config: SmcConfig, key: PRNGKeyArray, logbook: Logbook = UNRECORDED) -> InferenceResult:
    """Sample a problem's posterior with independent replicates.

    Raises:
        InputError: a budget that is too small, a prior that excludes the data, a checkpoint of another run.
    """
    digest = run_digest(problem, "smc", config, key)
    config = decided(problem.n_rows, config)
    plan = make_plan(problem, config)
    states = []
    for replicate in range(config.chains):
        checkpoint = logbook.checkpoint(f"smc_{replicate}", digest)

        def report(state: SmcState, replicate: int = replicate) -> None:
            done = (replicate + state.population.progress / problem.n_rows) / config.chains
            logbook.stage(done, method="smc", replicate=replicate, stage=state.stage, **state.trace[-1])

        states.append(_replicate(problem, config, plan, jax.random.fold_in(key, replicate), checkpoint, report))
    return _result(problem, config, plan, states)


def _replicate(
    problem: Problem,
    config: SmcConfig,
    plan: ReplicatePlan,
    key: PRNGKeyArray,
    checkpoint: Checkpoint,
    report: Callable[[SmcState], None],
) -> SmcState:
    init_key, stage_key = jax.random.split(key)
    saved = checkpoint.load()
    state = init(init_key, problem, plan) if saved is None else unpack(*saved)
    while not state.finished:
        state, _ = step(stage_key, state, problem, plan, config)
        checkpoint.save(*pack(state))
        report(state)
    return state


def pack(state: SmcState) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays of a state and the rest of it, for a checkpoint."""
    population = state.population
    arrays = {name: getattr(population, name) for name in ("position", "base", "rows", "log_weights")}
    meta = {name: getattr(state, name) for name in ("block", "stage", "log_evidence", "trace", "seconds", "finished")}
    meta |= {"progress": population.progress, "scale": population.scale, "ledger": state.ledger.record()}
    return {**arrays, "prefix_log_evidence": state.prefix_log_evidence}, meta


def unpack(arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> SmcState:
    """The state that `pack` took apart."""
    own = {name: arrays[name] for name in ("position", "base", "rows", "log_weights")}
    population = Population(**own, progress=meta["progress"], scale=meta["scale"])
    named = {name: meta[name] for name in ("block", "stage", "log_evidence", "trace", "seconds", "finished")}
    prefixes, ledger = arrays["prefix_log_evidence"], Ledger.from_record(meta["ledger"])
    return SmcState(population, prefix_log_evidence=prefixes, ledger=ledger, **named)


def _result(problem: Problem, config: SmcConfig, plan: ReplicatePlan, states: list[SmcState]) -> InferenceResult:
    count = min(len(state.population.position) for state in states)  # some had rollouts left for another round
    draws = chains(problem, [state.population.position[:count] for state in states])
    values = np.array([state.log_evidence for state in states])
    prefixes = np.stack([state.prefix_log_evidence for state in states])
    spent = sum((state.ledger for state in states), Ledger())
    trace = [{"replicate": index, **row} for index, state in enumerate(states) for row in state.trace]
    sd = float(values.std(ddof=1)) if len(values) > 1 else float("nan")
    return InferenceResult(
        method="smc",
        draws=draws,
        log_evidence=(float(np.mean(values)), sd),
        prefix_log_evidence=prefixes.mean(axis=0),
        block_scores=_block_scores(plan.horizons, prefixes),
        log_likelihood=np.stack([state.population.rows[:count] for state in states]),
        trace=trace,
        **spent.record(),
        cautions=[
            *prior_cautions(problem, draws),
            *exclusion_cautions(spent.excluded, spent.evaluations),
            *stage_cautions(trace, config.rollouts),
            *replicate_cautions(draws, values),
            *unseen_modes(len(values)),
        ],
        seconds=sum(state.seconds for state in states),
        details={
            "algorithm": FROM_PRIOR,
            "log_evidence_replicates": values.tolist(),
            "particles": plan.particles,
            "horizons": plan.horizons,
        },
    )


def _block_scores(horizons: tuple[int, ...], prefixes: Float[np.ndarray, "r n_rows"]) -> list[dict[str, Any]]:
    scores, first = [], 0
    for last in horizons:
        block = prefixes[:, last - 1] - (prefixes[:, first - 1] if first else 0.0)
        sd = float(block.std(ddof=1)) if len(block) > 1 else float("nan")
        scores.append({"first_row": first + 1, "last_row": last, "log_score": float(block.mean()), "sd": sd})
        first = last
    return scores
