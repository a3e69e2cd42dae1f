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
