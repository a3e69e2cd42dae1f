"""Naming of causes, step by step; each step is a complete result.

`name_causes` is a generator. A caller that stops early, by the time limit or by the user, has the last `Named` with all
findings so far.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from rfdropo_bayes.discrepancy.extension import DISCRETISATION, Added, ExtensionSearch, Refits
from rfdropo_bayes.discrepancy.fit import Fit, FitTarget, optimise, polled
from rfdropo_bayes.discrepancy.forward import Forward
from rfdropo_bayes.discrepancy.inadequacy import fit_with_noise
from rfdropo_bayes.discrepancy.repairs import optimised_again, paying_pair, simplified
from rfdropo_bayes.discrepancy.score_tests import ScoreTests, p_in_words


@dataclass(frozen=True)
class Named:
    """The base model, and the causes named so far.

    Attributes:
        search: search beside the base model.
        base: its fit.
        steps: mechanisms added to it.
        tests: score tests of the model with all steps; None if not tested yet.
        tried: candidates refitted beside that model; None before the first.
    """

    search: ExtensionSearch
    base: Fit
    steps: tuple[Added, ...] = ()
    tests: ScoreTests | None = None
    tried: Refits | None = None

    @property
    def fit_target(self) -> FitTarget:
        """The target with the noise of the last model."""
        return self.steps[-1].fit_target if self.steps else self.search.target

    @property
    def fit(self) -> Fit:
        """The last model."""
        return self.steps[-1].fit if self.steps else self.base

    @property
    def names(self) -> list[str]:
        """Names of the added mechanisms."""
        return [step.name for step in self.steps]

    @property
    def asked(self) -> ExtensionSearch:
        """Search beside the last model."""
        return self.search.under(self.fit_target)

    @property
    def test_series(self) -> list[ScoreTests]:
        """Score tests of the base model and after each step; for the last model only if tested."""
        return [*(step.before for step in self.steps), *([] if self.tests is None else [self.tests])]

    @property
    def gains(self) -> dict[str, float]:
        """Log Bayes factors of the candidates that were refitted beside the last model."""
        return {} if self.tried is None else self.asked.gains(self.fit, self.tried)

    @property
    def waiting(self) -> tuple[str, ...]:
        """Leading candidates that have not been refitted."""
        return () if self.tried is None else self.tried.waiting

    @property
    def best(self) -> Added | None:
        """The best of the candidates that were refitted; None if none is worth it."""
        if self.tests is None or self.tried is None:
            return None
        return self.asked.best(self.tests, self.tried, bool(self.steps))

    def extended(self, steps: Sequence[Added]) -> Named:
        """The model with other steps, without score tests."""
        return replace(self, steps=tuple(steps), tests=None, tried=None)

    def with_best(self) -> Named:
        """The model with the best refitted candidate, if it has enough evidence."""
        step = self.best
        return self if step is None else self.extended([*self.steps, step])

    def with_better(self, fit: Fit) -> Named:
        """The last model at a better optimum."""
        if not self.steps:
            return Named(self.search, fit)
        last = self.steps[-1]
        gain, before = self.asked.gain, last.before.fit
        gained = last.log_bayes_factor + gain(before, fit) - gain(before, last.fit)
        return self.extended([*self.steps[:-1], replace(last, fit=fit, log_bayes_factor=gained)])


def name_causes(search: ExtensionSearch, base: Fit) -> Iterator[Named]:
    """Forward-stepwise extension of a base model; the last result has the score tests of the final model.

    The base model is replaced if a candidate has led to a better optimum of it, and the simulator if the data show its
    numerical error, see `ExtensionSearch.corrected`.
    """
    clock, report, rules = search.target.forward.deadline, search.report, search.rules
    named, renewed = Named(search, base), set[int]()  # numbers of steps at which a model was optimised again: once each
    # Names of the mechanisms of every model that was extended: each set once, also if steps are dropped.
    extended = set[frozenset[str]]()
    while True:
        if named.steps:  # the last model has the noise of its present residuals
            fit_target, fit = fit_with_noise(named.fit_target.measured, named.fit.x, named.fit.free)
            named = named.extended([*named.steps[:-1], replace(named.steps[-1], fit=fit, fit_target=fit_target)])
            with clock.stage("refits"):
                *_, settled = polled(fit_target, fit, f"with {named.names[-1]}", report)
            named = named.with_better(settled)
        tests = named.asked.score_tests(named.fit, named.names)
        named = replace(named, tests=tests)
        yield named
        p = tests.omnibus.p
        if not named.steps and p > rules.level:
            return
        first = tests.rows[0].name if tests.rows else "none"
        report(f"joint test p {p_in_words(p, rules.bootstraps)}; first: {first}")
        if p > rules.extended_passes:
            return
        exact = named.asked.corrected(tests) if first == DISCRETISATION else None
        if exact is not None:
            yield from _once_more(named, exact)
            return
        if frozenset(named.names) in extended:
            return
        extended.add(frozenset(named.names))
        with clock.stage("refits"):
            for tried in named.asked.refits(tests):
                named = replace(named, tried=tried)
                yield named
            step = named.best
            pair = paying_pair(named.asked, tests, named.names, step)
            if pair and named.asked.worthwhile(named.fit, pair[-1].fit, len(named.steps) + 2):
                named = named.extended([*named.steps, *pair])
                yield named
                named = with_simpler_steps(named)
                continue
            if step is None or not named.asked.worthwhile(named.fit, step.fit, len(named.steps) + 1):
                break
            again = optimised_again(named.asked, step) if len(named.steps) not in renewed else None
            if again is not None:
                renewed.add(len(named.steps))
                extended.remove(frozenset(named.names))
                report(f"without {step.name}, a better optimum than before: the question once more")
                named = named.with_better(again)
                continue
            named = named.with_best()
            yield named
            named = with_simpler_steps(named)

    exact = named.asked.corrected(tests)  # behind a candidate that no refit supports
    if exact is not None:
        yield from _once_more(named, exact)


def _once_more(named: Named, exact: Forward) -> Iterator[Named]:
    """The causes named on a simulator without its numerical error, from the base model on."""
    search = named.search.under(named.search.target.on(exact))
    search.report("once more without the error of mesh and time step")
    with search.target.forward.deadline.stage("refits"):
        base = optimise(search.target, named.base.x, named.base.free)
        *_, settled = polled(search.target, base, "base model", search.report)
    yield from name_causes(search, settled)


def with_simpler_steps(named: Named) -> Named:
    """The model without steps that later steps made redundant or simpler."""
    return named.extended(simplified(named.asked, named.base, named.steps))


def without_each_other(steps: Sequence[Added]) -> tuple[Added, ...]:
    """Steps with classes from which mechanisms of other steps are removed: the model contains both, so they are
    distinguishable.
    """
    named = {step.name for step in steps}
    return tuple(replace(s, members=tuple(n for n in s.members if n == s.name or n not in named)) for s in steps)
