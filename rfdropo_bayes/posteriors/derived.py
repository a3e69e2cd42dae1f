"""Named quantities that are functions of the parameters, such as the ratio of stiffness to density."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.posteriors.parameter_info import label


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
