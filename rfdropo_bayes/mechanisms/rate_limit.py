"""A drive that cannot go as fast as it is told."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.mechanisms.command_unit import InCommandUnit
from rfdropo_bayes.simulators.mechanisms import Values
from rfdropo_bayes.simulators.parameters import ParameterSpec


class RateLimit(InCommandUnit):
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

    def actuate(
        self, values: Values, command: Float[Array, "step channel"], initial: Float[Array, " channel"], time_step: float
    ) -> Float[Array, "step channel"]:
        """Follow the command as fast as the limit allows."""
        inverse = values["inverse_speed_limit"]
        longest = time_step / jnp.maximum(inverse, 1e-12)

        def follow(last: Array, sent: Array) -> tuple[Array, Array]:
            move = sent - last
            reached = jnp.where(jnp.abs(move) * inverse > time_step, last + jnp.sign(move) * longest, sent)
            return reached, reached

        return jax.lax.scan(follow, jnp.asarray(initial, command.dtype), command)[1]
