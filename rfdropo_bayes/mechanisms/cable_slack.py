"""Cables that are slack at zero command."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.mechanisms.command_unit import InCommandUnit
from rfdropo_bayes.simulators.mechanisms import MemorylessActuation, Values
from rfdropo_bayes.simulators.parameters import ParameterSpec


class CableSlack(InCommandUnit, MemorylessActuation):
    """The first part of every pull only takes up slack (a dead zone around zero); none at null."""

    name = "cable_slack"
    stage = "actuation"
    inside_drive = False
    cause = "cables that are not taut at zero command, or a dead zone of the drives"
    remedy = "tension the cables until each just moves the body, and set zero there"
    in_metres = (
        ParameterSpec(
            "cable_slack",
            "m",
            0.0,
            0.1,
            0.0,
            {"distribution": "HalfNormal", "scale": 0.001},
            "command that is lost before a cable is taut",
        ),
    )

    def reach(self, values: Values, sent: Float[Array, "*step channel"]) -> Float[Array, "*step channel"]:
        """Shrink the command towards zero by the slack."""
        slack = values["cable_slack"]
        return jnp.where(sent > slack, sent - slack, jnp.where(sent < -slack, sent + slack, 0.0))
