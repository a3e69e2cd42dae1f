"""The constraint problem of cables alone, on lanes of a batch: a complementarity problem, solved by its active set.

With cables only, Newton's step of ``constraints`` is the solution of R g + W g = -b over the cables that pull now. It is
taken whole, or to where the line search of that module ends, until the set stays.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rfdropo_bayes.fem.constraints import HALVINGS, ITERATIONS, TOLERANCE


def _solve(matrix: Float[Array, "n n lanes"], right: Float[Array, "n lanes"]) -> Float[Array, "n lanes"]:
    """Solution with a positive definite matrix, by elimination above and below each pivot."""
    whole = jnp.concatenate([matrix, right[:, None]], axis=1)

    def sweep(index: Array, whole: Array) -> Array:
        row, column = whole[index], whole[:, index]
        row = row / row[index]
        swept = whole - column[:, None] * row[None]
        return lax.dynamic_update_index_in_dim(swept, row, index, 0)

    return lax.fori_loop(0, len(right), sweep, whole)[:, -1]


def settle_cables(
    compliance: Float[Array, "n n lanes"],
    free: Float[Array, "n lanes"],
    softness: Float[Array, "n lanes"],
    start: Float[Array, "n lanes"],
) -> tuple[Float[Array, "n lanes"], Float[Array, " lanes"]]:
    """Impulses, and 1 where they were found."""
    size = len(free)
    lanes = max(part.shape[-1] for part in (compliance, free, softness, start))
    if not size:
        return jnp.zeros((0, lanes)), jnp.ones(lanes)
    compliance, free, softness, start = (
        jnp.broadcast_to(part, (*part.shape[:-1], lanes)) for part in (compliance, free, softness, start)
    )
    usable = jnp.isfinite(softness)
    soft = jnp.where(usable, softness, 1.0)
    eye = jnp.eye(size)[:, :, None]

    def product(impulse: Array) -> Array:
        return sum((compliance[:, k] * impulse[k] for k in range(1, size)), compliance[:, 0] * impulse[0])

    def pulled(velocity: Array) -> Array:
        return jnp.where(usable & (velocity < 0.0), -velocity / soft, 0.0)

    def one(carry: Any) -> Any:
        impulse, _, iteration = carry
        velocity = free + product(impulse)
        active = usable & (velocity < 0.0)
        both = active[:, None] & active[None]
        matrix = jnp.where(both, compliance, 0.0) + eye * jnp.where(active, soft, 1.0)[None]
        change = _solve(matrix, jnp.where(active, -free, 0.0)) - impulse
        moving = product(change)

        def slope(share: Any) -> Array:
            return jnp.sum(moving * (impulse + share * change - pulled(velocity + share * moving)), axis=0)

        def halve(_: Any, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
            low, high = bounds
            middle = 0.5 * (low + high)
            ahead = slope(middle) > 0.0
            return jnp.where(ahead, low, middle), jnp.where(ahead, middle, high)

        largest = jnp.maximum(jnp.max(jnp.abs(free), axis=0), jnp.max(jnp.abs(velocity), axis=0))
        going = jnp.max(jnp.abs(moving), axis=0) > TOLERANCE * largest
        beyond = (slope(1.0) > 0.0) & going
        none, whole = jnp.zeros(lanes), jnp.ones(lanes)
        low, high = lax.cond(
            jnp.any(beyond), lambda: lax.fori_loop(0, HALVINGS, halve, (none, whole)), lambda: (none, whole)
        )
        share = jnp.where(beyond, 0.5 * (low + high), 1.0)
        return impulse + share * change, going, iteration + 1

    first = start, jnp.ones(lanes, bool), 0
    impulse, going, _ = lax.while_loop(lambda c: jnp.any(c[1]) & (c[2] < ITERATIONS), one, first)
    return impulse, jnp.where(going, 0.0, 1.0)
