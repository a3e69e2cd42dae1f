"""Response of a cable drive to commanded displacements."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class DriveLimits(NamedTuple):
    """Limits of displacement-driven cables, as SOFA's CableConstraint applies them.

    ``maxDispVariation`` bounds the change against the displacement that SOFA last measured, which is the displacement
    at the START of the previous step: a cable that is commanded faster follows at about half the rate, one step late.
    """

    displacement: Float[np.ndarray, " cables"]  # largest displacement [m]; infinite without a limit
    rate: float = np.inf  # largest difference from the measured displacement [m per step]

    def apply(self, commanded: Float[Array, " cables"], measured: Float[Array, " cables"]) -> Float[Array, " cables"]:
        """Displacement [m] that a step imposes; ``measured`` is that at the start of the step before."""
        within = jnp.maximum(jnp.minimum(commanded, measured + self.rate), measured - self.rate)
        return jnp.minimum(within, jnp.asarray(self.displacement))


def animated_commands(
    command: Float[np.ndarray, "rows cables"], steps: int, time_step: float
) -> Float[np.ndarray, "rows steps cables"]:
    """Commanded displacement of every step when each row's change is carried out by an animation of SOFA's STLIB.

    ``command`` [m] is cumulative, the state before the first row zero. A row's change is handed over in ``steps`` equal
    updates, one at the start of each of the row's steps, until the animation's elapsed time reaches ``steps - 1`` time
    steps. Clock and elapsed time are sums of floats: if the sum rounds below the duration, a further update follows in
    the next row, and its displacement is never taken back.
    """
    duration = time_step * (steps - 1)
    changes = np.diff(np.asarray(command, float), axis=0, prepend=np.zeros((1, command.shape[1]))) / steps
    reached, clock = np.zeros(command.shape[1]), 0.0
    running: list[tuple[np.ndarray, float]] = []  # update and start time of each animation
    result = np.empty((len(changes), steps, command.shape[1]))
    for row, change in enumerate(changes):
        for step in range(steps):
            clock += time_step
            if step == 0:
                running.append((change, clock))
            reached = reached + sum(update for update, _ in running)
            running = [(update, start) for update, start in running if (clock - start) / duration < 1.0]
            result[row, step] = reached
    return result
