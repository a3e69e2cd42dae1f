"""Symmetric positive definite block-tridiagonal systems: factor once, solve for many right-hand sides.

Block elimination along the axis. The pivot blocks are inverted explicitly, by sweeps over their 3 x 3 diagonal blocks:
plain array operations over a batch, where a LAPACK call for each small block would cost more than its arithmetic.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from rfdropo_bayes.fem.hexahedron import cofactor


class BlockTridiagonal(NamedTuple):
    """Symmetric matrix with blocks on the diagonal and below it; ``lower[i]`` couples row i + 1 to column i."""

    diagonal: Float[Array, "stations b b"]
    lower: Float[Array, "stations_1 b b"]


def at_stations(lower: Float[Array, "layers *b"], upper: Float[Array, "layers *b"]) -> Float[Array, "stations *b"]:
    """Sums at all stations of what every layer has at its lower and at its upper one."""
    none = jnp.zeros_like(lower[:1])
    return jnp.concatenate([lower, none]) + jnp.concatenate([none, upper])


class BlockFactor(NamedTuple):
    """Inverse pivots D^-1 and multipliers L of A = (1 + L) D (1 + L)'; ``multiplier[0]`` is zero."""

    inverse: Float[Array, "stations b b"]
    multiplier: Float[Array, "stations b b"]


def multiply(matrix: BlockTridiagonal, vector: Float[Array, "stations b k"]) -> Float[Array, "stations b k"]:
    """Matrix times k vectors."""
    result = matrix.diagonal @ vector
    result = result.at[1:].add(matrix.lower @ vector[:-1])
    return result.at[:-1].add(jnp.swapaxes(matrix.lower, -1, -2) @ vector[1:])


def invert(block: Float[Array, "b b"]) -> Float[Array, "b b"]:
    """Inverse of a symmetric positive definite block of a size divisible by three (Gauss-Jordan by 3 x 3 pivots)."""
    size = block.shape[-1]

    def sweep(index: Int[Array, ""], block: Float[Array, "b b"]) -> Float[Array, "b b"]:
        first = 3 * index
        pivot = lax.dynamic_slice(block, (first, first), (3, 3))
        adjugate = cofactor(pivot).T
        inverse = adjugate / jnp.dot(pivot[0], adjugate[:, 0])
        row = inverse @ lax.dynamic_slice(block, (first, 0), (3, size))
        row = lax.dynamic_update_slice(row, inverse, (0, first))
        column = lax.dynamic_slice(block, (0, first), (size, 3))
        column = lax.dynamic_update_slice(column, jnp.zeros((3, 3)), (first, 0))
        rest = lax.dynamic_update_slice(block, jnp.zeros((size, 3)), (0, first))
        return lax.dynamic_update_slice(rest - column @ row, row, (first, 0))

    return lax.fori_loop(0, size // 3, sweep, block)


def factor(matrix: BlockTridiagonal) -> BlockFactor:
    """Eliminate from the first station to the last."""

    def eliminate(previous_inverse: Array, blocks: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        diagonal, lower = blocks
        multiplier = lower @ previous_inverse
        inverse = invert(diagonal - multiplier @ lower.T)
        return inverse, (inverse, multiplier)

    lower = jnp.concatenate([jnp.zeros_like(matrix.diagonal[:1]), matrix.lower])
    _, (inverse, multiplier) = lax.scan(eliminate, jnp.zeros_like(lower[0]), (matrix.diagonal, lower))
    return BlockFactor(inverse, multiplier)


def substitute(factored: BlockFactor, right: Float[Array, "stations b k"]) -> Float[Array, "stations b k"]:
    """Solve with a factor for k right-hand sides."""

    def forward(previous: Array, blocks: tuple[Array, Array]) -> tuple[Array, Array]:
        multiplier, values = blocks
        values = values - multiplier @ previous
        return values, values

    def backward(following: Array, blocks: tuple[Array, Array]) -> tuple[Array, Array]:
        multiplier, values = blocks
        values = values - following
        return multiplier.T @ values, values

    start = jnp.zeros_like(right[0])
    _, reduced = lax.scan(forward, start, (factored.multiplier, right))
    _, solution = lax.scan(backward, start, (factored.multiplier, factored.inverse @ reduced), reverse=True)
    return solution


def solve(matrix: BlockTridiagonal, right: Float[Array, "stations b k"]) -> Float[Array, "stations b k"]:
    """Solution X of A X = B for k right-hand sides.

    Derivatives go through the solution and not through the elimination: a tangent or a cotangent costs one substitution
    with the factor that is there already.
    """
    factored = factor(jax.tree.map(lax.stop_gradient, matrix))
    return lax.custom_linear_solve(
        lambda vector: multiply(matrix, vector),
        right,
        solve=lambda _, values: substitute(factored, values),
        symmetric=True,
    )
