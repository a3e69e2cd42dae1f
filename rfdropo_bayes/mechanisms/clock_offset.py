"""Clocks of cameras and drives that do not agree."""

from __future__ import annotations

import math
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfdropo_bayes.errors import InputError
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
        return _read(position, time, time - values["clock_offset"])

    def begin(self, values: Values, first: Float[Array, "marker 3"], interval: float) -> tuple[Array, Array]:
        """The last observations and their times, as far back as an offset may reach; none before the first."""
        rows = math.ceil(self.parameters[0].high / interval) + 2
        return jnp.broadcast_to(first, (rows, *first.shape)), jnp.zeros(rows)

    def check_steps(self, values: Mapping[str, Float[np.ndarray, " lane"]]) -> None:
        """Raise InputError where a session would have to show what has not happened yet."""
        if np.any(values["clock_offset"] < 0.0):
            raise InputError(
                f"clock_offset = {np.min(values['clock_offset']):g} s would show the future",
                where="a session",
                remedy="leave clock_offset out: it belongs to a recording, and a policy sees one clock",
            )

    def advance(
        self, values: Values, memory: tuple[Array, Array], given: Float[Array, "marker 3"], now: Float[Array, ""]
    ) -> tuple[tuple[Array, Array], Float[Array, "marker 3"]]:
        """Read the positions earlier."""
        position = jnp.concatenate([memory[0][1:], given[None]])
        time = jnp.concatenate([memory[1][1:], jnp.asarray(now, float)[None]])
        return (position, time), _read(position, time, now - values["clock_offset"])


def _read(
    position: Float[Array, "time marker 3"], time: Float[Array, " time"], at: Float[Array, "*when"]
) -> Float[Array, "*when marker 3"]:
    """Positions at other times, linearly between those given; beyond the ends they stand still."""
    # Not a clip, whose derivative at the first and last row would be halved.
    until = jnp.where(at > time[-1], time[-1], at)
    after = jnp.clip(jnp.searchsorted(time, until), 1, len(time) - 1)
    gap = jnp.maximum(time[after] - time[after - 1], 1e-9)
    weight = ((time[after] - until) / gap)[..., None, None]
    read = position[after] - weight * (position[after] - position[after - 1])
    return jnp.where((at > time[0])[..., None, None], read, position[0])
