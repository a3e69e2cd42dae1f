"""Calibration of long recordings: several Levenberg-Marquardt climbs over growing horizons, then Laplace."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from rfdropo_bayes.bayes.problem import Problem, ResidualProblem
from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.errors import InputError, NoLikelihoodError
from rfdropo_bayes.inference.checkpoints import UNSAVED, Checkpoint, run_digest
from rfdropo_bayes.inference.evaluations import Ledger
from rfdropo_bayes.inference.logbook import UNRECORDED, Logbook
from rfdropo_bayes.inference.modes.basins import OneSummit, one_point, one_ridge
from rfdropo_bayes.inference.modes.climb import (
    Climbable,
    Laplace,
    LevenbergState,
    climb_cost,
    laplace,
    maximise,
    normal_at,
)
from rfdropo_bayes.inference.modes.climbs import RIVAL, Climbs, begin, go_on, pack, record, unpack, with_starts
from rfdropo_bayes.inference.modes.first_climbs import screened, surveyed
from rfdropo_bayes.inference.modes.newton import SmoothTarget, log_likelihood_derivatives
from rfdropo_bayes.inference.modes.plateaus import climbs_from, plateaus
from rfdropo_bayes.inference.modes.restarts import affordable_generations, astray, search
from rfdropo_bayes.inference.modes.survey import survey
from rfdropo_bayes.inference.modes.targets import Target, make_target, prior_derivatives
from rfdropo_bayes.inference.result import InferenceResult, chains, exclusion_cautions, prior_cautions
from rfdropo_bayes.inference.schedules import block_boundaries
from rfdropo_bayes.inference.smc.mixture import prior_moments
from rfdropo_bayes.inference.smc.moves import squared_distance
from rfdropo_bayes.inference.smc.sampler import FEWEST_PARTICLES

JACOBIANS = ("auto", "forward", "central")
SURVEY_OF_CLIMBS = 0.6  # share of the budget of climbs that a survey before them may take, and of their progress
# Horizons of climbs after a survey, as shares of the recording. From half of it to all of it in one step most climbs of
# a push, where contacts begin and end, came to rest on the way.
CONTINUED = (0.75, 0.875, 1.0)
FOR_PLATEAUS = 0.1  # share of the budget of climbs, and of a survey, that is held back for plateaus
FOR_SEARCH = 0.1  # the same for climbs that begin again, see `restarts`, unless none could be made otherwise
FEWEST_STEPS = 4.0  # of a climb that is worth its start


@dataclass(frozen=True)
class LaplaceConfig:
    """Laplace: a normal posterior around the optima that Levenberg-Marquardt climbs reach.

    Attributes:
        starts: number of climbs at the first horizon; the better half of their summits go on to each longer one, and
            every rival of the best.
        screen: draws, from the prior or from where the problem says that climbs may start, judged at the first
            horizon: the best is the first start, the others lie apart from it among the best quarter.
        survey: particles of a tempered population that finds the starts instead, for posteriors with many summits; it
            takes the place of the climbs at short horizons, and those at longer ones begin at `CONTINUED`; then
            plateaus are looked for, see `plateaus`; 0 for none. Only for problems with residuals.
        blocks: horizons of a climb, or of the survey, doubling; short ones first, because a long recording has many
            local optima.
        max_steps: most steps of a climb at one horizon.
        tolerance: a climb ends when a step promises less [nat].
        jacobian: "forward", "central" or "auto".
        draws: draws from the normal approximation.
        rollouts: budget in full-length rollouts, of which every climb gets its share, and a survey at most
            `SURVEY_OF_CLIMBS`; None for no limit.
    """

    starts: int = 4
    screen: int = 64
    survey: int = 0
    blocks: int = 3
    max_steps: int = 60
    tolerance: float = 1e-4
    jacobian: str = "auto"
    draws: int = 2000
    rollouts: float | None = None

    def __post_init__(self) -> None:
        for name in ("starts", "screen", "blocks", "max_steps", "draws"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} = {getattr(self, name)} is less than 1", where="[inference]")
        if self.survey and self.survey < FEWEST_PARTICLES:
            raise InputError(f"survey = {self.survey} is neither 0 nor {FEWEST_PARTICLES} or more", where="[inference]")
        if self.tolerance <= 0.0 or (self.rollouts is not None and self.rollouts <= 0.0):
            raise InputError("tolerance and rollouts must be positive", where="[inference]")
        if self.jacobian not in JACOBIANS:
            raise InputError(
                f"unknown jacobian {self.jacobian!r}", where="[inference]", remedy=f"one of {', '.join(JACOBIANS)}"
            )


class Modes(NamedTuple):
    """Distinct optima at the full horizon, best evidence first, with what it took to find them."""

    modes: list[Laplace]
    climbs: Climbs
    cautions: list[Caution]


def find_modes(
    problem: Problem,
    config: LaplaceConfig,
    key: PRNGKeyArray,
    checkpoint: Checkpoint = UNSAVED,
    logbook: Logbook = UNRECORDED,
    ledger: Ledger | None = None,
) -> Modes:
    """Climb from the best of some prior draws, or from the particles of a survey, to the optima of the full posterior.

    Args:
        problem: to be climbed.
        config: settings.
        key: random key.
        checkpoint: of the climbs.
        logbook: of the survey before them, and where stages are reported.
        ledger: is charged; after an error it knows what was spent in vain.

    Raises:
        InputError: a problem without residuals whose likelihood JAX cannot differentiate either.
        NoLikelihoodError: none of the draws has a positive likelihood.
    """
    horizons, target_at = _targets(problem, config)
    same: OneSummit = one_point
    began_at = 0.0
    if config.survey and isinstance(problem, ResidualProblem):
        same, began_at = one_ridge(problem, key), SURVEY_OF_CLIMBS
    saved = checkpoint.load()
    if saved is None:
        ledger = Ledger() if ledger is None else ledger
        climbs = _first(problem, config, key, horizons[0], ledger, logbook.part(0.0, began_at))
    else:
        climbs = unpack(*saved)
    target = None
    while climbs.level < len(horizons):
        began = time.monotonic()
        if target is None:
            target = target_at(horizons[climbs.level], climbs.ledger, climbs.positions[0], climbs.noise)
        allowed = _affordable_steps(problem.n_rows, config, climbs, horizons, int(target.noise.sum()))
        state, steps = maximise(target, climbs.positions[climbs.done], max_steps=allowed, tolerance=config.tolerance)
        climbs = record(climbs, state, len(steps), horizons[climbs.level], target)
        if climbs.level_done and config.survey and isinstance(problem, ResidualProblem):
            climbs = _with_search(problem, config, climbs, horizons, target_at, target, key)
        if climbs.level_done:
            _check_heights(climbs, horizons[climbs.level])
            climbs = go_on(climbs, target, one_point if horizons[climbs.level] == horizons[-1] else same)
            target = None
        climbs = climbs._replace(seconds=climbs.seconds + time.monotonic() - began)
        checkpoint.save(*pack(climbs))
        share = (climbs.level + climbs.done / len(climbs.positions)) / len(horizons)
        logbook.part(began_at, 1.0).stage(share, method="laplace", **climbs.trace[-1])
    assert climbs.noise is not None
    target = target_at(problem.n_rows, climbs.ledger, climbs.positions[0], climbs.noise)
    on_plateaus: list[Laplace] = []
    if config.survey and isinstance(problem, ResidualProblem):
        began = time.monotonic()
        on_plateaus = _on_plateaus(problem, config, climbs, target, key)
        climbs = climbs._replace(seconds=climbs.seconds + time.monotonic() - began)
    return _collect(climbs, target, on_plateaus)


def _targets(problem: Problem, config: LaplaceConfig) -> tuple[tuple[int, ...], Callable[..., Climbable]]:
    """Horizons to climb at, and the posterior at one of them, given the ledger, a point, and noise coordinates."""
    prior = prior_derivatives(problem)
    if isinstance(problem, ResidualProblem):

        def by_residuals(horizon: int, ledger: Ledger, u: np.ndarray, noise: np.ndarray | None) -> Climbable:
            return make_target(problem, horizon, ledger, u, prior, config.jacobian, noise)

        horizons = block_boundaries(problem.n_rows, config.blocks)
        if config.survey:
            horizons = tuple(math.ceil(share * problem.n_rows) for share in CONTINUED)
        return tuple(sorted(set(horizons))), by_residuals
    if hasattr(problem, "log_likelihood_at"):
        derivatives = log_likelihood_derivatives(problem)

        def by_hessians(horizon: int, ledger: Ledger, u: np.ndarray, noise: np.ndarray | None) -> Climbable:
            return SmoothTarget(problem, ledger, derivatives, *prior, noise=np.zeros(len(u), dtype=bool))

        return (problem.n_rows,), by_hessians
    raise InputError(
        "this problem has no residuals, and no likelihood that JAX can differentiate",
        where="[inference] method",
        remedy='use method = "smc"',
    )


def _affordable_steps(n_rows: int, config: LaplaceConfig, climbs: Climbs, horizons: tuple[int, ...], noise: int) -> int:
    """Steps the present climb may take: what is left of the budget is shared among climbs by their horizons.

    Of the climbs of a horizon half are expected at the next, see `go_on`.
    """
    if config.rollouts is None:
        return config.max_steps
    starts, d = climbs.positions.shape
    now = horizons[climbs.level]
    later = sum(-(-starts // 2**ahead) * rows for ahead, rows in enumerate(horizons[climbs.level + 1 :], start=1))
    waiting = starts - climbs.done
    share = now * waiting / (now * waiting + later)
    grid, step = climb_cost(d, noise)
    left = max(_for_climbs(config) - climbs.ledger.rollouts, 0.0) * n_rows / now
    held = FOR_SEARCH * config.rollouts * (config.survey > 0 and len(climbs.earlier) > 0) * n_rows / now
    if climbs.done == 0 and left - held < grid + FEWEST_STEPS * step:
        held = 0.0  # a climb rather than a search from where there was none
    rows = max(left - held, 0.0) * share
    if climbs.begins_again:
        rows = max(rows, min(left, grid + FEWEST_STEPS * step))
    # More rivals than expected may have come to the last horizon: the best climb on, rather than none.
    served = waiting if later else int(np.clip(rows / (grid + FEWEST_STEPS * step), 1, waiting))
    return int(np.clip((rows / served - grid) / step, 0, config.max_steps))


def _for_climbs(config: LaplaceConfig) -> float:
    """Rollouts of a survey and of climbs, but for those on plateaus."""
    return math.inf if config.rollouts is None else config.rollouts * (1.0 - FOR_PLATEAUS * (config.survey > 0))


def _first(
    problem: Problem, config: LaplaceConfig, key: PRNGKeyArray, horizon: int, ledger: Ledger, logbook: Logbook
) -> Climbs:
    """Climbs at their starts."""
    began = time.monotonic()
    if config.survey and isinstance(problem, ResidualProblem):
        budget = None if config.rollouts is None else SURVEY_OF_CLIMBS * config.rollouts
        prefixes = block_boundaries(problem.n_rows, config.blocks + 1)
        found = survey(problem, prefixes[:-1] or prefixes, config.survey, budget, key, ledger, logbook)
        u, density = surveyed(problem, found, horizon, config.starts, ledger)
    else:
        u, density = screened(problem, config.screen, horizon, config.starts, key, ledger)
    return begin(u, density, ledger, time.monotonic() - began)


def _with_search(
    problem: ResidualProblem,
    config: LaplaceConfig,
    climbs: Climbs,
    horizons: tuple[int, ...],
    target_at: Callable[..., Climbable],
    target: Climbable,
    key: PRNGKeyArray,
) -> Climbs:
    """A further climb at a horizon at which even the best went astray, once, if the budget allows; see `restarts`."""
    if len(climbs.earlier) == 0:
        return climbs
    rows, (d, noise) = horizons[climbs.level - 1], (climbs.positions.shape[1], int(target.noise.sum()))
    grid, step = climb_cost(d, noise)
    # A climb from what is found, and one at each horizon to come.
    kept = (grid + FEWEST_STEPS * step) * sum(horizons[climbs.level :]) / problem.n_rows
    left = (_for_climbs(config) - climbs.ledger.rollouts - kept) * problem.n_rows / horizons[climbs.level]
    generations = affordable_generations(left, d, noise)
    if not generations:
        return climbs
    before, after = climbs.earlier[0], climbs.positions[int(np.argmax(climbs.log_density))].copy()
    after[target.noise] = before[target.noise]
    shorter = target_at(rows, climbs.ledger, before, climbs.noise)
    assert isinstance(shorter, Target)
    assert isinstance(target, Target)
    # Residuals know nothing of a rollout that ended before its time.
    lost = not np.isfinite(climbs.log_density).any()
    if not lost and not astray(shorter.residuals(before[None])[0], target.residuals(after[None])[0]):
        return climbs
    mode = normal_at(shorter, LevenbergState(before, math.nan, 0.0, True))
    return with_starts(climbs, search(problem, mode, target, generations, jax.random.fold_in(key, rows)))


def _check_heights(climbs: Climbs, horizon: int) -> None:
    if not np.isfinite(climbs.log_density).any():
        raise NoLikelihoodError(
            f"no climb has a positive likelihood up to row {horizon} ({climbs.ledger.reasons})",
            where="[inference]",
            remedy="look at what the simulator reports there, or allow more starts",
        )


def _on_plateaus(
    problem: Problem, config: LaplaceConfig, climbs: Climbs, target: Climbable, key: PRNGKeyArray
) -> list[Laplace]:
    """Normal approximations on plateaus beside the best of the climbs."""
    best = int(np.argmax(climbs.log_density))
    state = LevenbergState(climbs.positions[best], float(climbs.log_density[best]), 0.0, bool(climbs.converged[best]))
    widths = np.sqrt(np.diag(prior_moments(problem, key)[1]))
    places = plateaus(target, normal_at(target, state), widths, RIVAL)
    left = math.inf if config.rollouts is None else config.rollouts - climbs.ledger.rollouts
    modes = []
    for place, end in zip(places, climbs_from(target, places, config.tolerance, left), strict=False):
        facts = {"horizon": problem.n_rows, "plateau": place.coordinate, "log_density": end.log_density}
        climbs.trace.append(facts | {"converged": end.converged, "rollouts": climbs.ledger.rollouts})
        if end.log_density > state.log_density - RIVAL:
            mode = laplace(target, end)
            assert mode.slope is not None
            # No summit along that coordinate: its likelihood is level, whatever the slope of the prior.
            slope = np.where(np.arange(len(mode.mean)) == place.coordinate, 0.0, mode.slope)
            modes.append(mode._replace(slope=slope))
    return modes


def _collect(climbs: Climbs, target: Climbable, on_plateaus: list[Laplace]) -> Modes:
    """Laplace at every optimum that could matter, in the order of their evidence."""
    cautions = []
    modes: list[Laplace] = []
    for index in np.argsort(-climbs.log_density, kind="stable"):
        state = LevenbergState(
            climbs.positions[index], float(climbs.log_density[index]), 0.0, bool(climbs.converged[index])
        )
        if state.log_density > climbs.log_density.max() - RIVAL and _apart(state.position, modes):
            mode = laplace(target, state)
            modes += [mode] if _apart(mode.mean, modes) else []
    modes += [mode for mode in on_plateaus if _apart(mode.mean, modes)]
    modes.sort(key=lambda mode: -mode.log_evidence)
    best = np.argmin(np.max(np.abs(climbs.positions - modes[0].mean), axis=1))
    if not climbs.converged[best]:
        sentence = "the best climb had not converged when its steps or its budget ran out; raise max_steps or rollouts"
        cautions.append(Caution(Code.CLIMB_UNFINISHED, sentence, grave=True))
    rivals = [mode for mode in modes[1:] if mode.log_evidence > modes[0].log_evidence - 5.0]
    if rivals:
        sentence = (
            f"{len(rivals)} further optima have an evidence within 5 nats: one normal distribution does not describe "
            "this posterior; use the bridge or SMC"
        )
        cautions.append(Caution(Code.SEVERAL_OPTIMA, sentence))
    return Modes(modes, climbs, cautions)


def _apart(position: Float[np.ndarray, " d"], modes: list[Laplace]) -> bool:
    """Whether a point lies beyond one posterior deviation of every mode: climbs also stop on one flat top."""
    factors = [np.linalg.cholesky(mode.covariance) for mode in modes]
    away = [squared_distance(factor, (position - mode.mean)[None]) for factor, mode in zip(factors, modes, strict=True)]
    return all(distance > len(position) for distance in away)


def run(
    problem: Problem,
    config: LaplaceConfig,
    key: PRNGKeyArray,
    logbook: Logbook = UNRECORDED,
) -> InferenceResult:
    """Posterior mode and draws of the normal approximation around it, mapped back to physical units."""
    mode_key, draw_key = jax.random.split(key)
    digest = run_digest(problem, "laplace", config, key)
    checkpoint = logbook.checkpoint("laplace", digest)
    found = find_modes(problem, config, mode_key, checkpoint, logbook)
    best = found.modes[0]
    factor = np.linalg.cholesky(best.covariance)
    u = best.mean + np.asarray(jax.random.normal(draw_key, (config.draws, len(best.mean)))) @ factor.T
    draws = chains(problem, [u])
    ledger = found.climbs.ledger
    return InferenceResult(
        method="laplace",
        draws=draws,
        log_evidence=(best.log_evidence, float("nan")),
        trace=found.climbs.trace,
        rollouts=ledger.rollouts,
        evaluations=ledger.evaluations,
        excluded=dict(ledger.excluded),
        cautions=[
            *found.cautions,
            *prior_cautions(problem, draws),
            *exclusion_cautions(ledger.excluded, ledger.evaluations),
        ],
        seconds=found.climbs.seconds,
        optimum=mode_values(problem, best),
        details={
            "covariance_unconstrained": best.covariance.tolist(),
            "noise_coordinates": np.flatnonzero(np.asarray(found.climbs.noise)).tolist(),
            "modes": [{"log_evidence": m.log_evidence, **mode_values(problem, m)} for m in found.modes],
        },
    )


def mode_values(problem: Problem, mode: Laplace) -> dict[str, float]:
    """A mode in physical units."""
    values = problem.from_unconstrained(jnp.asarray(mode.mean[None]))
    return {name: float(np.asarray(values[name])[0]) for name in problem.names}
