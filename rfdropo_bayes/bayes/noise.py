"""Observation noise: Gaussian, white or autoregressive in time, with masked rows left out.

For every marker coordinate the noise is a stationary Ornstein-Uhlenbeck process seen at the times that are not
masked: given the last valid row, ``gap`` seconds before, the residual is normal with mean ``phi r`` and variance
``sigma^2 (1 - phi^2)``, ``phi = exp(-gap / tau)``. The white model is its limit for tau -> 0.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.parameters import ParameterSpec

NOISE_MODELS = ("white", "ar1")

OBSERVATION_NOISE = ParameterSpec(
    "observation_noise",
    "m",
    1e-6,
    0.2,
    1e-3,
    {"distribution": "LogNormal", "median": 2e-3, "sigma": 1.5},
    "standard deviation of one coordinate of one marker: sensor noise and what the simulator misses",
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

# Finite, because an infinite gap would turn the derivative of exp(-gap / tau) into NaN.
LONG_AGO = 1e6


class Timeline(NamedTuple):
    """For every row and marker: is it valid, which valid row came before it, and how long ago.

    Attributes:
        valid: False where the recording is masked.
        previous: index of the last valid row before this one; its own index if there is none.
        gap: time since then [s]; `LONG_AGO` if there is none.
    """

    valid: Bool[np.ndarray, "time marker"]
    previous: Int[np.ndarray, "time marker"]
    gap: Float[np.ndarray, "time marker"]


def timeline(time: Float[np.ndarray, " time"], valid: Bool[np.ndarray, "time marker"]) -> Timeline:
    """Link each row of each marker to the valid row before it."""
    rows = np.arange(len(time))[:, None]
    last = np.maximum.accumulate(np.where(valid, rows, -1), axis=0)
    previous = np.vstack([np.full((1, valid.shape[1]), -1), last[:-1]])
    gap = np.where(previous >= 0, np.asarray(time)[:, None] - np.asarray(time)[np.maximum(previous, 0)], LONG_AGO)
    return Timeline(valid, np.where(previous >= 0, previous, rows).astype(np.int32), gap)


def noise_specs(model: str) -> tuple[ParameterSpec, ...]:
    """Parameters of a noise model, ``"white"`` or ``"ar1"``."""
    if model not in NOISE_MODELS:
        raise InputError(f"unknown noise model {model!r}", where="[model] noise", remedy=f"use one of {NOISE_MODELS}")
    return (OBSERVATION_NOISE,) if model == "white" else (OBSERVATION_NOISE, NOISE_CORRELATION_TIME)


def _conditional(
    sigma: Float[Array, ""], tau: Float[Array, ""] | None, line: Timeline
) -> tuple[Float[Array, "time marker"], Float[Array, "time marker"]]:
    """Coefficient on the previous residual and conditional standard deviation of each row and marker."""
    if tau is None:
        return jnp.zeros_like(line.gap), jnp.broadcast_to(sigma, line.gap.shape)
    phi = jnp.exp(-line.gap / tau)
    return phi, sigma * jnp.sqrt(-jnp.expm1(-2.0 * line.gap / tau))


def whiten(
    residual: Float[Array, "time marker 3"], sigma: Float[Array, ""], tau: Float[Array, ""] | None, line: Timeline
) -> tuple[Float[Array, "time marker 3"], Float[Array, "time marker"]]:
    """Independent unit-variance residuals (zero where masked), and the standard deviation each was divided by [m]."""
    phi, scale = _conditional(sigma, tau, line)
    before = jnp.take_along_axis(residual, line.previous[:, :, None], axis=0)
    white = (residual - phi[:, :, None] * before) / scale[:, :, None]
    return jnp.where(line.valid[:, :, None], white, 0.0), scale


def row_log_density(
    residual: Float[Array, "time marker 3"], sigma: Float[Array, ""], tau: Float[Array, ""] | None, line: Timeline
) -> Float[Array, " time"]:
    """Log density of each row given the rows before it; the sum over a prefix is that prefix's log likelihood."""
    white, scale = whiten(residual, sigma, tau, line)
    normaliser = jnp.where(line.valid, 1.5 * jnp.log(2.0 * jnp.pi) + 3.0 * jnp.log(scale), 0.0)
    return -0.5 * jnp.sum(white**2, axis=(1, 2)) - jnp.sum(normaliser, axis=1)


def draw_noise(
    key: PRNGKeyArray, time: Float[Array, " time"], markers: int, sigma: Float[Array, ""], tau: Float[Array, ""] | None
) -> Float[Array, "time marker 3"]:
    """One realisation of the noise at the given times [m]."""
    white = jax.random.normal(key, (len(time), markers, 3))
    if tau is None:
        return sigma * white
    gap = jnp.diff(jnp.asarray(time), prepend=time[0] - LONG_AGO)
    phi, scale = jnp.exp(-gap / tau), sigma * jnp.sqrt(-jnp.expm1(-2.0 * gap / tau))

    def advance(last, row):
        coefficient, spread, innovation = row
        now = coefficient * last + spread * innovation
        return now, now

    return jax.lax.scan(advance, jnp.zeros((markers, 3)), (phi, scale, white))[1]
