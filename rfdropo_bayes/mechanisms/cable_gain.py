"""Cables that do not all move by what their drives are told."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.mechanisms import MemorylessActuation, Values
from rfdropo_bayes.simulators.parameters import ParameterSpec

NUMBERED = tuple(str(k + 1) for k in range(8))


class CableGain(MemorylessActuation):
    """Each command scaled by its own ``1 + error``; zero at null. Equal errors of all are `command_gain`'s.

    Args:
        channels: names of the command channels; numbers by default.
    """

    name = "cable_gain"
    stage = "actuation"
    inside_drive = False
    cause = "spools of different radius, or cables of different stretch"
    remedy = "measure the travel of each cable for one turn of its drive"

    def __init__(self, channels: Sequence[str] = NUMBERED) -> None:
        self.parameters = tuple(
            ParameterSpec(
                f"cable_gain_error_{channel}",
                "-",
                -0.9,
                2.0,
                0.0,
                {"distribution": "Normal", "loc": 0.0, "scale": 0.1},
                f"relative error of the displacement of {channel}",
            )
            for channel in channels
        )

    @classmethod
    def for_robot(cls, robot: Robot) -> CableGain:
        """One error for every command channel of a robot."""
        return cls(robot.channel_names)

    def reach(self, values: Values, sent: Float[Array, "*step channel"]) -> Float[Array, "*step channel"]:
        """Scale each command, from zero on."""
        count = sent.shape[-1]
        error = jnp.stack([values[spec.name] for spec in self.parameters[:count]])
        return (1.0 + error) * sent
