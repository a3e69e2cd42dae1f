"""The direct solver against dense algebra."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rfdropo_bayes.fem.blocktridiagonal import BlockTridiagonal, multiply, solve

from rfdropo_bayes import fem  # noqa: F401  (switches JAX to float64)


def random_system(seed: int, blocks: int, size: int) -> BlockTridiagonal:
    """Positive definite: a product of block-bidiagonal factors, condition number of some thousands."""
    rng = np.random.default_rng(seed)
    lower, diagonal = rng.normal(size=(blocks - 1, size, size)), rng.normal(size=(blocks, size, size))
    square = diagonal @ diagonal.transpose(0, 2, 1) + 0.1 * np.eye(size)
    square[1:] += lower @ lower.transpose(0, 2, 1)
    return BlockTridiagonal(jnp.asarray(square), jnp.asarray(lower @ diagonal[:-1].transpose(0, 2, 1)))


def dense(matrix: BlockTridiagonal) -> np.ndarray:
    """The whole matrix."""
    blocks, size, _ = matrix.diagonal.shape
    full = np.zeros((blocks * size, blocks * size))
    for row in range(blocks):
        here = slice(row * size, (row + 1) * size)
        full[here, here] = matrix.diagonal[row]
        if row:
            before = slice((row - 1) * size, row * size)
            full[here, before], full[before, here] = matrix.lower[row - 1], matrix.lower[row - 1].T
    return full


@pytest.mark.parametrize(("blocks", "size"), [(1, 3), (7, 12), (4, 27)])
def test_solution_agrees_with_dense_algebra(blocks, size):
    matrix = random_system(0, blocks, size)
    right = np.random.default_rng(1).normal(size=(blocks, size, 4))
    expected = np.linalg.solve(dense(matrix), right.reshape(-1, 4))
    found = jax.jit(solve)(matrix, jnp.asarray(right))
    np.testing.assert_allclose(found.reshape(-1, 4), expected, rtol=1e-9, atol=1e-10 * np.abs(expected).max())
    np.testing.assert_allclose(multiply(matrix, found), right, atol=1e-9)


def test_both_modes_of_differentiation_agree_with_dense_algebra():
    matrix, change = random_system(2, 3, 6), random_system(3, 3, 6)
    right = jnp.asarray(np.random.default_rng(4).normal(size=(3, 6, 2)))

    def value(amount):
        moved = jax.tree.map(lambda a, b: a + amount * b, matrix, change)
        return jnp.sum(jnp.sin(solve(moved, right * (1.0 + amount))))

    solution = np.linalg.solve(dense(matrix), right.reshape(-1, 2))
    derivative = np.linalg.solve(dense(matrix), right.reshape(-1, 2) - dense(change) @ solution)
    expected = np.sum(np.cos(solution) * derivative)
    assert float(jax.jvp(value, (0.0,), (1.0,))[1]) == pytest.approx(expected, rel=1e-8)
    assert float(jax.grad(value)(0.0)) == pytest.approx(expected, rel=1e-8)
