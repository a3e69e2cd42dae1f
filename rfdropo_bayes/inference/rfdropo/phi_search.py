"""RF-DROPO: the distribution over simulator parameters that best explains a trajectory, without resets.

phi holds a mean and a standard deviation per parameter; it maximises the likelihood of growing prefixes of the data
(eq. 2 and 3) under Monte-Carlo rollouts, by a gradient-free optimiser. Three flaws of the published pipeline are mended
unless ``mended = false``: the horizon ends at the last row; the finalists (the best of every stage) are scored again at
the FULL horizon with common random numbers, because losses at different horizons cannot be compared; and measurements
have noise, whose variance is added to the rollouts' so that phi need not explain it.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from rfdropo_bayes.bayes.problem import Problem, RolloutProblem, with_rollouts
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference.evaluations import Ledger
from rfdropo_bayes.inference.method_options import MethodOptions
from rfdropo_bayes.inference.progress import UNRECORDED, Checkpoint, Logbook, run_digest
from rfdropo_bayes.inference.result import InferenceResult, exclusion_cautions
from rfdropo_bayes.inference.rfdropo.candidate_scores import ScorePlan, motion_scale, row_scores, simulate, uniforms
from rfdropo_bayes.inference.rfdropo.phi_space import WIDTH, search_space
from rfdropo_bayes.inference.smc.moves import host_generator

OPTIMISERS = ("cma", "cem")
STEP = 0.3  # initial step of an optimiser, as a share of the search range
ELITE = 0.3  # share of the candidates that a refit by cross-entropy uses
SMOOTHING = 0.7  # weight of the new fit; the old fit keeps the rest, which prevents collapse of the spread
LEVELS = 8  # rollouts are simulated to one of this many horizons, the shortest sufficient horizon
# Added to the variances, in squared units of the trajectory's root mean square motion; unless the published pipeline is
# asked for, the observation noise at the prior's medians is also added.
FLOOR = 1e-5
FINALISTS = 10  # number of candidates scored again at the full horizon
FINAL = 10**6  # key of the finalists' random numbers, beyond any generation's
DRAWS = FINAL + 1


@dataclass(frozen=True, repr=False)
class RfdropoConfig(MethodOptions, called="RFDROPO"):
    """RF-DROPO: phi, the distribution to randomise over, by a search along a growing horizon.

    Attributes:
        rollouts: budget in full-length rollouts, which then decides the number of generations.
        evaluations: number of candidates if there is no budget (paper: 5000).
        rollouts_per_candidate: Monte-Carlo rollouts behind each loss (paper: 100).
        optimiser: "cma" or "cem".
        parameters: names of the searched parameters; empty for all that rollouts depend on.
        search: ranges that differ from the central 99 % of the prior, by name.
        draws: number of draws of the final distribution.
        mended: False gives the published schedule (99 of 100 rows), takes measurements for exact, and returns the
            lowest loss at any horizon.
    """

    rollouts: float | None = None
    evaluations: int = 5000
    rollouts_per_candidate: int = 100
    optimiser: str = "cma"
    parameters: tuple[str, ...] = ()
    search: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    draws: int = 2000
    mended: bool = True

    def __post_init__(self) -> None:
        where = "[inference]"
        if self.optimiser not in OPTIMISERS:
            raise InputError(f"unknown optimiser {self.optimiser!r}", where=where, remedy=f"use one of {OPTIMISERS}")
        least = {"evaluations": 1, "rollouts_per_candidate": 4, "draws": 1}
        for name, lowest in least.items():
            if getattr(self, name) < lowest:
                raise InputError(f"{name} = {getattr(self, name)} is less than {lowest}", where=where)


class SearchState(NamedTuple):
    """History of the search; the optimiser's state is a function of it."""

    candidates: Float[np.ndarray, "generation population k"]  # candidates of every finished generation
    losses: Float[np.ndarray, "generation population"]  # their losses, each generation at its own horizon
    # ledger, trace, seconds: as in every method
    ledger: Ledger
    trace: list[dict[str, Any]]
    seconds: float


def make_plan(problem: RolloutProblem, config: RfdropoConfig, key: PRNGKeyArray) -> ScorePlan:
    """Search space, population and the horizon of every generation, within the budget.

    Raises:
        InputError: the budget does not allow a single generation, or the search space is ill-defined.
    """
    prior = {name: np.asarray(values) for name, values in problem.sample_prior(key, 1000).items()}
    names = config.parameters or problem.physical_names
    space = search_space(problem, names, config.search, prior)
    population = default_population(config.optimiser, space.dimension)
    fixed = {name: float(np.median(prior[name])) for name in problem.names if name not in names}
    scale = motion_scale(np.asarray(problem.observed, dtype=float), np.asarray(problem.observed_mask))
    finalists = FINALISTS if config.mended else 0
    generations = max(1, config.evaluations // population)
    if config.rollouts is not None:
        generations = _affordable_generations(problem.n_rows, population, finalists, config)
    horizons = tuple(paper_horizon(i, generations, problem.n_rows, mended=config.mended) for i in range(generations))
    floor = np.full(np.asarray(problem.observed_mask).shape[1], FLOOR)
    if config.mended:
        middle = {name: float(np.median(values)) for name, values in prior.items()}
        floor = floor + (np.asarray(problem.noise_deviation(middle), dtype=float) / scale) ** 2
    return ScorePlan(space, population, horizons, min(finalists, generations + 1), fixed, scale, floor)


def _simulated(horizon: int, n_rows: int) -> int:
    """The shortest of `LEVELS` even horizons that covers one: few shapes, so that little is compiled."""
    level = -(-horizon * LEVELS // n_rows)
    return min(n_rows, -(-level * n_rows // LEVELS))


def _affordable_generations(n_rows: int, population: int, finalists: int, config: RfdropoConfig) -> int:
    assert config.rollouts is not None
    # One more candidate than finalists: the optimiser's centre may be among them, and is counted.
    budget = config.rollouts / config.rollouts_per_candidate - finalists

    def cost(generations: int) -> float:
        taus = (paper_horizon(i, generations, n_rows, mended=config.mended) for i in range(generations))
        return population * sum(_simulated(tau, n_rows) for tau in taus) / n_rows

    if cost(1) > budget:
        least = config.rollouts_per_candidate * (finalists + cost(1))
        raise InputError(
            f"{config.rollouts:g} rollouts do not allow one generation of {population} candidates",
            where="[inference] rollouts",
            remedy=f"allow at least {least:.0f}, or fewer rollouts_per_candidate",
        )
    low, high = 1, 2
    while cost(high) <= budget:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if cost(middle) <= budget else (low, middle)
    return low


def step(
    key: PRNGKeyArray,
    state: SearchState,
    problem: RolloutProblem,
    plan: ScorePlan,
    config: RfdropoConfig,
    asked: np.ndarray,
) -> SearchState:
    """Score one generation at its horizon."""
    began = time.monotonic()
    i = len(state.losses)
    m, d, horizon = config.rollouts_per_candidate, len(plan.space.names), plan.horizons[i]
    uniform = uniforms(jax.random.fold_in(key, i), m, d, stratified=config.mended)
    simulated = _simulated(horizon, problem.n_rows)
    rollouts = simulate(problem, plan, asked, uniform, simulated, state.ledger)
    values = -row_scores(problem, plan, rollouts, horizon).sum(axis=1)
    facts = {"generation": i, "horizon": horizon, "loss": float(values.min())}
    state.trace.append(facts | {"rollouts": state.ledger.rollouts})
    return state._replace(
        candidates=np.concatenate([state.candidates, asked[None]]),
        losses=np.concatenate([state.losses, values[None]]),
        seconds=state.seconds + time.monotonic() - began,
    )


def choose_finalists(state: SearchState, plan: ScorePlan, centre: Float[np.ndarray, " k"]) -> Float[np.ndarray, "c k"]:
    """Best candidates of evenly spread stages, and the final centre of the optimiser; a stage is a run of generations.

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


def run(problem: Problem, config: RfdropoConfig, key: PRNGKeyArray, logbook: Logbook = UNRECORDED) -> InferenceResult:
    """Search phi and draw from the distribution found.

    Raises:
        InputError: a problem without rollouts, a budget that is too small, every rollout of the search failed.
    """
    problem = with_rollouts(problem)
    prior_key, search_key = jax.random.split(key)
    plan = make_plan(problem, config, prior_key)
    digest = run_digest(problem, "rfdropo", config, key)
    checkpoint = logbook.checkpoint("rfdropo", digest)
    state, centre = _search(problem, config, plan, search_key, checkpoint, logbook)
    if not np.isfinite(state.losses).any():
        raise InputError(
            f"at least half of the rollouts of every candidate failed ({dict(state.ledger.excluded)})",
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
        **ledger.record(),
        cautions=[*plan.space.edge_cautions(chosen), *exclusion_cautions(ledger.excluded, ledger.evaluations)],
        seconds=state.seconds,
        phi=plan.space.describe(chosen, problem.units),
        fixed=dict(plan.fixed),
        details=details,
    )


def _search(
    problem: RolloutProblem,
    config: RfdropoConfig,
    plan: ScorePlan,
    key: PRNGKeyArray,
    checkpoint: Checkpoint,
    logbook: Logbook,
) -> tuple[SearchState, np.ndarray]:
    """All generations; a resumed optimiser is given its history again."""
    k = plan.space.dimension
    seed = int(host_generator(key).integers(2**31))
    optimiser = make_optimiser(config.optimiser, k, high=WIDTH, sigma=STEP, population=plan.population, seed=seed)
    saved = checkpoint.load()
    nothing = np.empty((0, plan.population, k)), np.empty((0, plan.population))
    empty = SearchState(*nothing, Ledger(), [], 0.0)
    state = empty if saved is None else _unpack(*saved)
    for known in state.losses:
        optimiser.tell(optimiser.ask(), known)
    while len(state.losses) < len(plan.horizons):
        asked = optimiser.ask()
        state = step(key, state, problem, plan, config, asked)
        optimiser.tell(asked, state.losses[-1])
        arrays = {"candidates": state.candidates, "losses": state.losses}
        checkpoint.save(arrays, {"ledger": state.ledger.record(), "trace": state.trace, "seconds": state.seconds})
        logbook.stage(len(state.losses) / len(plan.horizons), method="rfdropo", **state.trace[-1])
    return state, np.clip(optimiser.centre, 0.0, WIDTH)


def _choose(
    problem: RolloutProblem,
    config: RfdropoConfig,
    plan: ScorePlan,
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
    rollouts = simulate(problem, plan, finalists, uniform, n, state.ledger)
    scores = -row_scores(problem, plan, rollouts, n).sum(axis=1)
    details["finalist_losses"] = scores.tolist()
    state.trace.append({"horizon": n, "loss": float(scores.min()), "rollouts": state.ledger.rollouts, "final": True})
    return finalists[int(np.argmin(scores))], details


def _unpack(arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> SearchState:
    ledger = Ledger.from_record(meta["ledger"])
    return SearchState(arrays["candidates"], arrays["losses"], ledger, meta["trace"], meta["seconds"])


def paper_horizon(iteration: int, iterations: int, n_rows: int, *, mended: bool = True) -> int:
    """Horizon of RF-DROPO at one iteration, ``max(1, floor(n (1 - exp(-(2 / K) ln(10) i))))``.

    Args:
        iteration: i, from 0 to K.
        iterations: K, the number of iterations.
        n_rows: n, rows of data.
        mended: False for the published horizons, which end at 99 of 100 rows and never use the whole recording;
            mended, the curve is stretched by 1 / 0.99 and ends at n when ``i = K - 1``.
    """
    if not mended:
        return max(1, math.floor(n_rows * (1.0 - 10.0 ** (-2.0 * iteration / iterations))))
    last = max(iterations - 1, 1)
    share = (1.0 - 10.0 ** (-2.0 * min(iteration / last, 1.0))) / 0.99
    return min(n_rows, max(1, math.floor(n_rows * share + 1e-9)))


def default_population(name: str, d: int) -> int:
    """``4 + floor(3 ln d)``, Hansen's default for CMA-ES; the cross-entropy method wants 5 d, it keeps little."""
    hansen = 4 + math.floor(3.0 * math.log(d))
    return max(hansen, 5 * d) if name == "cem" else hansen


def make_optimiser(name: str, d: int, *, high: float, sigma: float, population: int, seed: int) -> Optimiser:
    """An optimiser over ``[0, high]^d`` that starts in the middle.

    Args:
        name: "cma" or "cem".
        d: dimension.
        high: upper edge of the box.
        sigma: initial step, as a share of the box.
        population: candidates per generation.
        seed: seed of its random numbers.

    Raises:
        InputError: an unknown name.
    """
    if name == "cma":
        return CovarianceAdaptation(d, high, sigma * high, population, seed)
    if name == "cem":
        return CrossEntropy(d, high, sigma * high, population, seed)
    raise InputError(f"unknown optimiser {name!r}", where="[inference]", remedy=f"use one of {', '.join(OPTIMISERS)}")


class CrossEntropy:
    """Cross-entropy method: refit a diagonal normal to the best candidates of each generation.

    Args:
        d, high, sigma, population, seed: see `make_optimiser`, sigma in the box's units.
    """

    def __init__(self, d: int, high: float, sigma: float, population: int, seed: int) -> None:
        self.high, self.population = high, population
        self.elites = max(2, round(ELITE * population))
        self.mean, self.sd = np.full(d, 0.5 * high), np.full(d, sigma)
        self._generator = np.random.default_rng(seed)

    def ask(self) -> Float[np.ndarray, "population d"]:
        """Normal candidates; values outside are reflected, so that mass does not collect at the edges."""
        z = self._generator.standard_normal((self.population, len(self.mean)))
        folded = np.mod(self.mean + self.sd * z, 2.0 * self.high)
        return np.minimum(folded, 2.0 * self.high - folded)

    def tell(self, candidates: Float[np.ndarray, "population d"], losses: Float[np.ndarray, " population"]) -> None:
        """Refit to the elite. Deviations are taken from the OLD mean, so that the width does not collapse early."""
        best = candidates[np.argsort(losses, kind="stable")[: self.elites]]
        deviation = np.sqrt(np.mean((best - self.mean) ** 2, axis=0))
        self.mean = SMOOTHING * best.mean(axis=0) + (1.0 - SMOOTHING) * self.mean
        self.sd = SMOOTHING * deviation + (1.0 - SMOOTHING) * self.sd

    @property
    def centre(self) -> Float[np.ndarray, " d"]:
        """Mean of the normal."""
        return self.mean


class CovarianceAdaptation:
    """CMA-ES of pycma, with random numbers of its own instead of numpy's global generator."""

    def __init__(self, d: int, high: float, sigma: float, population: int, seed: int) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # pycma warns of optional plotting packages when imported
            import cma

        generator = np.random.default_rng(seed)
        options = {
            "bounds": [0.0, high],
            "popsize": population,
            "seed": np.nan,
            "randn": lambda *shape: generator.standard_normal(shape),
            "verbose": -9,
            "tolfun": 0.0,  # the number of generations is the schedule's to decide, not a tolerance's
            "tolx": 0.0,
        }
        self._strategy = cma.CMAEvolutionStrategy(np.full(d, 0.5 * high), sigma, options)

    def ask(self) -> Float[np.ndarray, "population d"]:
        """Candidates of the next generation."""
        return np.asarray(self._strategy.ask())

    def tell(self, candidates: Float[np.ndarray, "population d"], losses: Float[np.ndarray, " population"]) -> None:
        """Update the search distribution; pycma wants finite losses."""
        finite = losses[np.isfinite(losses)]
        worst = (finite.max() if len(finite) else 0.0) + 1e6
        self._strategy.tell(list(candidates), np.where(np.isfinite(losses), losses, worst).tolist())

    @property
    def centre(self) -> Float[np.ndarray, " d"]:
        """Mean of the search distribution, inside the box."""
        return np.asarray(self._strategy.result.xfavorite)


Optimiser = CrossEntropy | CovarianceAdaptation
"""Minimises a noisy loss over a box: `ask` for the candidates of a generation, `tell` their losses (infinite losses
rank last), and `centre` of the search distribution.
"""
