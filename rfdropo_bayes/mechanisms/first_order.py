"""The first-order lag of drives, creep and cameras."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def first_order(
    reached: Float[Array, "*shape"],
    before: Float[Array, "*shape"],
    given: Float[Array, "*shape"],
    gap: float | Float[Array, ""],
    time_constant: float | Float[Array, "*shape"] | Float[Array, ""],
) -> Float[Array, "*shape"]:
    """``y`` of ``tau y' = u - y`` at the end of a gap in which u runs straight from ``before`` to ``given``; exact.

    A u that jumps at the start of the gap instead would let a lag that is short beside the gap pass for none.

    Args:
        reached: y at the start of the gap.
        gap: duration [s], not zero.
        time_constant: tau [s]; zero makes y = u.
    """
    memory = time_constant > 1e-3 * gap  # exp(-1000) is zero in any precision
    kept = jnp.where(memory, jnp.exp(-gap / jnp.where(memory, time_constant, 1.0)), 0.0)
    behind = time_constant * (given - before) / gap
    return given - behind + kept * (reached - before + behind)
