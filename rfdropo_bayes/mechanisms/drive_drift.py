"""A zero that wanders."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rfdropo_bayes.mechanisms.command_unit import InCommandUnit
from rfdropo_bayes.simulators.mechanisms import SteppedActuation, Values
from rfdropo_bayes.simulators.parameters import ParameterSpec


class DriveDrift(InCommandUnit, SteppedActuation):
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

    def begin(self, values: Values, first: Float[Array, " channel"], interval: float) -> Int[Array, ""]:
        """Number of steps."""
        return jnp.zeros((), int)

    def advance(
        self, values: Values, memory: Int[Array, ""], given: Float[Array, " channel"], now: float
    ) -> tuple[Int[Array, ""], Float[Array, " channel"]]:
        """Add the drift to every channel."""
        return memory + 1, given + values["drive_drift"] * now * (memory + 1)
