"""Geometric stiffness of layers in tension, body and cables together: they hold the axis straight as a string does.

The corotational tangent leaves it out. Without it the iteration for equilibrium of a soft body that hangs in its cables
or its own weight swings about the answer with growing amplitude.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfdropo_bayes.fem.blocktridiagonal import BlockTridiagonal, at_stations
from rfdropo_bayes.fem.layered import LayeredBody


def layer_tension(
    body: LayeredBody,
    resistance: Float[Array, "layers dofs"],
    cable_force: Float[Array, "nodes 3"],
    frame: Float[Array, "layers 3 3"],
) -> Float[Array, " layers"]:
    """Axial force [N] in each section, of what the layer resists in its frame and of the cables together: what a cable
    compresses, it holds straight as well."""
    nodes = body.section_nodes
    axial = jnp.sum(resistance.reshape(len(frame), 2 * nodes, 3)[:, nodes:, 2], axis=1)
    beyond = jnp.cumsum(jnp.sum(cable_force.reshape(-1, nodes, 3), axis=1)[::-1], axis=0)[::-1][1:]
    return axial - jnp.einsum("li,li->l", beyond, frame[:, :, 2])


def lateral_stiffening(
    body: LayeredBody, frame: Float[Array, "layers 3 3"], tension: Float[Array, " layers"]
) -> BlockTridiagonal:
    """Stiffness N / L against lateral motion of one face relative to the other, for tensions [N] in the layers.

    Compression is left out: its stiffness would be negative.
    """
    nodes = body.section_nodes
    axis = frame[:, :, 2]
    lateral = jnp.eye(3) - axis[:, :, None] * axis[:, None, :]
    spring = jnp.maximum(tension, 0.0) / np.diff(body.station) / nodes**2
    block = jax.vmap(lambda part: jnp.kron(jnp.ones((nodes, nodes)), part))(lateral * spring[:, None, None])
    return BlockTridiagonal(at_stations(block, block), -block)
