"""A cable-driven trunk: commands, through actuation, body and sensing, to marker positions and tensions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rfdropo_bayes.fem import LayeredBody, Material, PointMap, System, attach, cable_layout, prepare, profile_body
from rfdropo_bayes.fem.balance import Balance, layered_balance
from rfdropo_bayes.fem.stage_balance import stepped_balance
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.body_engine import CubeInputs, Engine
from rfdropo_bayes.simulators.commands import Commands
from rfdropo_bayes.simulators.control_session import Session
from rfdropo_bayes.simulators.mechanisms import Mechanism, Values
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator


@dataclass(frozen=True)
class Discretisation:
    """How finely the body and time are cut: nodes across a section, sub-layers per layer, and the time step [s]."""

    time_step: float
    nodes_across: int = 2
    refine: int = 1


class Assembly(NamedTuple):
    """A robot as the finite-element engines see it."""

    system: System
    markers: PointMap
    station_of: np.ndarray  # index of each of the robot's own stations in the refined body


def assemble(robot: Robot, discretisation: Discretisation) -> Assembly:
    """Cut the robot's body into layers and attach cables and markers to it."""
    arrays = dict(robot.layered_arrays())
    body = refined_body(arrays, discretisation.refine, discretisation.nodes_across)
    system = System(body, cable_layout(body, robot.anchors(), robot.guides()))
    station_of = np.arange(len(np.asarray(arrays["station"]))) * discretisation.refine
    return Assembly(system, attach(body, robot.marker_points()), station_of)


def refined_body(arrays: Mapping[str, np.ndarray | int | bool], refine: int, nodes_across: int) -> LayeredBody:
    """The body with every layer cut into ``refine`` equal layers of the same section."""
    station, half_width = np.asarray(arrays["station"]), np.asarray(arrays["half_width"])
    at = np.arange((len(station) - 1) * refine + 1) / refine
    rows = np.arange(len(station))
    sections = {
        name: np.repeat(np.asarray(value), refine, axis=0)
        for name, value in arrays.items()
        if name not in ("station", "half_width", "nodes_across", "sectional")
    }
    return profile_body(
        station=np.interp(at, rows, station),
        half_width=np.stack([np.interp(at, rows, half_width[:, i]) for i in range(2)], axis=1),
        nodes_across=nodes_across,
        sectional=bool(arrays["sectional"]),
        **sections,
    )


@dataclass(frozen=True)
class TrunkSimulator(RobotSimulator):
    """A layered trunk with mechanisms, behind the `Simulator` protocol.

    Attributes:
        discretisation: how finely the body and time are cut; for the others see `RobotSimulator`.
    """

    robot: Robot
    engine: Engine
    assembly: Assembly
    discretisation: Discretisation
    mechanisms: Sequence[Mechanism] = field(default_factory=tuple)

    @property
    def time_step(self) -> float:  # type: ignore[override]
        """That of the discretisation."""
        return self.discretisation.time_step

    @property
    def discretised(self) -> dict[str, object]:
        """See `RobotSimulator`."""
        layers = len(self.assembly.system.body.station) - 1
        return {"nodes_across": self.discretisation.nodes_across, "layers": layers}

    def session(self, lanes: int, period: float) -> Session:
        """So many trunks that are commanded one control period [s] at a time; see `Session`."""
        return Session(self, lanes, period)

    def inputs(self, values: Values, commands: Commands) -> tuple[Material, Array, Array]:
        """See `RobotSimulator`."""
        return self.material(values), *self.wound(values, commands, self.time_step)

    def balance_of(self, inputs: tuple[Material, Array, Array], cube: CubeInputs | None) -> Balance:
        """See `RobotSimulator`; the energies are those of the body."""
        system, engine = self.assembly.system, self.engine
        if engine.integrator == "euler":
            motion, prepared = self.motion_of_nodes(inputs, cube), prepare(system, inputs[0])
            return layered_balance(system, prepared, motion.position, motion.tension, self.time_step)
        material, start, displacement = inputs
        prepared, state, _ = engine.initial(material, start)
        around = () if cube is None else (engine.scene, cube.cube)
        if cube is not None:
            state = state._replace(cube=cube.start)
        return stepped_balance(system, prepared, state, displacement, self.time_step, engine.integrator, *around)

    def material(self, values: Values) -> Material:
        """See `RobotSimulator`."""
        body = self.assembly.system.body
        masses = jnp.zeros(len(body.station)).at[self.assembly.station_of].set(self.robot.point_masses(values))
        scale = jnp.repeat(jnp.asarray(self.robot.stiffness_scale(values["poisson_ratio"])), self.discretisation.refine)
        return self.embodied(values, body, scale, masses)
