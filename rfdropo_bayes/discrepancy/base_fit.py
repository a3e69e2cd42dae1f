"""The base model's noise and posterior mode, point by point: each intermediate point is a result."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.noise import Autoregression
from rfdropo_bayes.bayes.noise.autoregression import RESIDUALS
from rfdropo_bayes.bayes.noise.stacked import Stacked
from rfdropo_bayes.discrepancy.audit_problem import AuditProblem, measurements_of, simulated
from rfdropo_bayes.discrepancy.deadline import Deadline, OutOfTime, about
from rfdropo_bayes.discrepancy.fit import (
    Fit,
    FitTarget,
    base_optimum,
    optimisation_rollouts,
    optimum_rollouts,
    poll_rollouts,
    polled,
    with_usable_differences,
)
from rfdropo_bayes.discrepancy.inadequacy import fit_with_noise
from rfdropo_bayes.discrepancy.journal import Journal
from rfdropo_bayes.errors import InputError

# White noise of each channel in its own unit, until something better is known: millimetres, and the medians of priors.
GUESSES = {"markers": 1e-3, "tension": 0.02, "motor_angle": 0.02, "object_pose": 5e-3, "orientation": 0.01}


@dataclass(frozen=True)
class Reached:
    """Intermediate point of the search for a base model.

    Attributes:
        target: data, noise and simulator.
        x: coordinates of all parameters.
        fit: fit that ended there; None before the first optimisation has ended.
    """

    target: FitTarget
    x: Float[np.ndarray, " d"]
    fit: Fit | None = None

    @classmethod
    def at(cls, target: FitTarget, fit: Fit) -> Reached:
        """End point of a fit."""
        return cls(target, fit.x, fit)

    def settled(self) -> tuple[FitTarget, Fit]:
        """Target and fit. A point that is not the end of a fit takes a rollout of each recording, counts as not
        converged, and has the prior covariance of the base parameters.
        """
        if self.fit is not None:
            return self.target, self.fit
        target, fit = self.target, _unfitted(self.target, self.x)
        if target.noise.source == RESIDUALS:  # a first guess
            target = replace(target, noise=residual_noise(target, fit))
            fit = _unfitted(target, self.x)
        return target, fit


def _unfitted(target: FitTarget, x: Float[np.ndarray, " d"]) -> Fit:
    free = np.arange(target.forward.coordinates.base)
    residual = target.residual(x[None])[0]
    covariance = np.diag(target.forward.coordinates.prior_sd[free] ** 2)
    return Fit(x, free, residual, np.zeros((len(residual), len(free))), covariance, -np.inf, np.inf)


def first_target(problem: AuditProblem, journal: Journal, deadline: Deadline | None = None) -> FitTarget:
    """The fitted recordings under the noise of repeats or of the experiment file, or a first guess."""
    measurements = measurements_of(problem, range(len(problem.trajectories)), problem.trajectories)
    noise = problem.stated_noise
    if measurements.has_repeats:
        noise = measurements.noise(measurements.departures, 0)
    if noise is None:
        scales = [np.full(c.valid.shape[-1], GUESSES[c.name]) for c in measurements.channels]
        noise = Stacked(tuple(Autoregression(scale, np.ones(1), RESIDUALS, np.inf) for scale in scales))
    firsts = [group[0] for group in measurements.members]
    return FitTarget(simulated(problem, False, measurements, firsts, deadline), measurements, noise, journal)


def beginning(problem: AuditProblem, target: FitTarget) -> Reached:
    """Start of the search: an earlier calibration, or the centre of the priors."""
    coordinates = target.forward.coordinates
    return Reached(target, coordinates.null if problem.start is None else coordinates.encode(problem.start))


def base_fits(
    problem: AuditProblem, begun: Reached, seed: int, report: Callable[[str], None] = lambda line: None
) -> Iterator[Reached]:
    """A sequence of improving base models, from a given start or from `calibrate`'s search. The optimisation continues
    while nearby rollouts are better. If the noise is estimated from residuals, noise and fit alternate at the end.
    """
    target = begun.target
    _announce(target, problem.start is None, report)
    coordinates, known = target.forward.coordinates, target.noise.source != RESIDUALS
    free = np.arange(coordinates.base)
    first = base_optimum(target, jax.random.key(seed)) if problem.start is None else begun.x
    yield Reached(target, first)
    smooth = with_usable_differences(target, first)
    if smooth.forward.lanes.difference != target.forward.lanes.difference:
        report(f"motion is rough: derivatives over relative steps of {smooth.forward.lanes.difference:g}")
    fit_target, begun_fit = fit_with_noise(smooth, first, free)
    for fit in polled(fit_target, begun_fit, "base model", report):
        yield Reached.at(fit_target, replace(fit, promise=np.inf))
    yield Reached.at(fit_target, fit) if known else Reached.at(*under_residual_noise(fit_target, fit))


def base_model(
    problem: AuditProblem,
    seed: int,
    report: Callable[[str], None] = lambda line: None,
    deadline: Deadline | None = None,
) -> tuple[FitTarget, Fit]:
    """Noise and base fit, alternating if the noise is estimated from residuals.

    Raises:
        InputError: the time was up before the base model was fitted.
    """
    begun = beginning(problem, first_target(problem, Journal(), deadline))
    try:
        *_, last = base_fits(problem, begun, seed, report)
    except OutOfTime:
        raise InputError(
            "the time was up before the base model was fitted",
            where=(deadline or Deadline()).where,
            remedy="raise it, fit fewer or shorter recordings, or start from a calibration (--from)",
        ) from None
    return last.settled()


def under_residual_noise(target: FitTarget, fit: Fit) -> tuple[FitTarget, Fit]:
    """Noise and fit in turn."""
    converged = fit.converged
    for _ in range(2):
        target, fit = fit_with_noise(replace(target.measured, noise=residual_noise(target, fit)), fit.x, fit.free)
    return target, fit if converged else replace(fit, promise=np.inf)


def residual_noise(target: FitTarget, fit: Fit) -> Stacked:
    """What is taken for noise of what a model leaves of every recording, if nothing else says what the noise is.

    An autoregression, unless the residuals change more slowly than the noise of a measurement: those are a misfit, and
    an autoregression would explain it away. Noise is then only what the rows before do not predict, so that the model
    counts as far off, see `inadequacy`.
    """
    measured = target.measured.measurements
    left = np.array(measured.departures)
    for group, error in zip(measured.members, target.errors(fit.x), strict=True):
        left[list(group)] += error
    noise = measured.noise(np.where(measured.single_valid, left, 0.0), len(fit.free))
    return Stacked(tuple(part.unpredicted if part.doubtful else part for part in noise.parts))


def _announce(target: FitTarget, searches: bool, report: Callable[[str], None]) -> None:
    """Announce the first fit and its expected time, from the measured pace of rollouts and the time to compile
    derivatives, which equals the rollouts'.
    """
    forward, own = target.forward, target.forward.coordinates
    counted = f"{forward.count} recording{'s' if forward.count > 1 else ''}, repeats taken together"
    points = np.repeat(own.null[None], -(-forward.lanes.width // forward.count), axis=0)
    points[:, : own.base] += np.linspace(-0.5, 0.5, len(points))[:, None] * own.prior_sd[: own.base]
    took = []
    for _ in range(2):  # the first call compiles
        began = time.monotonic()
        forward.observe(np.clip(points, *own.bounds))
        took.append(time.monotonic() - began)
    optimisations = 3 if target.noise.source == RESIDUALS else 1  # noise and fit in turn
    rollouts = optimisations * optimisation_rollouts(target, own.base) + poll_rollouts(target)
    rollouts += optimum_rollouts(target) if searches else 0
    forward.compiling = max(took[0] - took[1], 0.0)
    words = about(rollouts * forward.pace + forward.compiling)
    report(f"fitting the base model: {own.base} parameters, {counted}; about {rollouts} rollouts, {words}")
