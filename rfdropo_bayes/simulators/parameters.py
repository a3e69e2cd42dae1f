"""Description of a simulator's parameter: name, unit, hard bounds, nominal value, default prior."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.tables import nearest as nearest


class ParameterSpec(NamedTuple):
    """One physical parameter of a simulator, of a mechanism or of a noise model.

    Attributes:
        name: name used in experiment files, posteriors and reports.
        unit: SI unit, "-" if it has none.
        low, high: hard bounds, outside which the model has no meaning.
        nominal: value used if the parameter is fixed; a mechanism's null value.
        prior: default prior as a table, e.g. ``{"distribution": "LogNormal", "median": 4.5e6, "sigma": 0.5}``.
        description: one line on its physical meaning.
        grid: values to try, for a mechanism's parameter that has no effect while the others are null (a time constant,
            the place of a wall): its derivative is zero there, so it cannot be screened. Empty for all others.
        family: the quantity of which this is a local value, if a simulator offers it as a candidate of audits; empty
            for all others.
    """

    name: str
    unit: str
    low: float
    high: float
    nominal: float
    prior: Mapping[str, Any]
    description: str
    grid: tuple[float, ...] = ()
    family: str = ""


def specs_of(table: Mapping[str, Any]) -> tuple[ParameterSpec, ...]:
    """Specifications of the parameters of robots and black boxes (`robots.parameter.Parameter`, by name)."""
    return tuple(
        ParameterSpec(name, p.unit, p.low, p.high, p.nominal, p.prior, p.description) for name, p in table.items()
    )


def check_names(names: Iterable[str], specs: Iterable[ParameterSpec], *, where: str) -> None:
    """Raise InputError for a name that no specification carries."""
    known = {spec.name for spec in specs}
    for name in names:
        if name not in known:
            raise InputError(f"unknown parameter {name!r}", where=where, remedy=nearest(name, known))


def check_value(spec: ParameterSpec, value: float, *, where: str) -> float:
    """Return ``value`` if it lies within the hard bounds of ``spec``; raise InputError otherwise."""
    if not spec.low <= value <= spec.high:
        raise InputError(
            f"{spec.name} = {value:g} {spec.unit} is outside its hard bounds [{spec.low:g}, {spec.high:g}]",
            where=where,
            remedy="give a value inside them",
        )
    return float(value)
