"""A cable-driven trunk whose body is a tetrahedral mesh; with SOFA's options, SOFA's trunk to its last digit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem import LayeredBody, Material
from rfdropo_bayes.fem.balance import Balance, tetrahedral_balance
from rfdropo_bayes.fem.tetrahedral_dynamics import TetrahedralMaterial
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.commands import Commands, animated_on_grid, commands_on_grid
from rfdropo_bayes.simulators.engine import Backend, Engine
from rfdropo_bayes.simulators.mechanisms import BodyMechanism, Mechanism, check_mechanisms
from rfdropo_bayes.simulators.mesh_body import MeshAssembly, TetrahedraTable
from rfdropo_bayes.simulators.protocol import Observation, Result
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator, Values, every_node, sampled
from rfdropo_bayes.simulators.trunk import refined_body


@dataclass(frozen=True)
class MeshTrunkSimulator(RobotSimulator):
    """A trunk of tetrahedra with mechanisms, behind the `Simulator` protocol, started undeformed.

    Order of a rollout: as `TrunkSimulator`. Mechanisms of the body see the robot's layers and stations; what they do to
    a layer holds for the elements in it, and a mass at a station rests on the section at its height.

    Attributes:
        robot: what is simulated.
        engine: what computes the motion of the body.
        assembly: the robot bound to the mesh the engine was made for.
        options: how the mesh is simulated.
        time_step: of the simulation [s].
        mechanisms: extensions, applied in the order given within each stage.
    """

    robot: Robot
    engine: Engine
    assembly: MeshAssembly
    options: TetrahedraTable
    time_step: float
    mechanisms: Sequence[Mechanism] = field(default_factory=tuple)

    def __post_init__(self) -> None:
        object.__setattr__(self, "mechanisms", check_mechanisms(self.mechanisms))

    def with_backend(self, backend: Backend) -> MeshTrunkSimulator:
        """The same, computed by another backend."""
        return replace(self, engine=replace(self.engine, backend=backend))

    @property
    def lanes(self) -> int:
        """Those of the engine."""
        return self.engine.lanes

    @property
    def description(self) -> dict[str, object]:
        """Engine, precision, discretisation, options and mechanisms."""
        body = self.assembly.system.body
        return {
            **self.engine.describe(),
            "robot": self.robot.name,
            "time_step_s": self.time_step,
            "body": "tetrahedra",
            "nodes": len(body.rest),
            "elements": len(body.element),
            **{name: value for name, value in self.options.model_dump().items() if name != "unit"},
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
        """Recorded commands on this simulator's clock, handed over as its drives do."""
        if self.options.drives == "sofa":
            return animated_on_grid(time, value, initial, observation_time, time_step=self.time_step)
        return commands_on_grid(
            time,
            value,
            initial,
            observation_time,
            time_step=self.time_step,
            ramp=self.robot.command.ramp_s,
            dead_time=self.robot.command.dead_time_s,
        )

    def rollout(self, parameters: Values, commands: Commands, steps: Int[Array, ""] | None = None) -> Observation:
        """Simulate from rest to the last observation, or at least ``steps`` time steps; see `TrunkSimulator.rollout`.

        Raises:
            InputError: a name that is not a parameter of this simulator.
        """
        values = self.complete(parameters)
        steps = self.steps_seen(values, commands, self.time_step, steps)
        motion = self.engine.motion(*self.inputs(values, commands), steps)
        return self.observation(values, commands, motion, Result.CABLE_LIMIT)

    def inputs(self, values: Values, commands: Commands) -> tuple[TetrahedralMaterial, Array, Array]:
        """As `TrunkSimulator.inputs`."""
        displacement = self.displacements(values, commands)
        return self.material(values), jnp.zeros_like(displacement[0]), displacement

    def balance(self, parameters: Values, commands: Commands) -> Balance:
        """See `RobotSimulator.balance`."""
        values = self.complete(parameters)
        material, start, displacement = self.inputs(values, commands)
        nodes = every_node(len(self.assembly.system.body.rest))
        motion = self.engine.recording(nodes).motion(material, start, displacement)
        return self.balance_of(material, motion.position, motion.tension, commands)

    def balance_of(
        self,
        material: TetrahedralMaterial,
        position: Float[Array, "row node 3"],
        tension: Float[Array, "row cable"],
        commands: Commands,
    ) -> Balance:
        """As `TrunkSimulator.balance_of`."""
        found = tetrahedral_balance(self.assembly.system, material, position, tension, self.time_step)
        return sampled(found, commands)

    def displacements(self, values: Values, commands: Commands) -> Float[Array, "step cable"]:
        """Commanded cable displacements [m] at the end of every step; SOFA's limits are those of the engine."""
        if self.options.drives == "robot":
            return self.wound(values, commands, self.time_step)[1]
        command = self.actuated(values, commands, self.time_step)[1]
        return command @ jnp.asarray(self.robot.channel_matrix(values)).T + self.pretension(values)

    @cached_property
    def _layers(self) -> LayeredBody:
        return refined_body(self.robot.layered_arrays(), 1, 2)

    def material(self, values: Values) -> TetrahedralMaterial:
        """Material of the mesh for these values, body mechanisms included."""
        layers = self._layers
        material = Material(
            young_modulus=values["young_modulus"],
            poisson_ratio=values["poisson_ratio"],
            density=jnp.asarray(self.robot.density(values["trunk_mass"])),
            rayleigh_mass=values["rayleigh_mass"],
            rayleigh_stiffness=values["rayleigh_stiffness"],
            gravity=jnp.asarray(self.robot.gravity),
            stiffness_scale=jnp.ones(len(layers.station) - 1),
            point_mass=jnp.asarray(self.robot.point_masses(values)),
        )
        for mechanism in self.mechanisms:
            if isinstance(mechanism, BodyMechanism):
                material = mechanism.embody(values, material, layers)
                if material.effects.present:
                    raise InputError(
                        f"the mechanism {mechanism.name!r} acts on layered bodies only", where="[model] mechanisms",
                        remedy='remove it, or set body = "layered" under [simulator]',
                    )  # fmt: skip
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
