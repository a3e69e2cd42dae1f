"""Naming of causes, step by step; each step is a complete result.

`name_causes` is a generator. A caller that stops early, by the time limit or by the user, has the last `Named` with all
findings so far.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rfdropo_bayes.discrepancy.candidates import start_together
from rfdropo_bayes.discrepancy.extension import (
    DISCRETISATION,
    SHARES,
    TOLD_APART,
    WIDER,
    Added,
    ExtensionSearch,
    Refits,
)
from rfdropo_bayes.discrepancy.fit import Fit, FitTarget, best_between, heights, optimise
from rfdropo_bayes.discrepancy.inadequacy import fit_with_noise, misspecified
from rfdropo_bayes.discrepancy.score import joint_statistic
from rfdropo_bayes.discrepancy.score_tests import ScoreTests, p_in_words

PAIRS = 3  # that are refitted


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
        return {} if self.tried is None else self.tried.gains(self.fit)

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
        gained = last.log_bayes_factor + fit.log_evidence - last.fit.log_evidence
        return self.extended([*self.steps[:-1], replace(last, fit=fit, log_bayes_factor=gained)])


def name_causes(search: ExtensionSearch, base: Fit) -> Iterator[Named]:
    """Forward-stepwise extension of a base model; the last result has the score tests of the final model.

    The base model is replaced if a candidate has led to a better optimum of it.
    """
    clock, report, rules = search.target.forward.deadline, search.report, search.rules
    named, renewed = Named(search, base), set[int]()  # numbers of steps at which a model was optimised again: once each
    while True:
        if named.steps:  # the last model has the noise of its present residuals
            fit_target, fit = fit_with_noise(named.fit_target.measured, named.fit.x, named.fit.free)
            named = named.extended([*named.steps[:-1], replace(named.steps[-1], fit=fit, fit_target=fit_target)])
        tests = named.asked.score_tests(named.fit, named.names)
        named = replace(named, tests=tests)
        yield named
        p = tests.omnibus.p
        if not named.steps and p > rules.base_passes:
            return
        first = tests.rows[0].name if tests.rows else "none"
        report(f"joint test p {p_in_words(p, rules.bootstraps)}; first: {first}")
        if named.asked.room(len(named.steps)) < 1 or p > rules.extended_passes:
            return
        with clock.stage("refits"):
            for tried in named.asked.refits(tests):
                named = replace(named, tried=tried)
                yield named
            step = named.best
            pair = paying_pair(named.asked, tests, named.names, step)
            if pair:
                named = named.extended([*named.steps, *pair])
                yield named
                named = without_needless_steps(named)
                continue
            if step is None:
                return
            again = optimised_again(named.asked, step) if len(named.steps) not in renewed else None
            if again is not None:
                renewed.add(len(named.steps))
                report(f"without {step.name}, a better optimum than before: the question once more")
                named = named.with_better(again)
                continue
            named = named.with_best()
            yield named
            named = without_needless_steps(named)


def without_needless_steps(named: Named) -> Named:
    """The model without steps that later steps made redundant."""
    return named.extended(without_needless(named.asked, named.base, named.steps))


def without_each_other(steps: Sequence[Added]) -> tuple[Added, ...]:
    """Steps with classes from which mechanisms of other steps are removed: the model contains both, so they are
    distinguishable.
    """
    named = {step.name for step in steps}
    return tuple(replace(s, members=tuple(n for n in s.members if n == s.name or n not in named)) for s in steps)


def paying_pair(search: ExtensionSearch, tests: ScoreTests, named: Sequence[str], single: Added | None) -> list[Added]:
    """Two mechanisms at once, if the best leaves most of a large misfit; empty if they do not pay.

    Pairs are ranked by the linear model, and the leading pairs are refitted.

    Args:
        search: search beside the present model.
        found: its score tests.
        named: mechanisms in it.
        single: the best single mechanism; None without it.
    """
    if search.room(len(named)) < 2:
        return []
    fit, last, target = tests.fit, single.fit if single else tests.fit, search.target
    taken = float(fit.residual @ fit.residual - last.residual @ last.residual)
    if not misspecified(single.fit_target if single else target, last.x):
        return []
    rows = {row.name: row for row in tests.rows if row.probe is not None and row.name != DISCRETISATION}
    heads = sorted(rows.values(), key=lambda row: -row.lm)[: search.rules.members]
    drops = {
        tuple(sorted((a.name, b.name))): joint_statistic(a.probe.mark, b.probe.mark, fit.residual)
        for a in heads
        for b in rows.values()
        if a.name != b.name and a.probe and b.probe
    }
    worth = search.rules.evidence + np.log(len(search.candidates))
    leading = sorted((p for p in drops if drops[p] > taken + 2.0 * worth), key=lambda p: -drops[p])[:PAIRS]
    fits = {}
    for names in leading:
        probes = [probe for name in names if (probe := rows[name].probe)]
        constant = [index for probe in probes for index in probe.point]
        added = np.concatenate([c.indices for c in search.candidates if c.name in names])
        start = best_between(target, fit.x, start_together(fit, probes), constant, SHARES)
        fits[names] = optimise(target, start, np.array([*fit.free, *np.setdiff1d(added, fit.free)]))
        gained = fits[names].log_evidence - fit.log_evidence
        search.report(f"refit with {' and '.join(names)}: log Bayes factor {gained:.1f}")
    if not fits:
        return []
    best = max(fits, key=lambda names: fits[names].log_evidence - WIDER * len(fits[names].free))
    enough = search.surpasses(fits[best], single.fit, worth) if single else True
    if not enough or fits[best].log_evidence < fit.log_evidence + worth:
        return []
    alone = {name: search.refit(fit, rows[name]) for name in best}
    first, second = sorted(best, key=lambda name: -alone[name].log_evidence)
    between = search.score_tests(alone[first], [*named, first])
    gains = [alone[first].log_evidence - fit.log_evidence, fits[best].log_evidence - alone[first].log_evidence]
    return [
        Added(first, (first,), tests, alone[first], gains[0], single.refits if single else {}, target),
        Added(second, (second,), between, fits[best], gains[1], {}, target),
    ]


def optimised_again(search: ExtensionSearch, step: Added) -> Fit | None:
    """The model before a step, optimised again from the step's result; None if that is no better."""
    before, target = step.before.fit, search.target
    free, added = step.fit.free, np.setdiff1d(step.fit.free, before.free)
    emptied = step.fit.x.copy()
    emptied[added] = before.x[added]
    # An effect that base parameters can also explain belongs to them, such as a gain of all cables and the radius of
    # their drums. Otherwise it would be credited to the candidate.
    place = {index: k for k, index in enumerate(free)}
    own, others = ([place[index] for index in chosen] for chosen in (before.free, added))
    done = step.fit.jacobian[:, others] @ (step.fit.x[added] - before.x[added])
    imitated = emptied.copy()
    imitated[before.free] += np.linalg.lstsq(step.fit.jacobian[:, own], done, rcond=1e-6)[0]
    starts = np.clip(np.stack([emptied, imitated]), *target.forward.coordinates.bounds)
    again = optimise(target, starts[int(np.argmax(heights(target, starts, "without")))], before.free)
    return again if again.log_evidence > before.log_evidence + 1.0 else None


def without_needless(search: ExtensionSearch, base: Fit, steps: Sequence[Added]) -> tuple[Added, ...]:
    """Steps without redundant steps: the last model has equal evidence without their parameters."""
    if len(steps) < 2:
        return tuple(steps)
    last, null = steps[-1], search.target.forward.coordinates.null
    for index in range(len(steps) - 1):
        if steps[index].name == DISCRETISATION:
            continue
        before = steps[index - 1].fit if index else base
        gone = np.setdiff1d(steps[index].fit.free, before.free)
        emptied = last.fit.x.copy()
        emptied[gone] = null[gone]
        place = [int(np.flatnonzero(last.fit.free == index)[0]) for index in gone]
        apart = last.fit.x[gone] - emptied[gone]
        covariance = last.fit.covariance[np.ix_(place, place)]
        if 0.5 * float(apart @ np.linalg.solve(covariance, apart)) > TOLD_APART:  # the least loss [nat]
            continue
        if optimise(last.fit_target, emptied, np.setdiff1d(last.fit.free, gone)).log_evidence >= last.fit.log_evidence:
            search.report(f"{steps[index].name} is no longer needed")
            return without_needless(search, base, without(search, steps, index, base))
    return tuple(steps)


def without(search: ExtensionSearch, steps: Sequence[Added], index: int, base: Fit) -> tuple[Added, ...]:
    """Steps without one step with parameters; later steps are refitted without it."""
    candidate, null = search.candidate(steps[index].name), search.target.forward.coordinates.null
    assert candidate is not None
    gone = np.setdiff1d(candidate.indices, steps[index - 1].fit.free if index else base.free)
    kept, fit_targets = list(steps[:index]), [step.fit_target for step in steps[: index + 1]]
    for step in steps[index + 1 :]:
        before, start = kept[-1].fit if kept else base, step.fit.x.copy()
        start[gone] = null[gone]
        fit = optimise(step.fit_target, start, np.setdiff1d(step.fit.free, gone))
        under = optimise(step.fit_target.on(fit_targets[-1].forward), before.x, before.free)
        fit_targets.append(step.fit_target)
        kept.append(replace(step, fit=fit, log_bayes_factor=fit.log_evidence - under.log_evidence))
    return tuple(kept)
