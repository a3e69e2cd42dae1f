"""Search for modes: optimisations from the best of many prior draws, over growing horizons, then Laplace.

1. Optimisations start at prior draws that explain a short prefix of the data: the best draw, and distant draws of the
   best quarter. The medians of the prior count as a draw. If the budget allows it, a pilot run (`pilot_run`) replaces
   the draws: particles tempered from the prior to the posteriors of short prefixes. An optimisation stops at the first
   local optimum, and the best prior draws need not lie near the highest. A slowly tempered population ends in the
   basins with most mass, at horizons with cheap rollouts.
2. Each optimisation is a Levenberg-Marquardt search at growing horizons. Short prefixes come first, because a long
   recording has many local optima.
3. Each optimum keeps one optimisation for the next horizon: the better half of the optima, and every optimum within
   `ALTERNATIVE` nats of the best. They restart at draws from the normal distributions around these optima, see
   `begun_anew`.
4. Around each optimum stands a normal distribution (Laplace's approximation), whose integral estimates its evidence.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray
from scipy.special import logsumexp

from rfdropo_bayes.bayes.problem import Hierarchy, Problem, ResidualProblem, WarmStart
from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.errors import InputError, NoLikelihoodError
from rfdropo_bayes.inference.evaluations import Ledger, block_boundaries, evaluate_prior, evaluate_rows
from rfdropo_bayes.inference.method_options import MethodOptions
from rfdropo_bayes.inference.modes.lasting import CountedProblem, Lasting, lasting_cautions, lasting_residuals
from rfdropo_bayes.inference.modes.mixture import alternatives, draw_mixture, mixture_cautions, shares
from rfdropo_bayes.inference.modes.optimisation import (
    Laplace,
    LevenbergState,
    Optimisable,
    laplace,
    maximise,
    normal_at,
    optimisation_cost,
)
from rfdropo_bayes.inference.modes.reweighting import CANDIDATE_SHARE, Reweighted, reweighted, reweighting_cautions
from rfdropo_bayes.inference.modes.scales import integrate_scales
from rfdropo_bayes.inference.modes.targets import Target, make_target, prior_derivatives
from rfdropo_bayes.inference.progress import UNRECORDED, UNSAVED, Checkpoint, Logbook, run_digest
from rfdropo_bayes.inference.result import Draws, InferenceResult, chains, exclusion_cautions, prior_cautions
from rfdropo_bayes.inference.smc import sampler
from rfdropo_bayes.inference.smc.moves import BlockProblem, StraightProblem, squared_distance
from rfdropo_bayes.inference.smc.sampler import FEWEST_PARTICLES

FOR_MEDIANS = 1000  # draws, which put the medians within .04 deviations
SAME = 0.02  # largest difference of any coordinate between two optimisations with the same result
ALTERNATIVE = 30.0  # nats below the best optimum, beyond which another matters to no posterior: exp(-30) is 1e-13
PILOT_SHARE = 0.6  # share of the budget of optimisations that a pilot run may take, and of their progress
PILOT_PREFIXES = 2  # number of last prefixes whose particles start optimisations; the same number of horizons follows
PILOT_MOVES = 8  # of a stage, at most: optimisations need a start in the right basins, not a fair sample of them
FEWEST_STEPS = 4.0  # of an optimisation that is worth its start


@dataclass(frozen=True, repr=False)
class LaplaceConfig(MethodOptions, called="Laplace"):
    """Laplace: a normal posterior around the optima found by Levenberg-Marquardt optimisations.

    Attributes:
        starts: number of optimisations at the first horizon; the better half of their optima continue to longer
            horizons, with every optimum close to the best.
        prior_draws: number of draws from the prior, or from the problem's own distribution of starts, evaluated at the
            first horizon. The best draw is the first start; the others are distant draws of the best quarter.
        pilot_particles: particles of a tempered pilot run that finds the starts instead; 0 for none. Only for problems
            with residuals.
        blocks: number of horizons of an optimisation or of the pilot run, doubling; two follow a pilot run.
        max_steps: most steps of an optimisation at one horizon.
        tolerance: predicted gain of a step below which an optimisation ends [nat].
        draws: draws from the normal approximations, weighted by the exact posterior and resampled.
        rollouts: budget in full-length rollouts, shared by the optimisations, with at most `PILOT_SHARE` for a
            pilot run; the rest, at least a quarter, weights the draws. None for no limit.
    """

    starts: int = 4
    prior_draws: int = 64
    pilot_particles: int = 0
    blocks: int = 3
    max_steps: int = 60
    tolerance: float = 1e-4
    draws: int = 2000
    rollouts: float | None = None

    def __post_init__(self) -> None:
        for name in ("starts", "prior_draws", "blocks", "max_steps", "draws"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} = {getattr(self, name)} is less than 1", where="[inference]")
        if self.pilot_particles and self.pilot_particles < FEWEST_PARTICLES:
            raise InputError(
                f"pilot_particles = {self.pilot_particles} is neither 0 nor {FEWEST_PARTICLES} or more",
                where="[inference]",
            )
        if self.tolerance <= 0.0 or (self.rollouts is not None and self.rollouts <= 0.0):
            raise InputError("tolerance and rollouts must be positive", where="[inference]")


class Optimisations(NamedTuple):
    """State of several optimisations over growing horizons."""

    positions: Float[np.ndarray, "start d"]  # present point of each optimisation
    log_density: Float[np.ndarray, " start"]  # log posterior there, at the horizon of its last update
    converged: Bool[np.ndarray, " start"]  # whether it converged at that horizon
    level: int  # index of the present horizon
    done: int  # optimisations finished at it
    noise: Bool[np.ndarray, " d"] | None  # noise coordinates
    # ledger, trace, seconds: as in every method
    ledger: Ledger
    trace: list[dict[str, Any]]
    seconds: float


class Modes(NamedTuple):
    """Distinct optima at the full horizon, best evidence first, with the cost of the search."""

    modes: list[Laplace]
    search: Optimisations
    cautions: list[Caution]


def find_modes(
    problem: Problem,
    config: LaplaceConfig,
    key: PRNGKeyArray,
    checkpoint: Checkpoint = UNSAVED,
    logbook: Logbook = UNRECORDED,
    ledger: Ledger | None = None,
    chosen: Callable[[Optimisations], Bool[np.ndarray, " start"]] | None = None,
) -> Modes:
    """Optimise from the best of some prior draws to the optima of the full posterior.

    Args:
        problem: problem to optimise.
        config: settings.
        key: random key.
        checkpoint: checkpoint of the optimisations.
        logbook: checkpoint of a pilot run, and reports of stages.
        ledger: charged with the cost, also after an error.
        chosen: selects from the final optimisations; by default all within `ALTERNATIVE` nats of the best.

    Raises:
        InputError: a problem without residuals.
        NoLikelihoodError: none of the draws has a positive likelihood.
    """
    horizons, target_at = _targets(problem, config)
    saved = checkpoint.load()
    if saved is None:
        began = time.monotonic()
        ledger = Ledger() if ledger is None else ledger
        if config.pilot_particles and isinstance(problem, ResidualProblem):
            starts = starts_of_pilot_run(problem, config, horizons[0], key, ledger, logbook.part(0.0, PILOT_SHARE))
        else:
            starts = starts_of_draws(problem, config.prior_draws, horizons[0], config.starts, key, ledger)
        search = begin(*starts, ledger, time.monotonic() - began)
    else:
        search = _unpack(*saved)
    target = None
    while search.level < len(horizons):
        began, horizon = time.monotonic(), horizons[search.level]
        if target is None:
            target = target_at(horizon, search.ledger, search.positions[0], search.noise)
        allowed = _affordable_steps(problem.n_rows, config, search, horizons, int(target.noise.sum()))
        state, steps = maximise(target, search.positions[search.done], max_steps=allowed, tolerance=config.tolerance)
        search = _record(search, state, len(steps), horizon, target)
        if search.done == len(search.positions):
            search = _go_on(search, horizon)
            if search.level < len(horizons):
                longer, level_key = horizons[search.level], jax.random.fold_in(key, search.level)
                search = begun_anew(problem, target, search, longer, config.prior_draws, level_key)
            target = None
        search = search._replace(seconds=search.seconds + time.monotonic() - began)
        checkpoint.save(*_pack(search))
        share = (search.level + search.done / len(search.positions)) / len(horizons)
        logbook.part(PILOT_SHARE * (config.pilot_particles > 0), 1.0).stage(share, method="laplace", **search.trace[-1])
    assert search.noise is not None
    matter = search.log_density > search.log_density.max() - ALTERNATIVE if chosen is None else chosen(search)
    return _collect(search, target_at(problem.n_rows, search.ledger, search.positions[0], search.noise), matter, config)


def starts_of_draws(
    problem: Problem, prior_draws: int, horizon: int, count: int, key: PRNGKeyArray, ledger: Ledger
) -> tuple[Float[np.ndarray, "start d"], Float[np.ndarray, " start"]]:
    """Some of many draws from the prior, or from the problem's own distribution of starts, and of its medians.

    Args:
        problem: problem to optimise.
        prior_draws: number of draws.
        horizon: horizon at which draws are evaluated.
        count: number of starts; there may be fewer.
        key: random key.
        ledger: charged with the cost.

    Returns:
        unconstrained points, the best first, and their log posterior at the horizon.

    Raises:
        NoLikelihoodError: none of the draws has a positive likelihood.
    """
    draw = problem.sample_starts if isinstance(problem, WarmStart) else problem.sample_prior
    own, many = (
        np.asarray(problem.to_unconstrained(draw(each, number)), dtype=float)
        for each, number in ((key, max(prior_draws, count, 2) - 1), (jax.random.fold_in(key, 1), FOR_MEDIANS))
    )
    u = np.concatenate([np.median(many, axis=0)[None], own])  # in many dimensions no draw comes near the middle
    density = _heights(problem, u, horizon, ledger)
    order = _spread(u, density, count)
    return u[order], density[order]


def starts_of_pilot_run(
    problem: ResidualProblem, config: LaplaceConfig, horizon: int, key: PRNGKeyArray, ledger: Ledger, logbook: Logbook
) -> tuple[Float[np.ndarray, "start d"], Float[np.ndarray, " start"]]:
    """Particles of the last prefixes of a pilot run, equally many of each; returns the same as `starts_of_draws`.

    The longest prefix locates the optimum best, unless all its particles lie in a wrong basin; particles of a shorter
    prefix cross between basins more easily.
    """
    prefixes = block_boundaries(problem.n_rows, config.blocks + 1)
    populations = pilot_run(problem, config, prefixes[:-1] or prefixes, key, ledger, logbook)[-PILOT_PREFIXES:]
    chosen = []
    for index, (position, density) in enumerate(reversed(populations)):
        wanted = config.starts // len(populations) + (index < config.starts % len(populations))
        chosen.append(position[_spread(position, density, wanted)[:wanted]])
    u = np.concatenate(chosen)
    density = _heights(problem, u, horizon, ledger)
    order = np.argsort(-density, kind="stable")[: np.isfinite(density).sum()]
    return u[order], density[order]


def _heights(problem: Problem, u: Float[np.ndarray, "n d"], horizon: int, ledger: Ledger) -> Float[np.ndarray, " n"]:
    """Log posterior of a prefix at some points.

    Raises:
        NoLikelihoodError: no start has a positive likelihood.
    """
    density = evaluate_prior(problem, u) + evaluate_rows(problem, u, horizon, ledger).sum(axis=1)
    if not np.isfinite(density).any():
        raise NoLikelihoodError(
            f"none of {len(u)} draws has a positive likelihood up to row {horizon} ({ledger.reasons})",
            where="[model.priors]",
            remedy="widen the priors, or look at the simulator's reports for them",
        )
    return density


def _spread(u: Float[np.ndarray, "n d"], density: Float[np.ndarray, " n"], count: int) -> Int[np.ndarray, " k"]:
    """The best draw, then repeatedly the draw of the best quarter that is farthest from all chosen draws.

    The best few draws are often close together, and would all lead to the same optimum.
    """
    order = np.argsort(-density, kind="stable")
    order = order[np.isfinite(density[order]) & np.isfinite(u[order]).all(axis=1)]
    if len(order) == 0:
        return order
    deviation = u[order].std(axis=0)
    order = order[: max(count, len(u) // 4)]
    scaled = u[order] / np.maximum(deviation, 1e-300)
    chosen = [0]
    while len(chosen) < min(count, len(order)):
        distance = np.linalg.norm(scaled[:, None] - scaled[chosen], axis=2).min(axis=1)
        chosen.append(int(np.argmax(distance)))
    return order[chosen]


def pilot_run(
    problem: ResidualProblem,
    config: LaplaceConfig,
    horizons: tuple[int, ...],
    key: PRNGKeyArray,
    ledger: Ledger,
    logbook: Logbook,
) -> list[tuple[Float[np.ndarray, "n d"], Float[np.ndarray, " n"]]]:
    """Temper particles to the posteriors of growing prefixes.

    Args:
        problem: problem to optimise.
        config: settings with the number of particles.
        horizons: the prefixes.
        key: random key.
        ledger: charged with the cost.
        logbook: checkpoint, and reports of stages.

    Returns:
        for each prefix the particles weighted to its posterior, before moves: unconstrained positions, and their log
        posterior.

    Raises:
        NoLikelihoodError: no particle has a positive likelihood.
    """
    straight_key, run_key = jax.random.split(key)
    blocks = BlockProblem(StraightProblem(problem, straight_key), horizons)
    # The sampler assumes rows of equal cost in a block, which overestimates short prefixes.
    whole = None if config.rollouts is None else PILOT_SHARE * config.rollouts * problem.n_rows / horizons[-1]
    sampling = sampler.SmcConfig(rollouts=whole, particles=config.pilot_particles, draws=1)
    checkpoint = logbook.checkpoint("pilot_run", run_digest(blocks, "pilot_run", sampling, run_key))
    populations, state = _populations(blocks, sampling, run_key, checkpoint, logbook)
    _charge(problem, horizons, state.trace, ledger)
    ledger.excluded.update(state.ledger.excluded)
    found = []
    for block, (position, rows) in enumerate(populations, start=1):
        values = blocks.from_unconstrained(jnp.asarray(position))
        u = np.asarray(problem.to_unconstrained(values), dtype=float)
        found.append((u, evaluate_prior(problem, u) + rows[:, :block].sum(axis=1)))
    return found


def _populations(
    blocks: BlockProblem, config: sampler.SmcConfig, key: PRNGKeyArray, checkpoint: Checkpoint, logbook: Logbook
) -> tuple[list[tuple[np.ndarray, np.ndarray]], sampler.SmcState]:
    """Positions and rows of the particles at the end of each block, and the sampler's last state."""
    init_key, stage_key = jax.random.split(key)
    every = tuple(range(1, blocks.n_rows + 1))
    plan = sampler.make_plan(blocks, config, every)._replace(most_moves=PILOT_MOVES)
    ends: list[tuple[np.ndarray, np.ndarray]] = []
    saved = checkpoint.load()
    if saved is None:
        state = sampler.init(init_key, blocks, plan)
    else:
        arrays, meta = saved
        state = sampler.unpack(arrays, meta)
        ends = [(arrays[f"positions_{block}"], arrays[f"rows_{block}"]) for block in range(meta["ends"])]
    while not state.finished:
        state, _ = sampler.step(stage_key, state, blocks, plan, config)
        population = state.population
        if population.progress == len(ends) + 1:
            ends.append((population.position, population.rows))
        arrays, meta = sampler.pack(state)
        for block, (position, rows) in enumerate(ends):
            arrays |= {f"positions_{block}": position, f"rows_{block}": rows}
        checkpoint.save(arrays, meta | {"ends": len(ends)})
        facts = {name: state.trace[-1][name] for name in ("ess", "acceptance", "moves")}
        share, horizon = population.progress / blocks.n_rows, blocks.horizons[state.block]
        logbook.stage(share, method="pilot_run", stage=state.stage, horizon=horizon, **facts)
    return ends, state


def _charge(problem: ResidualProblem, horizons: tuple[int, ...], trace: list[dict[str, Any]], ledger: Ledger) -> None:
    """Convert the sampler's cost from blocks to rows, and charge it."""
    before = 0.0
    for stage in trace:
        block, spent = stage["horizon"], stage["rollouts"]
        ledger.charge(problem, round((spent - before) * len(horizons) / block), horizons[block - 1])
        before = spent


def begin(
    positions: Float[np.ndarray, "start d"], log_density: Float[np.ndarray, " start"], ledger: Ledger, seconds: float
) -> Optimisations:
    """Optimisations at their starts."""
    return Optimisations(positions, log_density, np.zeros(len(positions), dtype=bool), 0, 0, None, ledger, [], seconds)


def _record(
    search: Optimisations, state: LevenbergState, steps: int, horizon: int, target: Optimisable
) -> Optimisations:
    """Record a finished optimisation."""
    positions, density, converged = (search.positions.copy(), search.log_density.copy(), search.converged.copy())
    positions[search.done], density[search.done] = state.position, state.log_density
    converged[search.done] = state.converged
    facts = {"horizon": horizon, "start": search.done, "steps": steps, "log_density": state.log_density}
    search.trace.append(facts | {"converged": state.converged, "rollouts": search.ledger.rollouts})
    return search._replace(
        positions=positions, log_density=density, converged=converged, done=search.done + 1, noise=target.noise
    )


def _go_on(search: Optimisations, horizon: int) -> Optimisations:
    """Keep one optimisation of each optimum and continue at the next horizon.

    The better half of the optimisations continues (successive halving), and every optimum within `ALTERNATIVE` nats of
    the best.

    Raises:
        NoLikelihoodError: no optimisation has a likelihood.
    """
    positions, density = search.positions, search.log_density
    if not np.isfinite(density).any():
        raise NoLikelihoodError(
            f"no optimisation has a positive likelihood up to row {horizon} ({search.ledger.reasons})",
            where="[inference]",
            remedy="look at the simulator's reports there, or allow more starts",
        )
    kept: list[int] = []
    for index in np.argsort(-density, kind="stable"):
        if all(np.max(np.abs(positions[index] - positions[other])) > SAME for other in kept):
            kept.append(int(index))
    order = np.array([index for index in kept if np.isfinite(density[index])])
    order = order[(2 * np.arange(len(order)) < len(order)) | (density[order] > density[order[0]] - ALTERNATIVE)]
    return search._replace(
        positions=positions[order],
        log_density=density[order],
        converged=search.converged[order],
        level=search.level + 1,
        done=0,
    )


def begun_anew(
    problem: Problem, target: Optimisable, search: Optimisations, horizon: int, prior_draws: int, key: PRNGKeyArray
) -> Optimisations:
    """The optimisations at their starts for a longer prefix of the data.

    Parameters that a prefix does not inform, such as the mass of a cube before contact, are at the prior's centre in
    every optimum. All optimisations of the longer prefix would then share this value. Starts are therefore chosen from
    the optima and from ``prior_draws`` draws of the normal distributions around them, which keep the prior's spread.

    Args:
        problem: problem to optimise.
        target: posterior of the finished prefix.
        search: one optimisation per optimum.
        horizon: horizon of the longer prefix, at which draws are evaluated.
        prior_draws: number of draws.
        key: random key.

    Raises:
        NoLikelihoodError: neither an optimum nor a draw has a positive likelihood.
    """
    ends = zip(search.positions, search.log_density, search.converged, strict=True)
    modes = [normal_at(target, LevenbergState(u, float(density), 0.0, bool(done))) for u, density, done in ends]
    drawn = draw_mixture(modes, prior_draws, key)
    u = np.concatenate([search.positions, drawn])
    density = _heights(problem, u, horizon, search.ledger)
    order = _spread(u, density, len(modes))
    return search._replace(positions=u[order], log_density=density[order], converged=np.zeros(len(order), dtype=bool))


def _pack(search: Optimisations) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and metadata of the optimisations, for a checkpoint."""
    assert search.noise is not None
    meta = {name: getattr(search, name) for name in ("level", "done", "trace", "seconds")}
    arrays = {name: getattr(search, name) for name in ("positions", "log_density", "converged", "noise")}
    return arrays, meta | {"ledger": search.ledger.record()}


def _unpack(arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> Optimisations:
    """Inverse of `_pack`."""
    named = {name: meta[name] for name in ("level", "done", "trace", "seconds")}
    saved: dict[str, Any] = {**arrays, **named}
    return Optimisations(ledger=Ledger.from_record(meta["ledger"]), **saved)


def _targets(problem: Problem, config: LaplaceConfig) -> tuple[tuple[int, ...], Callable[..., Optimisable]]:
    """Horizons of the search, and the posterior at one of them, given the ledger, a point, and noise coordinates."""
    if not isinstance(problem, ResidualProblem):
        raise InputError("this problem has no residuals", where="[inference] method", remedy='use method = "smc"')
    prior = prior_derivatives(problem)

    def target_at(horizon: int, ledger: Ledger, u: np.ndarray, noise: np.ndarray | None) -> Optimisable:
        return make_target(problem, horizon, ledger, u, prior, noise)

    return block_boundaries(problem.n_rows, PILOT_PREFIXES if config.pilot_particles else config.blocks), target_at


def _affordable_steps(
    n_rows: int, config: LaplaceConfig, search: Optimisations, horizons: tuple[int, ...], noise: int
) -> int:
    """Steps of the present optimisation: the rest of the budget is shared among optimisations by their horizons.

    Half of the optimisations are expected to continue, see `_go_on`.
    """
    if config.rollouts is None:
        return config.max_steps
    starts, d = search.positions.shape
    now = horizons[search.level]
    later = sum(-(-starts // 2**ahead) * rows for ahead, rows in enumerate(horizons[search.level + 1 :], start=1))
    waiting = starts - search.done
    share = now * waiting / (now * waiting + later)
    grid, step = optimisation_cost(d, noise)
    rows = max(config.rollouts - search.ledger.rollouts, 0.0) * n_rows / now * share
    # More optima than expected may have reached the last horizon: continue with the best, rather than none.
    served = waiting if later else int(np.clip(rows / (grid + FEWEST_STEPS * step), 1, waiting))
    return int(np.clip((rows / served - grid) / step, 0, config.max_steps))


def _collect(
    search: Optimisations, target: Optimisable, matter: Bool[np.ndarray, " start"], config: LaplaceConfig
) -> Modes:
    """Laplace at every optimum that could matter, in the order of their evidence."""
    modes: list[Laplace] = []
    for index in np.argsort(-search.log_density, kind="stable"):
        state = LevenbergState(
            search.positions[index], float(search.log_density[index]), 0.0, bool(search.converged[index])
        )
        if state.log_density > -np.inf and matter[index] and _apart(state.position, modes):
            mode = laplace(target, state)
            modes += [mode] if _apart(mode.mean, modes) else []
    modes.sort(key=lambda mode: -mode.log_evidence)
    best = np.argmin(np.max(np.abs(search.positions - modes[0].mean), axis=1))
    return Modes(modes, search, _unfinished(bool(search.converged[best]), search.trace[-1]["steps"], config))


def _unfinished(converged: bool, steps: int, config: LaplaceConfig) -> list[Caution]:
    """A caution if the best optimisation has not converged, for want of steps or of rollouts for them."""
    ended, more = f"after max_steps = {config.max_steps}", "max_steps"
    if steps < config.max_steps:
        ended, more = "when its budget ran out", "minutes or rollouts"
    sentence = f"the best optimisation had not converged {ended}; raise {more} in [inference]"
    return [] if converged else [Caution(Code.OPTIMISATION_UNFINISHED, sentence, grave=True)]


def _apart(position: Float[np.ndarray, " d"], modes: list[Laplace]) -> bool:
    """Whether a point lies beyond one posterior deviation of every mode: optimisations also stop at different points of
    a flat optimum.
    """
    factors = [np.linalg.cholesky(mode.covariance) for mode in modes]
    away = [squared_distance(factor, (position - mode.mean)[None]) for factor, mode in zip(factors, modes, strict=True)]
    return all(distance > len(position) for distance in away)


def run(problem: Problem, config: LaplaceConfig, key: PRNGKeyArray, logbook: Logbook = UNRECORDED) -> InferenceResult:
    """Posterior modes and draws of the normal approximations around them, mapped back to physical units.

    A `Hierarchy` is optimised at fixed standard deviations, which are then integrated out (`integrate_scales`).
    """
    mode_key, draw_key = jax.random.split(key)
    digest = run_digest(problem, "laplace", config, key)
    checkpoint = logbook.checkpoint("laplace", digest)
    whole, fixed = problem, dict(problem.typical_scales) if isinstance(problem, Hierarchy) else {}
    if isinstance(whole, Hierarchy) and fixed:
        problem = whole.holding(fixed)

    def explain_as_well(search: Optimisations) -> Bool[np.ndarray, " start"]:
        return alternatives(evaluate_rows(problem, search.positions, problem.n_rows, search.ledger))

    allowed = None if config.rollouts is None else (1.0 - CANDIDATE_SHARE) * config.rollouts
    settings = replace(config, rollouts=allowed)
    optima = find_modes(problem, settings, mode_key, checkpoint, logbook, chosen=explain_as_well)
    ledger, began = optima.search.ledger, time.monotonic()
    problem, optima, lasting = _counted(problem, optima, settings)
    modes, exact, rows = optima.modes, None, None
    compared = not (isinstance(whole, Hierarchy) and fixed)
    if isinstance(whole, Hierarchy) and fixed:
        draws, modes = _with_scales(whole, problem, fixed, modes, config, draw_key)
    else:
        affordable = (
            config.draws if config.rollouts is None else min(config.draws, int(config.rollouts - ledger.rollouts))
        )
        exact = reweighted(problem, modes, affordable, draw_key, ledger, config.draws)
        position = draw_mixture(modes, config.draws, draw_key) if exact is None else exact.position
        draws = chains(problem, [position])
        rows = None if exact is None or exact.rows is None else _whole_rows(exact.rows, problem, problem is whole)
    best, seconds = modes[0], optima.search.seconds + time.monotonic() - began
    return InferenceResult(
        method="laplace",
        draws=draws,
        log_evidence=(float(logsumexp([mode.log_evidence for mode in modes])), float("nan")),
        log_likelihood=rows,
        trace=optima.search.trace,
        rollouts=ledger.rollouts,
        evaluations=ledger.evaluations,
        excluded=dict(ledger.excluded),
        cautions=[
            *optima.cautions,
            *mixture_cautions(len(modes)),
            *(reweighting_cautions(exact) if compared else []),
            *lasting_cautions(lasting),
            *prior_cautions(whole, draws),
            *exclusion_cautions(ledger.excluded, ledger.evaluations),
        ],
        seconds=seconds,
        optimum={**mode_values(problem, best), **fixed},
        details=_details(problem, optima._replace(modes=modes), lasting, exact),
    )


def _whole_rows(
    rows: Float[np.ndarray, "draw row"], problem: Problem, whole: bool
) -> Float[np.ndarray, "1 draw row"] | None:
    """Log density of each row at each draw, without shares; None if channels have different shares."""
    if whole:
        return rows[None]
    shares = set(problem.shares.values()) if isinstance(problem, CountedProblem) else set()
    return rows[None] / shares.pop() if len(shares) == 1 else None


def _details(
    problem: Problem, optima: Modes, lasting: Mapping[str, Lasting], exact: Reweighted | None
) -> dict[str, Any]:
    """Further numbers of a result."""
    modes = optima.modes
    return {
        "effective_draws": None if exact is None else exact.effective,
        "lasting": {name: {**each._asdict(), "widened": each.widened.tolist()} for name, each in lasting.items()},
        "covariance_unconstrained": modes[0].covariance.tolist(),
        "noise_coordinates": np.flatnonzero(np.asarray(optima.search.noise)).tolist(),
        "optima": [
            {"weight": 1.0 / len(modes), "log_evidence": mode.log_evidence, "log_density": mode.log_density}
            for mode in modes
        ],
        "modes": [{"log_evidence": m.log_evidence, **mode_values(problem, m)} for m in modes],
    }


def _with_scales(
    whole: Hierarchy,
    problem: Problem,
    fixed: Mapping[str, float],
    modes: Sequence[Laplace],
    config: LaplaceConfig,
    key: PRNGKeyArray,
) -> tuple[Draws, list[Laplace]]:
    """Draws of a hierarchy with modes at fixed standard deviations; and the modes in the order of their evidence after
    the standard deviations are integrated out.
    """
    members = [[problem.names.index(name) for name in whole.scales[scale]] for scale in fixed]
    order_key, *keys = jax.random.split(key, len(modes) + 1)
    values = np.array(list(fixed.values()))
    mixed = [
        integrate_scales(mode, values, members, whole.scale_log_prior, config.draws, k)
        for mode, k in zip(modes, keys, strict=True)
    ]
    order = np.argsort([-each.log_evidence for each in mixed])
    ends = shares(len(order), config.draws)
    shuffled = np.asarray(jax.random.permutation(order_key, config.draws))
    position = np.concatenate([mixed[i].position[:n] for i, n in zip(order, ends, strict=True)])[shuffled]
    scales = np.concatenate([mixed[i].scales[:n] for i, n in zip(order, ends, strict=True)])[shuffled]
    draws = chains(problem, [position]) | {name: scales[None, :, j] for j, name in enumerate(fixed)}
    integrated = [
        modes[i]._replace(log_density=modes[i].log_density + mixed[i].log_evidence - modes[i].log_evidence)
        for i in order
    ]
    return {name: draws[name] for name in whole.names}, integrated


def _counted(problem: Problem, optima: Modes, config: LaplaceConfig) -> tuple[Problem, Modes, dict[str, Lasting]]:
    """The problem with rows weighted by the residual correlation time, its modes, and the residual statistics.

    The new modes are optimised from the given modes; see `modes.lasting`.
    """
    modes, search = optima.modes, optima.search
    if not isinstance(problem, CountedProblem):
        return problem, optima, {}

    def target_of(problem: CountedProblem) -> Target:
        derivatives = prior_derivatives(problem)
        at, noise = modes[0].mean, search.noise
        return make_target(problem, problem.n_rows, search.ledger, at, derivatives, noise)

    lasting = lasting_residuals(problem, target_of(problem), modes[0])
    shares = {name: each.share for name, each in lasting.items() if each.share < 1.0}
    if not shares:
        return problem, optima, lasting
    counted = problem.counting(shares)
    target, moved = target_of(counted), []
    for waiting, mode in zip(range(len(modes), 0, -1), modes, strict=True):
        steps = config.max_steps
        if config.rollouts is not None:
            grid, step = optimisation_cost(len(mode.mean), int(target.noise.sum()))
            affordable = (config.rollouts - search.ledger.rollouts) / waiting
            steps = int(np.clip((affordable - grid) / step, 0, steps))
        state, _ = maximise(target, mode.mean, max_steps=steps, tolerance=config.tolerance)
        moved.append((laplace(target, state), state.converged))
    moved.sort(key=lambda each: -each[0].log_evidence)
    again = lasting_residuals(counted, target, moved[0][0])
    lasting = {name: each._replace(widened=again[name].widened) for name, each in lasting.items()}
    return counted, Modes([mode for mode, _ in moved], search, _unfinished(moved[0][1], steps, config)), lasting


def mode_values(problem: Problem, mode: Laplace) -> dict[str, float]:
    """A mode in physical units."""
    values = problem.from_unconstrained(jnp.asarray(mode.mean[None]))
    return {name: float(np.asarray(values[name])[0]) for name in problem.names}
