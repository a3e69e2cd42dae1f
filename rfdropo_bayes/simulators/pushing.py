"""A trunk that pushes a cube on a plate, whatever body and engine move the trunk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.balance import Balance
from rfdropo_bayes.fem.layered import LayeredBody, PointMap, rest_positions
from rfdropo_bayes.fem.pushing import PushScene, push_scene
from rfdropo_bayes.fem.rigid_body import Cube, CubeState, cube_at, solid_gyration_radius
from rfdropo_bayes.robots import PushScene as PushTable
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.commands import Commands, observed_at, sample
from rfdropo_bayes.simulators.mechanisms import Mechanism
from rfdropo_bayes.simulators.mesh_trunk import MeshTrunkSimulator
from rfdropo_bayes.simulators.parameters import ParameterSpec
from rfdropo_bayes.simulators.protocol import Observation, Result
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator, Values, every_node
from rfdropo_bayes.simulators.trunk import EQUILIBRIUM_TOLERANCE, TrunkSimulator

BANDS_PER_METRE = 230.0
"""Bands of the surface along the axis that each may touch once: about four to a vertebra of the trunk."""


class CubeInputs(NamedTuple):
    """The cube of one rollout."""

    cube: Cube
    friction: Float[Array, ""]
    start: CubeState


class PushMotion(NamedTuple):
    """What an engine returns: rows are time steps, row 0 is the initial state."""

    position: Float[Array, "row marker 3"]
    tension: Float[Array, "row cable"]
    pose: Float[Array, "row 7"]  # of the cube: centre [m] and unit quaternion (x, y, z, w)
    diverged: Bool[Array, ""]
    cables_converged: Bool[Array, ""]
    contacts_converged: Bool[Array, ""]
    imbalance: Float[Array, ""]  # relative unbalanced force of the initial equilibrium; 0 for a start at rest


class PushEngine(Protocol):
    """Computes the motion of a trunk and a cube.

    Attributes:
        lanes: how many rollouts it likes to be given at once.
    """

    lanes: ClassVar[int]

    @property
    def trunk(self) -> TrunkSimulator | MeshTrunkSimulator:
        """The trunk without cube: its body, commands and material."""

    @property
    def time_step(self) -> float:
        """Time step of the simulation [s]."""

    def describe(self) -> dict[str, object]:
        """Name and precision, for the record."""

    def motion(self, values: Values, commands: Commands, cube: CubeInputs) -> PushMotion:
        """Roll out with these parameters of the trunk."""

    def recording(self, points: PointMap) -> PushEngine:
        """The same engine in double precision, recording these points of the body in place of the markers."""


def push_table(robot: Robot) -> PushTable:
    """The robot's cube and plate.

    Raises:
        InputError: the robot has none.
    """
    if robot.push is None:
        raise InputError(
            f"robot {robot.name!r} has no cube to push", where="[simulator] push", remedy="use push = false"
        )
    return robot.push


def bands_along(length: float) -> int:
    """Number of bands of a surface of that length [m]."""
    return round(BANDS_PER_METRE * length)


def plate_normal(robot: Robot) -> Float[np.ndarray, "3"]:
    """Unit vector against gravity, out of the plate."""
    return -robot.gravity / np.linalg.norm(robot.gravity)


def scene_of(robot: Robot, surface: PointMap, rest: Float[np.ndarray, "nodes 3"]) -> PushScene:
    """Cube and plate of a robot whose surface points are bound to nodes at ``rest`` [m]."""
    table = push_table(robot)
    height = np.einsum("pk,pk->p", surface.weight, rest[surface.node, 2])
    return push_scene(
        surface,
        height,
        bands_along(float(np.ptp(height))),
        plate_normal=plate_normal(robot),
        plate_height=table.plate_height_m,
        contact_distance=table.contact_distance_m,
    )


Trunk = TypeVar("Trunk", TrunkSimulator, MeshTrunkSimulator)


def with_markers(trunk: Trunk, points: PointMap) -> Trunk:
    """The trunk with other recorded points."""
    return replace(trunk, assembly=trunk.assembly._replace(markers=points))


def rest_nodes(trunk: TrunkSimulator | MeshTrunkSimulator) -> Float[np.ndarray, "nodes 3"]:
    """Nodes of a trunk's undeformed body [m]."""
    body = trunk.assembly.system.body
    return rest_positions(body) if isinstance(body, LayeredBody) else body.rest


@dataclass(frozen=True)
class PushSimulator(RobotSimulator):
    """A trunk and a cube on a plate, behind the `Simulator` protocol; the cube starts at rest where it is put.

    Attributes:
        engine: what computes the motion of both, and the trunk without cube, whose commands, material and measurement
            are these.
    """

    engine: PushEngine

    @property
    def trunk(self) -> TrunkSimulator | MeshTrunkSimulator:
        """The trunk without cube."""
        return self.engine.trunk

    @property
    def robot(self) -> Robot:  # type: ignore[override]
        """That of the trunk."""
        return self.trunk.robot

    @property
    def mechanisms(self) -> Sequence[Mechanism]:  # type: ignore[override]
        """Those of the trunk."""
        return self.trunk.mechanisms

    @property
    def lanes(self) -> int:
        """Those of the engine."""
        return self.engine.lanes

    @property
    def description(self) -> dict[str, object]:
        """As the trunk's, with the engine that computes the contacts."""
        return {**self.trunk.description, **self.engine.describe(), "object": "cube"}

    @cached_property
    def parameters(self) -> tuple[ParameterSpec, ...]:  # type: ignore[override]
        """Parameters of the trunk, then those of the cube."""
        return self.trunk.parameters + tuple(
            ParameterSpec(name, p.unit, p.low, p.high, p.nominal, p.prior, p.description)
            for name, p in push_table(self.robot).parameters.items()
        )

    def commands(
        self,
        time: Float[np.ndarray, " command"],
        value: Float[np.ndarray, "command channel"],
        initial: Float[np.ndarray, " channel"],
        observation_time: Float[np.ndarray, " time"],
    ) -> Commands:
        """Recorded commands on the trunk's clock."""
        return self.trunk.commands(time, value, initial, observation_time)

    def cube(self, values: Values) -> CubeInputs:
        """The cube for these values."""
        side = jnp.asarray(values["cube_side"], float)
        centre = jnp.stack([jnp.asarray(values[f"cube_{axis}"], float) for axis in "xyz"])
        return CubeInputs(
            Cube(jnp.asarray(values["cube_mass"], float), side, solid_gyration_radius(side)),
            jnp.asarray(values["friction"], float),
            cube_at(centre, values["cube_yaw"], plate_normal(self.robot)),
        )

    def with_object_at(self, values: Mapping[str, Any], pose: Float[Any, "7"]) -> dict[str, Any]:
        """Values with the cube where it was measured, less the offset of the measuring frame, standing on the plate.

        Args:
            values: of one rollout, or of many (arrays of one shape); what is left out is nominal.
            pose: measured centre [m] and unit quaternion (x, y, z, w).
        """
        nominal = {spec.name: spec.nominal for spec in self.parameters}
        known = {**nominal, **values}
        normal = plate_normal(self.robot)
        offset = [known[f"offset_{axis}"] for axis in "xyz"]
        centre = jnp.stack(
            jnp.broadcast_arrays(*(jnp.asarray(p - o) for p, o in zip(pose[:3], offset, strict=True))), -1
        )
        table = push_table(self.robot)
        height = table.plate_height_m + table.contact_distance_m + 0.5 * jnp.asarray(known["cube_side"])
        centre = centre + (height - centre @ normal)[..., None] * normal
        yaw = 2.0 * jnp.arctan2(jnp.asarray(pose[3:6]) @ normal, pose[6])
        yaw = jnp.broadcast_to((yaw + jnp.pi) % (2.0 * jnp.pi) - jnp.pi, centre.shape[:-1])
        return {**values, "cube_yaw": yaw} | {f"cube_{axis}": centre[..., i] for i, axis in enumerate("xyz")}

    def balance(self, parameters: Values, commands: Commands) -> Balance:
        """See `RobotSimulator.balance`; the energies are those of the trunk."""
        values = self.complete(parameters)
        own = {spec.name: values[spec.name] for spec in self.trunk.parameters}
        nodes = len(rest_nodes(self.trunk))
        motion = self.engine.recording(every_node(nodes)).motion(own, commands, self.cube(values))
        material: Any = self.trunk.material(own)
        return self.trunk.balance_of(material, motion.position, motion.tension, commands)

    def rollout(self, parameters: Values, commands: Commands, steps: Int[Array, ""] | None = None) -> Observation:
        """Simulate from the initial state to the last observation; all steps are computed, whatever ``steps`` says.

        Raises:
            InputError: a name that is not a parameter of this simulator.
        """
        values = self.complete(parameters)
        own = {spec.name: values[spec.name] for spec in self.trunk.parameters}
        motion = self.engine.motion(own, commands, self.cube(values))
        status = jnp.where(
            motion.diverged,
            int(Result.DIVERGED),
            jnp.where(
                ~motion.cables_converged,
                int(Result.CABLE_LIMIT),
                jnp.where(
                    motion.imbalance > EQUILIBRIUM_TOLERANCE,
                    int(Result.NOT_IN_EQUILIBRIUM),
                    jnp.where(motion.contacts_converged, int(Result.OK), int(Result.CONTACT_NOT_CONVERGED)),
                ),
            ),
        )
        pose = sample(motion.pose, commands)
        pose = pose.at[:, 3:].divide(jnp.linalg.norm(pose[:, 3:], axis=1, keepdims=True))
        position = self.trunk.measured(
            own, sample(motion.position, commands), observed_at(commands, self.engine.time_step)
        )
        angle = self.trunk.driven(own, commands, self.engine.time_step)
        return Observation(position, sample(motion.tension, commands), pose, status, angle)
