"""Facts about an inferred parameter, and its owner (a recording, a group or none)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

Draws = Mapping[str, Float[np.ndarray, " n"]]


@dataclass(frozen=True)
class Scope:
    """Owner of a parameter, and the composition of its value."""

    owner: str = ""  # the recording or group of recordings that has it; empty if all recordings share it
    group: bool = False  # whether the owner is a group, whose further recordings have it as well
    added_to: str = ""  # the parameter that it is added to; empty if it is not added to another parameter
    scaled_by: str = ""  # the parameter that is its standard deviation, instead of its prior's; empty if there is none
    spread: bool = False  # whether it is the standard deviation of others, between groups


SHARED = Scope()


def label(name: str, owner: str) -> str:
    """A parameter and its owner in one word, for people and as a key: ``offset_x@AKLWI_1``. It is never taken apart."""
    return f"{name}@{owner}" if owner else name


@dataclass(frozen=True)
class ParameterInfo:
    """Facts about a parameter beside its draws."""

    parameter: str  # name in the experiment file
    unit: str  # SI unit, "-" if it has none
    # low, high: hard bounds, infinite without a bound
    low: float = -np.inf
    high: float = np.inf
    # table of its prior, ``{"distribution": "LogNormal", "median": 4.5e6, "sigma": 0.5}``; empty if derived
    prior: Mapping[str, Any] = field(default_factory=dict)
    description: str = ""  # one line on its physical meaning
    scope: Scope = SHARED  # its owner and the composition of its value

    @classmethod
    def from_dict(cls, given: Mapping[str, Any]) -> ParameterInfo:
        """Inverse of `as_dict`."""
        return cls(**{**given, "scope": Scope(**given["scope"])})

    def as_dict(self) -> dict[str, Any]:
        """The facts as JSON types."""
        return {**asdict(self), "low": float(self.low), "high": float(self.high), "prior": dict(self.prior)}

    @property
    def name(self) -> str:
        """Its label, under which its draws are."""
        return label(self.parameter, self.scope.owner)

    @property
    def logarithmic(self) -> bool:
        """Whether the prior is on the logarithm."""
        return str(self.prior.get("distribution", "")).startswith("Log")

    @property
    def ends(self) -> tuple[float, float]:
        """Ends of the prior, at or inside the hard bounds; infinite without an end.

        Zero is not counted as an end of a spread between groups: the groups are then equal.
        """
        if self.scope.spread:
            return -np.inf, min(self.high, self.prior.get("high", np.inf))
        low = 0.0 if self.prior.get("distribution") == "HalfNormal" else self.prior.get("low", -np.inf)
        return max(self.low, low), min(self.high, self.prior.get("high", np.inf))

    def spread_of(self, values: Draws, count: int) -> Float[np.ndarray, " n"]:
        """Standard deviation between groups of a deviation's parameter, for each of ``count`` draws."""
        if self.scope.scaled_by:
            return np.asarray(values[self.scope.scaled_by])
        return np.full(count, float(self.prior["scale"]))


DrawsByOwner = Mapping[str, Draws]  # draws by parameter and by owner, see `Scope`


def by_owner(infos: Iterable[ParameterInfo], draws: Draws) -> dict[str, dict[str, Float[np.ndarray, " n"]]]:
    """Draws that have labels, by parameter and owner."""
    owned: dict[str, dict[str, Float[np.ndarray, " n"]]] = {}
    for info in infos:
        if info.name in draws:
            owned.setdefault(info.parameter, {})[info.scope.owner] = np.asarray(draws[info.name])
    return owned
