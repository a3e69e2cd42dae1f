"""Symmetric positive definite systems along a chain of stations with six unknowns each: Cholesky's factor, written out
by components, with a batch in the last axis (``lanes``).

Matrices come as the stiffness of the elements between stations and the inertia at stations. Blocks are assembled during
elimination, which saves memory traffic.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rfdropo_bayes.fem.components import Matrix, transposed
from rfdropo_bayes.fem.rod_elements import Stiffness

SIZE = 6


class Chain(NamedTuple):
    """A symmetric block-tridiagonal matrix."""

    element: Stiffness
    straight: Matrix  # of the translations of a station
    turning: Matrix  # of its rotations


class Factor(NamedTuple):
    """A = C C', with C lower block-bidiagonal."""

    pivot: Float[Array, "stations 6 6 ..."]  # lower triangles of C's diagonal blocks, their diagonals inverted
    coupling: Float[Array, "stations 6 6 ..."]  # transposed blocks below the diagonal; zero at the first station


class Eliminated(NamedTuple):
    """Result of the elimination."""

    factor: Factor
    solved: Float[Array, "stations 6 ..."]  # y = C^-1 times the right-hand side
    columns: Float[Array, "stations 6 rows ..."]  # Y = C^-1 J'
    compliance: Float[Array, "rows rows ..."]  # Y' Y = J A^-1 J'
    reached: Float[Array, "rows ..."]  # Y' y
    moving: Float[Array, "rows ..."]  # J times the velocities


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
    """Solve with a triangle."""
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


def _at(values: Any, index: Array) -> Any:
    """Entries of the third axis."""
    return jax.tree.map(lambda part: lax.dynamic_index_in_dim(part, index, 2, keepdims=False), values)


def _block(one: Matrix, two: Matrix, three: Matrix, four: Matrix) -> Float[Array, "6 6 ..."]:
    return jnp.concatenate([jnp.concatenate([one, two], axis=1), jnp.concatenate([three, four], axis=1)])


def eliminate(
    chain: Chain,
    right: Float[Array, "6 stations ..."],
    rows: Float[Array, "stations 6 rows ..."],
    twist: Float[Array, "6 stations ..."],
    clamped: int,
) -> Eliminated:
    """Factorise and go down with a right-hand side and the rows J of constraints, over the stations that are free."""
    stations, many, lanes = right.shape[1], rows.shape[2], right.shape[-1]

    def one(before: Any, here: tuple[Array, Array]) -> tuple[Any, Any]:
        triangle, solved, columns, compliance, reached, moving = before
        index, row = here
        element = _at(chain.element, index - 1)
        below = jax.tree.map(lambda part: jnp.where(index > 0, part, 0.0), element) if clamped == 0 else element
        above = jax.tree.map(lambda part: jnp.where(index < stations - 1, part, 0.0), _at(chain.element, index))
        mixed = below.b - above.a
        straight = below.c + above.c + _at(chain.straight, index)
        turning = below.bb + above.aa + _at(chain.turning, index)
        block = _block(straight, mixed, transposed(mixed), turning)
        coupled = _block(-below.c, -below.b, transposed(below.a), transposed(below.ba))
        coupling = jnp.where(index > clamped, _down(triangle, coupled), 0.0)
        triangle = _triangle(block - sum(coupling[z][:, None] * coupling[z][None] for z in range(SIZE)))
        force = lax.dynamic_index_in_dim(right, index, 1, keepdims=False)
        speed = lax.dynamic_index_in_dim(twist, index, 1, keepdims=False)
        solved = _down(triangle, force - sum(coupling[z] * solved[z] for z in range(SIZE)))
        across = sum(coupling[z][:, None] * columns[z][None] for z in range(SIZE))
        columns = _down(triangle, row - across)
        compliance = compliance + sum(column[:, None] * column[None] for column in columns)
        reached = reached + sum(column * value for column, value in zip(columns, solved, strict=True))
        moving = moving + sum(row[z] * speed[z] for z in range(SIZE))
        return (triangle, solved, columns, compliance, reached, moving), (triangle, coupling, solved, columns)

    none = jnp.zeros((many, lanes))
    first = (
        jnp.ones((SIZE, SIZE, lanes)),
        jnp.zeros((SIZE, lanes)),
        jnp.zeros((SIZE, many, lanes)),
        jnp.zeros((many, many, lanes)),
        none,
        none,
    )
    along = jnp.arange(clamped, stations), rows[clamped:]
    last, (pivot, coupling, solved, columns) = lax.scan(one, first, along)
    return Eliminated(Factor(pivot, coupling), solved, columns, *last[3:])


def descend(
    factor: Factor, columns: Float[Array, "stations 6 rows ..."], right: Float[Array, "stations 6 ..."]
) -> tuple[Float[Array, "stations 6 ..."], Float[Array, "rows ..."]]:
    """y = C^-1 times a right-hand side, and Y' y."""

    def one(before: tuple[Array, Array], here: tuple[Array, ...]) -> tuple[Any, Array]:
        solved, total = before
        triangle, coupling, others, values = here
        solved = _down(triangle, values - sum(coupling[z] * solved[z] for z in range(SIZE)))
        return (solved, total + sum(others[z] * solved[z] for z in range(SIZE))), solved

    start = jnp.zeros_like(right[0]), jnp.zeros_like(columns[0, 0])
    (_, total), solved = lax.scan(one, start, (factor.pivot, factor.coupling, columns, right))
    return solved, total


def ascend(factor: Factor, right: Float[Array, "stations 6 ..."]) -> Float[Array, "stations 6 ..."]:
    """C'^-1 times a right-hand side."""

    def one(after: tuple[Array, Array], here: tuple[Array, Array, Array]) -> tuple[Any, Array]:
        solved, coupling = after
        triangle, own, values = here
        solved = _up(triangle, values - sum(coupling[:, k] * solved[k] for k in range(SIZE)))
        return (solved, own), solved

    start = jnp.zeros_like(right[0]), jnp.zeros_like(factor.coupling[0])
    return lax.scan(one, start, (factor.pivot, factor.coupling, right), reverse=True)[1]
