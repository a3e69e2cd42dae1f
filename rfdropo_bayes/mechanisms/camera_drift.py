"""A measuring frame that wanders."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.simulators.mechanisms import Values
from rfdropo_bayes.simulators.parameters import ParameterSpec


class CameraDrift:
    """The measuring frame moves at a steady velocity from the start of the recording; none at null."""

    name = "camera_drift"
    stage = "sensing"
    cause = "cameras or a base that move or warm up during the recording"
    remedy = "record a marker that is fixed to the base"
    parameters = tuple(
        ParameterSpec(
            f"camera_drift_{axis}",
            "m/s",
            -0.1,
            0.1,
            0.0,
            {"distribution": "Normal", "loc": 0.0, "scale": 0.0005},
            f"velocity of measured positions along {axis}",
        )
        for axis in "xyz"
    )

    def sense_over_time(
        self, values: Values, position: Float[Array, "time marker 3"], time: Float[Array, " time"]
    ) -> Float[Array, "time marker 3"]:
        """Shift the positions in proportion to time."""
        return position + self._shift(values, (time - time[0])[:, None, None])

    def begin(self, values: Values, first: Float[Array, "marker 3"], interval: float) -> tuple[()]:
        """Nothing to remember."""
        return ()

    def advance(
        self, values: Values, memory: tuple[()], given: Float[Array, "marker 3"], now: Float[Array, ""]
    ) -> tuple[tuple[()], Float[Array, "marker 3"]]:
        """Shift the positions in proportion to time."""
        return memory, given + self._shift(values, now)

    def _shift(self, values: Values, elapsed: Float[Array, "..."]) -> Float[Array, "..."]:
        return elapsed * jnp.stack([values[spec.name] for spec in self.parameters])
