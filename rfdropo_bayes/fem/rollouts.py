"""Whole rollouts: commands in, recorded point positions and cable tensions out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.dynamics import Prepared, State, StepInfo, System, remembering, step
from rfdropo_bayes.fem.effects import Scalar
from rfdropo_bayes.fem.equilibrium import quasi_static_step
from rfdropo_bayes.fem.integrators import Integrator
from rfdropo_bayes.fem.points import point_positions
from rfdropo_bayes.fem.pushing import PushGeometry
from rfdropo_bayes.fem.rigid_body import Cube
from rfdropo_bayes.fem.rod import PointMap
from rfdropo_bayes.fem.section_loads import SectionLoads, loaded


class Rollout(NamedTuple):
    """Recorded motion. A diverged rollout stays finite, but its rows from then on mean nothing."""

    position: Float[Array, "rows points 3"]  # [m]
    tension: Float[Array, "rows cables"]  # [N]
    state: Any  # after the last step
    diverged: Bool[Array, ""]
    converged: Bool[Array, ""]  # whether the impulses of every step's constraints were found
    pose: Float[Array, "rows 7"] | None = None  # of the cube: centre [m] and unit quaternion (x, y, z, w)


class Motion(NamedTuple):
    """Recorded motion of a body by any engine, of one rollout or a batch; row 0 is the initial state.

    A diverged rollout stays finite, but its rows from then on mean nothing.
    """

    position: Float[Any, "*batch row point 3"]  # [m]
    tension: Float[Any, "*batch row cable"]  # [N]
    diverged: Bool[Any, "*batch"]
    imbalance: Float[Any, "*batch"]  # relative unbalanced force of the initial equilibrium; 0 for a start at rest
    converged: Bool[Any, "*batch"]  # whether the impulses of every step's constraints were found
    pose: Float[Any, "*batch row 7"] | None = None  # of the cube: centre [m] and unit quaternion (x, y, z, w)
    peak: Float[Any, "*batch cable"] | None = None  # largest tension at the steps of a session's last call [N]
    solves: Float[Any, "*batch"] | None = None  # linear solves of a quasi-static motion's rows


class _Progress(NamedTuple):
    state: Any
    info: StepInfo


Recorded = tuple[Float[Array, "points 3"], Float[Array, " cables"], Float[Array, "7"] | None]
"""Points, tensions, and pose of the cube."""


def roll(
    take: Callable[[Any, Any, StepInfo], tuple[Any, StepInfo]],
    start: Any,
    drive: Any,
    points: PointMap,
    horizon: Int[Array, ""] | int | None = None,
) -> Rollout:
    """Rollout of any body, from its step function to the drives at the ends of its steps.

    Args:
        drive: (rows, substeps, drives), or a tree of arrays (rows, substeps, ...) split into steps.
        horizon: rows to compute; later rows are zero. A traced number of steps serves every prefix with one
        compilation; later rows cost nothing, and there is no reverse mode. None computes all rows and allows reverse
        mode.
    """

    def one(progress: _Progress, commanded: Any) -> tuple[_Progress, None]:
        before = progress.info
        state, info = take(progress.state, commanded, before)
        codes = StepInfo(before.diverged | info.diverged, before.converged & info.converged)
        return _Progress(state, codes), None

    def recorded(state: Any) -> Recorded:
        cube = state.cube
        pose = None if cube is None else jnp.concatenate([cube.position, cube.orientation])
        return point_positions(points, state.position, state.orientation), state.tension, pose

    def row(progress: _Progress, commands: Any) -> tuple[_Progress, Recorded]:
        progress = lax.scan(jax.checkpoint(one, prevent_cse=False), progress, commands)[0]
        return progress, recorded(progress.state)

    def next_row(index: Int[Array, ""], carry: tuple[_Progress, Any]) -> tuple[_Progress, Any]:
        progress, here = row(carry[0], jax.tree.map(lambda part: part[index], drive))
        return progress, jax.tree.map(lambda rows, new: rows.at[index].set(new), carry[1], here)

    first = _Progress(start, StepInfo(jnp.array(False), jnp.array(True)))
    if horizon is None:
        last, rows = lax.scan(row, first, drive)
    else:
        count = jax.tree.leaves(drive)[0].shape[0]
        empty = jax.tree.map(lambda part: jnp.zeros((count, *part.shape)), recorded(start))
        last, rows = lax.fori_loop(0, jnp.minimum(horizon, count), next_row, (first, empty))
    return Rollout(rows[0], rows[1], last.state, *last.info, rows[2])


def simulate(
    system: System,
    prepared: Prepared,
    state: State,
    drive: Float[Array, "rows substeps drives"],
    time_step: Scalar,
    points: PointMap,
    scene: PushGeometry | None = None,
    cube: Cube | None = None,
    horizon: Int[Array, ""] | int | None = None,
    integrator: Integrator = "euler",
    loads: SectionLoads | None = None,
) -> Rollout:
    """Rollout from ``state`` through the drives (see `System`) of every step, recorded after every row.

    ``time_step`` [s] is the length of a substep. With a ``scene`` and a ``cube`` the body pushes it; ``state.cube`` is
    its initial pose. ``horizon`` as for `roll`. If a step has several stages, ``state.commanded`` are the drives
    before the first step, zero if None. ``loads`` act in every step.

    Raises:
        InputError: a scene in quasi-static motion.
    """
    still = integrator == "quasi-static"
    if still and scene is not None:
        raise InputError("a cube cannot be pushed in quasi-static motion", where="[simulator] motion")
    if loads is not None:

        def pushed(
            before: State, given: tuple[Float[Array, " drives"], Int[Array, ""]], codes: StepInfo
        ) -> tuple[State, StepInfo]:
            under, force = loaded(system, prepared, loads, given[1])
            if still:
                return quasi_static_step(system, under, before, given[0], force, codes)
            return step(system, under, before, given[0], time_step, force, scene, cube, integrator)

        number = 1 + jnp.arange(drive.shape[0] * drive.shape[1]).reshape(drive.shape[:2])
        begin = remembering(system, prepared, state, scene, integrator)
        return roll(pushed, begin, (drive, number), points, horizon)

    def take(before: State, commanded: Float[Array, " drives"], codes: StepInfo) -> tuple[State, StepInfo]:
        if still:
            return quasi_static_step(system, prepared, before, commanded, 0.0, codes)
        return step(system, prepared, before, commanded, time_step, scene=scene, cube=cube, integrator=integrator)

    return roll(take, remembering(system, prepared, state, scene, integrator), drive, points, horizon)
