"""Named quantities that are functions of the parameters, such as the ratio of stiffness to density."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.posteriors.parameter_info import label

FAMILY = 3  # fewest members that have a median beside them
SHARPER = 0.5  # deviation of differences over that of members: .88 and more if independent, .06 beside a common gain


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


@dataclass(frozen=True)
class LessMedian:
    """A member of a family of parameters, such as the gain of a cable, less the median of the family."""

    parameter: str  # name of the quantity
    unit: str  # SI unit, "-" if it has none
    member: str
    family: tuple[str, ...]  # the member is among them
    description: str = ""  # one line on its physical meaning
    owner: str = ""  # the recording or group that has it; empty if all share it

    @property
    def name(self) -> str:
        """Its label, see `ParameterInfo.name`."""
        return label(self.parameter, self.owner)


Derived = ProductOfPowers | LessMedian


def sharper_less_median(values: Float[np.ndarray, "draw member"]) -> Float[np.ndarray, "draw member"] | None:
    """Members of a family less their median, if the draws determine these differences much better than the members;
    None otherwise.

    A further parameter may act as all members together: a gain of all drives beside gains of single cables.
    """
    apart = values - np.median(values, axis=1, keepdims=True)
    sharper = np.mean(apart.var(axis=0)) <= SHARPER**2 * np.mean(values.var(axis=0))
    return apart if values.shape[1] >= FAMILY and sharper else None


def evaluate_derived(
    draws: Mapping[str, Float[np.ndarray, "..."]], quantities: Sequence[Derived]
) -> dict[str, Float[np.ndarray, "..."]]:
    """Values of each quantity at each draw, by its label.

    Raises:
        InputError: a quantity that names an unknown parameter, a product of one that is not positive, or a quantity
            that takes the name of a parameter.
    """
    values: dict[str, Float[np.ndarray, "..."]] = {}
    for quantity in quantities:
        where = f"derived quantity {quantity.name!r}"
        of = list(quantity.powers) if isinstance(quantity, ProductOfPowers) else quantity.family
        unknown = [each for each in of if each not in draws]
        if unknown:
            raise InputError(f"unknown parameter {unknown[0]!r}", where=where, remedy=f"known: {', '.join(draws)}")
        if quantity.name in draws:
            raise InputError("has the name of a parameter", where=where, remedy="choose another name")
        if isinstance(quantity, LessMedian):
            values[quantity.name] = draws[quantity.member] - np.median([draws[each] for each in of], axis=0)
            continue
        for each in of:
            if not np.all(draws[each] > 0):
                raise InputError(f"{each} is not always positive", where=where, remedy="leave it out")
        values[quantity.name] = np.exp(sum(power * np.log(draws[each]) for each, power in quantity.powers.items()))
    return values
