"""A cable-driven rod: commands, through actuation, body and sensing, to marker positions and tensions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfdropo_bayes.fem import (
    Material,
    PointMap,
    Rod,
    System,
    attach,
    cable_layout,
    chamber_layout,
    profile_rod,
    refined,
)
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.body_engine import Engine
from rfdropo_bayes.simulators.commands import Commands
from rfdropo_bayes.simulators.control_session import Session
from rfdropo_bayes.simulators.mechanisms import Mechanism, Values
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator


@dataclass(frozen=True)
class Discretisation:
    """Discretisation of body and time: time step [s], and factor on the elements of the robot's body."""

    time_step: float
    refine: int = 1


class Assembly(NamedTuple):
    """A robot as the finite-element engines see it."""

    system: System
    markers: PointMap
    station_of: np.ndarray  # index of each of the robot's own stations in the refined body


def assemble(robot: Robot, discretisation: Discretisation) -> Assembly:
    """Cut the robot's body into elements and attach cables and markers to it."""
    cuts = discretisation.refine * np.array(robot.body.cuts())
    body = refined(profile_rod(**robot.rod_arrays()), cuts)
    system = System(body, cable_layout(body, robot.anchors(), robot.guides()), chambers=_chambers(robot, body))
    station_of = np.append(0, np.cumsum(cuts))
    return Assembly(system, attach(body, np.concatenate([robot.marker_points(), section_points(robot)])), station_of)


def _chambers(robot: Robot, body: Rod) -> np.ndarray | None:
    """Layout of a robot's chambers; None without chambers."""
    if not robot.chambers:
        return None
    middle = np.array([chamber.middle() for chamber in robot.chambers])
    ends = np.array([chamber.z_m for chamber in robot.chambers])
    return chamber_layout(body, middle, ends, [chamber.area_m2 for chamber in robot.chambers])


ARM = 0.01  # [m] Distance from the axis of the points that give a section's orientation


def section_points(robot: Robot) -> Float[np.ndarray, "point 3"]:
    """Three points of each section whose orientation is measured: on the axis, and along its x and y."""
    corners = ARM * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    middles = np.array([[0.0, 0.0, each.z_m] for each in robot.orientations]).reshape(-1, 1, 3)
    return (middles + corners).reshape(-1, 3)


@dataclass(frozen=True)
class TrunkSimulator(RobotSimulator):
    """A rod with mechanisms, behind the `Simulator` protocol."""

    robot: Robot
    engine: Engine
    assembly: Assembly
    discretisation: Discretisation  # resolution of body and time; for the others see `RobotSimulator`
    mechanisms: Sequence[Mechanism] = field(default_factory=tuple)

    @property
    def time_step(self) -> float:  # type: ignore[override]
        """Time step of the discretisation."""
        return self.discretisation.time_step

    @property
    def discretised(self) -> dict[str, object]:
        return {"body": "rod", "elements": self.assembly.system.body.elements}

    def session(self, lanes: int, period: float) -> Session:
        """A session of ``lanes`` trunks, commanded once per control ``period`` [s]; see `Session`."""
        return Session(self, lanes, period)

    def inputs(self, values: Values, commands: Commands) -> tuple[Material, Array, Array]:
        return self.material(values), *self.wound(values, commands, self.time_step)

    def material(self, values: Values) -> Material:
        body = self.assembly.system.body
        masses = jnp.zeros(len(body.station)).at[self.assembly.station_of].set(self.robot.point_masses(values))
        cuts = np.diff(self.assembly.station_of)
        scale = jnp.asarray(self.robot.stiffness_scale(values["poisson_ratio"]))[np.repeat(np.arange(len(cuts)), cuts)]
        return self.embodied(values, body, scale, masses)
