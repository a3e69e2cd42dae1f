"""What a cable drive makes of a commanded displacement, beside the commands themselves."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class DriveLimits(NamedTuple):
    """Limits of displacement-driven cables, as SOFA's CableConstraint applies them.

    ``maxDispVariation`` bounds the change against the displacement that SOFA last measured, and that is the one at the START of the
    step before: a cable that is commanded faster follows at about half the rate, one step late.
    """

    displacement: Float[np.ndarray, " cables"]  # largest displacement [m]; infinite where there is no limit
    rate: float = np.inf  # largest difference from the measured displacement [m per step]

    def apply(
        self, commanded: Float[Array, " cables"], measured: Float[Array, " cables"]
    ) -> Float[Array, " cables"]:
        """Displacement [m] that a step imposes; ``measured`` is that at the start of the step before."""
        within = jnp.maximum(jnp.minimum(commanded, measured + self.rate), measured - self.rate)
        return jnp.minimum(within, jnp.asarray(self.displacement))


def no_limits(cables: int) -> DriveLimits:
    """Drives that reach every command within the step."""
    return DriveLimits(np.full(cables, np.inf))
