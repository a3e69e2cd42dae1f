"""The audit from data to verdict: show, name, extend, measure."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import jax
import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.noise import Autoregression
from rfdropo_bayes.bayes.noise.autoregression import RESIDUALS, STATED
from rfdropo_bayes.bayes.noise.stacked import Stacked
from rfdropo_bayes.cautions import Caution
from rfdropo_bayes.discrepancy.audit_problem import AuditProblem, measurements_of, simulated
from rfdropo_bayes.discrepancy.deadline import Deadline, OutOfTime, about
from rfdropo_bayes.discrepancy.described import Described, NamedModel, describe
from rfdropo_bayes.discrepancy.extension import DISCRETISATION, Added, ExtensionSearch, numerical_shift
from rfdropo_bayes.discrepancy.fit import (
    WITHIN,
    Fit,
    FitTarget,
    base_optimum,
    better_nearby,
    climb,
    climb_rollouts,
    optimum_rollouts,
    poll_rollouts,
    widened,
    with_usable_differences,
)
from rfdropo_bayes.discrepancy.forward import Forward
from rfdropo_bayes.discrepancy.gain import Gain, Unseen, UnseenErrors, noise_distance
from rfdropo_bayes.discrepancy.held_out import HeldOut, supported_steps
from rfdropo_bayes.discrepancy.inadequacy import as_measured, fit_with_noise, spread
from rfdropo_bayes.discrepancy.journal import Journal
from rfdropo_bayes.discrepancy.measurements import Measurements
from rfdropo_bayes.discrepancy.prior_ends import decided_by_priors
from rfdropo_bayes.discrepancy.remainder import Remainder, describe_remainder
from rfdropo_bayes.discrepancy.screen import Screen, p_in_words
from rfdropo_bayes.discrepancy.verdict import DESCRIBED, NEGLIGIBLE, NO_VERDICT, PARTLY, UNEXPLAINED, decide, negligible
from rfdropo_bayes.errors import InputError

AGAIN = 3  # times that a base fit is climbed on from a better point beside it, before it counts as not converged
# White noise of each channel in its own unit, until something better is known: millimetres, and the medians of priors.
GUESSES = {"markers": 1e-3, "tension": 0.02, "motor_angle": 0.02, "object_pose": 5e-3, "orientation": 0.01}


@dataclass(frozen=True)
class Causes:
    """What the search over extensions has named.

    Attributes:
        steps: that unseen recordings support, all of them where these support none.
        unsupported: mechanisms that the fitted recordings asked for and unseen ones do not support.
        screens: of the base model, and after each step.
        described: what acts that the library does not have; None where nothing was left to describe.
    """

    steps: list[Added]
    unsupported: list[str]
    screens: list[Screen]
    described: Described | None = None


@dataclass(frozen=True)
class Validation:
    """What the extension is worth on recordings that no fit has seen.

    Attributes:
        gain: of all steps; None where it could not be measured.
        stages: explained fraction after each step.
        recordings: which they are, in words.
        predictions: of the base model and of the last one.
        unseen: the measurements.
    """

    gain: Gain | None = None
    stages: list[float] = field(default_factory=list)
    recordings: str = ""
    predictions: tuple[UnseenErrors, UnseenErrors] | None = None
    unseen: Unseen | None = None


@dataclass(frozen=True)
class Doubts:
    """What speaks against the noise, or against the simulation.

    Attributes:
        suspected: a noise under which the base model would pass, where a stated one leaves a discrepancy that is not
            explained.
        shift: distance by which constants tell repeats apart [m]; None without repeats.
        numerical: how far half the time step and a finer mesh move the markers of the last model [m]; None where that
            is not known, or the finer one is the model.
        priors: parameters of the base model that their prior decides.
    """

    suspected: Stacked | None
    shift: float | None
    numerical: float | None
    priors: list[Caution]


@dataclass(frozen=True)
class Cost:
    """What an audit took.

    Attributes:
        stopped: whether the time was up before all was done.
        rollouts: of the whole run.
        profile: seconds of each stage, of all parts of an audit that was resumed.
        waited: seconds for which its last part waited for processors that other programs held.
    """

    stopped: bool
    rollouts: int
    profile: dict[str, float]
    waited: float

    @property
    def seconds(self) -> float:
        """Of all stages."""
        return sum(self.profile.values())


@dataclass(frozen=True)
class Answer:
    """What an audit found.

    Attributes:
        verdict: see `decide`.
        problem: what was audited.
        target: data, noise of the measurement, and simulator.
        base: fit of the base model.
        causes, validation, doubts, cost: see their own classes.
        remainder: what no candidate explains.
        sizes: the last model's fit under priors that do not pull; ``draws`` are from it.
    """

    verdict: str
    problem: AuditProblem
    target: FitTarget
    base: Fit
    causes: Causes
    validation: Validation
    remainder: Remainder
    sizes: Fit
    draws: Float[np.ndarray, "draw d"]
    doubts: Doubts
    cost: Cost

    @property
    def fitted(self) -> bool:
        """Whether the base fit came to an end; where it did not, its parameters are where the search had come to."""
        return self.base.converged or not self.cost.stopped

    @property
    def converged(self) -> bool:
        """Whether the fit of the last model has."""
        return self.extended.converged

    @property
    def extended(self) -> Fit:
        """The last model."""
        return self.causes.steps[-1].fit if self.causes.steps else self.base

    @property
    def law(self) -> Described | None:
        """The law that joins the model for good; None without one."""
        found = self.causes.described
        return found if found is not None and found.holds else None

    @property
    def adopted(self) -> list[Added]:
        """Steps that join the model for good: those that unseen recordings clearly support, in a model that explains
        more than next to nothing."""
        gain = self.validation.gain
        if self.law is not None:
            gain = self.validation.gain or self.law.gain
        return self.causes.steps if gain is not None and gain.clear and self.verdict != UNEXPLAINED else []


def _sizes(steps: Sequence[Added], extended: Fit, deadline: Deadline) -> Fit:
    """The extended model's fit under priors no narrower than its sizes; as it is where the time is up."""
    with suppress(OutOfTime), deadline.stage("sizes"):
        return widened(steps[-1].judge, extended) if steps else extended
    return extended


def _leaves_something(verdict: str, base: Fit) -> bool:
    """Whether there is something to describe: a discrepancy that the library does not explain, or a base model that
    could not be fitted for it."""
    return verdict in (PARTLY, UNEXPLAINED) or (verdict == NO_VERDICT and not base.converged)


def _remainder(target: FitTarget, extended: Fit, described: Described | None) -> Remainder:
    """What the last model leaves, a law that holds being in it."""
    left = extended.residual
    if described is not None and described.holds and described.last is not None:
        left = as_measured(described.last.target, described.last.fit).residual
    return describe_remainder(target.measurements, left, target.noise.first)


def _weighed_up(
    problem: AuditProblem, verdict: str, target: FitTarget, remainder: Remainder, shown: float | None
) -> str:
    """The verdict, or `NEGLIGIBLE` where what is left is too small to matter."""
    size, noise = float(np.sqrt(3.0) * remainder.amplitude), noise_distance(target.noise.first)
    return NEGLIGIBLE if negligible(problem.rules, size, noise, shown) else verdict


def _described_validation(described: Described) -> Validation:
    """What unseen recordings say of the base model with a law, alone or beside mechanisms."""
    held = described.held_out
    if held is None:
        return Validation()
    if described.steps:
        return _validation(held, len(described.steps))
    return Validation(described.overall, [], held.which, (held.predictions[0], held.predictions[-1]), held.unseen)


def audit(
    problem: AuditProblem,
    report: Callable[[str], None] = lambda line: None,
    journal: Journal | None = None,
    deadline: Deadline | None = None,
) -> Answer:
    """Run the audit. Same problem, same answer.

    Args:
        problem: see `AuditProblem`.
        report: called with a line of words now and then.
        journal: keeps what was computed, for an audit that is interrupted.
        deadline: of a run that has begun before; by default the problem's minutes from now on.

    Raises:
        InputError: rollouts at the optimum do not end well.
    """
    deadline = deadline or Deadline(problem.rules.minutes)
    with deadline.stage("base model"):
        target, base = _fitted_or_not(problem, journal, report, deadline)
    fitted = not deadline.reached
    problem = _with_differences_of(problem, target)
    if fitted:
        report(f"base model fitted; {_noise(target.measured.noise.first)}{_far_off(target, base)}")
    finer = _forward(problem, True, target.measurements, deadline) if fitted and problem.finer else None
    judge, search = target, ExtensionSearch(target, problem.candidates, problem.rules, problem.seed, finer, report)
    search, base, steps, last = _searched(search, base)
    judge = judge if judge.known is not None else search.target.on(judge.forward)
    asked = [step.name for step in steps]
    steps, last, held_out = supported_steps(problem, judge, search, base, steps, last)
    under = NamedModel(judge, base, tuple(steps))
    base, steps = as_measured(judge, base), [replace(s, fit=as_measured(s.judge, s.fit)) for s in steps]
    unsupported = [name for name in asked if name not in [step.name for step in steps]]
    if unsupported:
        report(f"unseen recordings do not support {' and '.join(unsupported)}")
    extended, target = steps[-1].fit if steps else base, judge.measured
    if steps and target.noise.source == RESIDUALS:
        with suppress(OutOfTime):
            last = _final_screen(replace(search, target=steps[-1].judge), extended, steps)
    screens = [*(step.before for step in steps), last]
    validation = _validation(held_out, len(steps))
    verdict, suspected = _verdict(replace(search, target=judge), base, steps, screens, validation.gain, deadline)
    asks = fitted and not deadline.reached and _leaves_something(verdict, base)
    described = describe(problem, under, held_out, report) if asks else None
    if described is not None and described.holds:
        verdict, suspected = DESCRIBED, None
        if len(described.steps) < len(steps):
            steps = [replace(step, fit=as_measured(step.judge, step.fit)) for step in described.steps]
            screens = [*(step.before for step in steps), last] if steps else screens[:1]
            extended, validation = steps[-1].fit if steps else base, _described_validation(described)
    sizes = _sizes(steps, extended, deadline)
    stopped = deadline.reached
    deadline.lift()  # what is left are single rollouts, for the report, and the climb for the sizes of a law
    shown = None if DISCRETISATION in asked or finer is None else numerical_shift(target, finer, extended)
    remainder = _remainder(target, extended, described)
    if verdict in (PARTLY, UNEXPLAINED) and not steps:
        verdict = _weighed_up(problem, verdict, target, remainder, shown)
    draws = sizes.draws(np.random.default_rng([problem.seed, 5]), 1000, *problem.coordinates.bounds)
    return Answer(
        verdict,
        problem,
        target,
        base,
        Causes(steps, unsupported, screens, described),
        validation,
        remainder,
        sizes,
        draws,
        Doubts(suspected, target.measurements.shift, shown, decided_by_priors(target, draws)),
        Cost(stopped, judge.forward.rollouts + (finer.rollouts if finer else 0), deadline.profile, deadline.waited),
    )


def _validation(held_out: HeldOut | None, steps: int) -> Validation:
    """What unseen recordings say of the model after so many steps, and after each of them."""
    if held_out is None:
        return Validation()
    gains = [held_out.gain(0, k) for k in range(1, steps + 1)]
    explained, predictions = [gain.explained for gain in gains], held_out.predictions
    last = gains[-1] if gains else None
    return Validation(last, explained, held_out.which, (predictions[0], predictions[steps]), held_out.unseen)


def _noise(noise: Autoregression) -> str:
    """What a line of words says of a noise."""
    shared = "" if noise.correlation is None else ", shared between coordinates"
    return f"noise from {noise.source}, AR({noise.order}){shared}"


def _far_off(target: FitTarget, fit: Fit) -> str:
    """What a line of words says of a model that is far off."""
    if target.known is None:
        return ""
    noise, own = target.noise.first.scale, target.measurements.columns[0]
    left = spread(target, fit)[own]
    size, share = 1e3 * np.sqrt(3.0 * np.mean(left**2)), float(np.mean((left / noise) ** 2))
    return f"; it is far off: judged under white noise of the {size:.2g} mm that it leaves; a row counts {share:.2g}"


def _verdict(
    search: ExtensionSearch,
    base: Fit,
    steps: Sequence[Added],
    screens: Sequence[Screen],
    gain: Gain | None,
    deadline: Deadline,
) -> tuple[str, Stacked | None]:
    """The verdict, and the noise under which the base model would pass where something is left unexplained."""
    rules, last = search.rules, screens[-1].omnibus.p
    members, noise = [len(step.members) for step in steps], search.target.measured.noise
    verdict = decide(rules, screens[0].omnibus.p, last if steps else None, members, gain, noise.doubtful)
    if not (base.converged or steps) or (verdict == UNEXPLAINED and deadline.reached):
        verdict = NO_VERDICT
    suspected = None
    if verdict in (PARTLY, UNEXPLAINED) and last <= rules.extended_passes:
        with suppress(OutOfTime):
            suspected = _suspected(search, base)
    return verdict, suspected


def _searched(search: ExtensionSearch, base: Fit) -> tuple[ExtensionSearch, Fit, list[Added], Screen]:
    """Named causes, and the screen of the model with them; asked once more where the noise is that of residuals.

    What the base model lacks may drive its fit to a corner of the priors where motion is rough, and no climb ends.
    Causes are asked for all the same; they count if the fit of the model with them has converged.

    Returns:
        the search and the base fit that they are of, the steps, and the screen.
    """
    unnamed = search, base, list[Added]()
    if not base.converged and search.target.forward.deadline.reached:
        return *unnamed, search.tested(base, 0)
    own = search.target.forward
    base, steps, last = search.name_causes(base)
    if steps and not steps[-1].fit.converged:
        return *unnamed, search.tested(unnamed[1], 0)
    if steps and search.target.noise.source == RESIDUALS:
        with suppress(OutOfTime):
            again, renewed = _asked_again(search, own, base, steps[-1].fit)
            found = again.name_causes(renewed)
            if not search.target.forward.deadline.reached:
                return again, *found
    return search, base, steps, last


def _with_differences_of(problem: AuditProblem, target: FitTarget) -> AuditProblem:
    """The problem with derivatives over the steps that the base fit has found usable."""
    step = target.forward.lanes.difference
    if step is None or step == problem.lanes.difference:
        return problem
    finer = problem.finer and (problem.finer[0].with_difference(step), problem.finer[1])
    return replace(problem, lanes=target.forward.lanes, finer=finer)


def _forward(problem: AuditProblem, finer: bool, measurements: Measurements, deadline: Deadline | None) -> Forward:
    return simulated(problem, finer, measurements, [group[0] for group in measurements.members], deadline)


def base_model(
    problem: AuditProblem,
    seed: int,
    journal: Journal | None = None,
    report: Callable[[str], None] = lambda line: None,
    deadline: Deadline | None = None,
) -> tuple[FitTarget, Fit]:
    """Noise and base fit; where the noise is estimated from residuals, the two in turn.

    Raises:
        InputError: the time was up before the base model was fitted.
    """
    target = first_target(problem, journal or Journal(), deadline)
    try:
        return _base_fit(target, problem.start, seed, report, [])
    except OutOfTime:
        raise InputError(
            "the time was up before the base model was fitted",
            where=(deadline or Deadline()).where,
            remedy="raise it, fit fewer or shorter recordings, or start from a calibration (--from)",
        ) from None


def _fitted_or_not(
    problem: AuditProblem, journal: Journal | None, report: Callable[[str], None], deadline: Deadline
) -> tuple[FitTarget, Fit]:
    """The base model's noise and fit; where the time is up before, the last point that the search has come to, which
    counts as not converged. The deadline is lifted then: what is left is a rollout of each recording."""
    target = first_target(problem, journal or Journal(), deadline)
    coordinates = target.forward.coordinates
    reached = [(target, coordinates.null if problem.start is None else coordinates.encode(problem.start))]
    try:
        return _base_fit(target, problem.start, problem.seed, report, reached)
    except OutOfTime:
        report("the time was up before the base model was fitted")
        deadline.lift()
        target, fit = _unfitted(*reached[-1])
    if target.noise.source == RESIDUALS:  # a first guess
        target, fit = _unfitted(replace(target, noise=residual_noise(target, fit)), fit.x)
    return target, fit


def _unfitted(target: FitTarget, x: Float[np.ndarray, " d"]) -> tuple[FitTarget, Fit]:
    """A point that no fit has ended at: of the base parameters no more is known than their prior."""
    free = np.arange(target.forward.coordinates.base)
    residual = target.residual(x[None])[0]
    covariance = np.diag(target.forward.coordinates.prior_sd[free] ** 2)
    return target, Fit(x, free, residual, np.zeros((len(residual), len(free))), covariance, -np.inf, np.inf)


def _announce(target: FitTarget, start: dict[str, float] | None, report: Callable[[str], None]) -> None:
    """Say what is fitted first, and how long it may take: rollouts at the pace of different ones that fill a call, and
    derivatives, which take as long to compile as rollouts did."""
    forward, own = target.forward, target.forward.coordinates
    counted = f"{forward.count} recording{'s' if forward.count > 1 else ''}, repeats taken together"
    points = np.repeat(own.null[None], -(-forward.lanes.width // forward.count), axis=0)
    points[:, : own.base] += np.linspace(-0.5, 0.5, len(points))[:, None] * own.prior_sd[: own.base]
    took = []
    for _ in range(2):  # the first one compiles
        began = time.monotonic()
        forward.observe(np.clip(points, *own.bounds))
        took.append(time.monotonic() - began)
    rollouts = climb_rollouts(target, own.base) + poll_rollouts(target)
    rollouts += optimum_rollouts(target) if start is None else 0
    words = about(rollouts * forward.pace + max(took[0] - took[1], 0.0))
    report(f"fitting the base model: {own.base} parameters, {counted}; about {rollouts} rollouts, {words}")


def first_target(problem: AuditProblem, journal: Journal, deadline: Deadline | None = None) -> FitTarget:
    """The fitted recordings under the noise of repeats or of the experiment file, or a first guess."""
    measurements = measurements_of(problem, range(len(problem.trajectories)), problem.trajectories)
    noise = problem.stated_noise
    if measurements.has_repeats:
        noise = measurements.noise(measurements.spread, 0)
    if noise is None:
        scales = [np.full(c.valid.shape[-1], GUESSES[c.name]) for c in measurements.channels]
        noise = Stacked(tuple(Autoregression(scale, np.ones(1), RESIDUALS, np.inf) for scale in scales))
    return FitTarget(_forward(problem, False, measurements, deadline), measurements, noise, journal)


def _base_fit(
    target: FitTarget,
    start: dict[str, float] | None,
    seed: int,
    report: Callable[[str], None],
    reached: list[tuple[FitTarget, Float[np.ndarray, " d"]]],
) -> tuple[FitTarget, Fit]:
    """The base model's noise and posterior mode, from a given start or from where `calibrate`'s search leads; climbed
    on while rollouts beside it are better. ``reached`` gets the points that the search has come to."""
    _announce(target, start, report)
    coordinates, known = target.forward.coordinates, target.noise.source != RESIDUALS
    free = np.arange(coordinates.base)
    first = base_optimum(target, jax.random.key(seed)) if start is None else coordinates.encode(start)
    reached.append((target, first))
    usual, target = target.forward.lanes.difference, with_usable_differences(target, first)
    if target.forward.lanes.difference != usual:
        report(f"motion is rough: derivatives over relative steps of {target.forward.lanes.difference:g}")
    target, fit = fit_with_noise(target, first, free)
    for _ in range(AGAIN):
        reached.append((target, fit.x))
        better = better_nearby(target, fit)
        if better is None:  # of a motion that bends, as where cables go slack, slopes promise what is not there
            fit = replace(fit, promise=0.0) if fit.promise < WITHIN else fit
            break
        report(f"base model: sum of squares {fit.residual @ fit.residual:.0f}, and better beside it")
        fit = climb(target, better, free)
    else:
        fit = fit if better_nearby(target, fit) is None else replace(fit, promise=np.inf)
    return (target, fit) if known else _under_residual_noise(target, fit)


def _under_residual_noise(target: FitTarget, fit: Fit) -> tuple[FitTarget, Fit]:
    """Noise and fit in turn."""
    converged = fit.converged
    for _ in range(2):
        target = replace(target, noise=residual_noise(target, fit))
        fit = climb(target, fit.x, fit.free)
    return target, fit if converged else replace(fit, promise=np.inf)


def residual_noise(target: FitTarget, fit: Fit) -> Stacked:
    """Autoregressions fitted to what a model leaves of every recording."""
    measured = target.measurements
    left = np.array(measured.spread)
    for group, error in zip(measured.members, target.errors(fit.x), strict=True):
        left[list(group)] += error
    return measured.noise(np.where(measured.single_valid, left, 0.0), len(fit.free))


def _asked_again(search: ExtensionSearch, own: Forward, base: Fit, extended: Fit) -> tuple[ExtensionSearch, Fit]:
    """The search, on the base model's own simulator, with the noise of what a first extension leaves: that of the base
    model holds the discrepancy itself, and whitens away what would tell its causes apart."""
    target = replace(search.target, noise=residual_noise(search.target, extended)).on(own)
    search.report(f"once more with the noise that the extended model leaves, AR({target.noise.first.order})")
    return replace(search, target=target), climb(target, base.x, base.free)


def _final_screen(search: ExtensionSearch, extended: Fit, steps: Sequence[Added]) -> Screen:
    """The screen of the extended model under the noise that it leaves itself."""
    renewed = replace(search.target, noise=residual_noise(search.target, extended))
    fit = climb(renewed, extended.x, extended.free)
    found, _ = replace(search, target=renewed).screened(fit, [step.name for step in steps])
    p = p_in_words(found.omnibus.p, search.rules.bootstraps)
    search.report(f"joint test under the noise that it leaves: p {p}")
    return found


def _suspected(search: ExtensionSearch, base: Fit) -> Stacked | None:
    """Noise fitted to what the base model leaves, where it passes under that, though not under the noise stated."""
    known = search.target.measured
    if known.noise.source != STATED:
        return None
    target, fit = _under_residual_noise(known, base)
    found, _ = replace(search, target=target).screened(fit)
    passes = found.omnibus.p > search.rules.base_passes and not target.noise.doubtful
    return target.noise if passes else None
