"""Whole rollouts: commands in, recorded point positions and cable tensions out."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rfdropo_bayes.fem.dynamics import Prepared, State, System, remembering, step
from rfdropo_bayes.fem.effects import Scalar
from rfdropo_bayes.fem.layered import PointMap, point_positions
from rfdropo_bayes.fem.pushing import PushScene
from rfdropo_bayes.fem.rigid_body import Cube


class Rollout(NamedTuple):
    """Recorded motion. A diverged rollout stays finite, but its rows from then on mean nothing."""

    position: Float[Array, "rows points 3"]  # [m]
    tension: Float[Array, "rows cables"]  # [N]
    state: State  # after the last step
    diverged: Bool[Array, ""]
    converged: Bool[Array, ""]  # whether the impulses of every step's constraints were found
    pose: Float[Array, "rows 7"] | None = None  # of the cube: centre [m] and unit quaternion (x, y, z, w)


class _Progress(NamedTuple):
    state: State
    diverged: Bool[Array, ""]
    converged: Bool[Array, ""]


class _Scene(NamedTuple):
    """What is around the body."""

    external_force: Float[Array, "nodes 3"] | float
    push: PushScene | None
    cube: Cube | None


class _Row(NamedTuple):
    """What is recorded."""

    position: Float[Array, "points 3"]
    tension: Float[Array, " cables"]
    pose: Float[Array, "7"] | None


def _advance(
    system: System,
    prepared: Prepared,
    progress: _Progress,
    commands: Float[Array, "substeps cables"],
    time_step: Scalar,
    around: _Scene,
) -> _Progress:
    """The steps of one recorded row."""

    def one(progress: _Progress, displacement: Float[Array, " cables"]) -> tuple[_Progress, None]:
        state, info = step(system, prepared, progress.state, displacement, time_step, *around)
        return _Progress(state, progress.diverged | info.diverged, progress.converged & info.converged), None

    return lax.scan(one, progress, commands)[0]


def _record(points: PointMap, state: State) -> _Row:
    cube = state.cube
    pose = None if cube is None else jnp.concatenate([cube.position, cube.orientation])
    return _Row(point_positions(points, state.position), state.tension, pose)


def simulate(
    system: System,
    prepared: Prepared,
    state: State,
    displacement: Float[Array, "rows substeps cables"],
    time_step: Scalar,
    points: PointMap,
    external_force: Float[Array, "nodes 3"] | float = 0.0,
    scene: PushScene | None = None,
    cube: Cube | None = None,
) -> Rollout:
    """Rollout from ``state`` through the commanded cable displacements [m] of every step, recorded after every row.

    ``time_step`` [s] is that of one substep; ``external_force`` [N] is constant. With a ``scene`` and a ``cube`` the
    body pushes it; ``state.cube`` is where it starts. Forward and reverse mode both work.
    """
    around = _Scene(external_force, scene, cube)

    def row(progress: _Progress, commands: Float[Array, "substeps cables"]) -> tuple[_Progress, _Row]:
        progress = _advance(system, prepared, progress, commands, time_step, around)
        return progress, _record(points, progress.state)

    start = _Progress(remembering(system, prepared, state, scene), jnp.array(False), jnp.array(True))
    last, rows = lax.scan(row, start, displacement)
    return Rollout(rows.position, rows.tension, last.state, last.diverged, last.converged, rows.pose)


def simulate_prefix(
    system: System,
    prepared: Prepared,
    state: State,
    displacement: Float[Array, "rows substeps cables"],
    time_step: Scalar,
    points: PointMap,
    horizon: Int[Array, ""] | int,
    external_force: Float[Array, "nodes 3"] | float = 0.0,
    scene: PushScene | None = None,
    cube: Cube | None = None,
) -> Rollout:
    """The first ``horizon`` rows of ``simulate``; later rows are zero.

    ``horizon`` may be traced: one compilation serves every prefix, and rows beyond it cost nothing. No reverse mode.
    """
    rows, around = displacement.shape[0], _Scene(external_force, scene, cube)

    def row(index: Int[Array, ""], carry: tuple[_Progress, _Row]) -> tuple[_Progress, _Row]:
        progress, recorded = carry
        progress = _advance(system, prepared, progress, displacement[index], time_step, around)
        here = _record(points, progress.state)
        return progress, jax.tree.map(lambda all_rows, one: all_rows.at[index].set(one), recorded, here)

    start = _Progress(remembering(system, prepared, state, scene), jnp.array(False), jnp.array(True))
    empty = jax.tree.map(lambda one: jnp.zeros((rows, *one.shape)), _record(points, state))
    last, recorded = lax.fori_loop(0, jnp.minimum(horizon, rows), row, (start, empty))
    return Rollout(recorded.position, recorded.tension, last.state, last.diverged, last.converged, recorded.pose)
