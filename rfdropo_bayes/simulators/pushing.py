"""A trunk that pushes a cube on a plate, whatever body and engine move the trunk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.balance import Balance
from rfdropo_bayes.fem.layered import LayeredBody, rest_positions
from rfdropo_bayes.fem.pushing import PushScene, layered_spheres, mesh_spheres, push_scene
from rfdropo_bayes.fem.rigid_body import Cube, cube_at, solid_gyration_radius
from rfdropo_bayes.fem.tetrahedra import TetrahedralBody
from rfdropo_bayes.robots import PushScene as PushTable
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.commands import Commands
from rfdropo_bayes.simulators.engine import Backend, CubeInputs, Engine
from rfdropo_bayes.simulators.mechanisms import Mechanism
from rfdropo_bayes.simulators.mesh_trunk import MeshTrunkSimulator
from rfdropo_bayes.simulators.parameters import ParameterSpec
from rfdropo_bayes.simulators.protocol import Observation, Result
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator, Values, every_node
from rfdropo_bayes.simulators.session import Session
from rfdropo_bayes.simulators.trunk import TrunkSimulator


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


def plate_normal(robot: Robot) -> Float[np.ndarray, "3"]:
    """Unit vector against gravity, out of the plate."""
    return -robot.gravity / np.linalg.norm(robot.gravity)


def scene_of(robot: Robot, body: LayeredBody | TetrahedralBody) -> PushScene:
    """Cube and plate of a robot, before its body; its section profile without notches is the body's outline.

    Raises:
        InputError: the robot has no cube.
    """
    table = push_table(robot)
    if isinstance(body, LayeredBody):
        spheres = layered_spheres(body)
    else:
        half = np.asarray(robot.body.half_width_m, float).mean(axis=1)
        spheres = mesh_spheres(body.rest, np.asarray(robot.body.station_m, float), half)
    return push_scene(
        spheres,
        plate_normal=plate_normal(robot),
        plate_height=table.plate_height_m,
        contact_distance=table.contact_distance_m,
    )


def pushing(trunk: TrunkSimulator | MeshTrunkSimulator) -> PushSimulator:
    """A trunk with the cube and the plate of its robot before it.

    Raises:
        InputError: a robot without a cube.
    """
    scene = scene_of(trunk.robot, trunk.assembly.system.body)
    return PushSimulator(replace(trunk, engine=replace(trunk.engine, scene=scene)))


def rest_nodes(trunk: TrunkSimulator | MeshTrunkSimulator) -> Float[np.ndarray, "nodes 3"]:
    """Nodes of a trunk's undeformed body [m]."""
    body = trunk.assembly.system.body
    return rest_positions(body) if isinstance(body, LayeredBody) else body.rest


@dataclass(frozen=True)
class PushSimulator(RobotSimulator):
    """A trunk and a cube on a plate, behind the `Simulator` protocol; the cube starts at rest where it is put.

    Attributes:
        trunk: whose engine has a scene (see `pushing`); its commands, material and measurement are these.
    """

    trunk: TrunkSimulator | MeshTrunkSimulator
    unsolved: ClassVar[Result] = Result.CONTACT_NOT_CONVERGED

    @property
    def engine(self) -> Engine:
        """That of the trunk."""
        return self.trunk.engine

    @property
    def robot(self) -> Robot:  # type: ignore[override]
        """That of the trunk."""
        return self.trunk.robot

    @property
    def mechanisms(self) -> Sequence[Mechanism]:  # type: ignore[override]
        """Those of the trunk."""
        return self.trunk.mechanisms

    def with_backend(self, backend: Backend) -> PushSimulator:
        """The same, computed by another backend."""
        return replace(self, trunk=self.trunk.with_backend(backend))

    @property
    def lanes(self) -> int:
        """Those of the trunk."""
        return self.trunk.lanes

    @property
    def time_step(self) -> float:  # type: ignore[override]
        """That of the trunk."""
        return self.trunk.time_step

    @property
    def description(self) -> dict[str, object]:
        """As the trunk's."""
        return {**self.trunk.description, "object": "cube"}

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

    def session(self, lanes: int, period: float) -> Session:
        """So many trunks and cubes that are commanded one control period [s] at a time; see `Session`."""
        return Session(self, lanes, period)

    def body_inputs(self, values: Values) -> tuple[Any, CubeInputs]:
        """See `SteppedSimulator`."""
        return self.trunk.material({spec.name: values[spec.name] for spec in self.trunk.parameters}), self.cube(values)

    def cube(self, values: Values) -> CubeInputs:
        """The cube for these values."""
        side = jnp.asarray(values["cube_side"], float)
        centre = jnp.stack([jnp.asarray(values[f"cube_{axis}"], float) for axis in "xyz"])
        return CubeInputs(
            Cube(
                jnp.asarray(values["cube_mass"], float),
                side,
                solid_gyration_radius(side),
                jnp.asarray(values["friction"], float),
            ),
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
        inputs: Any = self.trunk.inputs(own, commands)
        engine = self.trunk.engine.recording(every_node(len(rest_nodes(self.trunk))))
        motion = engine.motion(inputs[0], inputs[1], inputs[2], cube=self.cube(values))
        return self.trunk.balance_of(inputs[0], motion.position, motion.tension, commands)

    def rollout(self, parameters: Values, commands: Commands, steps: Int[Array, ""] | None = None) -> Observation:
        """Simulate from the initial state to the last observation, or ``steps`` time steps; see
        `TrunkSimulator.rollout`.

        Raises:
            InputError: a name that is not a parameter of this simulator.
        """
        values = self.complete(parameters)
        own = {spec.name: values[spec.name] for spec in self.trunk.parameters}
        inputs: Any = self.trunk.inputs(own, commands)
        steps = self.trunk.steps_seen(own, commands, self.time_step, steps)
        motion = self.trunk.engine.motion(inputs[0], inputs[1], inputs[2], steps, self.cube(values))
        return self.trunk.observation(own, commands, motion, self.unsolved)
