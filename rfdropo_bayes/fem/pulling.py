"""One linear solve of a layered body that cables pull, with friction along them where there is any."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rfdropo_bayes.fem.blocktridiagonal import BlockTridiagonal, solve
from rfdropo_bayes.fem.cable_friction import Slip, tensions_with_friction
from rfdropo_bayes.fem.cables import unilateral_tensions
from rfdropo_bayes.fem.effects import Scalar


class Pull(NamedTuple):
    """The cables in one linear solve."""

    jacobian: Float[Array, "cables nodes 3"]
    slack: Float[Array, " cables"]  # what is left of the commanded length, in the unit of jacobian times increment
    previous: Float[Array, " cables"]  # tensions that start the active set
    give: Float[Array, ""] | float = 0.0  # of every cable's slack per tension


class CableSolution(NamedTuple):
    """Increment of the body, tensions, and whether the cable problem was solved."""

    increment: Float[Array, "nodes 3"]
    tension: Float[Array, " cables"]
    converged: Bool[Array, ""]
    mobilised: Float[Array, " runs"]  # share of the friction, -1 to 1


def constrained_increment(
    held: int,
    matrix: BlockTridiagonal,
    right: Float[Array, "nodes 3"],
    pull: Pull,
    slip: Slip | None = None,
    velocity: Float[Array, "nodes 3"] | float = 0.0,
    time_step: Scalar = 1.0,
) -> CableSolution:
    """Solve A u = r - J' T with T >= 0 complementary to slack - J u >= 0; u is zero on the first ``held`` stations.

    With ``slip``, the velocity of the step's start and the time step [s], friction acts along the cables.
    """
    stations, cables = len(matrix.diagonal), len(pull.slack)
    rows = pull.jacobian if slip is None else jnp.concatenate([pull.jacobian, slip.pattern])
    columns = jnp.concatenate([right[None], rows]).reshape(1 + len(rows), stations, -1)[:, held:]
    columns = jnp.moveaxis(columns, 0, 2)
    solution = solve(BlockTridiagonal(matrix.diagonal[held:], matrix.lower[held:]), columns)
    free, response = solution[..., 0], solution[..., 1:]
    converged, tension, mobilised = jnp.array(True), jnp.zeros(0), jnp.zeros(0)
    if cables:
        compliance = jnp.einsum("sbc,sbd->cd", columns[..., 1:], response)
        moved = jnp.einsum("sbc,sb->c", columns[..., 1:], free)
        compliance = compliance.at[jnp.arange(cables), jnp.arange(cables)].add(pull.give)
        remaining = pull.slack - moved[:cables]
        if slip is None:
            tension, converged = unilateral_tensions(compliance, remaining, pull.previous)
            free = free - response @ tension
        else:
            sliding = jnp.einsum("rni,ni->r", slip.pattern, jnp.broadcast_to(velocity, slip.pattern.shape[1:]))
            (tension, converged), mobilised = tensions_with_friction(
                compliance, remaining, slip, -time_step * (sliding + moved[cables:]), pull.previous, time_step
            )
            drop = time_step * slip.strength * mobilised
            free = free - response[..., :cables] @ tension + response[..., cables:] @ drop
    increment = jnp.concatenate([jnp.zeros((held, free.shape[1])), free])
    return CableSolution(increment.reshape(-1, 3), tension, converged, mobilised)
