"""Displacement that a held command loses slowly."""

from __future__ import annotations

from jaxtyping import Array, Float

from rfdropo_bayes.mechanisms.actuation import kept_over
from rfdropo_bayes.simulators.mechanisms import SteppedActuation, Values
from rfdropo_bayes.simulators.parameters import ParameterSpec


class DriveCreep(SteppedActuation):
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

    def begin(self, values: Values, first: Float[Array, " channel"], interval: float) -> tuple[Array, Array]:
        """The slowly following command, and where it started."""
        return first, first

    def advance(
        self, values: Values, memory: tuple[Array, Array], given: Float[Array, " channel"], now: float
    ) -> tuple[tuple[Array, Array], Float[Array, " channel"]]:
        """Take away a share of the slowly following command."""
        slow, start = memory
        kept = kept_over(now, values["drive_creep_time"])
        slow = given + kept * (slow - given)
        return (slow, start), given - values["drive_creep"] * (slow - start)
