"""Geometric stiffness of layers in tension and of taut cables, which the corotational tangent leaves out.

Layers in tension, body and cables together, hold the axis straight as a string does. Without it the iteration for
equilibrium of a soft body that hangs in its cables or its own weight swings about the answer with growing amplitude,
and so do time steps under strongly opposed cables.

Taut cables hold a body against twist, as the strings of a bifilar pendulum do. A cable of tension T at distance r from
the axis resists the relative twist of two sections L apart with T r^2 / L. The compression of the body cancels what its
cables do to the lateral motion of sections, but not this; at the necks of a notched trunk it exceeds the body's own
torsional stiffness several times. An iteration whose tangent leaves it out swings in twist and never ends.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfdropo_bayes.fem.blocktridiagonal import BlockTridiagonal, at_stations
from rfdropo_bayes.fem.cables import CableLayout, routes
from rfdropo_bayes.fem.layered import LayeredBody, rest_layers, rest_positions


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


def twist_arms(body: LayeredBody, layout: CableLayout) -> Float[np.ndarray, "layers cables"]:
    """r^2 / L [m] of every cable in every layer, at rest and halfway up the layer; zero beyond the cable's end."""
    middle = 0.5 * (body.station[1:] + body.station[:-1])
    arms = np.zeros((len(middle), len(layout.anchor)))
    for cable, route in enumerate(routes(layout, rest_positions(body))):
        route = route[np.argsort(route[:, 2], kind="stable")]
        x, y = (np.interp(middle, route[:, 2], route[:, i]) for i in (0, 1))
        reached = (middle >= route[0, 2]) & (middle <= route[-1, 2])
        arms[:, cable] = np.where(reached, x**2 + y**2, 0.0)
    return arms / np.diff(body.station)[:, None]


def twist_functional(body: LayeredBody) -> Float[np.ndarray, "layers nodes2 3"]:
    """Twist of the upper face of every layer relative to the lower one, as weights of local displacements [1/m].

    Of a face it is the mean of the slopes of u_y along x and of -u_x along y.
    """
    faces = rest_layers(body).reshape(len(body.station) - 1, 2, -1, 3)
    offset = faces - faces.mean(axis=2, keepdims=True)
    squares = np.sum(offset**2, axis=2, keepdims=True)
    sign = np.array([-1.0, 1.0])[None, :, None]
    functional = np.zeros_like(faces)
    functional[..., 0] = -0.5 * sign * offset[..., 1] / squares[..., 1]
    functional[..., 1] = 0.5 * sign * offset[..., 0] / squares[..., 0]
    return functional.reshape(len(faces), -1, 3)


def twist_stiffening(
    body: LayeredBody, layout: CableLayout, frame: Float[Array, "layers 3 3"], tension: Float[Array, " cables"]
) -> BlockTridiagonal:
    """Stiffness that the tensions [N] add against the twist of every layer in its present frame."""
    stiffness = jnp.asarray(twist_arms(body, layout)) @ tension
    functional = jnp.einsum("lij,lnj->lni", frame, twist_functional(body)).reshape(len(stiffness), -1)
    dyad = stiffness[:, None, None] * functional[:, :, None] * functional[:, None, :]
    half = functional.shape[1] // 2
    return BlockTridiagonal(at_stations(dyad[:, :half, :half], dyad[:, half:, half:]), dyad[:, half:, :half])
