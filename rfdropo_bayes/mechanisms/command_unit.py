"""Mechanisms whose sizes are in the unit of the commands: metres of cable, or radians of a motor."""

from __future__ import annotations

from typing import ClassVar

from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.parameters import ParameterSpec

SPOOL = 0.02  # [m], a usual radius: a prior for metres of cable becomes one for radians of the motor that winds it
POWERS = {"m": 1, "m/s": 1, "1/m": -1, "s/m": -1}  # of a length in each unit
SIZES = ("loc", "scale")  # entries of a prior's table that have the parameter's unit


class InCommandUnit:
    """Base of such mechanisms: a class gives its parameters for metres of cable.

    Args:
        unit: of the commands, "m" or "rad".
    """

    parameters: tuple[ParameterSpec, ...]
    in_metres: ClassVar[tuple[ParameterSpec, ...]]

    def __init__(self, unit: str = "m") -> None:
        self.parameters = self.in_metres if unit == "m" else tuple(turned(spec) for spec in self.in_metres)

    @classmethod
    def for_robot(cls, robot: Robot) -> InCommandUnit:
        """With parameters in the unit that a robot is commanded in."""
        return cls(robot.command_unit)


def turned(spec: ParameterSpec) -> ParameterSpec:
    """A parameter given for metres of cable, for radians of a motor with a usual spool."""
    factor = SPOOL ** -POWERS[spec.unit]
    return spec._replace(
        unit="rad".join(spec.unit.rsplit("m", 1)),
        low=factor * spec.low,
        high=factor * spec.high,
        nominal=factor * spec.nominal,
        prior={name: factor * value if name in SIZES else value for name, value in spec.prior.items()},
        grid=tuple(factor * value for value in spec.grid),
    )
