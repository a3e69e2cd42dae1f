"""A rigid cube: its state, its motion between contacts, and how it moves on.

The cube's inertia is a multiple of the unit tensor, so that its spin needs no gyroscopic term.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfdropo_bayes.fem.effects import Scalar

CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
"""Corners of the cube of side one about its centre."""


class Cube(NamedTuple):
    """A homogeneous cube, or one of the same shape with another radius of gyration."""

    mass: Float[Array, ""]  # [kg]
    side: Float[Array, ""]  # [m]
    gyration_radius: Float[Array, ""]  # root of the moment of inertia per mass, about any axis [m]
    friction: Float[Array, ""]  # Coulomb's coefficient on whatever it touches


class CubeState(NamedTuple):
    """Pose and motion of the cube."""

    position: Float[Array, "3"]  # of the centre [m]
    orientation: Float[Array, "4"]  # unit quaternion (x, y, z, w)
    velocity: Float[Array, "3"]  # [m/s]
    spin: Float[Array, "3"]  # [rad/s], in space


def solid_gyration_radius(side: Scalar) -> Float[Array, ""]:
    """Radius of gyration [m] of a homogeneous cube, a / sqrt(6)."""
    return jnp.asarray(side) * (1.0 / np.sqrt(6.0))  # XLA rounds a quotient differently when it folds constants


def cube_at(position: Float[Array, "3"], yaw: Scalar, axis: Float[Array, "3"] | Float[np.ndarray, "3"]) -> CubeState:
    """A cube at rest, turned by ``yaw`` [rad] about a unit vector from the orientation with edges parallel to the
    axes.
    """
    half = 0.5 * jnp.asarray(yaw)
    orientation = jnp.concatenate([jnp.sin(half) * jnp.asarray(axis), jnp.cos(half)[None]])
    return CubeState(jnp.asarray(position), orientation, jnp.zeros(3), jnp.zeros(3))


def rotation_matrix(orientation: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Matrix that turns the cube's own vectors into space."""
    x, y, z, w = orientation
    return jnp.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def inverse_inertia(cube: Cube) -> Float[Array, "6"]:
    """Inverse of mass [1/kg] and moment of inertia [1/(kg m2)], for the three velocities and the three spins."""
    mass = jnp.full(3, 1.0 / cube.mass)
    return jnp.concatenate([mass, mass / cube.gyration_radius**2])


def twist_of(state: CubeState) -> Float[Array, "6"]:
    """Velocity and spin."""
    return jnp.concatenate([state.velocity, state.spin])


def free_twist(
    state: CubeState, gravity: Float[Array, "3"], rayleigh_mass: Scalar, time_step: Scalar
) -> Float[Array, "6"]:
    """Velocity and spin at the end of an implicit Euler step without contacts; ``rayleigh_mass`` is the drag [1/s]."""
    shrink = 1.0 / (1.0 + time_step * rayleigh_mass)
    return jnp.concatenate([(state.velocity + time_step * gravity) * shrink, state.spin * shrink])


def moved(state: CubeState, twist: Float[Array, "6"], time_step: Scalar) -> CubeState:
    """The cube after a step at constant velocity and spin."""
    velocity, spin = twist[:3], twist[3:]
    half = 0.5 * time_step * spin
    square = jnp.sum(half**2)
    # sin(a) / a and cos(a) of half the angle, differentiable at zero.
    angle = jnp.sqrt(jnp.where(square > 0.0, square, 1.0))
    vector = half * jnp.where(square > 0.0, jnp.sin(angle) / angle, 1.0)
    scalar = jnp.where(square > 0.0, jnp.cos(angle), 1.0)
    old, w = state.orientation[:3], state.orientation[3]
    orientation = jnp.concatenate(
        [scalar * old + w * vector + jnp.cross(vector, old), (scalar * w - vector @ old)[None]]
    )
    orientation = orientation / jnp.linalg.norm(orientation)
    return CubeState(state.position + time_step * velocity, orientation, velocity, spin)
