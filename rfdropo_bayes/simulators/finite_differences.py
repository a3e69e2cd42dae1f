"""Derivatives of a compiled engine: central differences along each tangent."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Inputs = TypeVar("Inputs")
Output = TypeVar("Output")

# Relative perturbation of a central difference. Its error is of second order in it; the rounding error (1e-13 m and
# 1e-5 m of the positions) is divided by it: near the cube root of the precision both are small.
DIFFERENCE = {"float64": 1e-5, "float32": 1e-2}
# Sizes that perturbations are relative to, if a value may be zero: [m] of cable, [kg], [m/s2], [1/s], [s].
LENGTH, MASS, ACCELERATION, MASS_DAMPING, STIFFNESS_DAMPING = 0.005, 0.1, 9.81, 1.0, 0.01


def with_differences(
    call: Callable[[Inputs, Array], Output],
    sizes: Callable[[Inputs], Inputs],
    precision: str,
    difference: float | None = None,
) -> Callable[[Inputs, Array], Output]:
    """``call(inputs, limit)`` with derivatives with respect to the inputs.

    Args:
        call: the rollout; outputs in double precision have derivatives.
        sizes: size of every input, the unit of perturbations.
        precision: precision of the engine, a key of `DIFFERENCE`.
        difference: relative perturbation, if motion is too rough for `DIFFERENCE`.
    """
    width = difference or DIFFERENCE[precision]

    @jax.custom_jvp
    def motion(inputs: Inputs, limit: Array) -> Output:
        return call(inputs, limit)

    @motion.defjvp
    def _(primals: tuple, tangents: tuple) -> tuple[Output, Output]:
        (inputs, limit), (directions, _) = primals, tangents
        step = width / _relative_size(sizes(inputs), directions)

        def moved(by: Array) -> Output:
            return call(jax.tree.map(lambda x, d: x + by * d, inputs, directions), limit)

        value, ahead, behind = call(inputs, limit), moved(step), moved(-step)
        slope = jax.tree.map(
            lambda a, b: (a - b) / (2.0 * step) if a.dtype == jnp.float64 else np.zeros(a.shape, jax.dtypes.float0),
            ahead,
            behind,
        )
        return value, slope

    return motion


LADDER = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
AGREE = 0.5  # share by which slopes over two successive steps of the ladder may differ
# Slopes of a motion with kinks, as with a slack cable, differ between steps but keep their size (within a tenth on the
# paper's trunk); slopes of a jittering motion grow as steps shrink.
JITTER = 3.0


def usable_difference(slope: Callable[[float], Float[np.ndarray, "..."]]) -> float:
    """Smallest step of `LADDER` at and above which slopes agree; the largest step if none agree.

    A motion can be rough: smooth on the smallest scales, with slopes thousands of times the relevant slopes (a
    jittering body of tetrahedra). Rounding is also rough. A curved motion is not: slopes over the smallest step are
    right if they are no larger than others.

    Args:
        slope: secants over a step to each side, of all outputs along all directions.
    """
    chosen = LADDER[-1]
    larger = slope(chosen)
    if np.linalg.norm(slope(LADDER[0])) < JITTER * np.linalg.norm(larger):
        return LADDER[0]
    for step in LADDER[-2::-1]:
        smaller = slope(step)
        if np.linalg.norm(smaller - larger) > AGREE * np.linalg.norm(larger):
            break
        chosen, larger = step, smaller
    return chosen


def _relative_size(sizes: Inputs, directions: Inputs) -> Float[Array, ""]:
    """Largest component of a direction in units of its inputs' sizes; 1 for a zero direction."""
    ratios = jax.tree.map(lambda d, s: jnp.max(jnp.abs(d) / s, initial=0.0), directions, sizes)
    largest = jnp.max(jnp.stack(jax.tree.leaves(ratios)))
    return jnp.where(largest > 0.0, largest, 1.0)


def incompressibility_margin(poisson_ratio: Float[Array, ""]) -> Float[Array, ""]:
    """Size of a Poisson ratio: stiffness against volume change goes with 1 / (1 - 2 nu), and must change little."""
    return jnp.clip(4.0 * (0.5 - poisson_ratio), 0.004, 0.4)
