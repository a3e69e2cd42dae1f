"""Last part of an audit: an effect on the robot that the library lacks, described as a law at a port.

The search runs if the library leaves a misfit. It extends the base model and, if that is no better than the named
mechanisms, the model with these mechanisms. A library candidate that is clearly worse than a law on unseen recordings
is a substitute for the law, and is not adopted as a cause.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from rfdropo_bayes.discrepancy.audit_problem import AuditProblem
from rfdropo_bayes.discrepancy.extension import DISCRETISATION, Added
from rfdropo_bayes.discrepancy.fit import Fit, FitTarget, optimise, widened
from rfdropo_bayes.discrepancy.gain import Gain
from rfdropo_bayes.discrepancy.held_out import FittedModel, HeldOut, predicted, stages_of
from rfdropo_bayes.discrepancy.inadequacy import fit_with_noise
from rfdropo_bayes.discrepancy.law_search import LawResult, Refit, law_search
from rfdropo_bayes.discrepancy.naming import Named
from rfdropo_bayes.discrepancy.repairs import without

UNSUPPORTED = 2
"""Terms in a row without the support of unseen recordings that end a search for a law."""


@dataclass(frozen=True)
class Described:
    """Result of a search for laws in an audit.

    Attributes:
        search: ports and law.
        steps: library mechanisms in the model beside the law.
        stand_ins: library mechanisms that the law replaces.
        gain: gain of the law on unseen recordings over the model without it; None without a law, or if the time was up.
        overall: the same over the base model.
        held_out: predictions of these recordings: by the base model, and last by the model with the law.
        holds: whether unseen recordings clearly support the law, and it explains a significant share of the
            discrepancy.
    """

    search: LawResult
    steps: tuple[Added, ...] = ()
    stand_ins: tuple[str, ...] = ()
    gain: Gain | None = None
    overall: Gain | None = None
    held_out: HeldOut | None = None
    holds: bool = False

    @property
    def beside(self) -> tuple[str, ...]:
        """Names of the library's mechanisms beside the law."""
        return tuple(step.name for step in self.steps)

    @property
    def last(self) -> Refit | None:
        """The model with the law."""
        return self.search.last

    @cached_property
    def sizes(self) -> tuple[Fit, FitTarget] | None:
        """The model's fit under priors that do not pull, and its target."""
        last = self.last
        return None if last is None else (widened(last.target, last.fit), last.target)


def describe(
    problem: AuditProblem, model: Named, held_out: HeldOut | None, report: Callable[[str], None] = lambda line: None
) -> Iterator[Described]:
    """Port and law of an effect that the library lacks; nothing if not requested.

    Args:
        problem: problem with the ports of its simulator.
        model: the base model with the named mechanisms.
        held_out: predictions of unseen recordings by the base model and after each step; None without steps.
        report: called with a line of words now and then.
    """
    if problem.ports is None or problem.compared is not None:
        return
    clock = model.search.target.forward.deadline
    with clock.stage("ports and laws"), clock.reserve():
        for law in _beside(problem, model.extended(()), report):
            alone = law
            # Beside named mechanisms, it does not hold until it is compared with them.
            yield replace(law, holds=law.holds and not model.steps)
        if not model.steps:
            return
        seen = alone.held_out if alone.holds else None
        if held_out is not None and seen is not None and seen.beside(held_out.after(len(model.steps))).clear:
            report(f"the law takes the place of {' and '.join(model.names)}")
            yield replace(alone, stand_ins=tuple(model.names))
            return
        *_, further = _beside(problem, model, report)
        if further.holds:
            yield further
            yield _without_stand_ins(problem, model, alone, further, report)


def _without_stand_ins(
    problem: AuditProblem, model: Named, alone: Described, described: Described, report: Callable[[str], None]
) -> Described:
    """The law beside only the mechanisms that unseen recordings still support with it.

    Later mechanisms may be stand-ins for an effect beside a named cause. The law is searched again without them, and
    kept unless unseen recordings are clearly likelier with them.

    Args:
        alone: the law beside the base model.
        described: the law beside all of the model's mechanisms.
    """
    needed = _needed(problem, described)
    gone = tuple(name for name in model.names if name not in needed)
    if not gone or described.held_out is None:
        return described
    report(f"with the law, unseen recordings do not ask for {' and '.join(gone)}: the law without them")
    *_, again = _beside(problem, _without(model, gone), report) if needed else [alone]
    if not again.holds or again.held_out is None or described.held_out.beside(again.held_out).clear:
        return described
    return replace(again, stand_ins=gone)


def _without(model: Named, gone: Sequence[str]) -> Named:
    """A model without some of its mechanisms, with a new noise model."""
    for name in gone:
        model = model.extended(without(model.asked, model.steps, model.names.index(name), model.base))
    fit_target, fit = fit_with_noise(model.fit_target.measured, model.fit.x, model.fit.free)
    return model.extended([*model.steps[:-1], replace(model.steps[-1], fit_target=fit_target, fit=fit)])


def _needed(problem: AuditProblem, described: Described) -> list[str]:
    """Mechanisms beside a law without which unseen recordings are clearly less likely; the last is tested first."""
    assert described.last is not None
    fit_target, fit, coordinates = described.last.target, described.last.fit, described.last.target.forward.coordinates
    finer = DISCRETISATION in described.beside
    needed: list[str] = []
    for step in reversed(described.steps):
        candidate = problem.candidate(step.name)
        own = np.intersect1d(candidate.indices, fit.free) if candidate is not None else np.zeros(0, dtype=int)
        if not own.size:  # the finer mesh, which has no parameters
            needed.append(step.name)
            continue
        start = fit.x.copy()
        start[own] = coordinates.null[own]
        less = optimise(fit_target, start, np.setdiff1d(fit.free, own))
        seen = predicted(problem, fit_target.measured, [FittedModel(fit_target, each, finer) for each in (less, fit)])
        if seen.count < 2 or seen.gain(0, 1).clear:
            needed.append(step.name)
        else:
            fit = less
    return needed


def _beside(problem: AuditProblem, model: Named, report: Callable[[str], None]) -> Iterator[Described]:
    """The law beside a model after each term, with its gain on unseen recordings.

    Like named mechanisms, a law is cut to its supported terms. The search ends if unseen recordings do not support its
    last `UNSUPPORTED` terms.
    """
    simulator: Any = problem.lanes.simulator
    assert problem.ports is not None
    channels, unit = tuple(simulator.channel_names), str(getattr(simulator, "command_unit", "m"))
    options = (problem.ports, channels, unit, problem.seed, problem.rules.level, report, problem.groups, problem.timed)
    before = stages_of(model.search.target, model.base, model.steps)
    named = len(before) - 1
    for law in law_search(model.fit_target, *options).laws(model.fit_target, model.fit):
        if not law.terms:
            yield Described(law, model.steps)
            continue
        stages = [*before, *(FittedModel(refit.target, refit.fit, before[-1].finer) for refit in law.terms)]
        held_out = predicted(problem, model.search.target.measured, stages)
        count = len(law.terms)
        if held_out.count < len(stages):
            report(f"with {count} terms, an unseen recording cannot be simulated")
            return
        supported = held_out.supported_from(named) - named
        kept = supported or count
        gain, overall = held_out.gain(named, named + kept), held_out.gain(0, named + kept)
        seen = held_out.after(named + kept)
        holds = bool(gain.clear and not gain.worse and gain.interval[0] > problem.rules.significant)
        yield Described(law.cut(kept), model.steps, (), gain, overall, seen, holds)
        if count - supported >= UNSUPPORTED:
            report(f"unseen recordings do not support more than {supported} of {count} terms: the search ends")
            return


def coefficients(described: Described, seed: int) -> list[dict[str, Any]]:
    """Coefficients of a law: mean, deviation, quantiles and unit, by the model's normal approximation.

    Shapes of features stand beside them; their deviation is None if they are not inferred.
    """
    if described.sizes is None:
        return []
    fit, target = described.sizes
    coordinates, simulator = target.forward.coordinates, target.forward.lanes.simulator
    unit = str(getattr(simulator, "command_unit", "m"))
    draws = fit.draws(np.random.default_rng([seed, 7]), 1000, *coordinates.bounds)
    values, rows = coordinates.values(draws), []
    for refit in described.search.terms:
        column = values[:, coordinates.names.index(refit.term.spec.name)]
        shape = None if refit.term.shape is None else values[:, coordinates.names.index(refit.term.shape.name)]
        rows.append(
            {
                "port": refit.term.port.name,
                "group": refit.term.scope.group,
                "feature": refit.term.feature.kind,
                "coefficient": refit.term.spec.name,
                "mean": float(column.mean()),
                "sd": float(column.std()),
                "q05": float(np.quantile(column, 0.05)),
                "q95": float(np.quantile(column, 0.95)),
                "unit": refit.term.spec.unit,
                "shape": refit.term.feature.shape if shape is None else float(shape.mean()),
                "shape_sd": None if shape is None else float(shape.std()),
                "shape_unit": refit.term.feature.shape_unit(unit),
                "left_out_gain": refit.gain.gain,
                "left_out_share": refit.gain.share,
                "score": refit.score,
            }
        )
    return rows
