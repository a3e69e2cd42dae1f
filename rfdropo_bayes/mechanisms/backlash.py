"""Play between drive and cable."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.simulators.mechanisms import Values
from rfdropo_bayes.simulators.parameters import ParameterSpec


class Backlash:
    """At each reversal a drive moves by twice ``backlash`` before the cable follows (play operator); none at null."""

    name = "backlash"
    stage = "actuation"
    cause = "play in gears, couplings or spools"
    remedy = "reverse each drive by hand and measure the play; preload the transmission"
    parameters = (
        ParameterSpec(
            "backlash",
            "m or rad",
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

        def drag(last: Array, sent: Array) -> tuple[Array, Array]:
            # Written with strict comparisons, so that without play the derivative stays that of the last move.
            reached = jnp.where(sent - last > half, sent - half, jnp.where(last - sent > half, sent + half, last))
            return reached, reached

        return jax.lax.scan(drag, jnp.asarray(initial, command.dtype), command)[1]
