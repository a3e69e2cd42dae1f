"""Surroundings that act on whole sections of a body: the drag of a fluid, and a wall.

Both act at the centre of a section, with their derivatives by place and velocity, for the implicit step.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.fem.effects import BodyEffects, Scalar, Wall
from rfdropo_bayes.fem.rod import Rod, drag_areas, tributary_lengths

STILL = 1e-6
"""Speed [m/s] below which drag is linear."""
WALL_SOFTNESS = 1e-3
"""A wall takes hold over this depth [m] on both sides of its plane, with a continuous derivative."""


class SectionLoad(NamedTuple):
    """Force on every section, its stiffness (minus the derivative by place) and its damping (by velocity)."""

    force: Float[Array, "stations 3"]  # [N]
    stiffness: Float[Array, "stations 3 3"]  # [N/m]
    damping: Float[Array, "stations 3 3"]  # [N s/m]


def _contact(depth: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Force of a unilateral spring of unit stiffness and its derivative: zero, then quadratic, then linear."""
    into = jnp.clip(depth + WALL_SOFTNESS, 0.0, 2.0 * WALL_SOFTNESS)
    slope = into / (2.0 * WALL_SOFTNESS)
    return 0.5 * slope * into + jnp.maximum(depth - WALL_SOFTNESS, 0.0), slope


def _wall_load(body: Rod, wall: Wall, centre: Float[Array, "stations 3"]) -> SectionLoad:
    azimuth = jnp.asarray(wall.azimuth)
    normal = jnp.stack([jnp.cos(azimuth), jnp.sin(azimuth), jnp.zeros_like(azimuth)])
    force, slope = _contact(centre @ normal - wall.distance)
    stiffness = wall.stiffness * jnp.asarray(tributary_lengths(body))
    return SectionLoad(
        force=-(stiffness * force)[:, None] * normal,
        stiffness=(stiffness * slope)[:, None, None] * normal[:, None] * normal[None, :],
        damping=jnp.zeros((len(centre), 3, 3)),
    )


def _drag_load(body: Rod, drag: Scalar, velocity: Float[Array, "stations 3"], steep: bool) -> SectionLoad:
    """v| v with the speed of a stage's start and the velocity of its end, which never adds energy; or with its whole
    derivative, ``steep``, without which no scheme would be of second order.|Drag -c A |v| v with the speed at the start
    of a stage and the velocity at its end, which never adds energy; with ``steep`` the whole derivative, which
    second-order schemes need.|v| v with the speed of a stage's start and the velocity of its end, which never adds
    energy; or with its whole derivative, ``steep``, without which no scheme would be of second order.
    """
    speed = jnp.sqrt(jnp.sum(velocity**2, axis=1) + STILL**2)
    factor = drag * jnp.asarray(drag_areas(body)) * speed
    damping = factor[:, None, None] * jnp.eye(3)
    if steep:
        along = velocity / speed[:, None]
        damping = damping + factor[:, None, None] * along[:, :, None] * along[:, None, :]
    return SectionLoad(force=-factor[:, None] * velocity, stiffness=jnp.zeros((len(velocity), 3, 3)), damping=damping)


def section_load(
    body: Rod,
    effects: BodyEffects,
    centre: Float[Array, "stations 3"],
    velocity: Float[Array, "stations 3"],
    *,
    steep: bool = False,
) -> SectionLoad | None:
    """Load on the sections whose centres have this place [m] and velocity [m/s]; None if nothing surrounds them.

    ``steep``: drag with the derivative of its speed.
    """
    loads = []
    if effects.wall is not None:
        loads.append(_wall_load(body, effects.wall, centre))
    if effects.drag is not None:
        loads.append(_drag_load(body, effects.drag, velocity, steep))
    return SectionLoad(*(sum(parts) for parts in zip(*loads, strict=True))) if loads else None
