"""Common base of simulators of a robot with cables or chambers, with any body: parameters, drives and measurement."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem import Material, Rod
from rfdropo_bayes.fem.rollouts import Motion
from rfdropo_bayes.robots import Robot, Travel
from rfdropo_bayes.simulators.body_engine import QUASI_STATIC, Backend, CubeInputs, Engine
from rfdropo_bayes.simulators.body_lanes import BodyLanes, LaneStart, body_lanes
from rfdropo_bayes.simulators.commands import Commands, commands_on_grid, observed_at, sample
from rfdropo_bayes.simulators.cube import cube_at_measured, cube_inputs, push_table, scene_of
from rfdropo_bayes.simulators.extended import ExtendedSimulator, Wound
from rfdropo_bayes.simulators.mechanisms import (
    BodyMechanism,
    Meanwhile,
    Mechanism,
    PushingMechanism,
    Values,
    bodies_of,
    check_mechanisms,
    code_of,
    motions_of,
    needs_cables,
)
from rfdropo_bayes.simulators.parameters import ParameterSpec, specs_of
from rfdropo_bayes.simulators.port_signals import BodySignals
from rfdropo_bayes.simulators.protocol import Observation, Result

PASSES = 2
"""Number of fixed-point iterations for laws that depend on the motion: after two, a pull and a softening are within 5 %
of their effect after eight.
"""
DAMPING = ("rayleigh_mass", "rayleigh_stiffness")  # parameters that a body at rest does not have
SOFT = 1e4
"""[m/N] Compliance between a cable and a drive that holds its tension: a length of 1 m changes the tension by 0.1
mN.
"""
DYNAMIC = 'set motion = "dynamic" under [simulator]'
EQUILIBRIUM_TOLERANCE = 1e-3
"""Static equilibrium counts as found when the unbalanced force is below this share of the largest force."""


def status_of(motion: Motion, unsolved: Result, arrays: Any = jnp) -> Int[Any, "*batch"]:
    """Result codes of rollouts; ``unsolved`` is the code for unsolved constraints, ``arrays`` is ``numpy`` or
    ``jax.numpy``.
    """
    cases = motion.diverged, motion.imbalance > EQUILIBRIUM_TOLERANCE, ~motion.converged
    codes = Result.DIVERGED, Result.NOT_IN_EQUILIBRIUM, unsolved
    return arrays.select(cases, [int(code) for code in codes], int(Result.OK))


def orientations(points: Float[Array, "time point 3"]) -> Float[Array, "time section 4"]:
    """Unit quaternions (x, y, z, w) of sections, given three points of each: on its axis, and along its x and y."""
    corner = points.reshape(len(points), -1, 3, 3)
    along, beside = corner[:, :, 1] - corner[:, :, 0], corner[:, :, 2] - corner[:, :, 0]
    x = along / jnp.linalg.norm(along, axis=-1, keepdims=True)
    beside = beside - jnp.sum(beside * x, axis=-1, keepdims=True) * x
    y = beside / jnp.linalg.norm(beside, axis=-1, keepdims=True)
    z = jnp.cross(x, y)
    # Four formulas for the quaternion, each accurate if its own component is large.
    a, e, i = x[..., 0], y[..., 1], z[..., 2]
    p, q, r = y[..., 2] - z[..., 1], z[..., 0] - x[..., 2], x[..., 1] - y[..., 0]
    u, v, w = x[..., 1] + y[..., 0], x[..., 2] + z[..., 0], y[..., 2] + z[..., 1]
    ways = jnp.stack(
        [
            jnp.stack([1.0 + a - e - i, u, v, p], axis=-1),
            jnp.stack([u, 1.0 - a + e - i, w, q], axis=-1),
            jnp.stack([v, w, 1.0 - a - e + i, r], axis=-1),
            jnp.stack([p, q, r, 1.0 + a + e + i], axis=-1),
        ],
        axis=-2,
    )
    largest = jnp.argmax(jnp.stack([a - e - i, e - a - i, i - a - e, a + e + i], axis=-1), axis=-1)
    quaternion = jnp.take_along_axis(ways, largest[..., None, None], axis=-2)[..., 0, :]
    return quaternion / jnp.linalg.norm(quaternion, axis=-1, keepdims=True)


class RobotSimulator(ExtendedSimulator):
    """Base of simulators that move a robot's body by cables, alone or with a cube on a plate before it.

    Order of a rollout: command -> actuation mechanisms -> cable displacements within their limits -> body with its
    mechanisms, and cube -> markers -> sensing mechanisms -> observation. A cube starts at rest at its given pose.
    """

    robot: Robot  # simulated robot
    engine: Engine  # engine of the motion of the body, and of a cube if it has a scene
    assembly: Any  # the discretised robot that the engine was made for
    mechanisms: Sequence[Mechanism]  # extensions, applied in the given order within each stage
    time_step: float  # time step of the simulation [s]

    def __post_init__(self) -> None:
        object.__setattr__(self, "mechanisms", check_mechanisms(self.mechanisms))

    @property
    def description(self) -> dict[str, object]:
        """Engine, precision, discretisation, options and mechanisms, for the record."""
        return {
            **self.engine.describe(),
            "robot": self.robot.name,
            "time_step_s": self.time_step,
            **self.discretised,
            "mechanisms": [mechanism.name for mechanism in self.mechanisms],
            "content_sha256": self.content_sha256,
            **({"object": "cube"} if self.pushes else {}),
        }

    @property
    def shown(self) -> int:
        """Number of engine points that are markers; later points give orientations of sections."""
        return len(self.robot.markers)

    @property
    def section_names(self) -> tuple[str, ...]:
        """Sections of the robot with a simulated orientation."""
        return self.robot.section_names

    @property
    def at_rest(self) -> bool:
        """Whether every observation shows an equilibrium, found from the observation before: no time step, no
        damping.
        """
        return self.engine.at_rest

    @property
    def discretised(self) -> dict[str, object]:
        """Discretisation of the body, for records."""
        raise NotImplementedError

    def inputs(self, values: Values, commands: Commands) -> tuple[Any, Array, Array]:
        """Inputs of the engine: material, and cable displacements before the first and at each step."""
        raise NotImplementedError

    def material(self, values: Values) -> Any:
        """Material of the body for these values, body mechanisms included."""
        raise NotImplementedError

    @property
    def pushes(self) -> bool:
        """Whether a cube stands before the robot."""
        return self.engine.scene is not None

    @property
    def unsolved(self) -> Result:
        """Result code of a rollout with unsolved constraints."""
        return Result.CONTACT_NOT_CONVERGED if self.pushes else Result.CABLE_LIMIT

    @property
    def lanes(self) -> int:
        """Preferred number of rollouts per call, from the engine."""
        return self.engine.lanes

    def with_backend(self, backend: Backend) -> Self:
        """The simulator with another backend."""
        return replace(self, engine=replace(self.engine, backend=backend))  # type: ignore[type-var]

    def pushing(self) -> Self:
        """The simulator with the robot's cube and plate.

        Raises:
            InputError: a robot without a cube.
        """
        scene = scene_of(self.robot, self.assembly.system.body)
        return replace(self, engine=replace(self.engine, scene=scene))  # type: ignore[type-var]

    def commands(
        self,
        time: Float[np.ndarray, " command"],
        value: Float[np.ndarray, "command channel"],
        initial: Float[np.ndarray, " channel"],
        observation_time: Float[np.ndarray, " time"],
    ) -> Commands:
        """Recorded commands on the simulator's clock, with the robot's ramp and dead time.

        Within a time step commands change linearly. A change that takes less time is spread over a step about its
        middle: if it began at its time, it would be half a step late.
        """
        ramp, dead_time = self.robot.command.ramp_s, self.robot.command.dead_time_s
        if not self.at_rest and ramp < self.time_step:
            ramp, dead_time = self.time_step, dead_time - 0.5 * (self.time_step - ramp)
        return commands_on_grid(
            time, value, initial, observation_time, time_step=self.time_step, ramp=ramp, dead_time=dead_time
        )

    def body_inputs(self, values: Values) -> tuple[Any, CubeInputs | None]:
        """Material of the body, and the cube before it, for these values."""
        return self.material(values), cube_inputs(self.robot, values) if self.pushes else None

    def taken(
        self, recording: str, initial: Float[np.ndarray, " channel"], value: Float[np.ndarray, "command channel"]
    ) -> Float[np.ndarray, "command channel"]:
        """See `ExtendedSimulator.taken`; the robot states the effect of commands beyond the travel.

        Raises:
            InputError: the stated limits of drives do not fit the recording; see `robots.travel_in`.
        """
        travel = self.robot.travel(recording, initial)
        return value if travel is None else travel.follow(initial, value)

    def rollout(self, parameters: Values, commands: Commands, steps: Int[Array, ""] | None = None) -> Observation:
        """Simulate from the initial state to the last observation.

        Args:
            parameters: values by name; missing values are nominal.
            commands: see `commands`.
            steps: number of time steps, extended by the look-ahead of mechanisms of sensing; later rows are
                meaningless. None simulates all and is differentiable in reverse mode.

        Raises:
            InputError: a name that is not a parameter of this simulator.
        """
        values = self.complete(parameters)
        steps = self.steps_seen(values, commands, self.time_step, steps)
        loads = self.loads(values, commands)
        following = [m for m in self.mechanisms if isinstance(m, PushingMechanism) and m.follows_motion]
        for _ in range(PASSES if following else 0):
            path = self._path(self._motion(values, commands, steps, loads), commands)
            loads = self.loads(values, commands, path)
        return self.observation(values, commands, self._motion(values, commands, steps, loads), self.unsolved)

    def path(self, parameters: Values, commands: Commands) -> Float[Array, "row 3"]:
        """Path of the last marker before the first step and at the end of each [m], in the base frame, without laws
        that depend on the motion.
        """
        values = self.complete(parameters)
        return self._path(self._motion(values, commands, None, self.loads(values, commands)), commands)

    def _motion(
        self, values: Values, commands: Commands, steps: Int[Array, ""] | None, loads: BodySignals | None
    ) -> Motion:
        """The motion of the body: a row before the first step and at the end of each; of a body at rest before the
        first observation and at each."""
        cube, (material, start, displacement) = self.body_inputs(values)[1], self.inputs(values, commands)
        if self.at_rest:
            displacement = sample(jnp.concatenate([start[None], displacement]), commands)
            if loads is not None:
                loads = jax.tree.map(lambda part: jnp.concatenate([part[:1], sample(part, commands)]), loads)
            if steps is not None:
                steps = jnp.sum(commands.sample_step + (commands.sample_fraction > 0) <= steps)
        return self.engine.motion(material, start, displacement, steps, cube, loads)

    def _path(self, motion: Motion, commands: Commands) -> Float[Array, "row 3"]:
        """Path of the last marker before the first step and at the end of each [m]; linear between observations of a
        body at rest.
        """
        tip = motion.position[:, self.shown - 1]
        if not self.at_rest:
            return tip
        at = jnp.concatenate([jnp.zeros(1), commands.sample_step + commands.sample_fraction])
        rows = jnp.arange(len(commands.step) + 1.0)
        return jnp.stack([jnp.interp(rows, at, tip[:, axis]) for axis in range(3)], axis=1)

    def _seen(self, series: Float[Array, "row ..."], commands: Commands) -> Float[Array, "time ..."]:
        """The rows of a motion that are observed."""
        return series[1:] if self.at_rest else sample(series, commands)

    def loads(
        self, values: Values, commands: Commands, path: Float[Array, "row 3"] | None = None
    ) -> BodySignals | None:
        """Loads on the body from step to step: signals of the commands, and mechanisms; None without loads.

        Args:
            values: values of all parameters.
            commands: see `commands`.
            path: path of the last marker in the base frame [m], for laws that depend on it; without it they are
                inactive.

        Raises:
            InputError: such mechanisms on another body than a rod without a cube.
        """
        pushing = [mechanism for mechanism in self.mechanisms if isinstance(mechanism, PushingMechanism)]
        loads = [] if commands.signals is None or commands.signals.body is None else [commands.signals.body]
        if pushing:
            if not self.engine.carries_loads:
                raise InputError(
                    f"{pushing[0].name} acts on a rod without a cube only",
                    where="[[model.laws]]",
                    remedy='set body = "rod" under [simulator], and leave the cube out',
                )
            initial, command = self.actuated(values, commands, self.time_step)
            levels = jnp.concatenate([initial[None], command])
            loads += [mechanism.push(values, levels, path, self.time_step) for mechanism in pushing]
        return jax.tree.map(lambda *parts: sum(parts[1:], parts[0]), *loads) if loads else None

    def embodied(
        self,
        values: Values,
        body: Rod,
        stiffness_scale: Float[Array, " elements"],
        point_mass: Float[Array, " stations"],
    ) -> Material:
        """Material of a rod, body mechanisms included.

        Raises:
            InputError: a mechanism that acts on rods or on motion only, on another body or a body at rest.
        """
        material = Material(
            young_modulus=values["young_modulus"],
            poisson_ratio=values["poisson_ratio"],
            density=jnp.asarray(self.robot.density(values["trunk_mass"])),
            rayleigh_mass=values.get("rayleigh_mass", jnp.zeros(())),
            rayleigh_stiffness=values.get("rayleigh_stiffness", jnp.zeros(())),
            gravity=jnp.asarray(self.robot.gravity),
            stiffness_scale=stiffness_scale,
            point_mass=point_mass,
        )
        if self.robot.held_by_force and self.robot.cables:
            material = material._replace(effects=material.effects._replace(cable_compliance=jnp.asarray(SOFT)))
        for mechanism in self.mechanisms:
            if self.at_rest and QUASI_STATIC not in motions_of(mechanism):
                words = f"the mechanism {mechanism.name!r} acts on a body in motion"
                raise InputError(words, where="[model] mechanisms", remedy=f"remove it, or {DYNAMIC}")
            if needs_cables(mechanism) and not self.robot.cables:
                words = f"the mechanism {mechanism.name!r} acts on cables, and the robot has none"
                raise InputError(words, where="[model] mechanisms", remedy="remove it")
            if isinstance(mechanism, BodyMechanism):
                material = mechanism.embody(values, material, body)
                if not self.engine.is_rod and "tetrahedra" not in bodies_of(mechanism):
                    raise InputError(
                        f"the mechanism {mechanism.name!r} acts on rods only", where="[model] mechanisms",
                        remedy='remove it, or set body = "rod" under [simulator]',
                    )  # fmt: skip
        return material

    def with_object_at(self, values: Mapping[str, Any], pose: Float[Any, "7"]) -> dict[str, Any]:
        """Values with the cube at its measured pose, less the offset of the measuring frame, standing on the plate.

        Args:
            values: values of one rollout, or of many (arrays of equal shapes); missing values are nominal.
            pose: measured centre [m] and unit quaternion (x, y, z, w).
        """
        known = {spec.name: spec.nominal for spec in self.parameters} | dict(values)
        return {**values, **cube_at_measured(self.robot, known, pose)}

    def observation(self, values: Values, commands: Commands, motion: Motion, unsolved: Result) -> Observation:
        """Observation of a motion; ``unsolved`` is the code of a rollout with unsolved constraints."""
        points, at, shown = self._seen(motion.position, commands), observed_at(commands, self.time_step), self.shown
        true = points[:, :shown]
        position = self.measured(values, true, at, self.meanwhile(values, commands))
        pose = None
        if motion.pose is not None:
            pose = sample(motion.pose, commands)
            pose = pose.at[:, 3:].divide(jnp.linalg.norm(pose[:, 3:], axis=1, keepdims=True))
        angle = self.driven(values, commands, self.time_step)
        tension = self._seen(motion.tension, commands)
        turn = None if points.shape[1] == shown else orientations(points[:, shown:])
        return Observation(position, tension, pose, status_of(motion, unsolved), angle, orientation=turn)

    @cached_property
    def parameters(self) -> tuple[ParameterSpec, ...]:
        """Parameters of the robot, of the mechanisms, and of the cube; without damping for a body at rest."""
        base = specs_of(self.robot.parameter_table())
        base = tuple(spec for spec in base if not (self.at_rest and spec.name in DAMPING))
        extended = base + tuple(spec for mechanism in self.mechanisms for spec in mechanism.parameters)
        return extended + (specs_of(push_table(self.robot).parameters) if self.pushes else ())

    @cached_property
    def content_sha256(self) -> str:
        """Digest of the robot's description and of the mechanisms' code, which their names do not determine."""
        return hashlib.sha256(self.robot.model_dump_json().encode() + code_of(self.mechanisms)).hexdigest()

    @property
    def command_unit(self) -> str:
        """Unit of the robot's commands: "m" of cable, or "rad" of a motor."""
        return self.robot.command.unit

    def pretension(self, values: Values) -> Float[Array, " cable"]:
        """Cable displacements at zero command [m]."""
        return jnp.stack([values[name] for name in self.robot.initial_displacement_names])

    def exerted(self, values: Values, level: Float[Array, " drive"]) -> Float[Array, " drive"]:
        """Drives of the engine at levels of the robot's drives [m, N or Pa]. A drive that holds a tension winds a very
        soft spring, so that the cable's length has no effect.
        """
        if self.robot.held_by_force:
            return level * np.array([SOFT if each.unit == "N" else 1.0 for each in self.robot.actuators])
        return level + self.pretension(values)

    def wound(
        self, values: Values, commands: Commands, time_step: float
    ) -> tuple[Float[Array, " drive"], Float[Array, "step drive"]]:
        """Drives of the engine before the first step and at the end of every step, with their end stops."""
        initial, command = self.actuated(values, commands, time_step)
        start = self.unwound(values, initial)
        levels = jax.lax.scan(lambda drives, sent: self.wind(values, drives, sent), start, command)[1]
        return self.exerted(values, start.level), levels

    def unwound(self, values: Values, initial: Float[Array, " channel"]) -> Wound:
        """The drives before the first step, settled at this command [m or rad]."""
        limits = self.robot.drive_limits()
        level = self.robot.channel_matrix(values) @ initial
        return Wound(jnp.clip(level, limits[:, 0], limits[:, 1]), jnp.asarray(initial, float))

    def wind(
        self, values: Values, drives: Wound, sent: Float[Array, " channel"]
    ) -> tuple[Wound, Float[Array, " drive"]]:
        """The drives at the end of a step, and the engine's drives, given the command that reached them."""
        limits = jnp.asarray(self.robot.drive_limits())
        move = jnp.asarray(self.robot.channel_matrix(values)) @ (sent - drives.sent)
        # A drive at its limit ignores further pulls, and answers the first release at once.
        level = jnp.clip(drives.level + move, limits[:, 0], limits[:, 1])
        return Wound(level, sent), self.exerted(values, level)

    @property
    def integrator(self) -> str | None:
        return self.engine.integrator

    @property
    def command_timing(self) -> tuple[float, float]:
        return self.robot.command.ramp_s, self.robot.command.dead_time_s

    def travel(self, recording: str, command: Float[np.ndarray, " channel"]) -> Travel | None:
        """See `ExtendedSimulator.travel`; stated by the robot."""
        return self.robot.travel(recording, command)

    def lane_start(self, values: Values, drives: Wound) -> LaneStart:
        material, cube = self.body_inputs(values)
        return LaneStart(material, self.exerted(values, drives.level), cube)

    def begin_lanes(self, count: int) -> BodyLanes:
        """See `ExtendedSimulator.begin_lanes`.

        Raises:
            InputError: a body that is no rod.
        """
        body: Any = self.engine.body
        markers = type(body.markers)(*(part[: self.shown] for part in body.markers))
        shows_all = len(body.markers[0]) == self.shown
        engine = self.engine if shows_all else replace(self.engine, body=body._replace(markers=markers))
        return body_lanes(engine, count)

    def marker_points(self) -> Float[np.ndarray, "marker 3"]:
        """Markers of the undeformed robot [m]."""
        return self.robot.marker_points()

    def measured(
        self,
        values: Values,
        position: Float[Array, "time marker 3"],
        time: Float[Array, " time"],
        meanwhile: Meanwhile | None = None,
    ) -> Float[Array, "time marker 3"]:
        """See `ExtendedSimulator.measured`; the offset of the measuring frame is added last."""
        return self.in_measuring_frame(values, super().measured(values, position, time, meanwhile))

    def in_measuring_frame(self, values: Values, position: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
        return position + jnp.stack([values["offset_x"], values["offset_y"], values["offset_z"]])
