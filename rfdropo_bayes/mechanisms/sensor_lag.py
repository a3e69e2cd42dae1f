"""Cameras or filters that follow late."""

from __future__ import annotations

from typing import Any

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

        def follow(memory: tuple[Array, Array, Array], row: tuple[Array, Array]) -> tuple[Any, Array]:
            return self.advance(values, memory, *row)

        return jax.lax.scan(follow, self.begin(values, position[0], 0.0), (position, time - time[0]))[1]

    def begin(self, values: Values, first: Float[Array, "marker 3"], interval: float) -> tuple[Array, Array, Array]:
        """The last position as it was seen and as it was, and its time: the first one at zero."""
        return first, first, jnp.zeros(())

    def advance(
        self, values: Values, memory: tuple[Array, Array, Array], given: Float[Array, "marker 3"], now: Float[Array, ""]
    ) -> tuple[tuple[Array, Array, Array], Float[Array, "marker 3"]]:
        """Exact response to a position that ran straight from the last one to this."""
        last, before, then = memory
        tau = values["sensor_lag"]
        on = tau > 0.0
        safe = jnp.where(on, tau, 1.0)
        gap = jnp.maximum(now - then, 1e-9)
        slope = (given - before) / gap
        kept = jnp.where(on, jnp.exp(-gap / safe), 0.0)
        seen = given - tau * slope + kept * (last - before + tau * slope)
        return (seen, given, jnp.asarray(now, float)), seen
