"""A cable-driven trunk: commands, through actuation, body and sensing, to marker positions and tensions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rfdropo_bayes.fem import LayeredBody, Material, PointMap, System, attach, cable_layout, prepare, profile_body
from rfdropo_bayes.fem.balance import Balance, layered_balance
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.commands import Commands, commands_on_grid
from rfdropo_bayes.simulators.engine import Backend, Engine
from rfdropo_bayes.simulators.mechanisms import BodyMechanism, Mechanism, check_mechanisms
from rfdropo_bayes.simulators.protocol import Observation, Result
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator, Values, every_node, sampled
from rfdropo_bayes.simulators.session import Session


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

    Order of a rollout: command -> actuation mechanisms -> cable displacements within their limits -> body with its
    mechanisms -> markers -> sensing mechanisms -> observation.

    Attributes:
        robot: what is simulated.
        engine: what computes the motion of the body.
        assembly: the discretised robot the engine was made for.
        discretisation: how fine it is.
        mechanisms: extensions, applied in the order given within each stage.
    """

    robot: Robot
    engine: Engine
    assembly: Assembly
    discretisation: Discretisation
    mechanisms: Sequence[Mechanism] = field(default_factory=tuple)
    unsolved: ClassVar[Result] = Result.CABLE_LIMIT

    def __post_init__(self) -> None:
        object.__setattr__(self, "mechanisms", check_mechanisms(self.mechanisms))

    def with_backend(self, backend: Backend) -> TrunkSimulator:
        """The same, computed by another backend."""
        return replace(self, engine=replace(self.engine, backend=backend))

    @property
    def lanes(self) -> int:
        """Those of the engine."""
        return self.engine.lanes

    @property
    def time_step(self) -> float:  # type: ignore[override]
        """That of the discretisation."""
        return self.discretisation.time_step

    @property
    def description(self) -> dict[str, object]:
        """Engine, precision, discretisation and mechanisms."""
        return {
            **self.engine.describe(),
            "robot": self.robot.name,
            "time_step_s": self.discretisation.time_step,
            "nodes_across": self.discretisation.nodes_across,
            "layers": len(self.assembly.system.body.station) - 1,
            "mechanisms": [mechanism.name for mechanism in self.mechanisms],
            "content_sha256": self.content_sha256,
        }

    def commands(
        self,
        time: Float[np.ndarray, " command"],
        value: Float[np.ndarray, "command channel"],
        initial: Float[np.ndarray, " channel"],
        observation_time: Float[np.ndarray, " time"],
    ) -> Commands:
        """Recorded commands on this simulator's clock, with the robot's ramp and lag."""
        return commands_on_grid(
            time,
            value,
            initial,
            observation_time,
            time_step=self.discretisation.time_step,
            ramp=self.robot.command.ramp_s,
            dead_time=self.robot.command.dead_time_s,
        )

    def session(self, lanes: int, period: float) -> Session:
        """So many trunks that are commanded one control period [s] at a time; see `Session`."""
        return Session(self, lanes, period)

    def body_inputs(self, values: Values) -> tuple[Material, None]:
        """See `SteppedSimulator`."""
        return self.material(values), None

    def rollout(self, parameters: Values, commands: Commands, steps: Int[Array, ""] | None = None) -> Observation:
        """Simulate from the initial state to the last observation.

        Args:
            parameters: values by name; those left out are nominal.
            commands: from `commands`.
            steps: simulate only so many time steps, and those that mechanisms of sensing look ahead; rows beyond hold
                no meaning. None simulates all and is differentiable in reverse mode.

        Raises:
            InputError: a name that is not a parameter of this simulator.
        """
        values = self.complete(parameters)
        steps = self.steps_seen(values, commands, self.time_step, steps)
        motion = self.engine.motion(*self.inputs(values, commands), steps)
        return self.observation(values, commands, motion, self.unsolved)

    def inputs(self, values: Values, commands: Commands) -> tuple[Material, Array, Array]:
        """What the engine moves the body by: material, and cable displacements before the first and at each step."""
        return self.material(values), *self.wound(values, commands, self.time_step)

    def balance(self, parameters: Values, commands: Commands) -> Balance:
        """See `RobotSimulator.balance`."""
        values = self.complete(parameters)
        material, start, displacement = self.inputs(values, commands)
        nodes = every_node(self.assembly.system.body.nodes)
        motion = self.engine.recording(nodes).motion(material, start, displacement)
        return self.balance_of(material, motion.position, motion.tension, commands)

    def balance_of(
        self,
        material: Material,
        position: Float[Array, "row node 3"],
        tension: Float[Array, "row cable"],
        commands: Commands,
    ) -> Balance:
        """Forces and energies of a motion of all nodes [m], recorded after every step."""
        system = self.assembly.system
        found = layered_balance(system, prepare(system, material), position, tension, self.discretisation.time_step)
        return sampled(found, commands)

    def material(self, values: Values) -> Material:
        """Material of the body for these values, body mechanisms included."""
        body = self.assembly.system.body
        stations = len(body.station)
        masses = jnp.asarray(self.robot.point_masses(values))
        scale = self.robot.stiffness_scale(values["poisson_ratio"])
        material = Material(
            young_modulus=values["young_modulus"],
            poisson_ratio=values["poisson_ratio"],
            density=jnp.asarray(self.robot.density(values["trunk_mass"])),
            rayleigh_mass=values["rayleigh_mass"],
            rayleigh_stiffness=values["rayleigh_stiffness"],
            gravity=jnp.asarray(self.robot.gravity),
            stiffness_scale=jnp.repeat(jnp.asarray(scale), self.discretisation.refine),
            point_mass=jnp.zeros(stations).at[self.assembly.station_of].set(masses),
        )
        for mechanism in self.mechanisms:
            if isinstance(mechanism, BodyMechanism):
                material = mechanism.embody(values, material, body)
        return material
