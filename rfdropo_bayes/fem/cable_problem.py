"""The constraint problem of cables alone, on lanes of a batch: a complementarity problem, solved by its active set.

With cables only, Newton's step of ``constraints`` is the solution of R g + W g = -b over the cables that pull. It is
the answer if these cables are the same after it. Most steps have the same active set as the step before. Otherwise
Newton's method continues from the impulses of that step, with the line search of `fem.constraints`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rfdropo_bayes.fem.constraints import HALVINGS, ITERATIONS, TOLERANCE


class _Iterate(NamedTuple):
    impulse: Float[Array, "n ..."]
    active: Bool[Array, "n ..."]  # cables that are taken to pull
    found: Bool[Array, " ..."]
    iteration: Int[Array, ""]


def _solve(matrix: Float[Array, "n n ..."], right: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """Solution with a positive definite matrix, by elimination above and below each pivot."""
    whole = jnp.concatenate([matrix, right[:, None]], axis=1)

    def sweep(index: Array, whole: Array) -> Array:
        row, column = whole[index], whole[:, index]
        row = row / row[index]
        swept = whole - column[:, None] * row[None]
        return lax.dynamic_update_index_in_dim(swept, row, index, 0)

    return lax.fori_loop(0, len(right), sweep, whole)[:, -1]


def settle_cables(
    compliance: Float[Array, "n n ..."],
    free: Float[Array, "n ..."],
    softness: Float[Array, "n ..."],
    start: Float[Array, "n ..."],
) -> tuple[Float[Array, "n ..."], Float[Array, " ..."]]:
    """Impulses, and 1 if the solve succeeded."""
    size, lanes = free.shape
    if not size:
        return jnp.zeros((0, lanes)), jnp.ones(lanes)
    usable = jnp.isfinite(softness)
    soft = jnp.where(usable, softness, 1.0)
    eye = jnp.eye(size)[:, :, None]

    def product(impulse: Array) -> Array:
        return sum((compliance[:, k] * impulse[k] for k in range(1, size)), compliance[:, 0] * impulse[0])

    def pulling(velocity: Array) -> Array:
        return usable & (velocity < 0.0)

    def searched(current: Array, change: Array, velocity: Array, moving: Array) -> Array:
        """Step length along a change of the impulses."""

        def slope(share: Any) -> Array:
            reached = velocity + share * moving
            wanted = jnp.where(pulling(reached), -reached / soft, 0.0)
            return jnp.sum(moving * (current + share * change - wanted), axis=0)

        def halve(_: Any, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
            low, high = bounds
            middle = 0.5 * (low + high)
            ahead = slope(middle) > 0.0
            return jnp.where(ahead, low, middle), jnp.where(ahead, middle, high)

        low, high = lax.fori_loop(0, HALVINGS, halve, (jnp.zeros(lanes), jnp.ones(lanes)))
        return jnp.where(slope(1.0) > 0.0, 0.5 * (low + high), 1.0)

    def one(now: _Iterate) -> _Iterate:
        both = now.active[:, None] & now.active[None]
        matrix = jnp.where(both, compliance, 0.0) + eye * jnp.where(now.active, soft, 1.0)[None]
        aim = _solve(matrix, jnp.where(now.active, -free, 0.0))
        reached = free + product(aim)
        same = jnp.all(pulling(reached) == now.active, axis=0)

        def go_on() -> tuple[Array, Array, Array]:
            velocity = free + product(now.impulse)
            change, moving = aim - now.impulse, reached - velocity
            largest = jnp.maximum(jnp.max(jnp.abs(free), axis=0), jnp.max(jnp.abs(velocity), axis=0))
            still = jnp.max(jnp.abs(moving), axis=0) <= TOLERANCE * largest
            share = jnp.where(still, 1.0, searched(now.impulse, change, velocity, moving))
            # The constraint set of the step before does not match its impulses: no Newton step continues from it.
            share = jnp.where(now.iteration > 0, share, 0.0)
            return now.impulse + share * change, pulling(velocity + share * moving), still & (now.iteration > 0)

        done = now.found | same
        impulse, active, still = lax.cond(jnp.all(done), lambda: (aim, now.active, jnp.zeros(lanes, bool)), go_on)
        impulse = jnp.where(now.found, now.impulse, jnp.where(same, aim, impulse))
        return _Iterate(impulse, jnp.where(done, now.active, active), done | still, now.iteration + 1)

    first = _Iterate(start, usable & (start > 0.0), jnp.zeros(lanes, bool), jnp.zeros((), int))
    last = lax.while_loop(lambda now: ~jnp.all(now.found) & (now.iteration < ITERATIONS), one, first)
    return last.impulse, last.found.astype(float)
