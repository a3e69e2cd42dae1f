"""RF-DROPO: the distribution over simulator parameters that best explains a trajectory, without resets.

phi holds a mean and a standard deviation per parameter; it maximises the likelihood of growing prefixes of the data
(eq. 2 and 3) under Monte-Carlo rollouts, by a gradient-free optimiser. Two flaws of the published pipeline are mended
unless ``mended = false``: the horizon ends at the last row, and the finalists (the best of every stage) are scored
again at the FULL horizon with common random numbers, because losses at different horizons cannot be compared.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from scipy.stats import qmc

from rfdropo_bayes.bayes.problem import Problem, RolloutProblem
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference.checkpoints import Checkpoint, open_checkpoint, run_digest
from rfdropo_bayes.inference.evaluations import Ledger
from rfdropo_bayes.inference.optimisers import OPTIMISERS, default_population, make_optimiser
from rfdropo_bayes.inference.progress import Progress
from rfdropo_bayes.inference.proposals import host_generator
from rfdropo_bayes.inference.randomisation import WIDTH, SearchSpace, search_space
from rfdropo_bayes.inference.result import InferenceResult, exclusion_warnings
from rfdropo_bayes.inference.schedules import linear_horizon, paper_horizon
from rfdropo_bayes.inference.trajectory_match import motion_scale, step_log_likelihood

HORIZONS = ("paper", "linear", "full")
FINAL = 10**6  # key of the finalists' random numbers, beyond any generation's
DRAWS = FINAL + 1


@dataclass(frozen=True)
class RfdropoConfig:
    """RF-DROPO.

    Attributes:
        rollouts: budget in full-length rollouts, which then decides the number of generations.
        evaluations: candidates tried, where no budget is given (paper: 5000).
        rollouts_per_candidate: Monte-Carlo rollouts behind each loss (paper: 100).
        optimiser: "cma" or "cem".
        population: candidates per generation; None for 4 + floor(3 ln d), or 5 d for "cem".
        sigma: initial step, as a share of the search range.
        horizon: schedule "paper", "linear" or "full".
        levels: rollouts are simulated to one of this many horizons, the shortest that is long enough.
        variance_floor: added to the variances, in squared units of the trajectory's root mean square motion.
        finalists: candidates scored again at the full horizon.
        parameters: names to search; empty for all that rollouts depend on.
        search: ranges that differ from the central 99 % of the prior, by name.
        draws: draws of the final distribution.
        mended: False gives the published schedule (99 of 100 rows) and returns the lowest loss at any horizon.
    """

    rollouts: float | None = None
    evaluations: int = 5000
    rollouts_per_candidate: int = 100
    optimiser: str = "cma"
    population: int | None = None
    sigma: float = 0.3
    horizon: str = "paper"
    levels: int = 8
    variance_floor: float = 1e-5
    finalists: int = 10
    parameters: tuple[str, ...] = ()
    search: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    draws: int = 2000
    mended: bool = True

    def __post_init__(self) -> None:
        where = "[inference]"
        if self.optimiser not in OPTIMISERS:
            raise InputError(f"unknown optimiser {self.optimiser!r}", where=where, remedy=f"one of {OPTIMISERS}")
        if self.horizon not in HORIZONS:
            raise InputError(f"unknown horizon {self.horizon!r}", where=where, remedy=f"one of {HORIZONS}")
        least = {"evaluations": 1, "rollouts_per_candidate": 4, "levels": 1, "finalists": 1, "draws": 1}
        for name, lowest in least.items():
            if getattr(self, name) < lowest:
                raise InputError(f"{name} = {getattr(self, name)} is less than {lowest}", where=where)
        if self.population is not None and self.population < 4:
            raise InputError(f"population = {self.population} is less than 4", where=where)
        if self.variance_floor <= 0.0 or self.sigma <= 0.0:
            raise InputError("variance_floor and sigma must be positive", where=where)


class Plan(NamedTuple):
    """Sizes fixed at the start.

    Attributes:
        space: what is searched.
        population: candidates per generation.
        horizons: of every generation, in rows.
        simulated: rows simulated for each of them.
        finalists: how many are scored again.
        fixed: values of the parameters that are not searched.
        scale: unit of the features [unit of the problem's features].
    """

    space: SearchSpace
    population: int
    horizons: tuple[int, ...]
    simulated: tuple[int, ...]
    finalists: int
    fixed: dict[str, float]
    scale: float


class SearchState(NamedTuple):
    """What was tried so far; the optimiser is a function of it.

    Attributes:
        candidates: of every generation done.
        losses: theirs, each generation at its own horizon.
        ledger, trace, seconds: as in every method.
    """

    candidates: Float[np.ndarray, "generation population k"]
    losses: Float[np.ndarray, "generation population"]
    ledger: Ledger
    trace: list[dict[str, Any]]
    seconds: float


def make_plan(problem: RolloutProblem, config: RfdropoConfig, key: PRNGKeyArray) -> Plan:
    """Search space, population and the horizon of every generation, within the budget.

    Raises:
        InputError: the budget does not allow a single generation, or the search space is ill-defined.
    """
    prior = {name: np.asarray(values) for name, values in problem.sample_prior(key, 1000).items()}
    names = config.parameters or tuple(getattr(problem, "physical_names", problem.names))
    space = search_space(problem, names, config.search, prior)
    population = config.population or default_population(config.optimiser, space.dimension)
    fixed = {name: float(np.median(prior[name])) for name in problem.names if name not in names}
    scale = motion_scale(np.asarray(problem.observed, dtype=float), np.asarray(problem.observed_mask))
    finalists = config.finalists if config.mended else 0
    generations = max(1, config.evaluations // population)
    if config.rollouts is not None:
        generations = _affordable_generations(problem.n_rows, population, finalists, config)
    horizons = _horizons(generations, problem.n_rows, config)
    simulated = tuple(_simulated(tau, problem.n_rows, config.levels) for tau in horizons)
    return Plan(space, population, horizons, simulated, min(finalists, generations + 1), fixed, scale)


def _horizons(generations: int, n_rows: int, config: RfdropoConfig) -> tuple[int, ...]:
    if config.horizon == "full":
        return (n_rows,) * generations
    if config.horizon == "linear":
        return tuple(linear_horizon(i, generations, n_rows) for i in range(generations))
    return tuple(paper_horizon(i, generations, n_rows, mended=config.mended) for i in range(generations))


def _simulated(horizon: int, n_rows: int, levels: int) -> int:
    """The shortest of ``levels`` even horizons that covers one: few shapes, so that little is compiled."""
    level = -(-horizon * levels // n_rows)
    return min(n_rows, -(-level * n_rows // levels))


def _affordable_generations(n_rows: int, population: int, finalists: int, config: RfdropoConfig) -> int:
    assert config.rollouts is not None
    # One more candidate than finalists: the optimiser's centre may be among them, and is counted.
    budget = config.rollouts / config.rollouts_per_candidate - finalists

    def cost(generations: int) -> float:
        taus = _horizons(generations, n_rows, config)
        return population * sum(_simulated(tau, n_rows, config.levels) for tau in taus) / n_rows

    if cost(1) > budget:
        least = config.rollouts_per_candidate * (finalists + cost(1))
        raise InputError(
            f"{config.rollouts:g} rollouts do not allow one generation of {population} candidates",
            where="[inference] rollouts",
            remedy=f"allow at least {least:.0f}, or fewer rollouts_per_candidate or finalists",
        )
    low, high = 1, 2
    while cost(high) <= budget:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if cost(middle) <= budget else (low, middle)
    return low


def uniforms(key: PRNGKeyArray, m: int, d: int, *, stratified: bool) -> Float[np.ndarray, "m d"]:
    """Uniform numbers that all candidates of a generation share; stratified ones (Latin hypercube) scatter less."""
    generator = host_generator(key)
    return qmc.LatinHypercube(d, rng=generator).random(m) if stratified else generator.uniform(size=(m, d))


def losses(
    problem: RolloutProblem,
    plan: Plan,
    config: RfdropoConfig,
    candidates: Float[np.ndarray, "c k"],
    uniform: Float[np.ndarray, "m d"],
    horizon: int,
    simulated: int,
    ledger: Ledger,
) -> Float[np.ndarray, " c"]:
    """Minus the log likelihood (eq. 3) of every candidate at one horizon; infinite where half of its rollouts failed.

    Candidates times rollouts go to the problem as ONE batch.
    """
    drawn = plan.space.draw(candidates, uniform)
    c, m, _ = drawn.shape
    values = {name: jnp.full(c * m, value) for name, value in plan.fixed.items()}
    values |= {name: jnp.asarray(drawn[..., j].ravel()) for j, name in enumerate(plan.space.names)}
    features, status = (np.asarray(part) for part in problem.rollouts(values, simulated))
    ledger.charge(problem, c * m, simulated)
    features = features[:, :horizon].astype(float) / plan.scale
    not_a_number = np.logical_not(np.isfinite(features).all(axis=(1, 2)))
    ledger.exclude(problem, status, not_a_number)
    alive = ((status == 0) & ~not_a_number).reshape(c, m)
    features = features.reshape(c, m, *features.shape[1:])
    mask = np.asarray(problem.observed_mask)[:horizon]
    observed = np.where(mask, np.asarray(problem.observed, dtype=float)[:horizon], 0.0) / plan.scale
    out = np.full(c, np.inf)
    for index in range(c):
        if alive[index].sum() >= max(2, m / 2):
            rows = step_log_likelihood(features[index], alive[index], observed, mask, config.variance_floor)
            out[index] = -rows.sum()
    return out


def step(
    key: PRNGKeyArray, state: SearchState, problem: RolloutProblem, plan: Plan, config: RfdropoConfig, asked: np.ndarray
) -> SearchState:
    """Score one generation at its horizon."""
    began = time.monotonic()
    i = len(state.losses)
    m, d = config.rollouts_per_candidate, len(plan.space.names)
    uniform = uniforms(jax.random.fold_in(key, i), m, d, stratified=config.mended)
    values = losses(problem, plan, config, asked, uniform, plan.horizons[i], plan.simulated[i], state.ledger)
    facts = {"generation": i, "horizon": plan.horizons[i], "loss": float(values.min())}
    state.trace.append(facts | {"rollouts": state.ledger.rollouts})
    return state._replace(
        candidates=np.concatenate([state.candidates, asked[None]]),
        losses=np.concatenate([state.losses, values[None]]),
        seconds=state.seconds + time.monotonic() - began,
    )


def choose_finalists(state: SearchState, plan: Plan, centre: Float[np.ndarray, " k"]) -> Float[np.ndarray, "c k"]:
    """Best candidates of evenly spread stages, and where the optimiser ended; a stage is a run of generations.

    Within a stage candidates are compared by loss per row, horizons there being nearly the same.
    """
    stages = np.array_split(np.arange(len(state.losses)), max(1, plan.finalists - 1))
    chosen = [centre]
    per_row = state.losses / np.asarray(plan.horizons[: len(state.losses)])[:, None]
    for members in stages:
        if len(members):
            generation, index = np.unravel_index(np.argmin(per_row[members]), per_row[members].shape)
            chosen.append(state.candidates[members[generation], index])
    return np.stack(chosen[: max(1, plan.finalists)] if plan.finalists > 1 else chosen[1:2])


def run(
    problem: Problem,
    config: RfdropoConfig,
    key: PRNGKeyArray,
    *,
    checkpoint_dir: Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> InferenceResult:
    """Search phi and draw from the distribution found.

    Raises:
        InputError: a problem without rollouts, a budget that is too small, every rollout of the search failed.
    """
    if not isinstance(problem, RolloutProblem):
        raise InputError("this problem has no rollouts", where="[inference] method", remedy='use method = "smc"')
    prior_key, search_key = jax.random.split(key)
    plan = make_plan(problem, config, prior_key)
    digest = run_digest(problem, "rfdropo", config, key)
    checkpoint = open_checkpoint(checkpoint_dir, "rfdropo", digest, resume=resume)
    state, centre = _search(problem, config, plan, search_key, checkpoint, progress)
    if not np.isfinite(state.losses).any():
        raise InputError(
            f"no candidate had half of its rollouts end well ({dict(state.ledger.excluded)})",
            where="[inference] search",
            remedy="narrow the search ranges to parameters that the simulator can handle",
        )
    chosen, details = _choose(problem, config, plan, state, centre, search_key)
    uniform = uniforms(jax.random.fold_in(search_key, DRAWS), config.draws, len(plan.space.names), stratified=False)
    draws = plan.space.draw(chosen, uniform)
    ledger = state.ledger
    return InferenceResult(
        method="rfdropo",
        draws={name: draws[None, :, j] for j, name in enumerate(plan.space.names)},
        trace=state.trace,
        rollouts=ledger.rollouts,
        evaluations=ledger.evaluations,
        excluded=dict(ledger.excluded),
        warnings=[*plan.space.edge_warnings(chosen), *exclusion_warnings(ledger.excluded, ledger.evaluations)],
        seconds=state.seconds,
        phi=plan.space.describe(chosen, problem.units),
        details=details,
    )


def _search(
    problem: RolloutProblem,
    config: RfdropoConfig,
    plan: Plan,
    key: PRNGKeyArray,
    checkpoint: Checkpoint,
    progress: Progress | None,
) -> tuple[SearchState, np.ndarray]:
    """All generations; a resumed optimiser is told again what it knew."""
    k = plan.space.dimension
    seed = int(host_generator(key).integers(2**31))
    optimiser = make_optimiser(
        config.optimiser, k, high=WIDTH, sigma=config.sigma, population=plan.population, seed=seed
    )
    saved = checkpoint.load()
    empty = SearchState(np.empty((0, plan.population, k)), np.empty((0, plan.population)), Ledger(), [], 0.0)
    state = empty if saved is None else _unpack(*saved)
    for known in state.losses:
        optimiser.tell(optimiser.ask(), known)
    while len(state.losses) < len(plan.horizons):
        asked = optimiser.ask()
        state = step(key, state, problem, plan, config, asked)
        optimiser.tell(asked, state.losses[-1])
        checkpoint.save(*_pack(state))
        if progress is not None:
            progress.stage(len(state.losses) / len(plan.horizons), method="rfdropo", **state.trace[-1])
    return state, np.clip(optimiser.centre, 0.0, WIDTH)


def _choose(
    problem: RolloutProblem,
    config: RfdropoConfig,
    plan: Plan,
    state: SearchState,
    centre: np.ndarray,
    key: PRNGKeyArray,
) -> tuple[np.ndarray, dict[str, Any]]:
    best = np.unravel_index(np.argmin(state.losses), state.losses.shape)
    details: dict[str, Any] = {"generations": len(state.losses), "feature_scale": plan.scale}
    details["lowest_loss_ever"] = {"loss": float(state.losses[best]), "horizon": plan.horizons[int(best[0])]}
    if not config.mended:
        return state.candidates[best], details
    finalists = choose_finalists(state, plan, centre)
    m, n = config.rollouts_per_candidate, problem.n_rows
    uniform = uniforms(jax.random.fold_in(key, FINAL), m, len(plan.space.names), stratified=True)
    scores = losses(problem, plan, config, finalists, uniform, n, n, state.ledger)
    details["finalist_losses"] = scores.tolist()
    state.trace.append({"horizon": n, "loss": float(scores.min()), "rollouts": state.ledger.rollouts, "final": True})
    return finalists[int(np.argmin(scores))], details


def _pack(state: SearchState) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    arrays = {"candidates": state.candidates, "losses": state.losses}
    return arrays, {"ledger": state.ledger.record(), "trace": state.trace, "seconds": state.seconds}


def _unpack(arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> SearchState:
    ledger = Ledger.from_record(meta["ledger"])
    return SearchState(arrays["candidates"], arrays["losses"], ledger, meta["trace"], meta["seconds"])
