"""Whole rollouts: commands in, recorded point positions and cable tensions out."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rfdropo_bayes.fem.dynamics import Prepared, State, System, remembering, step
from rfdropo_bayes.fem.effects import Scalar
from rfdropo_bayes.fem.layered import PointMap, point_positions


class Rollout(NamedTuple):
    """Recorded motion. A diverged rollout stays finite, but its rows from then on mean nothing."""

    position: Float[Array, "rows points 3"]  # [m]
    tension: Float[Array, "rows cables"]  # [N]
    state: State  # after the last step
    diverged: Bool[Array, ""]
    cables_converged: Bool[Array, ""]


class _Progress(NamedTuple):
    state: State
    diverged: Bool[Array, ""]
    cables_converged: Bool[Array, ""]


def _advance(
    system: System,
    prepared: Prepared,
    progress: _Progress,
    commands: Float[Array, "substeps cables"],
    time_step: Scalar,
    external_force: Float[Array, "nodes 3"] | float,
) -> _Progress:
    """The steps of one recorded row."""

    def one(progress: _Progress, displacement: Float[Array, " cables"]) -> tuple[_Progress, None]:
        state, info = step(system, prepared, progress.state, displacement, time_step, external_force)
        return _Progress(
            state, progress.diverged | info.diverged, progress.cables_converged & info.cables_converged
        ), None

    return lax.scan(one, progress, commands)[0]


def simulate(
    system: System,
    prepared: Prepared,
    state: State,
    displacement: Float[Array, "rows substeps cables"],
    time_step: Scalar,
    points: PointMap,
    external_force: Float[Array, "nodes 3"] | float = 0.0,
) -> Rollout:
    """Rollout from ``state`` through the commanded cable displacements [m] of every step, recorded after every row.

    ``time_step`` [s] is that of one substep; ``external_force`` [N] is constant. Forward and reverse mode both work.
    """

    def row(
        progress: _Progress, commands: Float[Array, "substeps cables"]
    ) -> tuple[_Progress, tuple[Float[Array, "points 3"], Float[Array, " cables"]]]:
        progress = _advance(system, prepared, progress, commands, time_step, external_force)
        return progress, (point_positions(points, progress.state.position), progress.state.tension)

    start = _Progress(remembering(system, prepared, state), jnp.array(False), jnp.array(True))
    last, (position, tension) = lax.scan(row, start, displacement)
    return Rollout(position, tension, *last)


def simulate_prefix(
    system: System,
    prepared: Prepared,
    state: State,
    displacement: Float[Array, "rows substeps cables"],
    time_step: Scalar,
    points: PointMap,
    horizon: Int[Array, ""] | int,
    external_force: Float[Array, "nodes 3"] | float = 0.0,
) -> Rollout:
    """The first ``horizon`` rows of ``simulate``; later rows are zero.

    ``horizon`` may be traced: one compilation serves every prefix, and rows beyond it cost nothing. No reverse mode.
    """
    rows = displacement.shape[0]

    def row(index: Int[Array, ""], carry: tuple[_Progress, Array, Array]) -> tuple[_Progress, Array, Array]:
        progress, position, tension = carry
        progress = _advance(system, prepared, progress, displacement[index], time_step, external_force)
        here = point_positions(points, progress.state.position)
        return progress, position.at[index].set(here), tension.at[index].set(progress.state.tension)

    start = _Progress(remembering(system, prepared, state), jnp.array(False), jnp.array(True))
    empty = jnp.zeros((rows, len(points.node), 3)), jnp.zeros((rows, len(state.tension)))
    last, position, tension = lax.fori_loop(0, jnp.minimum(horizon, rows), row, (start, *empty))
    return Rollout(position, tension, *last)
