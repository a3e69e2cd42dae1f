"""A step of differences on whose scale a motion is smooth."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

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
