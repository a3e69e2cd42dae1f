"""The audit from data to verdict: show, name, extend, measure.

`findings` is a generator: each `Results` has all results so far, and `conclude` makes an answer of any of them. An
audit stopped by its time limit or by Ctrl-C therefore answers with its present results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

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
from rfdropo_bayes.discrepancy.fit import Fit, FitTarget, optimise, widened
from rfdropo_bayes.discrepancy.gain import Gain, Unseen, UnseenErrors, noise_distance
from rfdropo_bayes.discrepancy.held_out import HeldOut, Kept, keep_supported
from rfdropo_bayes.discrepancy.inadequacy import as_measured, leaves_noise, residual_deviation
from rfdropo_bayes.discrepancy.journal import Journal
from rfdropo_bayes.discrepancy.naming import Named, name_causes
from rfdropo_bayes.discrepancy.prior_ends import decided_by_priors
from rfdropo_bayes.discrepancy.remainder import Remainder, describe_remainder
from rfdropo_bayes.discrepancy.score_tests import ScoreTests, p_in_words
from rfdropo_bayes.discrepancy.verdict import DESCRIBED, NEGLIGIBLE, NO_VERDICT, PARTLY, UNEXPLAINED, decide, negligible

BASE, CAUSES, FURTHER = "the fit of the base model", "naming causes", "further causes"
GAIN, LAWS = "the gain on unseen recordings", "laws at ports"


@dataclass(frozen=True)
class Results:
    """Intermediate results of an audit.

    Attributes:
        problem: the audited problem.
        reached: the base model.
        named: named causes; None before the score tests of the base model.
        kept: causes supported by unseen recordings; None before that test.
        suspected: a noise under which the base model would pass, if the stated noise leaves a discrepancy.
        described: effect that the library lacks; None before that search, or if it is not requested.
        ended: finished parts of the audit.
    """

    problem: AuditProblem
    reached: Reached
    named: Named | None = None
    kept: Kept | None = None
    suspected: Stacked | None = None
    described: Described | None = None
    small: bool = False  # whether what the named causes leave is negligible
    ended: tuple[str, ...] = ()

    def after(self, part: str) -> Results:
        """The results with one more finished part."""
        return replace(self, ended=(*self.ended, part))

    @property
    def unfinished(self) -> tuple[str, ...]:
        """Unfinished parts, in words; a stopped audit measures the gain of the causes that it has named."""
        waiting = () if self.named is None else self.named.waiting
        measured = self.kept is not None and self.kept.held_out is not None
        some = any(each.steps for each in (self.named, self.kept and self.kept.named) if each)
        parts = [BASE, CAUSES, *([GAIN] if not measured and (self.named is None or self.named.steps) else [])]
        unfinished = [part for part in parts if part not in self.ended]
        if waiting:
            unfinished[unfinished.index(CAUSES)] = f"refits with {', '.join(waiting)}, and {FURTHER}"
        elif CAUSES in unfinished and some:
            unfinished[unfinished.index(CAUSES)] = FURTHER
        asks = self.problem.ports is not None and self.problem.compared is None
        return (*unfinished, *([LAWS] if asks and LAWS not in self.ended else []))


@dataclass(frozen=True)
class Validation:
    """Gain of the extension on recordings that no fit has seen.

    Attributes:
        gain: gain of all steps; None if it could not be measured.
        stages: explained fraction after each step.
        recordings: description of the recordings.
        predictions: predictions of the base and the last model.
        unseen: the measurements.
    """

    gain: Gain | None = None
    stages: list[float] = field(default_factory=list)
    recordings: str = ""
    predictions: tuple[UnseenErrors, UnseenErrors] | None = None
    unseen: Unseen | None = None

    @classmethod
    def of_steps(cls, held_out: HeldOut | None, steps: int) -> Validation:
        """Validation on unseen recordings of the model after ``steps`` steps, and after each step."""
        if held_out is None:
            return cls()
        gains = [held_out.gain(0, k) for k in range(1, steps + 1)]
        explained, predictions = [gain.explained for gain in gains], held_out.predictions
        last = gains[-1] if gains else None
        return cls(last, explained, held_out.which, (predictions[0], predictions[steps]), held_out.unseen)

    @classmethod
    def of_law(cls, described: Described) -> Validation:
        """Validation on unseen recordings of the base model with a law, alone or beside mechanisms."""
        held_out = described.held_out
        if held_out is None:
            return cls()
        if described.steps:
            return cls.of_steps(held_out, len(described.steps))
        return cls(
            described.overall, [], held_out.which, (held_out.predictions[0], held_out.predictions[-1]), held_out.unseen
        )


@dataclass(frozen=True)
class Cost:
    """Cost of an audit.

    Attributes:
        stopped: why it ended before all was done, "time" or "interrupt"; empty if it finished.
        unfinished: unfinished parts.
        rollouts: rollouts of the whole run.
        profile: seconds of each stage, summed over all parts of a resumed audit.
    """

    stopped: str
    unfinished: tuple[str, ...]
    rollouts: int
    profile: dict[str, float]

    @property
    def seconds(self) -> float:
        """Seconds of all stages."""
        return sum(self.profile.values())


@dataclass(frozen=True)
class Answer:
    """Result of an audit.

    Attributes:
        verdict: see `decide`.
        problem: the audited problem.
        target: data, noise of the measurement, and simulator.
        base: fit of the base model.
        steps: steps supported by unseen recordings; all steps if none is supported.
        unsupported: mechanisms supported by fitted but not by unseen recordings.
        test_series: score tests of the base model, and after each step.
        refits: log Bayes factors of candidates refitted beside the last model but not added.
        described: effect that the library lacks; None if no misfit was left.
        validation, cost: see their own classes.
        remainder: the residual that no candidate explains.
        sizes: the last model's fit under widened priors; the source of ``draws``.
        suspected: a noise under which the base model would pass, if the stated noise leaves an unexplained discrepancy.
        shift: constant distance between repeats [m]; None without repeats.
        numerical: motion of the last model's markers by half the time step and a finer mesh [m]; None if unknown, or if
            the finer simulator is used.
        priors: cautions on parameters of the base model determined by their prior.
    """

    verdict: str
    problem: AuditProblem
    target: FitTarget
    base: Fit
    steps: list[Added]
    unsupported: list[str]
    test_series: list[ScoreTests]
    refits: dict[str, float]
    described: Described | None
    validation: Validation
    remainder: Remainder
    sizes: Fit
    draws: Float[np.ndarray, "draw d"]
    suspected: Stacked | None
    shift: float | None
    numerical: float | None
    priors: list[Caution]
    cost: Cost

    @property
    def fitted(self) -> bool:
        """Whether the base fit finished; if not, its parameters are the search's last point."""
        return BASE not in self.cost.unfinished

    @property
    def converged(self) -> bool:
        """Whether the fit of the last model has."""
        return self.extended.converged

    @property
    def extended(self) -> Fit:
        """The last model."""
        return self.steps[-1].fit if self.steps else self.base

    @property
    def law(self) -> Described | None:
        """The adopted law; None without an adopted law."""
        return self.described if self.described is not None and self.described.holds else None

    @property
    def law_leads(self) -> bool:
        """Whether a law takes more of the squared error of unseen recordings away than the mechanisms beside it."""
        named, law = self.validation.gain, None if self.law is None else self.law.gain
        if law is None or named is None or not self.steps:
            return law is not None
        taken, by_law = (gain.rmse_base**2 - gain.rmse_extended**2 for gain in (named, law))
        return by_law >= taken

    @property
    def adopted(self) -> list[Added]:
        """Adopted steps: clearly supported by unseen recordings, in a model with a noticeable explained share."""
        gain = self.validation.gain
        if self.law is not None:
            gain = self.validation.gain or self.law.gain
        return self.steps if gain is not None and gain.clear and self.verdict != UNEXPLAINED else []


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
        journal: stores results for an interrupted audit.
        deadline: deadline of a run that began earlier; by default the problem's minutes from now.

    Raises:
        InputError: rollouts at the optimum fail.
    """
    clock = deadline or Deadline(problem.rules.minutes)
    results = Results(problem, beginning(problem, first_target(problem, journal or Journal(), clock)))
    with clock.stopping(report):
        for known in findings(results, report):
            results = known
    return conclude(results, report)


def findings(begun: Results, report: Callable[[str], None]) -> Iterator[Results]:
    """Results after each part of an audit.

    Raises:
        OutOfTime: the time is up.
    """
    clock = begun.reached.target.forward.deadline
    results = begun
    with clock.stage("base model"):
        for reached in base_fits(begun.problem, begun.reached, begun.problem.seed, report):
            results = replace(results, reached=reached)
            yield results
    target, base = results.reached.settled()
    problem, step = begun.problem, target.forward.lanes.difference
    if step != problem.lanes.difference:  # steps that the base fit has found usable
        finer = problem.finer and (problem.finer[0].with_difference(step), problem.finer[1])
        problem = replace(problem, lanes=target.forward.lanes, finer=finer)
    results = replace(results, problem=problem).after(BASE)
    report(f"base model fitted; {_noise_in_words(target, base)}")
    firsts = [group[0] for group in target.measurements.members]
    refined = simulated(problem, True, target.measurements, firsts, clock) if problem.finer else None
    search = ExtensionSearch(target, problem.candidates, problem.rules, problem.seed, refined, report)
    named = Named(search, base)
    for each in _named(named):
        named, results = each, replace(results, named=each)
        yield results
    results = results.after(CAUSES)
    kept = Kept(named, None)
    for each_kept in keep_supported(problem, named):
        kept, results = each_kept, replace(results, kept=each_kept)
        yield results
    last = kept.named
    if last.steps and last.fit_target.noise.source == RESIDUALS:  # tested under the noise that it leaves itself
        renewed = replace(last.fit_target, noise=residual_noise(last.fit_target, last.fit))
        fit = optimise(renewed, last.fit.x, last.fit.free)
        tests = last.asked.under(renewed).score_tests(fit, last.names)
        report(f"joint test under the noise that it leaves: p {p_in_words(tests.omnibus.p, problem.rules.bootstraps)}")
        kept = replace(kept, named=replace(last, tests=tests))
    results = replace(results, kept=kept).after(GAIN)
    yield results
    passes = kept.named.test_series[-1].omnibus.p > problem.rules.extended_passes
    small = bool(kept.named.steps) and not passes and _leaves_little(problem, kept.named)
    results, suffices = replace(results, small=small), passes or small
    verdict = _verdict(kept, problem, ended=True, small=small)
    if verdict in (PARTLY, UNEXPLAINED) and not suffices:
        stated = search.target.measured
        if stated.noise.source == STATED:  # would the base model pass under a noise fitted to its residuals?
            other, fit = under_residual_noise(stated, as_measured(last.search.target, last.base))
            p = search.under(other).score_tests(fit).omnibus.p
            passing = p > problem.rules.level and not other.noise.doubtful
            results = replace(results, suspected=other.noise if passing else None)
        yield results
    # A discrepancy that the library does not explain, or a base model that could not be fitted for it. A model that
    # passes the joint test, or leaves too little to matter, leaves nothing to describe, even if the explained fraction
    # is uncertain.
    if verdict == UNEXPLAINED or (verdict == PARTLY and not suffices) or (verdict == NO_VERDICT and not base.converged):
        # Mechanisms that unseen recordings do not support may make a law visible, which then replaces them.
        for described in describe(problem, last, kept.held_out, report):
            results = replace(results, described=described)
            yield results
    yield results.after(LAWS)


def conclude(results: Results, report: Callable[[str], None] = lambda line: None) -> Answer:
    """The answer from the present results. A stopped audit measures the gain of its present extension if the reserved
    time suffices; the other work takes only a few rollouts.
    """
    problem, clock = results.problem, results.reached.target.forward.deadline
    stopped = clock.reached
    kept = results.kept or _kept_in_time(results, clock)
    fit_target, fitted = kept.named.search.target, kept.named
    base = as_measured(fit_target, fitted.base)
    steps = [replace(step, fit=as_measured(step.fit_target, step.fit)) for step in fitted.steps]
    test_series, validation = fitted.test_series, Validation.of_steps(kept.held_out, len(steps))
    verdict = _verdict(kept, problem, ended=CAUSES in results.ended, small=results.small)
    described = results.described
    if described is not None and described.holds:
        verdict = DESCRIBED
        if len(described.steps) < len(steps):
            steps = [replace(step, fit=as_measured(step.fit_target, step.fit)) for step in described.steps]
            test_series = [*(step.before for step in steps), test_series[-1]] if steps else test_series[:1]
            validation = Validation.of_law(described)
    target, extended = fit_target.measured, steps[-1].fit if steps else base
    sizes = extended
    with suppress(OutOfTime), clock.stage("sizes"):
        sizes = widened(steps[-1].fit_target, extended) if steps else extended
    clock.lift()  # the rest are single rollouts for the report, and the optimisation for the sizes of a law
    finer, refined = fitted.search.finer, DISCRETISATION in [*fitted.names, *kept.unsupported]
    shown = None if refined or finer is None else numerical_shift(target, finer, extended)
    residual = extended.residual
    if described is not None and described.holds and described.last is not None:
        residual = as_measured(described.last.target, described.last.fit).residual
    remainder = describe_remainder(target.measurements, residual, target.noise.first)
    if verdict in (PARTLY, UNEXPLAINED) and not steps:
        size, noise = float(np.sqrt(3.0) * remainder.amplitude), noise_distance(target.noise.first)
        excused = None if target.forward.correction else shown
        verdict = NEGLIGIBLE if negligible(problem.rules, size, noise, excused) else verdict
    draws = sizes.draws(np.random.default_rng([problem.seed, 5]), 1000, *problem.coordinates.bounds)
    rollouts = fit_target.forward.rollouts + (finer.rollouts if finer else 0)
    why, unfinished = (clock.why, replace(results, kept=kept).unfinished) if stopped else ("", ())
    return Answer(
        verdict,
        problem,
        target,
        base,
        steps,
        list(kept.unsupported),
        test_series,
        fitted.gains,
        described,
        validation,
        remainder,
        sizes,
        draws,
        suspected=None if verdict == DESCRIBED else results.suspected,
        shift=target.measurements.shift,
        numerical=shown,
        priors=decided_by_priors(target, draws),
        cost=Cost(why, unfinished, rollouts, clock.profile),
    )


def _kept_in_time(results: Results, clock: Deadline) -> Kept:
    """Result of a stopped audit: the base model with the best named causes so far, its joint test, and the gain on
    unseen recordings if the reserved time suffices.
    """
    named = results.named
    if named is None:
        with clock.granted(float("inf")):
            target, base = results.reached.settled()
        named = Named(
            ExtensionSearch(target, results.problem.candidates, results.problem.rules, results.problem.seed), base
        )
    named = named.with_best()
    if named.tests is None:
        named = replace(named, tests=named.asked.tested(named.fit, len(named.steps)))
    kept = Kept.of(named, named, None)
    with suppress(OutOfTime), clock.granted():
        kept = next(iter(keep_supported(results.problem, named)))
    return kept


def _leaves_little(problem: AuditProblem, named: Named) -> bool:
    """Whether the residual beside the named causes is negligible."""
    target, fit = named.search.target.measured, as_measured(named.fit_target, named.fit)
    corrected = bool(target.forward.correction) or DISCRETISATION in named.names
    finer = None if corrected else named.search.finer
    noise, left = target.noise.first, describe_remainder(target.measurements, fit.residual, target.noise.first)
    numerical = None if finer is None else numerical_shift(target, finer, fit)
    return negligible(problem.rules, float(np.sqrt(3.0) * left.amplitude), noise_distance(noise), numerical)


def _verdict(kept: Kept, problem: AuditProblem, *, ended: bool, small: bool) -> str:
    """The verdict on the named causes alone.

    Args:
        kept: named causes.
        problem: problem with the rules.
        ended: whether all candidates were tested.
        small: whether what the causes leave is negligible.
    """
    named, rules = kept.named, problem.rules
    noise, members = named.fit_target.measured.noise, [len(step.members) for step in named.steps]
    gain = Validation.of_steps(kept.held_out, len(named.steps)).gain
    last = named.test_series[-1].omnibus.p if named.steps else None
    verdict = decide(rules, named.test_series[0].omnibus.p, last, members, gain, noise.doubtful, small)
    if not named.fit.converged:  # clearly supported effects are found nevertheless
        return PARTLY if gain is not None and gain.clear else NO_VERDICT
    return verdict if ended or verdict != UNEXPLAINED else NO_VERDICT


def _named(begun: Named) -> Iterator[Named]:
    """Named causes; the search is repeated if the noise comes from residuals.

    A missing effect may drive the base fit to a corner of the priors with rough motion, in which no optimisation
    converges. Causes are searched nevertheless. Noise from a base model's residuals includes the discrepancy, and
    whitening hides its causes: the search is therefore repeated with noise from the first extension's residuals.
    """
    first = begun
    for named in name_causes(begun.search, begun.base):
        first = named
        yield first
    target = first.search.target
    if not first.steps or target.measured.noise.source not in (RESIDUALS, INNOVATIONS):
        return
    before = target.measured.noise
    target = replace(target.measured, noise=residual_noise(first.fit_target, first.fit))
    if not leaves_noise(before, target.noise):
        return
    begun.search.report(f"once more with the noise that the extended model leaves, AR({target.noise.first.order})")
    *_, again = name_causes(begun.search.under(target), optimise(target, first.base.x, first.base.free))
    yield again


def _noise_in_words(target: FitTarget, fit: Fit) -> str:
    """Phrase about the noise, and about a misspecified model, for progress reports."""
    noise = target.measured.noise.first
    shared = "" if noise.correlation is None else ", shared between coordinates"
    words = f"noise from {noise.source}, AR({noise.order}){shared}"
    if target.known is None:
        return words
    deviation = residual_deviation(target, fit)[target.measurements.columns[0]]
    size, share = (
        1e3 * np.sqrt(3.0 * np.mean(deviation**2)),
        float(np.mean((deviation / target.noise.first.scale) ** 2)),
    )
    white = f"white noise of {size:.2g} mm, the size of its residuals"
    return f"{words}; it is misspecified: {white}; a row is worth {share:.2g} of an independent row"
