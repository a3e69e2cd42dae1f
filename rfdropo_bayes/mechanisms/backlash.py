"""Play between drive and cable."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.mechanisms.command_unit import InCommandUnit
from rfdropo_bayes.simulators.mechanisms import SteppedActuation, Values
from rfdropo_bayes.simulators.parameters import ParameterSpec

REST = 1e-9  # m or rad per step: less is the rounding of a command that is held


class Backlash(InCommandUnit, SteppedActuation):
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

    def begin(self, values: Values, first: Float[Array, " channel"], interval: float) -> tuple[Array, Array]:
        """How far the drive leads the cable, and what it was sent last: the middle of the play at first."""
        return jnp.zeros_like(first), first

    def advance(
        self, values: Values, memory: tuple[Array, Array], given: Float[Array, " channel"], now: float
    ) -> tuple[tuple[Array, Array], Float[Array, " channel"]]:
        """Drag the cable's end along with the drive."""
        half, (lead, last) = values["backlash"], memory
        move = given - last
        # Written with strict comparisons, so that without play the derivative stays that of the last move.
        ahead = lead + jnp.where(jnp.abs(move) > REST, move, 0.0)
        lead = jnp.where(ahead > half, half, jnp.where(ahead < -half, -half, ahead))
        return (lead, given), given - lead
