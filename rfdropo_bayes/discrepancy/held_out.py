"""Recordings that no fit has seen, predicted by a model and its extensions, and the supported steps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from rfdropo_bayes.bayes.noise.stacked import Stacked
from rfdropo_bayes.discrepancy.audit_problem import AuditProblem, measurements_of, simulated
from rfdropo_bayes.discrepancy.extension import DISCRETISATION, Added
from rfdropo_bayes.discrepancy.fit import Fit, FitTarget, optimise
from rfdropo_bayes.discrepancy.gain import Gain, Unseen, UnseenErrors, measure_gain
from rfdropo_bayes.discrepancy.inadequacy import as_measured, residual_deviation
from rfdropo_bayes.discrepancy.measurements import Measurements
from rfdropo_bayes.discrepancy.naming import Named, without_each_other
from rfdropo_bayes.discrepancy.port_rollouts import with_laws_of
from rfdropo_bayes.discrepancy.repairs import without
from rfdropo_bayes.errors import NoLikelihoodError

DRAWS = 60
BLOCKS = 5  # of poses at rest, which are left out in turn
HELD_OUT_ROWS = 0.6  # of a single recording, which is all that is fitted of it when the rest is to be predicted


def _predict(target: FitTarget, fit: Fit, seed: Sequence[int]) -> UnseenErrors:
    """Predictions under the normal approximation, linear around the mode: along a ridge that the data leave free, such
    as the common scale of stiffness and mass, a draw would lie outside the range of the approximation.
    """
    centre = target.errors(fit.x)
    points = np.repeat(fit.x[None], len(fit.free), axis=0)
    slopes, _ = target.error_slopes(points, np.eye(len(fit.x))[fit.free])
    z = np.random.default_rng(seed).multivariate_normal(np.zeros(len(fit.free)), fit.covariance, DRAWS, method="eigh")
    z -= z.mean(axis=0)
    return UnseenErrors(centre + np.tensordot(z, slopes, axes=1))


@dataclass(frozen=True)
class HeldOut:
    """Recordings that no fit has seen, predicted by the base model and the model after each step.

    Attributes:
        which: description of the recordings.
        unseen: the measurements.
        predictions: predictions of the base model, then after each step.
        patterns: residuals of each model on its fitted data, see `measure_gain`.
        noise: noise of the measurements.
        noise_models: noise model of each model, see `inadequacy`.
        deviations: deviation of each model's residuals, by column.
        seed: seed of the gain's interval.
    """

    which: str
    unseen: Unseen
    predictions: list[UnseenErrors]
    patterns: list[np.ndarray]
    noise: Stacked
    noise_models: list[Stacked]
    deviations: list[np.ndarray]
    seed: int

    @property
    def count(self) -> int:
        """Number of predicting models; fewer than requested if a rollout failed."""
        return len(self.predictions)

    def gain(self, before: int, after: int) -> Gain:
        """Gain of the model after ``after`` steps over the model after ``before`` steps."""
        return self.after(after).beside(self.after(before))

    def beside(self, other: HeldOut) -> Gain:
        """Gain of the last model over the last model of another sequence of steps."""
        rng, noise_of_fit, pattern = np.random.default_rng([self.seed, 4]), other.noise_models[-1], other.patterns[-1]
        first, second, deviation = other.predictions[-1], self.predictions[-1], self.deviations[-1]
        return measure_gain(
            self.unseen, first, second, self.noise, pattern, rng, noise_of_fit=noise_of_fit, deviation=deviation
        )

    def after(self, steps: int) -> HeldOut:
        """The predictions of the base model and of at most ``steps`` steps."""
        parts = ("predictions", "patterns", "noise_models", "deviations")
        return replace(self, **{name: getattr(self, name)[: steps + 1] for name in parts})

    def supported(self) -> int:
        """Number of steps that the unseen recordings clearly support, each compared with the last supported step."""
        return self.supported_from(0)

    def supported_from(self, first: int) -> int:
        """The predictions after the first ``first`` steps, which are accepted."""
        last = first
        for after in range(first + 1, len(self.predictions)):
            if self.gain(last, after).clear:
                last = after
        return last


class FittedModel(NamedTuple):
    """A model that predicts unseen recordings.

    Attributes:
        fit_target: target of its fit.
        fit: its fit.
        finer: whether it runs on the finer simulator.
    """

    fit_target: FitTarget
    fit: Fit
    finer: bool


def stages_of(fit_target: FitTarget, base: Fit, steps: Sequence[Added]) -> list[FittedModel]:
    """The base model, and the model after each step."""
    names = [step.name for step in steps]
    after = [FittedModel(step.fit_target, step.fit, DISCRETISATION in names[: k + 1]) for k, step in enumerate(steps)]
    return [FittedModel(fit_target, base, False), *after]


def predicted(problem: AuditProblem, target: FitTarget, stages: Sequence[FittedModel]) -> HeldOut:
    """Predictions of models; ``target`` has the measurement's noise.

    A model with a failed rollout of an unseen recording gives no prediction, and later models are not evaluated.

    Raises:
        NoLikelihoodError: the first model's rollout fails.
    """
    count, every = len(problem.trajectories), len(problem.model.recordings.names)
    fits, fit_targets = [stage.fit for stage in stages], [stage.fit_target for stage in stages]
    if every > count:
        which = "test recordings"
        tested = measurements_of(problem, range(count, every))
        unseen = _unseen(tested, tested.valid, problem.model.recordings.names[count:])
        predictions = list[UnseenErrors]()
        with _up_to_the_last(predictions):
            for fit_target, fit, finer in stages:
                plain, times = simulated(problem, finer, tested, range(count, every)), fit_target.forward.times
                if times:
                    x = fits[0].x[: len(plain.coordinates.names)]
                    plain = plain.extrapolated(simulated(problem, True, tested, range(count, every)), x, times)
                own = replace(target, forward=with_laws_of(fit_target.forward, plain), measurements=tested)
                predictions.append(_predict(own, fit, [problem.seed, 3]))
    else:
        which, unseen, predictions = _left_out(problem, fit_targets, target, fits)
    stages, fit_targets = stages[: len(predictions)], fit_targets[: len(predictions)]
    patterns = [target.measurements.series(as_measured(fit_target, fit).residual) for fit_target, fit, _ in stages]
    deviations = [residual_deviation(fit_target, fit) for fit_target, fit, _ in stages]
    noises = [fit_target.noise for fit_target in fit_targets]
    return HeldOut(which, unseen, predictions, patterns, target.noise, noises, deviations, problem.seed)


@contextmanager
def _up_to_the_last(predicted: Sequence[Any]) -> Iterator[None]:
    """Stop at the first model with a failed rollout, with the models before it; an error if there are none."""
    try:
        yield
    except NoLikelihoodError:
        if not predicted:
            raise


def _unseen(tested: Measurements, valid: np.ndarray, recordings: Sequence[str]) -> Unseen:
    position = np.asarray(tested.channels[0].measured)
    names = tuple(" and ".join(recordings[i] for i in group) for group in tested.members)
    return Unseen(position.reshape(*position.shape[:2], -1), valid, names, tested.steps)


def _left_out(
    problem: AuditProblem, fit_targets: Sequence[FitTarget], target: FitTarget, fits: Sequence[Fit]
) -> tuple[str, Unseen, list[UnseenErrors]]:
    """Predict each group of repeats from the others. If a group has parameters that no other determines (as a single
    group has), predict the later rows of all from the earlier rows in motion, and at rest each block of poses from the
    others: a pose does not depend on the poses before it.
    """
    measured = target.measurements
    groups = len(measured.members)
    kinds = problem.kinds(target.forward.recordings)
    if min(kinds.count(kind) for kind in kinds) > 1:
        held_out = "fitted recordings, each left out in turn"
        masks = [np.arange(groups)[:, None, None] == g for g in range(groups)]
    elif getattr(target.forward.lanes.simulator, "at_rest", False):
        held_out = f"{BLOCKS} blocks of poses, each left out in turn"
        masks = [block[:, :, None] for block in blocks_of_rows(measured.valid)]
    else:
        held_out = "the later rows of the only recording" if groups == 1 else "the later rows of the fitted recordings"
        masks = [later_rows(measured.valid)[:, :, None]]
    parts = list[list[np.ndarray]]()
    with _up_to_the_last(parts):
        for fit_target, fit in zip(fit_targets, fits, strict=True):
            row = list[np.ndarray]()
            for mask in masks:
                count = np.where(mask, 0.0, fit_target.measurements.count)
                kept = replace(fit_target.measurements, count=count)
                refitted = optimise(replace(fit_target, measurements=kept), fit.x, fit.free, evaluations=15)
                row.append(_predict(target.on(fit_target.forward), refitted, [problem.seed, 3]).errors)
            parts.append(row)
    draws = min(len(part) for row in parts for part in row)
    predictions = []
    for row in parts:
        joined = np.zeros((draws, *measured.count.shape))
        for mask, part in zip(masks, row, strict=True):
            joined = np.where(mask, part[:draws], joined)
        predictions.append(UnseenErrors(joined))
    valid = measured.valid & np.any(np.broadcast_arrays(*masks, measured.valid)[:-1], axis=0)
    return held_out, _unseen(measured, valid, problem.model.recordings.names), predictions


def later_rows(valid: Bool[np.ndarray, "group time column"]) -> Bool[np.ndarray, "group time"]:
    """Rows of every recording after the fitted share of its measured rows, with gaps anywhere."""
    seen = np.asarray(valid.any(axis=2))
    before: np.ndarray = np.cumsum(seen, axis=1) - seen
    return before >= HELD_OUT_ROWS * seen.sum(axis=1, keepdims=True)


def blocks_of_rows(valid: Bool[np.ndarray, "group time column"]) -> list[Bool[np.ndarray, "group time"]]:
    """`BLOCKS` blocks of successive measured rows of every recording."""
    seen = np.asarray(valid.any(axis=2))
    before: np.ndarray = np.cumsum(seen, axis=1) - seen
    block = before * BLOCKS // np.maximum(seen.sum(axis=1, keepdims=True), 1)
    return [seen & (block == k) for k in range(BLOCKS)]


@dataclass(frozen=True)
class Kept:
    """Named causes after the test on unseen recordings.

    Attributes:
        named: supported steps (all steps if none is supported), with score tests of the model.
        held_out: predictions of these recordings by the base model and after each step; None without a step that can be
            simulated.
        unsupported: mechanisms supported by fitted but not by unseen recordings.
    """

    named: Named
    held_out: HeldOut | None
    unsupported: tuple[str, ...] = ()

    @classmethod
    def of(cls, asked: Named, named: Named, held_out: HeldOut | None) -> Kept:
        """What is kept of the named causes; a cause that is not kept may be a rival of those that are."""
        unsupported = tuple(name for name in asked.names if name not in named.names)
        if unsupported:
            asked.search.report(f"unseen recordings do not support {' and '.join(unsupported)}")
        return cls(replace(named, steps=without_each_other(named.steps)), held_out, unsupported)


def keep_supported(problem: AuditProblem, named: Named) -> Iterator[Kept]:
    """The steps supported by unseen recordings: first from predictions of all steps, then without steps that depend on
    a later step.
    """
    report, clock = named.search.report, named.search.target.forward.deadline
    if not named.steps:
        yield Kept(named, None)
        return
    report("measuring the gain on recordings that no fit has seen")
    with clock.stage("gain"), clock.reserve():
        held_out = _predicted(problem, named)
        if held_out.count <= len(named.steps):
            last = named.steps[held_out.count - 1]
            report(f"with {last.name}, an unseen recording cannot be simulated: it is not supported")
            fewer = replace(named, steps=named.steps[: held_out.count - 1], tests=last.before, tried=None)
        else:
            fewer = named
        supported = held_out.supported()
        if not fewer.steps or not supported:
            yield Kept.of(named, fewer, held_out if fewer.steps else None)
            return
        if supported < len(fewer.steps):
            before = fewer.steps[supported].before
            fewer = replace(fewer, steps=fewer.steps[:supported], tests=before, tried=None)
        yield Kept.of(named, fewer, held_out.after(supported))
        remaining, measured = _without_carried(problem, fewer, held_out.after(supported))
        if len(remaining.steps) < len(fewer.steps):
            remaining = replace(remaining, tests=remaining.asked.tested(remaining.fit, len(remaining.steps)))
        yield Kept.of(named, remaining, measured)


def _without_carried(problem: AuditProblem, named: Named, held_out: HeldOut) -> tuple[Named, HeldOut]:
    """Steps without any step supported only together with a later step that does equally well alone.

    Two mechanisms may pay only together. To test this, the first is removed: the model with it must predict unseen
    recordings clearly better than the model without it.
    """
    for index in range(len(named.steps) - 1):
        if held_out.gain(index, index + 1).clear or named.steps[index].name == DISCRETISATION:
            continue
        named.search.report(f"is {named.steps[index].name} needed? The model without it")
        fewer = named.extended(without(named.asked, named.steps, index, named.base))
        other = _predicted(problem, fewer)
        if other.count > len(fewer.steps) and not held_out.beside(other).clear:
            return _without_carried(problem, fewer, other)
    return named, held_out


def _predicted(problem: AuditProblem, named: Named) -> HeldOut:
    """Predictions of the base model and of the model after each step."""
    return predicted(problem, named.fit_target.measured, stages_of(named.search.target, named.base, named.steps))
