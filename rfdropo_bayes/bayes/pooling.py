"""Parameters that differ between groups of recordings (days, robots) about a value that all share: partial pooling."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.posteriors import SPREAD
from rfdropo_bayes.simulators.parameters import ParameterSpec

DEVIATION = "_deviation"


@dataclass(frozen=True)
class Pooled:
    """How one parameter is pooled.

    Attributes:
        spread: standard deviation between groups, in the parameter's unit: the scale of its half-normal prior, or its
            value where it is known.
        groups: recordings of each group, by the group's name.
        family: parameters with the same family have one spread, ``<family>_spread``; empty where the spread is known.
    """

    spread: float
    groups: Mapping[str, tuple[str, ...]]
    family: str = ""


def spread_spec(spec: ParameterSpec, pooled: Pooled) -> ParameterSpec:
    """The standard deviation between groups of all parameters of a family: half-normal, of the stated scale.

    Half-normal, because two or three groups leave the upper end to the prior (Gelman 2006).

    Raises:
        InputError: a scale that is not positive.
    """
    _check_spread(spec, pooled.spread)
    return ParameterSpec(
        f"{pooled.family}{SPREAD}",
        spec.unit,
        0.0,
        float("inf"),
        pooled.spread,
        {"distribution": "HalfNormal", "scale": pooled.spread},
        f"standard deviation of the {pooled.family.replace('_', ' ')} between groups of recordings",
    )


def deviation_spec(spec: ParameterSpec, spread: float) -> ParameterSpec:
    """What a group's value of a parameter is off the shared one, Normal(0, ``spread``), in the parameter's unit.

    Raises:
        InputError: a spread that is not positive.
    """
    _check_spread(spec, spread)
    return ParameterSpec(
        f"{spec.name}{DEVIATION}",
        spec.unit,
        -float("inf"),
        float("inf"),
        0.0,
        {"distribution": "Normal", "loc": 0.0, "scale": spread},
        f"of one group of recordings, from the {spec.name.replace('_', ' ')} that all share",
    )


def _check_spread(spec: ParameterSpec, spread: float) -> None:
    if not spread > 0.0:
        raise InputError(
            f"the spread between groups is {spread}", where=f"[model.per_group] {spec.name}", remedy="a positive number"
        )
