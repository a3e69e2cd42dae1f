"""A zero that wanders."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.mechanisms.command_unit import InCommandUnit
from rfdropo_bayes.simulators.mechanisms import Values
from rfdropo_bayes.simulators.parameters import ParameterSpec


class DriveDrift(InCommandUnit):
    """The zero of all drives moves at a steady rate from the start of the recording; no rate at null."""

    name = "drive_drift"
    stage = "actuation"
    inside_drive = False
    cause = "drives or cables that slip, or spools that wind unevenly, so that the zero wanders"
    remedy = "return to zero at the end of a recording and compare the pose with that at the start"
    in_metres = (
        ParameterSpec(
            "drive_drift",
            "m/s",
            -0.1,
            0.1,
            0.0,
            {"distribution": "Normal", "loc": 0.0, "scale": 0.0005},
            "rate at which the zero of every drive moves",
        ),
    )

    def actuate(
        self, values: Values, command: Float[Array, "step channel"], initial: Float[Array, " channel"], time_step: float
    ) -> Float[Array, "step channel"]:
        """Add the drift to every channel."""
        return command + values["drive_drift"] * time_step * jnp.arange(1, len(command) + 1)[:, None]
