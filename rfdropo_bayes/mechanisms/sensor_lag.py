"""Cameras or filters that follow late."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.simulators.mechanisms import Values
from rfdropo_bayes.simulators.parameters import ParameterSpec


class SensorLag:
    """Measured positions are smoothed by a first-order filter, ``tau y' = x - y``; tau = 0 at null."""

    name = "sensor_lag"
    stage = "sensing"
    cause = "a low-pass filter of the motion capture, or exposure that blurs over time"
    remedy = "switch the filter off, or record the drives' own encoders for comparison"
    parameters = (
        ParameterSpec(
            "sensor_lag",
            "s",
            0.0,
            5.0,
            0.0,
            {"distribution": "HalfNormal", "scale": 0.1},
            "time constant of the filter",
        ),
    )

    def sense_over_time(
        self, values: Values, position: Float[Array, "time marker 3"], time: Float[Array, " time"]
    ) -> Float[Array, "time marker 3"]:
        """Exact response to positions that run straight from one observation to the next."""
        tau = values["sensor_lag"]
        on = tau > 0.0
        safe = jnp.where(on, tau, 1.0)

        def follow(state: tuple[Array, Array], row: tuple[Array, Array]) -> tuple[tuple[Array, Array], Array]:
            last, before = state
            gap, now = row
            slope = (now - before) / gap
            kept = jnp.where(on, jnp.exp(-gap / safe), 0.0)
            seen = now - tau * slope + kept * (last - before + tau * slope)
            return (seen, now), seen

        rows = (jnp.maximum(jnp.diff(time), 1e-9), position[1:])
        seen = jax.lax.scan(follow, (position[0], position[0]), rows)[1]
        return jnp.concatenate([position[:1], seen])
