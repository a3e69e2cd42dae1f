"""A drive that cannot go as fast as it is told."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.mechanisms.command_unit import InCommandUnit
from rfdropo_bayes.simulators.mechanisms import SteppedActuation, Values
from rfdropo_bayes.simulators.parameters import ParameterSpec


class RateLimit(InCommandUnit, SteppedActuation):
    """Drives follow at a limited speed; the speed is infinite, its inverse zero, at null."""

    name = "rate_limit"
    stage = "actuation"
    inside_drive = True
    cause = "the speed or current limit of the drives, or a trajectory generator between command and drive"
    remedy = "read the drives' speed limit, or record their positions during a large step"
    in_metres = (
        ParameterSpec(
            "inverse_speed_limit",
            "s/m",
            0.0,
            1e4,
            0.0,
            {"distribution": "HalfNormal", "scale": 30.0},
            "one over the largest speed of a drive",
            grid=(3.0, 12.0, 20.0, 40.0, 100.0),
        ),
    )

    def begin(self, values: Values, first: Float[Array, " channel"], interval: float) -> Float[Array, " channel"]:
        """Where the drives stand."""
        return first

    def advance(
        self, values: Values, memory: Float[Array, " channel"], given: Float[Array, " channel"], now: float
    ) -> tuple[Float[Array, " channel"], Float[Array, " channel"]]:
        """Follow the command as fast as the limit allows."""
        inverse = values["inverse_speed_limit"]
        longest = now / jnp.maximum(inverse, 1e-12)
        move = given - memory
        reached = jnp.where(jnp.abs(move) * inverse > now, memory + jnp.sign(move) * longest, given)
        return reached, reached
