"""Play between drive and cable."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.mechanisms.command_unit import InCommandUnit
from rfdropo_bayes.simulators.mechanisms import Values
from rfdropo_bayes.simulators.parameters import ParameterSpec

REST = 1e-9  # m or rad per step: less is the rounding of a command that is held


class Backlash(InCommandUnit):
    """At each reversal a drive moves by twice ``backlash`` before the cable follows (play operator); none at null."""

    name = "backlash"
    stage = "actuation"
    inside_drive = False
    cause = "play in gears, couplings or spools"
    remedy = "reverse each drive by hand and measure the play; preload the transmission"
    in_metres = (
        ParameterSpec(
            "backlash",
            "m",
            0.0,
            0.1,
            0.0,
            {"distribution": "HalfNormal", "scale": 0.0005},
            "half of the play between drive and cable",
        ),
    )

    def actuate(
        self, values: Values, command: Float[Array, "step channel"], initial: Float[Array, " channel"], time_step: float
    ) -> Float[Array, "step channel"]:
        """Drag the cable's end along with the drive, from the middle of the play at first."""
        half = values["backlash"]
        sent = jnp.concatenate([jnp.asarray(initial, command.dtype)[None], command])
        moves = jnp.diff(sent, axis=0)

        def drag(lead: Array, move: Array) -> tuple[Array, Array]:
            # Written with strict comparisons, so that without play the derivative stays that of the last move.
            ahead = lead + move
            lead = jnp.where(ahead > half, half, jnp.where(ahead < -half, -half, ahead))
            return lead, lead

        moves = jnp.where(jnp.abs(moves) > REST, moves, 0.0)
        return command - jax.lax.scan(drag, jnp.zeros_like(sent[0]), moves)[1]
