"""What the unit of a parameter says of its share in forces."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

# Parts of units that carry a force, and its power; the first that fits counts.
FORCES = (("/N", -1), ("kg", 1), ("N", 1), ("Pa", 1))


def force_power(unit: str) -> int:
    """Power of the unit of force in a unit: 1 for masses, forces and stiffnesses, -1 for compliances, 0 for the rest.

    Of equations of motion in which every such parameter is multiplied by one factor to that power, no motion changes:
    where only positions are measured and lengths commanded, data say nothing of that factor (Buckingham's theorem).
    """
    return next((power for token, power in FORCES if token in unit), 0)


def common_scale(units: Mapping[str, str], names: tuple[str, ...]) -> Float[np.ndarray, " d"]:
    """Direction, of unit length in logarithms of the parameters, of their common scale of forces; zero if none has."""
    powers = np.array([float(force_power(units[name])) for name in names])
    return powers / max(float(np.linalg.norm(powers)), 1.0)
