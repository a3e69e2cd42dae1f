"""Implausible numbers in a robot's description, such as millimetres given as metres.

Bounds lie far beyond existing robots: they catch wrong units (factors of a thousand), not bad guesses.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from rfdropo_bayes.robots.robot import Robot

ASIDE = 20.0
"""Largest plausible anchor radius, half width or spool radius, in body lengths. The bundled robots reach 0.08 of it;
millimetres given as metres are fifty times the length or more.
"""
LONGEST, SHORTEST = 20.0, 1e-3  # [m], of a body
STRONGEST = 100.0  # [m/s2], ten times the Earth's gravity; that in mm/s2 is a hundred times as much
SLOWEST = 1.0  # [s], of a time step
DENSITIES = 1.0, 3e4  # [kg/m3]: less than any foam has, and more than any metal
MODULI = 10.0, 1e13  # [Pa]: softer than any gel, and stiffer than diamond


def implausible(robot: Robot) -> str | None:
    """Description of a value in an implausible unit; None if all are plausible."""
    station, half = np.array(robot.body.station_m), np.array(robot.body.half_width_m)
    length = float(station[-1] - station[0])
    if not SHORTEST <= length <= LONGEST:
        return f"the body is {length:.4g} m long: are lengths in metres?"
    sizes = {"half_width_m of the body": float(half.max())}
    for cable in robot.cables:
        sizes[f"anchor_radius_m of the cable {cable.name}"] = cable.anchor_radius_m
        sizes[f"distance of anchor_z_m of the cable {cable.name} from the body"] = station[0] - cable.anchor_z_m
    sizes |= {f"radius_m of the chamber {chamber.name}": chamber.radius_m for chamber in robot.chambers}
    if robot.channels.radius_parameter is not None:
        sizes[robot.channels.radius_parameter] = robot.parameters[robot.channels.radius_parameter].nominal
    for name, size in sizes.items():
        if size > ASIDE * length:
            return f"the {name} is {size:.4g} m, and the body is {length:.4g} m long: are all lengths in metres?"
    gravity = float(np.linalg.norm(robot.gravity_m_s2))
    if gravity > STRONGEST:
        return f"gravity_m_s2 is {gravity:.4g} m/s2: is it in metres?"
    if robot.time_step_s > SLOWEST:
        return f"time_step_s is {robot.time_step_s:.4g} s: is it in seconds?"
    nominal = {name: (parameter.nominal, parameter.nominal) for name, parameter in robot.parameters.items()}
    return implausible_values(robot, nominal)


def implausible_values(robot: Robot, ranges: Mapping[str, tuple[float, float]]) -> str | None:
    """Description of an implausible mass or stiffness of the body; None if all are plausible.

    Args:
        robot: robot with this body.
        ranges: least and largest likely value of each parameter [SI], by name; a range is implausible only if it lies
            entirely outside the plausible values.
    """
    for name, (low, high) in ranges.items():
        if name == "trunk_mass" and (found := _beyond(robot.density(low), robot.density(high), DENSITIES)):
            volume = f"a volume of {robot.body.volume_m3:.4g} m3"
            return (
                f"trunk_mass is {_words(low, high)} kg in {volume}, or {found:.3g} kg/m3: are they in kilograms and "
                "cubic metres?"
            )
        if name == "young_modulus" and _beyond(low, high, MODULI):
            return f"young_modulus is {_words(low, high)} Pa: is it in pascals?"
    return None


def _beyond(low: float, high: float, ends: tuple[float, float]) -> float | None:
    """The end of a range nearest to the plausible values, if the range is entirely outside them; None otherwise."""
    if high < ends[0]:
        return float(high)
    return float(low) if low > ends[1] else None


def _words(low: float, high: float) -> str:
    return f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
