"""A tetrahedral body that pushes a cube on a plate: the step of ``fem.tetrahedral_dynamics`` with contacts."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from rfdropo_bayes.fem import levels as level_systems
from rfdropo_bayes.fem.cables import lengths_and_jacobian
from rfdropo_bayes.fem.layered import PointMap, point_positions
from rfdropo_bayes.fem.pushing import PushRollout, PushScene, PushStatus, find_contacts, push, trunk_rows
from rfdropo_bayes.fem.rigid_body import Cube, CubeState, free_twist
from rfdropo_bayes.fem.tetrahedra import TetrahedralBody
from rfdropo_bayes.fem.tetrahedral_dynamics import (
    TetrahedralMaterial,
    TetrahedralState,
    TetrahedralSystem,
    accept,
    linearised,
)


class PushState(NamedTuple):
    """Body and cube."""

    body: TetrahedralState
    cube: CubeState


def surface_points(body: TetrahedralBody) -> PointMap:
    """The nodes and the middles of the edges of the surface of a mesh."""
    element = body.element
    faces = np.concatenate([element[:, corners] for corners in ([0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2])])
    _, index, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    outer = faces[index[count == 1]]
    edges = np.unique(np.sort(np.concatenate([outer[:, [0, 1]], outer[:, [1, 2]], outer[:, [2, 0]]]), axis=1), axis=0)
    nodes = np.unique(outer)
    node = np.zeros((len(nodes) + len(edges), 8), dtype=int)
    weight = np.zeros(node.shape)
    node[: len(nodes), 0], weight[: len(nodes), 0] = nodes, 1.0
    node[len(nodes) :, :2], weight[len(nodes) :, :2] = edges, 0.5
    return PointMap(node, weight)


def step(
    system: TetrahedralSystem,
    scene: PushScene,
    material: TetrahedralMaterial,
    cube: Cube,
    friction: Float[Array, ""],
    state: PushState,
    displacement: Float[Array, " cables"],
    time_step: float,
) -> tuple[PushState, PushStatus]:
    """One implicit Euler step of body and cube to the commanded cable displacements [m]."""
    levels, body = system.levels, state.body
    matrix, right = linearised(system, material, body, time_step)
    length, jacobian = lengths_and_jacobian(system.cables, jnp.asarray(system.guides), body.position)
    shortening = jnp.asarray(system.rest_length) - length
    touch = find_contacts(scene, cube, state.cube, body.position)
    rows = jnp.concatenate([right[None], -jacobian, trunk_rows(touch, len(body.position))])
    columns = rows[:, levels.order].reshape(len(rows), -1).T
    solution = level_systems.solve(matrix, columns)
    old = body.velocity[levels.order].ravel()
    velocity = old + solution[:, 0]
    target = system.limits.apply(displacement, body.measured)
    rate = (shortening - target) / time_step + columns[:, 1 : 1 + len(length)].T @ velocity
    twist = free_twist(state.cube, material.gravity, material.rayleigh_mass, time_step)
    pushed = push(
        touch, cube, state.cube, friction, twist, columns[:, 1:], solution[:, 1:], velocity, rate,
        body.tension * time_step, time_step,
    )  # fmt: skip
    after = body.velocity.at[levels.order].set((velocity + pushed.change).reshape(-1, 3))
    moved = TetrahedralState(body.position + time_step * after, after, pushed.cable / time_step, shortening)
    kept, info = accept(system, body, moved, pushed.cables_converged)
    fine = ~info.diverged & jnp.all(jnp.isfinite(pushed.cube.position))
    stopped = state.cube._replace(velocity=jnp.zeros(3), spin=jnp.zeros(3))
    after_cube = CubeState(*(jnp.where(fine, new, before) for new, before in zip(pushed.cube, stopped, strict=True)))
    return PushState(kept, after_cube), PushStatus(~fine, info.cables_converged, pushed.converged | ~fine)


def simulate(
    system: TetrahedralSystem,
    scene: PushScene,
    material: TetrahedralMaterial,
    cube: Cube,
    friction: Float[Array, ""],
    state: PushState,
    displacement: Float[Array, "rows substeps cables"],
    time_step: float,
    points: PointMap,
) -> PushRollout:
    """Rollout through the commanded cable displacements [m] of every step, recorded at the end of every row."""

    def one(carry, commanded):
        state, status = carry
        state, new = step(system, scene, material, cube, friction, state, commanded, time_step)
        return (state, status.joined(new)), None

    def row(carry, commands):
        carry, _ = lax.scan(one, carry, commands)
        body, solid = carry[0]
        pose = jnp.concatenate([solid.position, solid.orientation])
        return carry, (point_positions(points, body.position), body.tension, pose)

    (_, status), (position, tension, pose) = lax.scan(row, (state, PushStatus.fine()), displacement)
    return PushRollout(position, tension, pose, status)
