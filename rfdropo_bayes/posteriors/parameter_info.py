"""Facts about a parameter beside its draws."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

SPREAD = "_spread"  # ends the name of a standard deviation between groups


@dataclass(frozen=True)
class ParameterInfo:
    """Facts about a parameter beside its draws.

    Attributes:
        name: name in the experiment file; ``name@recording`` for a parameter of one recording.
        unit: SI unit, "-" if it has none.
        low, high: hard bounds, infinite without a bound.
        prior: table of its prior, ``{"distribution": "LogNormal", "median": 4.5e6, "sigma": 0.5}``; empty if derived.
        description: one line on its physical meaning.
    """

    name: str
    unit: str
    low: float = -np.inf
    high: float = np.inf
    prior: Mapping[str, Any] = field(default_factory=dict)
    description: str = ""

    @property
    def logarithmic(self) -> bool:
        """Whether the prior is on the logarithm."""
        return str(self.prior.get("distribution", "")).startswith("Log")

    @property
    def ends(self) -> tuple[float, float]:
        """Ends of its prior, at the hard bounds or inside them; infinite without an end.

        Zero is not counted as an end of a spread between groups: the groups are then equal.
        """
        if self.name.endswith(SPREAD):
            return -np.inf, min(self.high, self.prior.get("high", np.inf))
        low = 0.0 if self.prior.get("distribution") == "HalfNormal" else self.prior.get("low", -np.inf)
        return max(self.low, low), min(self.high, self.prior.get("high", np.inf))
