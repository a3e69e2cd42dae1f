"""Block-tridiagonal systems of any mesh: nodes grouped by their distance from the held ones, in elements.

An element touches at most two neighbouring levels, so the tangent is block tridiagonal with blocks of differing size.
The mesh is known when a function is traced, and the elimination is unrolled over its levels.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

from rfdropo_bayes.errors import InputError


class Levels(NamedTuple):
    """Groups of free nodes; level i holds ``order[first[i]:first[i + 1]]``."""

    order: Int[np.ndarray, " free"]
    first: Int[np.ndarray, " levels_1"]
    place: Int[np.ndarray, " nodes"]  # of every node in ``order``; -1 if it is held


class LevelMatrix(NamedTuple):
    """Symmetric block-tridiagonal matrix; ``lower[i]`` couples level i + 1 to level i."""

    diagonal: tuple[Float[Array, "n n"], ...]
    lower: tuple[Float[Array, "m n"], ...]


def node_levels(element: Int[np.ndarray, "elements 4"], fixed: Bool[np.ndarray, " nodes"]) -> Levels:
    """Levels by breadth-first search from the held nodes.

    Raises:
        InputError: a free node that no chain of elements ties to a held one.
    """
    level = np.where(fixed, 0, -1)
    front, number = fixed, 0
    while np.any(front):
        touched = np.zeros(len(fixed), dtype=bool)
        touched[element[np.any(front[element], axis=1)]] = True
        front, number = touched & (level < 0), number + 1
        level[front] = number
    if np.any(level < 0):
        raise InputError(
            f"{np.sum(level < 0)} nodes hang on no held node, the first is {int(np.argmax(level < 0))}",
            where="mesh", remedy="remove loose parts and unused nodes",
        )  # fmt: skip
    order = np.argsort(level, kind="stable")[int(np.sum(fixed)) :]
    place = np.full(len(fixed), -1)
    place[order] = np.arange(len(order))
    return Levels(order, np.concatenate([[0], np.cumsum(_merged(np.bincount(level)[1:]))]), place)


def _merged(sizes: Int[np.ndarray, " levels"]) -> list[int]:
    """Neighbouring levels joined as long as none outgrows the largest: fewer, fuller blocks, and less to compile."""
    joined = [int(sizes[0])]
    for size in sizes[1:]:
        if joined[-1] + size <= np.max(sizes):
            joined[-1] += int(size)
        else:
            joined.append(int(size))
    return joined


class _Entries(NamedTuple):
    """Where the element blocks, in order (element, a, b), go in one flat array of all blocks of the matrix."""

    used: Int[np.ndarray, " pairs"]  # element blocks on or below the diagonal
    flat: Int[np.ndarray, "pairs 3 3"]  # places of their entries
    start: Int[np.ndarray, " blocks_1"]
    height: Int[np.ndarray, " blocks"]
    width: Int[np.ndarray, " blocks"]


def _entries(levels: Levels, element: np.ndarray) -> _Entries:
    size = np.diff(levels.first)
    height = np.concatenate([size, size[1:]]) * 3
    width = np.concatenate([size, size[:-1]]) * 3
    start = np.concatenate([[0], np.cumsum(height * width)])
    level, inside = np.full(len(levels.place), -1), np.zeros(len(levels.place), dtype=int)
    level[levels.order] = np.repeat(np.arange(len(size)), size)
    inside[levels.order] = np.arange(len(levels.order)) - levels.first[level[levels.order]]
    row, column = np.repeat(element, 4, axis=1).ravel(), np.tile(element, (1, 4)).ravel()
    step = level[row] - level[column]
    used = (level[row] >= 0) & (level[column] >= 0) & ((step == 0) | (step == 1))
    block = np.where(step == 0, level[row], len(size) + level[column])[used]
    axis = np.arange(3)
    rows, columns = 3 * inside[row[used]][:, None] + axis, 3 * inside[column[used]][:, None] + axis
    flat = start[block][:, None, None] + rows[:, :, None] * width[block][:, None, None] + columns[:, None, :]
    return _Entries(np.flatnonzero(used), flat, start, height, width)


def assemble(
    levels: Levels,
    element: np.ndarray,
    tangent: Float[Array, "elements 4 4 3 3"],
    node_diagonal: Float[Array, " nodes"],
) -> LevelMatrix:
    """Sum of element blocks plus a scalar for each node on the diagonal."""
    used, flat, start, height, width = _entries(levels, element)
    values = tangent.reshape(-1, 3, 3)[used]
    total = jnp.zeros(start[-1]).at[flat].add(values)
    blocks = [
        total[first:last].reshape(rows, columns)
        for first, last, rows, columns in zip(start[:-1], start[1:], height, width, strict=True)
    ]
    count = len(levels.first) - 1
    nodes = node_diagonal[levels.order]
    diagonal = tuple(
        block + jnp.diag(jnp.repeat(nodes[levels.first[i] : levels.first[i + 1]], 3))
        for i, block in enumerate(blocks[:count])
    )
    return LevelMatrix(diagonal, tuple(blocks[count:]))


def _split(sizes: list[int], vector: Float[Array, "n k"]) -> list[Float[Array, "m k"]]:
    return jnp.split(vector, np.cumsum(sizes)[:-1])


def multiply(matrix: LevelMatrix, vector: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Matrix times k vectors."""
    parts = _split([len(block) for block in matrix.diagonal], vector)
    result = [block @ part for block, part in zip(matrix.diagonal, parts, strict=True)]
    for i, block in enumerate(matrix.lower):
        result[i + 1] = result[i + 1] + block @ parts[i]
        result[i] = result[i] + block.T @ parts[i + 1]
    return jnp.concatenate(result)


def _eliminate(matrix: LevelMatrix, right: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Block Cholesky, level by level, and both substitutions."""
    parts = _split([len(block) for block in matrix.diagonal], right)
    factors: list[Array] = []
    couplings: list[Array] = []
    for i, block in enumerate(matrix.diagonal):
        if i:
            coupling = solve_triangular(factors[-1], matrix.lower[i - 1].T, lower=True)
            couplings.append(coupling)
            block = block - coupling.T @ coupling
            parts[i] = parts[i] - coupling.T @ parts[i - 1]
        factors.append(jnp.linalg.cholesky(block))
        parts[i] = solve_triangular(factors[-1], parts[i], lower=True)
    for i in reversed(range(len(parts))):
        if i < len(couplings):
            parts[i] = parts[i] - couplings[i] @ parts[i + 1]
        parts[i] = solve_triangular(factors[i], parts[i], lower=True, trans=1)
    return jnp.concatenate(parts)


def solve(matrix: LevelMatrix, right: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Solution X of A X = B for k right-hand sides; derivatives go through the solution, not through the
    elimination."""
    constant = jax.tree.map(lax.stop_gradient, matrix)
    return lax.custom_linear_solve(
        lambda vector: multiply(matrix, vector),
        right,
        solve=lambda _, values: _eliminate(constant, values),
        symmetric=True,
    )
