"""A trunk whose body is a tetrahedral mesh: options, how cables, markers and masses are bound to it, its simulator.

With SOFA's options it is SOFA's trunk to its last digit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from pydantic import BaseModel, ConfigDict, Field

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.cable_drive import DriveLimits
from rfdropo_bayes.fem.mesh_points import NodePoints, joined
from rfdropo_bayes.fem.rod import Rod, profile_rod
from rfdropo_bayes.fem.tetrahedra import (
    TetrahedralBody,
    TetrahedralMaterial,
    TetrahedralSystem,
    locate,
    lumped_masses,
    mean_points,
    route_cables,
    tetrahedral_body,
)
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.robots.meshes import TetrahedralMesh
from rfdropo_bayes.simulators.body_engine import Engine
from rfdropo_bayes.simulators.commands import Commands, animated_on_grid
from rfdropo_bayes.simulators.mechanisms import Mechanism, Values
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator

SAME_HEIGHT = 1e-5
"""[m] A marker within this distance of the height of guides is their mean, if markers are means of guides."""


class TetrahedraTable(BaseModel):
    """[simulator.tetrahedra]: a mesh for the body, and how it is simulated."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    mesh: str = Field(description="mesh file (VTK, Gmsh), in the folders of recordings")
    unit: Literal["m", "cm", "mm"] = Field(
        description="unit of the mesh's coordinates, in the frame of the robot's base"
    )
    clamp_height: float = Field(description="height [m] at or below which nodes are fixed")
    frames: Literal["polar", "edges"] = Field(
        default="polar",
        description="frame of an element: the rotation nearest to its deformation, or axes along its edges "
        '(SOFA\'s "large")',
    )
    masses: Literal["equal", "volume"] = Field(
        default="volume",
        description="the trunk's mass in equal parts on all nodes (SOFA's UniformMass), or with the elements' volumes",
    )
    drives: Literal["robot", "sofa"] = Field(
        default="robot",
        description='"robot" follows the robot\'s ramp, lag and end stops; "sofa" applies a command in equal updates, '
        "as an animation of SOFA's STLIB does, and limits cables as SOFA's CableConstraint does",
    )
    drive_rate: Annotated[float, Field(gt=0.0)] | None = Field(
        default=None,
        description=(
            'largest change of the imposed displacement from the last measured displacement [m per step]; for "sofa"'
        ),
    )
    marker_cables: tuple[str, ...] = Field(
        default=(),
        description="cables at whose guides markers lie: a marker is then the mean of the guides at its height; if "
        "empty, markers are points of the body",
    )


class MeshAssembly(NamedTuple):
    """A robot with a mesh for its body as the finite-element engines see it."""

    system: TetrahedralSystem
    markers: NodePoints
    node_share: Float[np.ndarray, " nodes"]  # of the trunk's mass
    layer: Int[np.ndarray, " elements"]  # layer of the robot's section profile that an element lies in
    station_share: Float[np.ndarray, "nodes stations"]  # of a mass at a station of the robot, on each node


def assemble_mesh(robot: Robot, mesh: TetrahedralMesh, table: TetrahedraTable) -> MeshAssembly:
    """Bind a robot's cables, markers and masses to a mesh.

    Raises:
        InputError: options that do not fit the robot, or a mesh that nothing holds or that does not hang together.
    """
    if robot.initial_state != "rest":
        raise InputError(
            f"robot {robot.name!r} starts in equilibrium, a body of tetrahedra at rest",
            where="[simulator] body",
            remedy='use body = "rod", or a robot with initial_state = "rest"',
        )
    if robot.held_by_force:
        words = f"robot {robot.name!r} is driven by forces, a body of tetrahedra by displacements of cables"
        raise InputError(words, where="[simulator] body", remedy='use body = "rod"')
    _check_cables(robot, table)
    body = tetrahedral_body(mesh.position, mesh.element, mesh.position[:, 2] <= table.clamp_height, table.frames)
    guides = robot.guides()
    cables = route_cables(body, robot.anchors(), guides)
    limits = DriveLimits(np.full(len(guides), np.inf))
    if table.drives == "sofa":
        limits = DriveLimits(robot.drive_limits()[:, 1], table.drive_rate or np.inf)
    share = np.asarray(lumped_masses(body, 1.0 / body.volume.sum()))
    if table.masses == "equal":
        share = np.full(body.nodes, 1.0 / body.nodes)
    station = np.asarray(robot.body.station_m)
    layer = np.searchsorted(station, body.rest[body.element, 2].mean(axis=1), side="right") - 1
    return MeshAssembly(
        TetrahedralSystem(body, cables, limits),
        _markers(robot, body, dict(zip(robot.cable_names, guides, strict=True)), table.marker_cables),
        share,
        np.clip(layer, 0, len(station) - 2),
        _station_share(body, station),
    )


def _check_cables(robot: Robot, table: TetrahedraTable) -> None:
    where = "[simulator.tetrahedra]"
    known = ", ".join(robot.cable_names)
    for name in table.marker_cables:
        if name not in robot.cable_names:
            raise InputError(f"the robot has no cable {name!r}", where=where, remedy=f"its cables: {known}")
    if table.drive_rate is not None and table.drives != "sofa":
        raise InputError('drive_rate has no effect without drives = "sofa"', where=where, remedy="leave it out")


def _markers(
    robot: Robot, body: TetrahedralBody, guides: dict[str, np.ndarray], marker_cables: tuple[str, ...]
) -> NodePoints:
    maps = {name: locate(body, guides[name]) for name in marker_cables}
    rows = []
    for name, point in zip(robot.marker_names, robot.marker_points(), strict=True):
        near = {cable: np.abs(guides[cable][:, 2] - point[2]) < SAME_HEIGHT for cable in marker_cables}
        near_points = [NodePoints(*(part[at][:1] for part in maps[cable])) for cable, at in near.items() if at.any()]
        if len(near_points) not in (0, len(marker_cables)):
            raise InputError(
                f"marker {name!r} is at the height of a guide of some cables but not of all",
                where="[simulator.tetrahedra] marker_cables",
                remedy="name cables whose guides share their heights",
            )
        rows.append(mean_points(near_points) if near_points else locate(body, point[None]))
    return joined(rows)


def _station_share(body: TetrahedralBody, station: Float[np.ndarray, " stations"]) -> np.ndarray:
    """Distribution of a mass at a station to nodes: on the mesh edges that cross the station's plane, with its centre
    at that height.
    """
    pairs = np.array([(a, b) for a in range(4) for b in range(a + 1, 4)])
    edge = np.unique(np.sort(body.element[:, pairs].reshape(-1, 2), axis=1), axis=0)
    height = body.rest[edge, 2]
    share = np.zeros((len(body.rest), len(station)))
    for index, plane in enumerate(np.clip(station, height.min(), height.max())):
        lower, upper = (height - plane).T
        crosses = (lower * upper <= 0.0) & (lower != upper)
        way = lower[crosses] / (lower[crosses] - upper[crosses])
        np.add.at(share[:, index], edge[crosses, 0], 1.0 - way)
        np.add.at(share[:, index], edge[crosses, 1], way)
    return share / share.sum(axis=0)


@dataclass(frozen=True)
class MeshTrunkSimulator(RobotSimulator):
    """A trunk of tetrahedra with mechanisms, behind the `Simulator` protocol, started undeformed.

    Mechanisms of the body see the robot's layers and stations; their effect on a layer applies to its elements, and a
    mass at a station rests on the section at its height.
    """

    robot: Robot
    engine: Engine
    assembly: MeshAssembly
    options: TetrahedraTable  # settings of the mesh; for the others see `RobotSimulator`
    time_step: float
    mechanisms: Sequence[Mechanism] = field(default_factory=tuple)

    @property
    def discretised(self) -> dict[str, object]:
        """See `RobotSimulator`; with the options."""
        body, options = self.assembly.system.body, self.options.model_dump(exclude={"unit"})
        return {"body": "tetrahedra", "nodes": body.nodes, "elements": len(body.element), **options}

    def commands(
        self,
        time: Float[np.ndarray, " command"],
        value: Float[np.ndarray, "command channel"],
        initial: Float[np.ndarray, " channel"],
        observation_time: Float[np.ndarray, " time"],
    ) -> Commands:
        """Recorded commands on the simulator's clock, interpolated as by its drives."""
        if self.options.drives == "sofa":
            return animated_on_grid(time, value, initial, observation_time, time_step=self.time_step)
        return super().commands(time, value, initial, observation_time)

    def inputs(self, values: Values, commands: Commands) -> tuple[TetrahedralMaterial, Array, Array]:
        displacement = self.displacements(values, commands)
        return self.material(values), jnp.zeros_like(displacement[0]), displacement

    def displacements(self, values: Values, commands: Commands) -> Float[Array, "step cable"]:
        """Commanded cable displacements [m] at the end of every step; SOFA's limits belong to the engine."""
        if self.options.drives == "robot":
            return self.wound(values, commands, self.time_step)[1]
        command = self.actuated(values, commands, self.time_step)[1]
        return command @ jnp.asarray(self.robot.channel_matrix(values)).T + self.pretension(values)

    @cached_property
    def _layers(self) -> Rod:
        return profile_rod(**self.robot.rod_arrays())

    def material(self, values: Values) -> TetrahedralMaterial:
        layers = self._layers
        masses = jnp.asarray(self.robot.point_masses(values))
        material = self.embodied(values, layers, jnp.ones(layers.elements), masses)
        assembly = self.assembly
        trunk_mass = material.density * self.robot.body.volume_m3
        return TetrahedralMaterial(
            young_modulus=material.young_modulus,
            poisson_ratio=material.poisson_ratio,
            node_mass=assembly.node_share * trunk_mass + assembly.station_share @ material.point_mass,
            rayleigh_mass=material.rayleigh_mass,
            rayleigh_stiffness=material.rayleigh_stiffness,
            gravity=material.gravity,
            stiffness_scale=material.stiffness_scale[assembly.layer],
        )
