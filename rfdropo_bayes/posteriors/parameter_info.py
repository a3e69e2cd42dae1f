"""Facts about an inferred parameter, and its owner (a recording, a group or none).

Whether draws are piled up at a bound, for bounds of any width, or lie in a region of little prior mass. Named
quantities that are functions of the parameters, such as the ratio of stiffness to density.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.errors import InputError


@dataclass(frozen=True)
class ProductOfPowers:
    """A product of powers of positive parameters: in logarithms a weighted sum.

    Every combination that a scale ridge leaves determined has this form (E / density, friction / E, ...).
    """

    parameter: str  # name of the quantity
    unit: str  # SI unit, "-" if it has none
    powers: Mapping[str, float]  # exponent of each parameter, ``{"young_modulus": 1, "density": -1}``
    description: str = ""  # one line on its physical meaning
    owner: str = ""  # the recording or group that has it; empty if all share it

    @property
    def name(self) -> str:
        """Its label, see `ParameterInfo.name`."""
        return label(self.parameter, self.owner)


OUTERMOST = 0.005  # of the prior, on either side
SPARSE = 0.1  # of the mean density between the quartiles
NEIGHBOURS = 5  # prior draws on the denser side, which estimate the density at a place
PILED = 0.13  # of a standard deviation, between a half-normal (0.10) and a uniform distribution (0.17)

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


def cut_off_at(draws: Float[np.ndarray, " n"], low: float, high: float, *, logarithmic: bool = False) -> str | None:
    """The end, "low" or "high", at which a distribution is cut off at its mode; None if neither is.

    Its outer 5 % quantile then lies within a tenth of a standard deviation of that end.

    Args:
        draws: draws of one parameter.
        low, high: ends of its range; infinite without an end.
        logarithmic: compare positive draws in logarithms.
    """
    if logarithmic and np.all(draws > 0):
        draws = np.log(draws)
        low = np.log(low) if low > 0 else -np.inf
        high = np.log(high) if high > 0 else -np.inf
    q05, q95 = np.quantile(draws, [0.05, 0.95])
    reach = PILED * draws.std()
    if q05 - low <= reach:
        return "low"
    return "high" if high - q95 <= reach else None


def contradicts(draws: Float[np.ndarray, " n"], prior: Float[np.ndarray, " m"]) -> bool:
    """Whether the median of a posterior lies in the outermost 1 % of its prior, in a region of low prior density; False
    if there are too few draws.

    The ends of a wide uniform prior, zero of a half-normal prior, and zero of a log-normal prior over decades are
    outermost but dense.

    Args:
        draws: draws of one parameter's posterior.
        prior: draws of the parameter's prior, at least 400.
    """
    prior, centre = np.sort(prior[np.isfinite(prior)]), float(np.median(draws))
    n, below = len(prior), int(np.searchsorted(prior, centre))
    if n < 2.0 / OUTERMOST or OUTERMOST * n <= below <= (1.0 - OUTERMOST) * n:
        return False
    distances = (
        np.sort(np.abs(prior[below:] - centre))[:NEIGHBOURS],
        np.sort(np.abs(prior[:below] - centre))[:NEIGHBOURS],
    )
    nearest = min(side[-1] for side in distances if len(side) == NEIGHBOURS)
    low, high = np.quantile(prior, [0.25, 0.75])
    return bool(NEIGHBOURS / n * (high - low) < SPARSE * 0.5 * nearest)


def contradiction(names: Sequence[str]) -> str:
    """The clause about parameters whose posterior `contradicts` the prior."""
    return (
        f"the data put {', '.join(names)} into the outermost {200 * OUTERMOST:.0f} % of the prior, which excludes them"
    )


def evaluate_products(
    draws: Mapping[str, Float[np.ndarray, "..."]], products: Sequence[ProductOfPowers]
) -> dict[str, Float[np.ndarray, "..."]]:
    """Values of each product at each draw.

    Raises:
        InputError: a product that names an unknown parameter or one that is not positive, or that takes its name.
    """
    values = {}
    for product in products:
        where = f"derived quantity {product.name!r}"
        unknown = [name for name in product.powers if name not in draws]
        if unknown:
            raise InputError(f"unknown parameter {unknown[0]!r}", where=where, remedy=f"known: {', '.join(draws)}")
        if product.name in draws:
            raise InputError("has the name of a parameter", where=where, remedy="choose another name")
        for name in product.powers:
            if not np.all(draws[name] > 0):
                raise InputError(f"{name} is not always positive", where=where, remedy="leave it out")
        values[product.name] = np.exp(sum(power * np.log(draws[name]) for name, power in product.powers.items()))
    return values
