"""Taut cables hold a body against twist, as the strings of a bifilar pendulum do.

A cable of tension T at distance r from the axis resists the relative twist of two sections L apart with T r^2 / L. The
compression of the body cancels what its cables do to the lateral motion of sections, but not this; at the necks of a
notched trunk it exceeds the body's own torsional stiffness several times. An iteration whose tangent leaves it out
swings in twist and never ends.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfdropo_bayes.fem.blocktridiagonal import BlockTridiagonal
from rfdropo_bayes.fem.cables import CableLayout
from rfdropo_bayes.fem.layered import LayeredBody, rest_layers, rest_positions


def twist_arms(body: LayeredBody, layout: CableLayout) -> Float[np.ndarray, "layers cables"]:
    """r^2 / L [m] of every cable in every layer, at rest and halfway up the layer; zero beyond the cable's end."""
    middle = 0.5 * (body.station[1:] + body.station[:-1])
    rest = rest_positions(body)
    arms = np.zeros((len(middle), len(layout.anchor)))
    for cable, (anchor, node, weight, used) in enumerate(zip(*layout, strict=True)):
        route = np.vstack([anchor, np.einsum("gk,gki->gi", weight, rest[node])[used]])
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
    none = jnp.zeros((1, half, half))
    lower, upper = dyad[:, :half, :half], dyad[:, half:, half:]
    return BlockTridiagonal(jnp.concatenate([lower, none]) + jnp.concatenate([none, upper]), dyad[:, half:, :half])
