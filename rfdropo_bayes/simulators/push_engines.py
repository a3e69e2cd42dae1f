"""Engines for a trunk that pushes a cube, in JAX: double precision, differentiable, on whatever device JAX finds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.fem import layered_pushing, point_positions, prepare, state_at_rest, tetrahedral_pushing
from rfdropo_bayes.fem import static_equilibrium as find_equilibrium
from rfdropo_bayes.fem.layered import PointMap, rest_positions
from rfdropo_bayes.fem.pushing import PushRollout, PushScene
from rfdropo_bayes.fem.tetrahedral_dynamics import state_at_rest as mesh_at_rest
from rfdropo_bayes.simulators.commands import Commands
from rfdropo_bayes.simulators.mesh_trunk import MeshTrunkSimulator
from rfdropo_bayes.simulators.pushing import CubeInputs, PushMotion, bands_along, scene_of, with_markers
from rfdropo_bayes.simulators.robot_simulator import Values
from rfdropo_bayes.simulators.trunk import TrunkSimulator


def _describe() -> dict[str, object]:
    return {"engine": "jax", "precision": "float64", "device": jax.devices()[0].platform}


def _motion(
    markers: PointMap,
    position: Float[Array, "nodes 3"],
    tension: Float[Array, " cables"],
    cube: CubeInputs,
    rollout: PushRollout,
    imbalance: Float[Array, ""],
) -> PushMotion:
    """The initial state before the rollout's rows."""
    pose = jnp.concatenate([cube.start.position, cube.start.orientation])
    return PushMotion(
        jnp.concatenate([point_positions(markers, position)[None], rollout.position]),
        jnp.concatenate([tension[None], rollout.tension]),
        jnp.concatenate([pose[None], rollout.pose]),
        *rollout.status,
        imbalance,
    )


def mesh_scene(trunk: MeshTrunkSimulator) -> PushScene:
    """Cube, plate and the surface of a trunk's mesh."""
    body = trunk.assembly.system.body
    return scene_of(trunk.robot, tetrahedral_pushing.surface_points(body), body.rest)


def layered_scene(trunk: TrunkSimulator) -> PushScene:
    """Cube, plate and the outline of a layered trunk, without its notches."""
    body = trunk.assembly.system.body
    rings = bands_along(float(body.station[-1] - body.station[0])) + 1
    outline = layered_pushing.outline_points(body, body.half_width, rings)
    return scene_of(trunk.robot, outline, rest_positions(body))


@dataclass(frozen=True)
class MeshPushEngine:
    """A body of tetrahedra and a cube.

    Attributes:
        trunk: whose mesh, cables and markers it moves.
    """

    trunk: MeshTrunkSimulator
    lanes: ClassVar[int] = 16

    @property
    def time_step(self) -> float:
        """That of the trunk."""
        return self.trunk.time_step

    @cached_property
    def scene(self) -> PushScene:
        """Cube, plate and the trunk's surface."""
        return mesh_scene(self.trunk)

    def describe(self) -> dict[str, object]:
        """Name and precision."""
        return _describe()

    def recording(self, points: PointMap) -> MeshPushEngine:
        """See `PushEngine.recording`."""
        return replace(self, trunk=with_markers(self.trunk, points))

    def motion(self, values: Values, commands: Commands, cube: CubeInputs) -> PushMotion:
        """See `PushEngine.motion`."""
        system, markers = self.trunk.assembly.system, self.trunk.assembly.markers
        displacement = self.trunk.displacements(values, commands)[:, None, :]
        state = mesh_at_rest(system)
        rollout = tetrahedral_pushing.simulate(
            system, self.scene, self.trunk.material(values), cube.cube, cube.friction,
            tetrahedral_pushing.PushState(state, cube.start), displacement, self.time_step, markers,
        )  # fmt: skip
        return _motion(markers, state.position, state.tension, cube, rollout, jnp.zeros(()))


@dataclass(frozen=True)
class LayeredPushEngine:
    """A layered body and a cube. The body's outline, without its notches, is what touches.

    Attributes:
        trunk: whose layers, cables and markers it moves.
    """

    trunk: TrunkSimulator
    lanes: ClassVar[int] = 64

    @property
    def time_step(self) -> float:
        """That of the trunk."""
        return self.trunk.discretisation.time_step

    @cached_property
    def scene(self) -> PushScene:
        """Cube, plate and the trunk's outline."""
        return layered_scene(self.trunk)

    def describe(self) -> dict[str, object]:
        """Name and precision."""
        return _describe()

    def recording(self, points: PointMap) -> LayeredPushEngine:
        """See `PushEngine.recording`."""
        return replace(self, trunk=with_markers(self.trunk, points))

    def motion(self, values: Values, commands: Commands, cube: CubeInputs) -> PushMotion:
        """See `PushEngine.motion`."""
        system, markers = self.trunk.assembly.system, self.trunk.assembly.markers
        prepared = prepare(system, self.trunk.material(values))
        start, displacement = self.trunk.wound(values, commands, self.time_step)
        state, imbalance = state_at_rest(system), jnp.zeros(())
        if self.trunk.robot.initial_state == "equilibrium":
            state, found = find_equilibrium(system, prepared, start)
            imbalance = found.residual
        rollout = layered_pushing.simulate(
            system, prepared, self.scene, cube.cube, cube.friction,
            layered_pushing.LayeredPushState(state, cube.start), displacement[:, None, :], self.time_step, markers,
        )  # fmt: skip
        return _motion(markers, state.position, state.tension, cube, rollout, imbalance)
