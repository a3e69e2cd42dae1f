"""Chambers under pressure beside the axis of a rod.

A chamber lies parallel to the axis along part of the body, and its section does not change. Its pressure does work p dV
= p A dl, with l the length of the fibre in its middle. Sections along a chamber therefore carry the force -p A and its
moment about the axis, in their own frames: the load follows the body.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfdropo_bayes.fem.rod import Rod

Layout = Float[np.ndarray, "chambers elements 6"]
"""Force and moment on a section that a pressure of 1 Pa takes from it [m2], [m3]; mean over each element."""


def chamber_layout(
    body: Rod, middle: Float[np.ndarray, "chambers 2"], ends: Float[np.ndarray, "chambers 2"], area: Sequence[float]
) -> Layout:
    """Chambers with their middle at x and y, from height to height [m], with areas across the axis [m2]."""
    middle, ends = np.reshape(middle, (-1, 2)), np.reshape(ends, (-1, 2))
    covered = np.diff(np.clip(body.station, ends[:, :1], ends[:, 1:]), axis=1)
    force = np.asarray(area, dtype=float).reshape(-1, 1) * covered / np.diff(body.station)
    none, (x, y) = np.zeros_like(force), middle.T[..., None]
    return np.stack([none, none, force, y * force, -x * force, none], axis=-1)


def inflation(layout: Layout, pressure: Float[Array, " chambers"]) -> Float[Array, "6 elements"]:
    """Forces [N] and moments [N m] that pressures [Pa] take from the sections of all elements."""
    return jnp.einsum("cei,c->ie", layout, pressure)


def thrust(layout: Layout, pressure: Float[Array, " chambers"]) -> Float[Array, ""]:
    """Sum of the pressures' forces [N]."""
    return jnp.sum(layout[:, :, 2].max(axis=1) * jnp.abs(pressure))
