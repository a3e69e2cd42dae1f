"""A layered body that pushes a cube on a plate: the step of ``fem.dynamics`` with contacts."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from rfdropo_bayes.fem.blocktridiagonal import BlockTridiagonal, solve
from rfdropo_bayes.fem.cables import lengths_and_jacobian
from rfdropo_bayes.fem.dynamics import Prepared, State, System, accept, linearised, remembering
from rfdropo_bayes.fem.effects import BodyEffects
from rfdropo_bayes.fem.layered import LayeredBody, PointMap, attach, point_positions
from rfdropo_bayes.fem.pushing import PushRollout, PushScene, PushStatus, find_contacts, push, trunk_rows
from rfdropo_bayes.fem.rigid_body import Cube, CubeState, free_twist

AROUND = 16
"""Points on the circumference of a section."""


class LayeredPushState(NamedTuple):
    """Body and cube."""

    body: State
    cube: CubeState


def outline_points(body: LayeredBody, outline: Float[np.ndarray, "stations 2"], rings: int) -> PointMap:
    """Points on the circumference of the body: rings of sections, ellipses of these half widths [m], evenly spaced."""
    height = np.linspace(body.station[0], body.station[-1], rings)
    half = np.stack([np.interp(height, body.station, outline[:, axis]) for axis in range(2)], axis=1)
    angle = 2.0 * np.pi * np.arange(AROUND) / AROUND
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = np.concatenate(
        [half[:, None, :] * circle, np.broadcast_to(height[:, None, None], (rings, AROUND, 1))], axis=2
    )
    return attach(body, points.reshape(-1, 3))


def check_effects(effects: BodyEffects) -> None:
    """Raise InputError for effects of the cables, which contacts are not solved together with."""
    effects.refuse(
        ("cable_compliance", "coulomb_friction", "capstan_friction"),
        "{} cannot be combined with a cube",
        where="[model] mechanisms",
        remedy="remove the mechanism, or set push = false under [simulator]",
    )


def step(
    system: System,
    prepared: Prepared,
    scene: PushScene,
    cube: Cube,
    friction: Float[Array, ""],
    state: LayeredPushState,
    displacement: Float[Array, " cables"],
    time_step: float,
) -> tuple[LayeredPushState, PushStatus]:
    """One implicit Euler step of body and cube to the commanded cable displacements [m]."""
    body, held, stations = state.body, system.clamped_stations, len(system.body.station)
    matrix, right, memory = linearised(system, prepared, body, time_step)
    length, jacobian = lengths_and_jacobian(system.cables, prepared.guides, body.position)
    touch = find_contacts(scene, cube, state.cube, body.position)
    rows = jnp.concatenate([right[None], -jacobian, trunk_rows(touch, len(body.position))])
    columns = jnp.moveaxis(rows.reshape(len(rows), stations, -1)[:, held:], 0, 2)
    solution = solve(BlockTridiagonal(matrix.diagonal[held:], matrix.lower[held:]), columns)
    columns, solution = (part.reshape(-1, len(rows)) for part in (columns, solution))
    section = system.body.section_nodes
    velocity = body.velocity[held * section :].ravel() + solution[:, 0]
    slack = (prepared.rest_length - displacement - length) / time_step
    pushed = push(
        touch, cube, state.cube, friction,
        free_twist(state.cube, prepared.gravity, prepared.rayleigh_mass, time_step),
        columns[:, 1:], solution[:, 1:], velocity, slack + columns[:, 1 : 1 + len(length)].T @ velocity,
        body.tension * time_step, time_step,
    )  # fmt: skip
    after = body.velocity.at[held * section :].set((velocity + pushed.change).reshape(-1, 3))
    moved = State(body.position + time_step * after, after, pushed.cable / time_step, memory)
    kept, info = accept(system, prepared, body, moved, pushed.cables_converged)
    fine = ~info.diverged & jnp.all(jnp.isfinite(pushed.cube.position))
    stopped = state.cube._replace(velocity=jnp.zeros(3), spin=jnp.zeros(3))
    after_cube = jax.tree.map(lambda new, old: jnp.where(fine, new, old), pushed.cube, stopped)
    return LayeredPushState(kept, after_cube), PushStatus(~fine, info.cables_converged, pushed.converged | ~fine)


def simulate(
    system: System,
    prepared: Prepared,
    scene: PushScene,
    cube: Cube,
    friction: Float[Array, ""],
    state: LayeredPushState,
    displacement: Float[Array, "rows substeps cables"],
    time_step: float,
    points: PointMap,
) -> PushRollout:
    """Rollout through the commanded cable displacements [m] of every step, recorded at the end of every row."""
    check_effects(prepared.effects)

    def one(carry, commanded):
        state, status = carry
        state, new = step(system, prepared, scene, cube, friction, state, commanded, time_step)
        return (state, status.joined(new)), None

    def row(carry, commands):
        carry, _ = lax.scan(one, carry, commands)
        body, solid = carry[0]
        pose = jnp.concatenate([solid.position, solid.orientation])
        return carry, (point_positions(points, body.position), body.tension, pose)

    begin = state._replace(body=remembering(system, prepared, state.body)), PushStatus.fine()
    (_, status), (position, tension, pose) = lax.scan(row, begin, displacement)
    return PushRollout(position, tension, pose, status)
