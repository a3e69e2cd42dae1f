"""Displacement that a held command loses slowly."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.mechanisms.actuation import kept_over
from rfdropo_bayes.simulators.mechanisms import Values
from rfdropo_bayes.simulators.parameters import ParameterSpec


class DriveCreep:
    """A share of every displacement is given back with a time constant, as by a creeping cable; no share at null."""

    name = "drive_creep"
    stage = "actuation"
    inside_drive = False
    cause = "creep of the cables or of their anchorage under load"
    remedy = "hold one command for minutes and watch the pose; stretch new cables before use"
    parameters = (
        ParameterSpec(
            "drive_creep",
            "-",
            -0.9,
            0.9,
            0.0,
            {"distribution": "Normal", "loc": 0.0, "scale": 0.1},
            "share of a displacement that is lost in the end",
        ),
        ParameterSpec(
            "drive_creep_time",
            "s",
            1e-2,
            1e3,
            1.0,
            {"distribution": "LogNormal", "median": 1.0, "sigma": 1.2},
            "time constant of the loss",
            grid=(0.2, 0.5, 1.5, 5.0, 20.0),
        ),
    )

    def actuate(
        self, values: Values, command: Float[Array, "step channel"], initial: Float[Array, " channel"], time_step: float
    ) -> Float[Array, "step channel"]:
        """Take away a share of the slowly following command."""
        kept = kept_over(time_step, values["drive_creep_time"])

        def relax(last: Array, sent: Array) -> tuple[Array, Array]:
            slow = sent + kept * (last - sent)
            return slow, slow

        start = jnp.asarray(initial, command.dtype)
        slow = jax.lax.scan(relax, start, command)[1]
        return command - values["drive_creep"] * (slow - start)
