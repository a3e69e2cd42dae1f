"""A drive that cannot go as far as it is told."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.mechanisms.command_unit import InCommandUnit
from rfdropo_bayes.simulators.mechanisms import MemorylessActuation, Values
from rfdropo_bayes.simulators.parameters import ParameterSpec


class EndStop(InCommandUnit, MemorylessActuation):
    """Commands beyond a limit are cut off on either side; the limit is infinite, its inverse zero, at null."""

    name = "end_stop"
    stage = "actuation"
    inside_drive = True
    cause = "a mechanical end stop, a software limit or the largest torque of a drive"
    remedy = "read the drives' limits and their measured positions where the command is largest"
    in_metres = (
        ParameterSpec(
            "inverse_travel_limit",
            "1/m",
            0.0,
            1e5,
            0.0,
            {"distribution": "HalfNormal", "scale": 100.0},
            "one over the largest command that is carried out",
            grid=(5.0, 15.0, 30.0, 55.0, 60.0, 70.0, 85.0, 110.0, 150.0, 250.0),
        ),
    )

    def reach(self, values: Values, sent: Float[Array, "*step channel"]) -> Float[Array, "*step channel"]:
        """Cut the command off at the limit."""
        inverse = values["inverse_travel_limit"]
        limit = jnp.sign(sent) / jnp.maximum(inverse, 1e-12)
        return jnp.where(jnp.abs(sent) * inverse > 1.0, limit, sent)
