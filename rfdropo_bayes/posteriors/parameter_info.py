"""What is known of a parameter beside its draws."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

SPREAD = "_spread"  # ends the name of a standard deviation between groups


@dataclass(frozen=True)
class ParameterInfo:
    """What is known of a parameter beside its draws.

    Attributes:
        name: as in the experiment file; ``name@recording`` for one that belongs to a recording.
        unit: SI unit, "-" if it has none.
        low, high: hard bounds, infinite where there is none.
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
        """True where the prior is one of the logarithm."""
        return str(self.prior.get("distribution", "")).startswith("Log")

    @property
    def ends(self) -> tuple[float, float]:
        """Where its prior ends: on the hard bounds or between them; infinite where there is neither.

        A spread between groups that is zero is no end of anything: the groups do not differ.
        """
        if self.name.endswith(SPREAD):
            return -np.inf, min(self.high, self.prior.get("high", np.inf))
        low = 0.0 if self.prior.get("distribution") == "HalfNormal" else self.prior.get("low", -np.inf)
        return max(self.low, low), min(self.high, self.prior.get("high", np.inf))
