"""Symmetric positive definite block-tridiagonal systems with blocks of 6 x 6: Cholesky's factor along a chain of
stations, written out by components, with a batch in the last axis (``lanes``)."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

SIZE = 6


class Factor(NamedTuple):
    """A = C C', with C lower block-bidiagonal."""

    pivot: Float[Array, "stations 6 6"]  # lower triangle of C's diagonal blocks, its diagonal inverted
    coupling: Float[Array, "stations 6 6"]  # transposed blocks below the diagonal, to the station before; zero at first


def _triangle(block: Any) -> Array:
    """Cholesky's factor of a block, the diagonal inverted."""
    none = jnp.zeros_like(block[0, 0])
    rows: list[list[Any]] = [[none] * SIZE for _ in range(SIZE)]
    for k in range(SIZE):
        rows[k][k] = lax.rsqrt(block[k, k] - sum(rows[k][z] * rows[k][z] for z in range(k)))
        for r in range(k + 1, SIZE):
            rows[r][k] = (block[r, k] - sum(rows[r][z] * rows[k][z] for z in range(k))) * rows[k][k]
    return jnp.stack([jnp.stack(row) for row in rows])


def _down(triangle: Any, right: Any) -> Array:
    """Solve with a triangle; right-hand sides (6, ...)."""
    rows: list[Any] = []
    for r in range(SIZE):
        rows.append((right[r] - sum(triangle[r, z] * rows[z] for z in range(r))) * triangle[r, r])
    return jnp.stack(rows)


def _up(triangle: Any, right: Any) -> Array:
    """Solve with a transposed triangle."""
    rows: list[Any] = [None] * SIZE
    for r in reversed(range(SIZE)):
        rows[r] = (right[r] - sum(triangle[z, r] * rows[z] for z in range(r + 1, SIZE))) * triangle[r, r]
    return jnp.stack(rows)


def _across(coupling: Any, values: Any) -> Any:
    """Transpose of a coupling times values (6, ...)."""
    return sum(coupling[z][:, None] * values[z][None] for z in range(SIZE))


def eliminate(
    diagonal: Float[Array, "6 6 stations lanes"],
    lower: Float[Array, "6 6 elements lanes"],
    right: Float[Array, "6 columns stations lanes"],
) -> tuple[Factor, Float[Array, "stations 6 columns lanes"], Float[Array, "columns columns lanes"]]:
    """Factor, Y = C^-1 times right-hand sides, and Y' Y."""
    coupled = jnp.concatenate([jnp.zeros_like(lower[:, :, :1]), lower], axis=2)

    def one(before: tuple[Array, Array, Array], here: tuple[Array, Array, Array]) -> tuple[Any, Any]:
        triangle, solved, total = before
        block, below, values = here
        coupling = _down(triangle, jnp.swapaxes(below, 0, 1))
        block = block - sum(coupling[z][:, None] * coupling[z][None] for z in range(SIZE))
        triangle = _triangle(block)
        solved = _down(triangle, values - _across(coupling, solved))
        total = total + sum(solved[z][:, None] * solved[z][None] for z in range(SIZE))
        return (triangle, solved, total), (triangle, coupling, solved)

    lanes, columns = right.shape[-1], right.shape[1]
    first = (
        jnp.broadcast_to(jnp.eye(SIZE)[:, :, None], (SIZE, SIZE, lanes)),
        jnp.zeros((SIZE, columns, lanes)),
        jnp.zeros((columns, columns, lanes)),
    )
    along = [
        jnp.broadcast_to(jnp.moveaxis(part, 2, 0), (part.shape[2], *part.shape[:2], lanes))
        for part in (diagonal, coupled, right)
    ]
    (_, _, total), (pivot, coupling, solved) = lax.scan(one, first, along)
    return Factor(pivot, coupling), solved, total


def descend(
    factor: Factor, right: Float[Array, "stations 6 columns lanes"]
) -> Float[Array, "stations 6 columns lanes"]:
    """C^-1 times right-hand sides."""

    def one(solved: Array, here: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        triangle, coupling, values = here
        solved = _down(triangle, values - _across(coupling, solved))
        return solved, solved

    start = jnp.zeros_like(right[0] * factor.pivot[0, 0, 0])
    return lax.scan(one, start, (factor.pivot, factor.coupling, right))[1]


def ascend(factor: Factor, right: Float[Array, "stations 6 columns lanes"]) -> Float[Array, "stations 6 columns lanes"]:
    """C'^-1 times right-hand sides."""

    def one(after: tuple[Array, Array], here: tuple[Array, Array, Array]) -> tuple[Any, Array]:
        solved, coupling = after
        triangle, own, values = here
        back = sum(coupling[:, k][:, None] * solved[k][None] for k in range(SIZE))
        solved = _up(triangle, values - back)
        return (solved, own), solved

    start = jnp.zeros_like(right[0] * factor.pivot[0, 0, 0]), jnp.zeros_like(factor.coupling[0])
    return lax.scan(one, start, (factor.pivot, factor.coupling, right), reverse=True)[1]
