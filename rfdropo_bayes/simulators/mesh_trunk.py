"""A cable-driven trunk whose body is a tetrahedral mesh; with SOFA's options, SOFA's trunk to its last digit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfdropo_bayes.fem import LayeredBody
from rfdropo_bayes.fem.balance import Balance, tetrahedral_balance
from rfdropo_bayes.fem.rollouts import Motion
from rfdropo_bayes.fem.tetrahedral_dynamics import TetrahedralMaterial
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.commands import Commands, animated_on_grid
from rfdropo_bayes.simulators.engine import Engine
from rfdropo_bayes.simulators.mechanisms import Mechanism, Values
from rfdropo_bayes.simulators.mesh_body import MeshAssembly, TetrahedraTable
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator
from rfdropo_bayes.simulators.trunk import refined_body


@dataclass(frozen=True)
class MeshTrunkSimulator(RobotSimulator):
    """A trunk of tetrahedra with mechanisms, behind the `Simulator` protocol, started undeformed.

    Mechanisms of the body see the robot's layers and stations; what they do to
    a layer holds for the elements in it, and a mass at a station rests on the section at its height.

    Attributes:
        options: how the mesh is simulated; for the others see `RobotSimulator`.
    """

    robot: Robot
    engine: Engine
    assembly: MeshAssembly
    options: TetrahedraTable
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
        """Recorded commands on this simulator's clock, handed over as its drives do."""
        if self.options.drives == "sofa":
            return animated_on_grid(time, value, initial, observation_time, time_step=self.time_step)
        return super().commands(time, value, initial, observation_time)

    def inputs(self, values: Values, commands: Commands) -> tuple[TetrahedralMaterial, Array, Array]:
        """See `RobotSimulator`."""
        displacement = self.displacements(values, commands)
        return self.material(values), jnp.zeros_like(displacement[0]), displacement

    def balance_of(self, material: TetrahedralMaterial, motion: Motion) -> Balance:
        """See `RobotSimulator`; the energies are those of the body."""
        return tetrahedral_balance(self.assembly.system, material, motion.position, motion.tension, self.time_step)

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
        """See `RobotSimulator`."""
        layers = self._layers
        masses = jnp.asarray(self.robot.point_masses(values))
        material = self.embodied(values, layers, jnp.ones(len(layers.station) - 1), masses)
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
