"""One rule for sizes of mechanisms: numbers of a usual trunk, scaled to a robot by the dimension of their unit.

A play of half a millimetre is much for a robot that pulls eight, and nothing for a robot that pulls eighty. Cable
lengths scale with the pull of usual commands, other lengths with the body's length, and masses with the body's mass.
Forces scale with the tension (or thrust of a chamber) that bends the body by a usual pull: the pull times Young's
modulus over the integral of ``radius^2 / I`` along the cable. Times, angles and ratios stay, and so does the density of
a fluid around the body.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.parameters import ParameterSpec


class Scales(NamedTuple):
    """Sizes that mechanisms are measured by."""

    pull: float  # of a cable under a usual command [m]
    length: float  # of the body [m]
    mass: float  # of the body [kg]
    force: float  # tension that bends the body by a usual pull [N]


USUAL = Scales(pull=0.03, length=0.2, mass=0.2, force=10.0)
"""A silicone trunk, for which the library's numbers are given."""
POWERS: dict[str, Scales] = {
    "m": Scales(0, 1, 0, 0),
    "m/s": Scales(0, 1, 0, 0),
    "kg": Scales(0, 0, 1, 0),
    "N": Scales(0, 0, 0, 1),
    "m/N": Scales(1, 0, 0, -1),
    "N/m2": Scales(0, -2, 0, 1),
}
"""Powers of the scales in the units of mechanisms of bodies and cameras."""
WITH_UNIT = ("loc", "scale", "median", "low", "high")
"""Entries of a prior's table that have the parameter's unit."""


def scales_of(robot: Robot) -> Scales:
    """Scales of a robot at nominal parameters."""
    nominal = robot.nominal()
    courses = [*robot.guides(), *(chamber.ends() for chamber in robot.chambers)]
    give = float(np.mean([robot.body.shortening(course) for course in courses])) / nominal["young_modulus"]
    if robot.held_by_force:
        areas = np.array([1.0] * len(robot.cables) + [chamber.area_m2 for chamber in robot.chambers])
        force = robot.usual_command * float((areas @ np.abs(np.asarray(robot.channel_matrix(nominal)))).max())
        pull = force * give
    else:
        pull = robot.usual_command * float(np.abs(np.asarray(robot.channel_matrix(nominal))).max())
        force = pull / give
    return Scales(pull, robot.length, nominal["trunk_mass"], force)


def scaled(spec: ParameterSpec, factor: float) -> ParameterSpec:
    """A parameter with all that has its unit multiplied by a factor."""
    prior: dict[str, Any] = {name: factor * v if name in WITH_UNIT else v for name, v in spec.prior.items()}
    return spec._replace(
        low=factor * spec.low,
        high=factor * spec.high,
        nominal=factor * spec.nominal,
        prior=prior,
        grid=tuple(factor * value for value in spec.grid),
    )


def sized(spec: ParameterSpec, scales: Scales) -> ParameterSpec:
    """A parameter of a body's or a camera's mechanism, given for a usual trunk, in the sizes of a robot."""
    powers = POWERS.get(spec.unit)
    if powers is None:
        return spec
    ratios = np.array(scales) / np.array(USUAL)
    made = scaled(spec, float(np.prod(ratios ** np.array(powers))))
    # Bounds are limits of the physics, and never narrower than those of the usual trunk.
    return made._replace(low=min(made.low, spec.low), high=max(made.high, spec.high))
