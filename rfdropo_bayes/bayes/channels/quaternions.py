"""Rotations as unit quaternions (x, y, z, w)."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float


def inverse(q: Float[Array, "... 4"]) -> Float[Array, "... 4"]:
    """The rotation back."""
    return q * jnp.array([-1.0, -1.0, -1.0, 1.0])


def product(a: Float[Array, "... 4"], b: Float[Array, "... 4"]) -> Float[Array, "... 4"]:
    """First b, then a."""
    vector = a[..., 3:] * b[..., :3] + b[..., 3:] * a[..., :3] + jnp.cross(a[..., :3], b[..., :3])
    scalar = a[..., 3] * b[..., 3] - jnp.sum(a[..., :3] * b[..., :3], axis=-1)
    return jnp.concatenate([vector, scalar[..., None]], axis=-1)


def turn_between(first: Float[Any, "... 4"], second: Float[Any, "... 4"]) -> Float[Any, "... 3"]:
    """Twice the vector of the quaternion from one turn to another: the rotation vector [rad] for small turns, without a
    singularity for large turns.
    """
    between = product(second, inverse(first))
    return 2.0 * jnp.where(between[..., 3:] < 0.0, -1.0, 1.0) * between[..., :3]


def of_rotation_vector(turn: Float[Array, "... 3"]) -> Float[Array, "... 4"]:
    """The rotation by a vector [rad]; smooth at zero."""
    square = jnp.sum(turn**2, axis=-1, keepdims=True)
    small = square < 1e-8
    half = 0.5 * jnp.sqrt(jnp.where(small, 1.0, square))
    share = jnp.where(small, 0.5 - square / 48.0, 0.5 * jnp.sin(half) / half)
    cosine = jnp.where(small, 1.0 - square / 8.0, jnp.cos(half))
    return jnp.concatenate([share * turn, cosine], axis=-1)
