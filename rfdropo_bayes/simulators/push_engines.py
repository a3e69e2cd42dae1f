"""Engines for a trunk that pushes a cube, in JAX."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import jax
import jax.numpy as jnp

from rfdropo_bayes.fem import point_positions
from rfdropo_bayes.fem.pushing import PushScene
from rfdropo_bayes.fem.tetrahedral_dynamics import state_at_rest
from rfdropo_bayes.fem.tetrahedral_pushing import PushState, simulate, surface_points
from rfdropo_bayes.simulators.commands import Commands
from rfdropo_bayes.simulators.mesh_trunk import MeshTrunkSimulator
from rfdropo_bayes.simulators.pushing import CubeInputs, PushMotion, scene_of
from rfdropo_bayes.simulators.robot_simulator import Values


@dataclass(frozen=True)
class MeshPushEngine:
    """A body of tetrahedra and a cube, in double precision, on whatever device JAX finds.

    Attributes:
        trunk: whose mesh, cables and markers it moves.
    """

    trunk: MeshTrunkSimulator
    lanes: ClassVar[int] = 16

    @cached_property
    def scene(self) -> PushScene:
        """Cube, plate and the trunk's surface."""
        body = self.trunk.assembly.system.body
        return scene_of(self.trunk.robot, surface_points(body), body.rest)

    def describe(self) -> dict[str, object]:
        """Name and precision."""
        return {"engine": "jax", "precision": "float64", "device": jax.devices()[0].platform}

    def motion(self, simulator: MeshTrunkSimulator, values: Values, commands: Commands, cube: CubeInputs) -> PushMotion:
        """See `PushEngine.motion`."""
        system, markers = simulator.assembly.system, simulator.assembly.markers
        displacement = simulator.displacements(values, commands)[:, None, :]
        start = PushState(state_at_rest(system), cube.start)
        rollout = simulate(
            system, self.scene, simulator.material(values), cube.cube, cube.friction, start, displacement,
            simulator.time_step, markers,
        )  # fmt: skip
        first = point_positions(markers, start.body.position)
        pose = jnp.concatenate([cube.start.position, cube.start.orientation])
        return PushMotion(
            jnp.concatenate([first[None], rollout.position]),
            jnp.concatenate([start.body.tension[None], rollout.tension]),
            jnp.concatenate([pose[None], rollout.pose]),
            rollout.status.diverged,
            rollout.status.cables_converged,
            rollout.status.contacts_converged,
        )
