"""Observation noise: white, correlated in time, both at once, or heavy-tailed; masked rows are left out.

``auto`` is the sum of white noise and of a stationary Ornstein-Uhlenbeck process (AR(1) for evenly spaced rows), equal
for every coordinate of every marker. It becomes ``white`` if the correlated part vanishes, and ``ar1`` if the white
part vanishes. Its density given the rows before comes from a Kalman filter with one state (Sarkka, Bayesian Filtering
and Smoothing, 2013, section 4.3), which handles irregular and masked rows. ``ar1`` needs no filter: given the
last valid row, ``gap`` seconds before, the residual is normal with mean ``phi r`` and variance ``sigma^2 (1 - phi^2)``,
``phi = exp(-gap / tau)``. ``student-t`` is independent in time; its tails absorb single outliers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from scipy import stats

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.parameters import ParameterSpec

NOISE_MODELS = ("auto", "white", "ar1", "student-t")

OBSERVATION_NOISE = ParameterSpec(
    "observation_noise",
    "m",
    1e-6,
    0.2,
    1e-3,
    {"distribution": "LogNormal", "median": 2e-3, "sigma": 1.5},
    "standard deviation of one coordinate of one marker: sensor noise and simulator error",
)
LASTING_NOISE = ParameterSpec(
    "lasting_noise",
    "m",
    1e-6,
    0.2,
    1e-3,
    {"distribution": "LogNormal", "median": 2e-3, "sigma": 1.5},
    "standard deviation of the correlated part of the noise: mostly simulator error",
)
NOISE_CORRELATION_TIME = ParameterSpec(
    "noise_correlation_time",
    "s",
    1e-3,
    100.0,
    0.1,
    {"distribution": "LogNormal", "median": 0.5, "sigma": 1.5},
    "time over which the residual forgets its sign (Ornstein-Uhlenbeck)",
)
NOISE_DEGREES = ParameterSpec(
    "noise_degrees",
    "-",
    1.0,
    1000.0,
    30.0,
    {"distribution": "LogNormal", "median": 10.0, "sigma": 1.0},
    "degrees of freedom of the noise: few with outliers, many if it is normal",
)
_SPECS = {
    "auto": (OBSERVATION_NOISE, LASTING_NOISE, NOISE_CORRELATION_TIME),
    "white": (OBSERVATION_NOISE,),
    "ar1": (OBSERVATION_NOISE, NOISE_CORRELATION_TIME),
    "student-t": (OBSERVATION_NOISE, NOISE_DEGREES),
}
_FIELDS = {
    "observation_noise": "sigma",
    "noise_correlation_time": "tau",
    "lasting_noise": "lasting",
    "noise_degrees": "degrees",
}

# Half-width of the central 68 % of a Student-t of unit scale: a normal distribution's standard deviation.
_DEGREES = np.geomspace(NOISE_DEGREES.low, NOISE_DEGREES.high, 2000)
_CORE = stats.t.ppf(stats.norm.cdf(1.0), _DEGREES)

# Finite, because an infinite gap would turn the derivative of exp(-gap / tau) into NaN.
LONG_AGO = 1e6


class Timeline(NamedTuple):
    """For every row and marker: whether the row is valid, the last valid row before, and the time between them."""

    valid: Bool[np.ndarray, "time marker"]  # False for masked positions
    previous: Int[np.ndarray, "time marker"]  # index of the last valid row before; its own index if there is none
    gap: Float[np.ndarray, "time marker"]  # time since then [s]; `LONG_AGO` if there is none


def timeline(time: Float[np.ndarray, " time"], valid: Bool[np.ndarray, "time marker"]) -> Timeline:
    """Link each row of each marker to the valid row before it."""
    rows = np.arange(len(time))[:, None]
    last = np.maximum.accumulate(np.where(valid, rows, -1), axis=0)
    previous = np.vstack([np.full((1, valid.shape[1]), -1), last[:-1]])
    gap = np.where(previous >= 0, np.asarray(time)[:, None] - np.asarray(time)[np.maximum(previous, 0)], LONG_AGO)
    return Timeline(valid, np.where(previous >= 0, previous, rows).astype(np.int32), gap)


class Noise(NamedTuple):
    """Values of a noise model; absent parts are None."""

    # standard deviation [m] of one coordinate of one marker: of the white part, or of all noise if there is no
    # correlated part. For heavy-tailed noise half the width of the central 68 %, which tails do not change.
    sigma: Any
    tau: Any = None  # correlation time [s] of the correlated part; None for independent rows
    # standard deviation [m] of the correlated part beside a white part; None if all noise is correlated
    lasting: Any = None
    degrees: Any = None  # degrees of freedom of a Student-t; None for normal noise

    @property
    def deviation(self) -> Any:
        """Standard deviation [m] of one coordinate; of heavy-tailed noise without its tails."""
        return self.sigma if self.lasting is None else (self.sigma**2 + self.lasting**2) ** 0.5


def noise_specs(model: str) -> tuple[ParameterSpec, ...]:
    """Parameters of a noise model, one of `NOISE_MODELS`.

    Raises:
        InputError: no such model.
    """
    if model not in NOISE_MODELS:
        raise InputError(f"unknown noise model {model!r}", where="[model] noise", remedy=f"use one of {NOISE_MODELS}")
    return _SPECS[model]


def noise_values(model: str, known: Mapping[str, Any]) -> Noise:
    """The values of a noise model, taken from all parameters.

    Raises:
        InputError: a value is missing.
    """
    missing = [spec.name for spec in noise_specs(model) if spec.name not in known]
    if missing:
        raise InputError(
            f"noise = {model!r} has a parameter {missing[0]!r}, which has no value here",
            where="[model] noise",
            remedy="name the noise that the posterior was fitted with, or calibrate again",
        )
    return Noise(**{_FIELDS[spec.name]: known[spec.name] for spec in noise_specs(model)})


def whiten(
    residual: Float[Array, "time marker 3"], noise: Noise, line: Timeline
) -> tuple[Float[Array, "time marker 3"], Float[Array, "time marker"]]:
    """Independent residuals of unit size (zero if masked), and the scale [m] that normalises each.

    With white residuals w and scales s the log density of a coordinate is ``-w^2 / 2 - log(s) - log(2 pi) / 2``; s
    depends on the noise and the timeline alone. Normal noise makes w standard normal. For heavy-tailed noise w is the
    signed root of the deviance, which is nearly normal.
    """
    if noise.degrees is not None:
        white, scale = _student(residual, noise.sigma, noise.degrees)
        scale = jnp.broadcast_to(scale, line.gap.shape)
    elif noise.tau is None:
        white, scale = residual / noise.sigma, jnp.broadcast_to(noise.sigma, line.gap.shape)
    elif noise.lasting is None:
        phi, scale = jnp.exp(-line.gap / noise.tau), _innovation(noise.sigma, line.gap, noise.tau)
        before = jnp.take_along_axis(residual, line.previous[:, :, None], axis=0)
        white = (residual - phi[:, :, None] * before) / scale[:, :, None]
    else:
        white, scale = _filtered(residual, noise, line)
    return jnp.where(line.valid[:, :, None], white, 0.0), scale


def _innovation(sigma: Float[Array, ""], gap: Float[Array, "..."], tau: Float[Array, ""]) -> Float[Array, "..."]:
    """Standard deviation of an Ornstein-Uhlenbeck process given its value ``gap`` seconds before."""
    return sigma * jnp.sqrt(-jnp.expm1(-2.0 * gap / tau))


def _student(
    residual: Float[Array, "time marker 3"], sigma: Float[Array, ""], degrees: Float[Array, ""]
) -> tuple[Float[Array, "time marker 3"], Float[Array, ""]]:
    scale = _student_scale(sigma, degrees)
    square = (residual / scale) ** 2 / degrees
    # log1p(x) / x is 1 at zero, at which neither the quotient nor the derivative of a root exists.
    small = square < 1e-8
    ratio = jnp.where(small, 1.0 - 0.5 * square, jnp.log1p(square) / jnp.where(small, 1.0, square))
    white = residual / scale * jnp.sqrt((degrees + 1.0) / degrees * ratio)
    constant = gammaln(0.5 * (degrees + 1.0)) - gammaln(0.5 * degrees) - 0.5 * jnp.log(0.5 * degrees)
    return white, scale * jnp.exp(-constant)


def _student_scale(sigma: Float[Array, ""], degrees: Float[Array, ""]) -> Float[Array, ""]:
    return sigma / jnp.interp(jnp.log(degrees), np.log(_DEGREES), _CORE)


def _filtered(
    residual: Float[Array, "time marker 3"], noise: Noise, line: Timeline
) -> tuple[Float[Array, "time marker 3"], Float[Array, "time marker"]]:
    """Innovations of the Kalman filter over their standard deviations, and these: white noise on a lasting part."""
    white, power = noise.sigma**2, noise.lasting**2

    def advance(state: tuple[Array, Array], row: tuple[Array, Array, Array]) -> tuple[Any, tuple[Array, Array]]:
        mean, short = state  # of the lasting part at the last valid row; its variance is ``power - short``
        value, valid, phi = row
        short_now = phi**2 * short
        variance = power - short_now + white
        surprise = value - phi[:, None] * mean
        gain = (power - short_now) / variance
        updated = phi[:, None] * mean + gain[:, None] * surprise
        remaining = power - white * gain
        state = jnp.where(valid[:, None], updated, mean), jnp.where(valid, remaining, short)
        return state, (surprise / jnp.sqrt(variance)[:, None], jnp.sqrt(variance))

    nothing = jnp.zeros(residual.shape[1:]), jnp.zeros(residual.shape[1])
    return jax.lax.scan(advance, nothing, (residual, line.valid, jnp.exp(-line.gap / noise.tau)))[1]


def row_log_density(residual: Float[Array, "time marker 3"], noise: Noise, line: Timeline) -> Float[Array, " time"]:
    """Log density of each row given the rows before it; the sum over a prefix is that prefix's log likelihood."""
    white, scale = whiten(residual, noise, line)
    normaliser = jnp.where(line.valid, 1.5 * jnp.log(2.0 * jnp.pi) + 3.0 * jnp.log(scale), 0.0)
    return -0.5 * jnp.sum(white**2, axis=(1, 2)) - jnp.sum(normaliser, axis=1)


def draw_noise(
    key: PRNGKeyArray, time: Float[Array, " time"], markers: int, noise: Noise
) -> Float[Array, "time marker 3"]:
    """One realisation of the noise at the given times [m]."""
    shape = (len(time), markers, 3)
    if noise.degrees is not None:
        return _student_scale(noise.sigma, noise.degrees) * jax.random.t(key, noise.degrees, shape)
    if noise.tau is None:
        return noise.sigma * jax.random.normal(key, shape)
    if noise.lasting is None:
        return _lasting(key, time, markers, noise.sigma, noise.tau)
    lasting = _lasting(key, time, markers, noise.lasting, noise.tau)
    return lasting + noise.sigma * jax.random.normal(jax.random.fold_in(key, 1), shape)


def _lasting(
    key: PRNGKeyArray, time: Float[Array, " time"], markers: int, sigma: Float[Array, ""], tau: Float[Array, ""]
) -> Float[Array, "time marker 3"]:
    """An Ornstein-Uhlenbeck process."""
    white = jax.random.normal(key, (len(time), markers, 3))
    gap = jnp.diff(jnp.asarray(time), prepend=time[0] - LONG_AGO)
    phi, scale = jnp.exp(-gap / tau), _innovation(sigma, gap, tau)

    def advance(last: Array, row: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        coefficient, size, innovation = row
        now = coefficient * last + size * innovation
        return now, now

    return jax.lax.scan(advance, jnp.zeros((markers, 3)), (phi, scale, white))[1]
