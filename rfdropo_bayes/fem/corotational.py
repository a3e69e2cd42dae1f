"""Corotational layers: one rotating frame per layer, internal force and tangent in block-tridiagonal form.

The frame is the rotation of the layer's mean deformation gradient, by Newton's iteration for the polar decomposition
(Higham 1986, SIAM J. Sci. Stat. Comput. 7:1160-1174). In that frame the layer is linear: f = -R K (R' x - X), tangent R
K R' (Felippa and Haugen 2005, Comput. Methods Appl. Mech. Engng 194:2285-2335, without the geometric terms). A layer of
several hexahedra side by side turns as one: the sections of a slender body do, and it is one frame instead of four.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from rfdropo_bayes.fem.blocktridiagonal import BlockTridiagonal, at_stations
from rfdropo_bayes.fem.hexahedron import cofactor

POLAR_ITERATIONS = 6
"""Converge to round-off for stretches between 0.3 and 3."""


def rotation(deformation: Float[Array, "... 3 3"]) -> Float[Array, "... 3 3"]:
    """Rotation R of the polar decomposition F = R U, for det F > 0."""

    def average(_: Int[Array, ""], current: Float[Array, "... 3 3"]) -> Float[Array, "... 3 3"]:
        adjugate = cofactor(current)
        determinant = jnp.sum(current[..., :1, :] * adjugate[..., :1, :], axis=-1, keepdims=True)
        return 0.5 * (current + adjugate / determinant)

    return lax.fori_loop(0, POLAR_ITERATIONS, average, deformation)


def frames(
    gradient: Float[Array, "layers nodes2 3"], position: Float[Array, "layers nodes2 3"]
) -> Float[Array, "layers 3 3"]:
    """Rotation of every layer from its node positions and ``layered.centre_gradient``."""
    return rotation(jnp.einsum("lni,lnj->lij", position, gradient))


def local_displacement(
    frame: Float[Array, "layers 3 3"], position: Float[Array, "layers nodes2 3"], rest: Float[Array, "layers nodes2 3"]
) -> Float[Array, "layers dofs"]:
    """Displacement in the layer's own frame, R' x - X. Node positions relative to a node keep its digits."""
    return turned_back(frame, position) - (rest - rest[:, :1]).reshape(len(frame), -1)


def turned_back(
    frame: Float[Array, "layers 3 3"], field: Float[Array, "layers nodes2 3"]
) -> Float[Array, "layers dofs"]:
    """A nodal field in each layer's own frame, relative to its first node."""
    return jnp.einsum("lji,lnj->lni", frame, field - field[:, :1]).reshape(len(frame), -1)


def internal_force(
    frame: Float[Array, "layers 3 3"], resistance: Float[Array, "layers dofs"]
) -> Float[Array, "stations nodes 3"]:
    """Elastic force [N] on the nodes of every station, from what each layer resists in its own frame."""
    force = -jnp.einsum("lij,lnj->lni", frame, resistance.reshape(len(frame), -1, 3))
    half = force.shape[1] // 2
    return at_stations(force[:, :half], force[:, half:])


def pack(stiffness: Float[Array, "layers dofs dofs"]) -> Float[Array, "layers 9 pairs"]:
    """Layer stiffness for ``tangent``: the nine component pairs, then block (lower, upper, coupling) and node pair."""
    layers, size = stiffness.shape[0], stiffness.shape[1] // 2
    blocks = stiffness[:, :size, :size], stiffness[:, size:, size:], stiffness[:, size:, :size]
    parts = jnp.stack(blocks, axis=1).reshape(layers, 3, size // 3, 3, size // 3, 3)
    return jnp.transpose(parts, (0, 3, 5, 1, 2, 4)).reshape(layers, 9, size * size // 3)


def tangent(packed: Float[Array, "layers 9 pairs"], frame: Float[Array, "layers 3 3"]) -> BlockTridiagonal:
    """Tangent stiffness R K R' [N/m] over all stations, from ``pack``; positive semi-definite.

    One product with R (x) R turns all node pairs of a layer at once, several times faster than two products per pair.
    """
    layers = len(frame)
    section = math.isqrt(packed.shape[2] // 3)
    pairs = jnp.einsum("lij,lhk->lihjk", frame, frame).reshape(layers, 9, 9)
    parts = (pairs @ packed).reshape(layers, 3, 3, 3, section, section)
    blocks = jnp.transpose(parts, (3, 0, 4, 1, 5, 2)).reshape(3, layers, 3 * section, 3 * section)
    return BlockTridiagonal(at_stations(blocks[0], blocks[1]), blocks[2])
