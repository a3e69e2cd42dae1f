"""Positions of material points of a rod in space."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.fem.components import rotation, times
from rfdropo_bayes.fem.rod import PointMap


def point_positions(
    points: PointMap, position: Float[Array, "stations 3"], orientation: Float[Array, "stations 4"]
) -> Float[Array, "points 3"]:
    """Positions of attached points [m], from the places of the stations and the quaternions of their sections."""
    frame = rotation(orientation.T)[:, :, points.station]
    lever = times(frame, jnp.asarray(points.arm.transpose(2, 0, 1)))
    return jnp.sum(points.weight * position.T[:, points.station] + lever, axis=2).T


def distribute_forces(
    points: PointMap, force: Float[Array, "points 3"], orientation: Float[Array, "stations 4"]
) -> Float[Array, "stations 6"]:
    """Forces [N] and moments [N m] on the stations that are equivalent to forces at attached points."""
    frame = rotation(orientation.T)[:, :, points.station]
    lever = jnp.moveaxis(times(frame, jnp.asarray(points.arm.transpose(2, 0, 1))), 0, -1)
    shares = points.weight[..., None] * force[:, None, :]
    wrench = jnp.concatenate([shares, jnp.cross(lever, jnp.broadcast_to(force[:, None, :], lever.shape))], axis=-1)
    return jnp.zeros((len(orientation), 6)).at[points.station].add(wrench)
