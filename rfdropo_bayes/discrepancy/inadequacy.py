"""Noise model of a misspecified model: as in `calibrate`, white noise of the size of its residuals.

Under the measurement noise, any effect on the markers gains thousands of nats in a misspecified model: priors have no
influence, and correlated noise weights wrong increments above wrong poses. While the residuals exceed `POOR` times the
noise's variance, the model is fitted and extended under white noise of the size of its residuals. Rows are
down-weighted by the residual correlation time. Repeats do not reduce a model's error: a mean of five counts once. The
size is unknown: evidences are integrated over it, so that a model that leaves a tenth beats a model that leaves a half.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.bayes.noise import Autoregression
from rfdropo_bayes.bayes.noise.autoregression import INNOVATIONS, MISFIT, RESIDUALS
from rfdropo_bayes.bayes.noise.stacked import Stacked
from rfdropo_bayes.discrepancy.fit import Fit, FitTarget, optimise
from rfdropo_bayes.inference.modes.lasting import lasting_series

POOR = 2.0  # squared residual per value, in the noise's variance, above which a model is misspecified
ROUNDS = 6  # of noise and fit in turn
SETTLED = 0.1  # relative change of the noise between rounds
QUICK = 0.5  # share that the rows before predict, up to which residuals beside a misspecified model are noise


def misspecified(target: FitTarget, x: Float[np.ndarray, " d"]) -> bool:
    """Whether a model leaves more than `POOR` times the variance of the measurement's noise."""
    known = target.measured
    if known.noise.source == RESIDUALS:  # of the model itself
        return False
    residual = known.recall("left", [x], lambda: {"residual": known.residual(x[None])[0]})["residual"]
    return bool(residual @ residual > POOR * np.count_nonzero(residual))


def leaves_noise(before: Stacked, after: Stacked) -> bool:
    """Whether residuals of an extended model are noise.

    Poses that follow each other closely make any misfit slow. An autoregression would explain what is left of it, and
    its innovations would give an artefact hundreds of nats. Beside a misspecified model, noise is therefore quick.

    Args:
        before: noise beside the base model.
        left: noise beside the extended model.
    """
    if after.source == INNOVATIONS:
        return False
    return before.source != INNOVATIONS or max(part.remembered for part in after.parts) <= QUICK


def fit_with_noise(
    known: FitTarget, x: Float[np.ndarray, " d"], free: Int[np.ndarray, " free"]
) -> tuple[FitTarget, Fit]:
    """The target with a model's noise, and its fit, optimised from a point."""
    if not misspecified(known, x):
        return known, optimise(known, x, free)
    fit_target = _under(known, known.errors(x))
    for _ in range(ROUNDS):
        fit = optimise(fit_target, x, free)
        if not misspecified(known, fit.x):
            return known, optimise(known, fit.x, free)
        before, x = fit_target, fit.x
        fit_target = _under(known, _errors(fit_target, fit.residual), _shares(fit_target, fit))
        if np.all(np.abs(fit_target.noise.scale / before.noise.scale - 1.0) < SETTLED):
            break
    return fit_target, optimise(fit_target, x, free)


def as_measured(fit_target: FitTarget, fit: Fit) -> Fit:
    """A fit with residuals and slopes in deviations of the measurement's noise; its covariance stays."""
    return fit if fit_target.known is None else seen_under(fit_target, fit_target.known, fit)


def seen_under(fit_target: FitTarget, other: FitTarget, fit: Fit) -> Fit:
    """A fit with residuals and slopes in deviations of the noise of another target; its covariance stays. A fit under
    the measurement noise is unchanged.
    """
    if fit_target.known is None or fit_target.noise is other.noise:
        return fit

    def whitened(white: np.ndarray) -> np.ndarray:
        weighed = white[..., other.measurements.count.size :]
        return np.concatenate([rewhitened(fit_target, other, white), weighed], axis=-1)

    promise = fit.promise if fit.converged else np.inf
    return replace(fit, residual=whitened(fit.residual), jacobian=whitened(fit.jacobian.T).T, promise=promise)


def rewhitened(
    fit_target: FitTarget, other: FitTarget, white: Float[np.ndarray, "*batch n"]
) -> Float[np.ndarray, "*batch m"]:
    """Residuals under the white noise of ``fit_target``, in deviations of the noise of another target."""
    return other.measurements.whiten(_errors(fit_target, white), other.noise)


def noise_share(fit_target: FitTarget) -> float:
    """Mean square of the measurement's noise in deviations of the noise of ``fit_target``; 1 if the model is not
    misspecified.
    """
    if fit_target.known is None:
        return 1.0
    known = fit_target.known.measurements
    variance = (fit_target.known.noise.scale / fit_target.noise.scale) ** 2 / np.maximum(known.count, 1.0)
    return float(np.mean(variance[known.valid]))


def residual_deviation(fit_target: FitTarget, fit: Fit) -> Float[np.ndarray, " column"]:
    """Deviation of a fit's residuals for each column: the measurement noise, unless the model is misspecified, or the
    noise is the residuals' of another model."""
    if fit_target.known is not None:
        return _sizes(fit_target, _errors(fit_target, fit.residual))
    if fit_target.noise.source == RESIDUALS:
        return _sizes(fit_target, fit_target.errors(fit.x))
    return fit_target.noise.scale


def _errors(
    fit_target: FitTarget, white: Float[np.ndarray, "*batch n"]
) -> Float[np.ndarray, "*batch group time column"]:
    """Errors whose residuals under the white noise of ``fit_target`` are ``white``."""
    return fit_target.measurements.series(white) * fit_target.noise.scale


def _sizes(target: FitTarget, errors: Float[np.ndarray, "group time column"]) -> Float[np.ndarray, " column"]:
    """Root mean square of errors, one for all columns of a channel."""
    valid, sizes = target.measurements.valid, np.empty(errors.shape[-1])
    for own in target.measurements.columns:
        sizes[own] = np.sqrt(np.mean(errors[..., own][valid[..., own]] ** 2))
    return sizes


def _shares(fit_target: FitTarget, fit: Fit) -> list[float]:
    """Weight of a row of each channel, see `lasting_series`."""
    measured = fit_target.measurements
    errors = _errors(fit_target, fit.residual)
    series = np.where(measured.valid, errors / _sizes(fit_target, errors), 0.0)
    reach = measured.series((fit.jacobian @ np.linalg.cholesky(fit.covariance)).T)
    steps = measured.steps
    return [
        lasting_series(series[..., own], measured.valid[..., own], reach[..., own], steps).share
        for own in measured.columns
    ]


def _under(
    known: FitTarget, errors: Float[np.ndarray, "group time column"], shares: Sequence[float] | None = None
) -> FitTarget:
    """The target under white noise of the size of errors, over the root of the weight of a row."""
    measured, parts, sizes = known.measurements, [], _sizes(known, errors)
    for own, share in zip(measured.columns, shares or [1.0] * len(measured.columns), strict=True):
        counted = share * float(np.count_nonzero(measured.valid[..., own]))
        parts.append(Autoregression(sizes[own] / np.sqrt(share), np.ones(1), MISFIT, counted))
    firsts = tuple((group[0],) for group in measured.members)
    once = replace(measured, count=np.minimum(measured.count, 1.0), members=firsts)
    return replace(known, noise=Stacked(tuple(parts)), measurements=once, known=known)
