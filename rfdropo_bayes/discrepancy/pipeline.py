"""The audit from data to verdict: show, name, extend, measure.

`findings` is a generator: each `Found` that it gives holds all that is known by then, and `conclude` makes an answer of
any of them. So an audit that is stopped, by its time limit or by Ctrl-C, answers with what it has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.noise import Autoregression
from rfdropo_bayes.bayes.noise.autoregression import INNOVATIONS, RESIDUALS, STATED
from rfdropo_bayes.bayes.noise.stacked import Stacked
from rfdropo_bayes.cautions import Caution
from rfdropo_bayes.discrepancy.audit_problem import AuditProblem, simulated
from rfdropo_bayes.discrepancy.base_fit import (
    Reached,
    base_fits,
    beginning,
    first_target,
    residual_noise,
    under_residual_noise,
)
from rfdropo_bayes.discrepancy.deadline import Deadline, OutOfTime
from rfdropo_bayes.discrepancy.described import Described, describe
from rfdropo_bayes.discrepancy.extension import DISCRETISATION, Added, ExtensionSearch, numerical_shift
from rfdropo_bayes.discrepancy.fit import Fit, FitTarget, climb, widened
from rfdropo_bayes.discrepancy.gain import Gain, Unseen, UnseenErrors, noise_distance
from rfdropo_bayes.discrepancy.held_out import HeldOut, Kept, keep_supported
from rfdropo_bayes.discrepancy.inadequacy import as_measured, spread
from rfdropo_bayes.discrepancy.journal import Journal
from rfdropo_bayes.discrepancy.naming import Named, name_causes, without_each_other
from rfdropo_bayes.discrepancy.prior_ends import decided_by_priors
from rfdropo_bayes.discrepancy.remainder import Remainder, describe_remainder
from rfdropo_bayes.discrepancy.screen import Screen, p_in_words
from rfdropo_bayes.discrepancy.verdict import DESCRIBED, NEGLIGIBLE, NO_VERDICT, PARTLY, UNEXPLAINED, decide, negligible

BASE, CAUSES = "the fit of the base model", "naming causes"
GAIN, LAWS = "the gain on unseen recordings", "laws at ports"


@dataclass(frozen=True)
class Found:
    """What is known at some time of an audit.

    Attributes:
        problem: what is audited.
        reached: the base model.
        named: causes; None before the base model was screened.
        kept: of these, what unseen recordings support; None before they were asked.
        suspected: a noise under which the base model would pass, where a stated one leaves a discrepancy.
        described: what acts that the library does not have; None before it was asked, or where it is not.
        ended: of the parts of an audit, those that are done.
    """

    problem: AuditProblem
    reached: Reached
    named: Named | None = None
    kept: Kept | None = None
    suspected: Stacked | None = None
    described: Described | None = None
    ended: tuple[str, ...] = ()

    def after(self, part: str) -> Found:
        """The same with a part that is done."""
        return replace(self, ended=(*self.ended, part))

    @property
    def left(self) -> tuple[str, ...]:
        """What was not done, in words."""
        waiting = () if self.named is None else self.named.waiting
        parts = [BASE, CAUSES, *([GAIN] if self.named is None or self.named.steps else [])]
        found = [part for part in parts if part not in self.ended]
        if waiting:
            found[found.index(CAUSES)] = f"refits with {', '.join(waiting)}, and further causes"
        asks = self.problem.ports is not None and self.problem.compared is None
        return (*found, *([LAWS] if asks and LAWS not in self.ended else []))


@dataclass(frozen=True)
class Causes:
    """What the search over extensions has named.

    Attributes:
        steps: that unseen recordings support, all of them where these support none.
        unsupported: mechanisms that the fitted recordings asked for and unseen ones do not support.
        screens: of the base model, and after each step.
        refits: log Bayes factors of the candidates that were refitted beside the last model and did not join it.
        described: what acts that the library does not have; None where nothing was left to describe.
    """

    steps: list[Added]
    unsupported: list[str]
    screens: list[Screen]
    refits: dict[str, float] = field(default_factory=dict)
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

    @classmethod
    def of_steps(cls, held_out: HeldOut | None, steps: int) -> Validation:
        """What unseen recordings say of the model after so many steps, and after each of them."""
        if held_out is None:
            return cls()
        gains = [held_out.gain(0, k) for k in range(1, steps + 1)]
        explained, predictions = [gain.explained for gain in gains], held_out.predictions
        last = gains[-1] if gains else None
        return cls(last, explained, held_out.which, (predictions[0], predictions[steps]), held_out.unseen)

    @classmethod
    def of_law(cls, described: Described) -> Validation:
        """What unseen recordings say of the base model with a law, alone or beside mechanisms."""
        held = described.held_out
        if held is None:
            return cls()
        if described.steps:
            return cls.of_steps(held, len(described.steps))
        return cls(described.overall, [], held.which, (held.predictions[0], held.predictions[-1]), held.unseen)


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
        stopped: why it ended before all was done, "time" or "interrupt"; empty where it did not.
        left: what was not done.
        rollouts: of the whole run.
        profile: seconds of each stage, of all parts of an audit that was resumed.
        waited: seconds for which its last part waited for processors that other programs held.
    """

    stopped: str
    left: tuple[str, ...]
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
        return BASE not in self.cost.left

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
    clock = deadline or Deadline(problem.rules.minutes)
    found = Found(problem, beginning(problem, first_target(problem, journal or Journal(), clock)))
    with clock.stopping(report):
        for known in findings(found, report):
            found = known
    return conclude(found, report)


def findings(begun: Found, report: Callable[[str], None]) -> Iterator[Found]:
    """What is known after each part of an audit.

    Raises:
        OutOfTime: the time is up.
    """
    clock = begun.reached.target.forward.deadline
    found = begun
    with clock.stage("base model"):
        for reached in base_fits(begun.problem, begun.reached, begun.problem.seed, report):
            found = replace(found, reached=reached)
            yield found
    target, base = found.reached.settled()
    problem = _with_differences_of(begun.problem, target)
    found = replace(found, problem=problem).after(BASE)
    report(f"base model fitted; {_noise(target.measured.noise.first)}{_far_off(target, base)}")
    firsts = [group[0] for group in target.measurements.members]
    finer = simulated(problem, True, target.measurements, firsts, clock) if problem.finer else None
    search = ExtensionSearch(target, problem.candidates, problem.rules, problem.seed, finer, report)
    named = Named(search, base)
    for each in _named(named):
        named, found = each, replace(found, named=each)
        yield found
    found = found.after(CAUSES)
    kept = Kept(named, None)
    for each_kept in keep_supported(problem, replace(named, steps=without_each_other(named.steps))):
        kept, found = each_kept, replace(found, kept=each_kept)
        yield found
    last = kept.named
    if last.steps and last.judge.noise.source == RESIDUALS:
        kept = replace(kept, named=replace(last, screen=_final_screen(last)))
    found = replace(found, kept=kept).after(GAIN)
    yield found
    verdict = _verdict(kept, problem, ended=True)
    if verdict in (PARTLY, UNEXPLAINED) and kept.named.screens[-1].omnibus.p <= problem.rules.extended_passes:
        found = replace(found, suspected=_suspected(search, as_measured(last.search.target, last.base)))
        yield found
    # A discrepancy that the library does not explain, or a base model that could not be fitted for it.
    if verdict in (PARTLY, UNEXPLAINED) or (verdict == NO_VERDICT and not base.converged):
        for described in describe(problem, last, kept.held_out, report):
            found = replace(found, described=described)
            yield found
    yield found.after(LAWS)


def conclude(found: Found, report: Callable[[str], None] = lambda line: None) -> Answer:
    """The answer that is known by now. An audit that was stopped measures the gain of what it has, if the time that is
    kept for this suffices; all else that it does here takes no more than a few rollouts."""
    problem, clock = found.problem, found.reached.target.forward.deadline
    stopped = clock.reached
    kept = found.kept or _kept_in_time(found, clock)
    judge, fitted = kept.named.search.target, kept.named
    base = as_measured(judge, fitted.base)
    steps = [replace(step, fit=as_measured(step.judge, step.fit)) for step in fitted.steps]
    screens, validation = fitted.screens, Validation.of_steps(kept.held_out, len(steps))
    verdict, described = _verdict(kept, problem, ended=CAUSES in found.ended), found.described
    if described is not None and described.holds:
        verdict = DESCRIBED
        if len(described.steps) < len(steps):
            steps = [replace(step, fit=as_measured(step.judge, step.fit)) for step in described.steps]
            screens = [*(step.before for step in steps), screens[-1]] if steps else screens[:1]
            validation = Validation.of_law(described)
    target, extended = judge.measured, steps[-1].fit if steps else base
    sizes = extended
    with suppress(OutOfTime), clock.stage("sizes"):
        sizes = widened(steps[-1].judge, extended) if steps else extended
    clock.lift()  # the rest are single rollouts for the report, and the optimisation for the sizes of a law
    finer, refined = fitted.search.finer, DISCRETISATION in [*fitted.names, *kept.unsupported]
    shown = None if refined or finer is None else numerical_shift(target, finer, extended)
    left = extended.residual
    if described is not None and described.holds and described.last is not None:
        left = as_measured(described.last.target, described.last.fit).residual
    remainder = describe_remainder(target.measurements, left, target.noise.first)
    if verdict in (PARTLY, UNEXPLAINED) and not steps:
        size, noise = float(np.sqrt(3.0) * remainder.amplitude), noise_distance(target.noise.first)
        verdict = NEGLIGIBLE if negligible(problem.rules, size, noise, shown) else verdict
    draws = sizes.draws(np.random.default_rng([problem.seed, 5]), 1000, *problem.coordinates.bounds)
    suspected = None if verdict == DESCRIBED else found.suspected
    rollouts = judge.forward.rollouts + (finer.rollouts if finer else 0)
    return Answer(
        verdict,
        problem,
        target,
        base,
        Causes(steps, list(kept.unsupported), screens, fitted.gains, described),
        validation,
        remainder,
        sizes,
        draws,
        Doubts(suspected, target.measurements.shift, shown, decided_by_priors(target, draws)),
        Cost(clock.why if stopped else "", found.left if stopped else (), rollouts, clock.profile, clock.waited),
    )


def _kept_in_time(found: Found, clock: Deadline) -> Kept:
    """Of an audit that was stopped: the base model with the best that was named so far, its joint test, and the gain
    on unseen recordings where the time that is kept for it suffices."""
    named = found.named
    if named is None:
        target, base = _settled(found.reached, clock)
        named = Named(ExtensionSearch(target, found.problem.candidates, found.problem.rules, found.problem.seed), base)
    named = named.with_best()
    named = replace(named, steps=without_each_other(named.steps))
    if named.screen is None:
        named = replace(named, screen=named.asked.tested(named.fit, len(named.steps)))
    kept = Kept(named, None)
    with suppress(OutOfTime), clock.granted():
        kept = next(iter(keep_supported(found.problem, named)))
    return kept


def _settled(reached: Reached, clock: Deadline) -> tuple[FitTarget, Fit]:
    """Target and fit of a base model that was not fitted to the end."""
    with clock.granted(float("inf")):
        return reached.settled()


def _verdict(kept: Kept, problem: AuditProblem, *, ended: bool) -> str:
    """The verdict on what was named, whatever has no name; ``ended`` is whether all candidates had their say."""
    named, rules = kept.named, problem.rules
    noise, members = named.judge.measured.noise, [len(step.members) for step in named.steps]
    gain = Validation.of_steps(kept.held_out, len(named.steps)).gain
    last = named.screens[-1].omnibus.p if named.steps else None
    verdict = decide(rules, named.screens[0].omnibus.p, last, members, gain, noise.doubtful)
    if not named.fit.converged:  # clearly supported effects are found nevertheless
        return PARTLY if gain is not None and gain.clear else NO_VERDICT
    return verdict if ended or named.steps or verdict != UNEXPLAINED else NO_VERDICT


def _named(begun: Named) -> Iterator[Named]:
    """Named causes; asked once more where the noise is that of residuals.

    What the base model lacks may drive its fit to a corner of the priors where motion is rough, and no climb ends.
    Causes are asked for all the same. The noise of a base model's residuals holds the discrepancy itself, and whitens
    away what would tell its causes apart: so the whole question is asked again under the noise that the first
    extension leaves.
    """
    first = begun
    for named in name_causes(begun.search, begun.base):
        first = named
        yield first
    target = first.search.target
    if not first.steps or target.measured.noise.source not in (RESIDUALS, INNOVATIONS):
        return
    target = replace(target.measured, noise=residual_noise(first.judge, first.fit))
    if target.noise.source == INNOVATIONS:  # as far off as before
        return
    begun.search.report(f"once more with the noise that the extended model leaves, AR({target.noise.first.order})")
    *_, again = name_causes(begun.search.under(target), climb(target, first.base.x, first.base.free))
    yield again


def _with_differences_of(problem: AuditProblem, target: FitTarget) -> AuditProblem:
    """The problem with derivatives over the steps that the base fit has found usable."""
    step = target.forward.lanes.difference
    if step is None or step == problem.lanes.difference:
        return problem
    finer = problem.finer and (problem.finer[0].with_difference(step), problem.finer[1])
    return replace(problem, lanes=target.forward.lanes, finer=finer)


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


def _final_screen(last: Named) -> Screen:
    """The screen of the extended model under the noise that it leaves itself."""
    renewed = replace(last.judge, noise=residual_noise(last.judge, last.fit))
    fit = climb(renewed, last.fit.x, last.fit.free)
    found = last.asked.under(renewed).screened(fit, last.names)
    p = p_in_words(found.omnibus.p, last.search.rules.bootstraps)
    last.search.report(f"joint test under the noise that it leaves: p {p}")
    return found


def _suspected(search: ExtensionSearch, base: Fit) -> Stacked | None:
    """Noise fitted to what the base model leaves, where it passes under that, though not under the noise stated."""
    known = search.target.measured
    if known.noise.source != STATED:
        return None
    target, fit = under_residual_noise(known, base)
    found = search.under(target).screened(fit)
    passes = found.omnibus.p > search.rules.base_passes and not target.noise.doubtful
    return target.noise if passes else None
