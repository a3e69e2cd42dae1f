"""Corotational layers: one rotating frame per layer, internal force and tangent in block-tridiagonal form.

The frame is the rotation of the layer's mean deformation gradient, by Newton's iteration for the polar decomposition (Higham 1986,
SIAM J. Sci. Stat. Comput. 7:1160-1174). In that frame the layer is linear: f = -R K (R' x - X), tangent R K R' (Felippa and
Haugen 2005, Comput. Methods Appl. Mech. Engng 194:2285-2335, without the geometric terms).
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.fem.blocktridiagonal import BlockTridiagonal
from rfdropo_bayes.fem.hexahedron import cofactor

POLAR_ITERATIONS = 6
"""Converge to round-off for stretches between 0.3 and 3."""


def rotation(deformation: Float[Array, "... 3 3"]) -> Float[Array, "... 3 3"]:
    """Rotation R of the polar decomposition F = R U, for det F > 0."""
    for _ in range(POLAR_ITERATIONS):
        adjugate = cofactor(deformation)
        determinant = jnp.sum(deformation[..., :1, :] * adjugate[..., :1, :], axis=-1, keepdims=True)
        deformation = 0.5 * (deformation + adjugate / determinant)
    return deformation


def frames(gradient: Float[Array, "layers nodes2 3"], position: Float[Array, "layers nodes2 3"]) -> Float[Array, "layers 3 3"]:
    """Rotation of every layer from its node positions and ``layered.centre_gradient``."""
    return rotation(jnp.einsum("lni,lnj->lij", position, gradient))


def local_displacement(
    frame: Float[Array, "layers 3 3"], position: Float[Array, "layers nodes2 3"], rest: Float[Array, "layers nodes2 3"]
) -> Float[Array, "layers dofs"]:
    """Displacement in the layer's own frame, R' x - X. Node positions relative to a node keep its digits."""
    relative = position - position[:, :1]
    turned = jnp.einsum("lji,lnj->lni", frame, relative)
    return (turned - (rest - rest[:, :1])).reshape(len(frame), -1)


def internal_force(
    stiffness: Float[Array, "layers dofs dofs"],
    frame: Float[Array, "layers 3 3"],
    displacement: Float[Array, "layers dofs"],
) -> Float[Array, "stations nodes 3"]:
    """Elastic force [N] on the nodes of every station."""
    layers = len(frame)
    local = jnp.einsum("lij,lj->li", stiffness, displacement).reshape(layers, -1, 3)
    force = -jnp.einsum("lij,lnj->lni", frame, local)
    half = force.shape[1] // 2
    none = jnp.zeros((1, half, 3))
    return jnp.concatenate([force[:, :half], none]) + jnp.concatenate([none, force[:, half:]])


def tangent(
    stiffness: Float[Array, "layers dofs dofs"], frame: Float[Array, "layers 3 3"]
) -> BlockTridiagonal:
    """Tangent stiffness R K R' [N/m] over all stations; positive semi-definite."""
    layers, size = stiffness.shape[0], stiffness.shape[1] // 2
    nodes = size // 3

    def turned(block: Float[Array, "layers b b"]) -> Float[Array, "layers b b"]:
        parts = block.reshape(layers, nodes, 3, nodes, 3)
        return jnp.einsum("lij,lnjmk,lhk->lnimh", frame, parts, frame).reshape(layers, size, size)

    below, above = turned(stiffness[:, :size, :size]), turned(stiffness[:, size:, size:])
    none = jnp.zeros((1, size, size))
    diagonal = jnp.concatenate([below, none]) + jnp.concatenate([none, above])
    return BlockTridiagonal(diagonal, turned(stiffness[:, size:, :size]))
