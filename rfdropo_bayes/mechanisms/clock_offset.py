"""Clocks of cameras and drives that do not agree."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.simulators.mechanisms import Values
from rfdropo_bayes.simulators.parameters import ParameterSpec


class ClockOffset:
    """Positions carry time stamps that are late or early by a constant; zero at null."""

    name = "clock_offset"
    stage = "sensing"
    cause = "cameras and drives on clocks that were not synchronised, or frames stamped when they arrive"
    remedy = "synchronise the clocks by a trigger that both record"
    parameters = (
        ParameterSpec(
            "clock_offset",
            "s",
            -1.0,
            1.0,
            0.0,
            {"distribution": "Normal", "loc": 0.0, "scale": 0.05},
            "what is seen at a time happened so much earlier",
        ),
    )

    def sense_over_time(
        self, values: Values, position: Float[Array, "time marker 3"], time: Float[Array, " time"]
    ) -> Float[Array, "time marker 3"]:
        """Read the positions at other times, linearly between observations; beyond the ends they stand still."""
        at = time - values["clock_offset"]
        # Not a clip, whose derivative at the first and last row would be halved.
        at = jnp.where(at <= time[0], time[0], jnp.where(at > time[-1], time[-1], at))
        after = jnp.clip(jnp.searchsorted(time, at), 1, len(time) - 1)
        gap = jnp.maximum(time[after] - time[after - 1], 1e-9)
        weight = ((time[after] - at) / gap)[:, None, None]
        return position[after] - weight * (position[after] - position[after - 1])
