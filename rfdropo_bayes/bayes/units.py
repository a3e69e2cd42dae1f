"""What the unit of a parameter says of its share in forces."""

from __future__ import annotations

import re

FORCES = frozenset({"N", "kg", "Pa", "J", "W"})  # units that hold one force each


def force_power(unit: str) -> int:
    """Power of the unit of force in a unit such as "kg", "N/m", "Pa s" or "1/Pa"; exponents of its parts do not count.

    1 for masses, forces and stiffnesses, -1 for compliances. Of equations of motion in which every such parameter is
    multiplied by one factor to that power, no motion changes: where only positions are measured and lengths commanded,
    data say nothing of that factor (Buckingham's theorem).
    """
    above, *below = [sum(part in FORCES for part in re.findall(r"[A-Za-z]+", side)) for side in unit.split("/")]
    return above - sum(below)
