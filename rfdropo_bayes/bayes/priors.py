"""Prior distributions from the tables of an experiment file, confined to a parameter's hard bounds; the tables of
distributions of numpyro are in `numpyro_priors`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpyro.distributions as dist
from scipy import stats

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.parameters import ParameterSpec, nearest

# The arguments are checked below; a value that rounding puts a hair outside the support needs no warning.
UNCHECKED = {"validate_args": False}


def _normal(spec: ParameterSpec, loc: float, scale: float) -> dist.Distribution:
    return dist.TruncatedNormal(loc, scale, low=_open(spec.low), high=_open(spec.high), **UNCHECKED)


def _half_normal(spec: ParameterSpec, scale: float) -> dist.Distribution:
    return dist.TruncatedNormal(0.0, scale, low=max(0.0, spec.low), high=_open(spec.high), **UNCHECKED)


class TruncatedLogNormal(dist.TransformedDistribution):
    """Log-normal distribution confined to an interval.

    Its support is said here: a transformed distribution takes the whole codomain of its transform, here all positive
    numbers, for its support, and forgets where its base ends.
    """

    def __init__(self, median: float, sigma: float, low: float, high: float) -> None:
        first = math.log(low) if low > 0.0 else None
        last = math.log(high) if math.isfinite(high) else None
        base = dist.TruncatedNormal(math.log(median), sigma, low=first, high=last, **UNCHECKED)
        self._interval = (max(low, 0.0), high)
        super().__init__(base, dist.transforms.ExpTransform(), **UNCHECKED)

    @property
    def support(self) -> dist.constraints.Constraint:
        """The interval."""
        low, high = self._interval
        return dist.constraints.interval(low, high) if math.isfinite(high) else dist.constraints.greater_than(low)


def _log_normal(spec: ParameterSpec, median: float, sigma: float) -> dist.Distribution:
    return TruncatedLogNormal(median, sigma, spec.low, spec.high)


def _uniform(spec: ParameterSpec, low: float, high: float) -> dist.Distribution:
    return dist.Uniform(low, high, **UNCHECKED)


def _log_uniform(spec: ParameterSpec, low: float, high: float) -> dist.Distribution:
    return dist.LogUniform(low, high, **UNCHECKED)


def _open(bound: float) -> float | None:
    return bound if math.isfinite(bound) else None


FAMILIES: dict[str, tuple[Callable[..., dist.Distribution], tuple[str, ...]]] = {
    "Normal": (_normal, ("loc", "scale")),
    "TruncatedNormal": (_normal, ("loc", "scale")),
    "HalfNormal": (_half_normal, ("scale",)),
    "LogNormal": (_log_normal, ("median", "sigma")),
    "Uniform": (_uniform, ("low", "high")),
    "LogUniform": (_log_uniform, ("low", "high")),
}
OPTIONAL = {"TruncatedNormal": ("low", "high")}
"""Arguments that may be left out: a normal that ends before the hard bounds do."""


def prior_from_table(spec: ParameterSpec, table: Mapping[str, Any], *, where: str) -> dist.Distribution:
    """Build the prior of one parameter.

    Normal, HalfNormal and LogNormal priors are truncated to the hard bounds, a TruncatedNormal to its own ends, too;
    Uniform and LogUniform ranges must lie inside them.

    Args:
        spec: the parameter, with its unit and bounds.
        table: ``distribution`` and its arguments in the parameter's unit; LogNormal takes ``median`` and ``sigma``
            (standard deviation of the logarithm).

    Raises:
        InputError: unknown distribution or argument, a scale that is not positive, or a prior outside the bounds.
    """
    arguments = dict(table)
    family = arguments.pop("distribution", None)
    if family not in FAMILIES:
        raise InputError(f"unknown distribution {family!r}", where=where, remedy=nearest(str(family), FAMILIES))
    build, names = FAMILIES[family]
    known = (*names, *OPTIONAL.get(family, ()))
    for name in arguments:
        if name not in known:
            raise InputError(f"{family} takes no argument {name!r}", where=where, remedy=nearest(name, known))
    missing = [name for name in names if name not in arguments]
    if missing:
        raise InputError(f"{family} lacks {', '.join(missing)}", where=where, remedy=f"it takes {', '.join(names)}")
    numbers = {name: _number(name, value, where) for name, value in arguments.items()}
    _check_inside(spec, family, numbers, where)
    return build(confined(spec, table), **{name: numbers[name] for name in names})


def confined(spec: ParameterSpec, table: Mapping[str, Any]) -> ParameterSpec:
    """The parameter within the ends that a TruncatedNormal has beside the hard bounds; else as it is."""
    if table.get("distribution") not in OPTIONAL:
        return spec
    low, high = table.get("low", -math.inf), table.get("high", math.inf)
    return spec._replace(low=max(spec.low, low), high=min(spec.high, high))


def log_density(spec: ParameterSpec, table: Mapping[str, Any], values: np.ndarray) -> np.ndarray:
    """Log density of the prior that `prior_from_table` builds, without a compilation for each number of values."""
    family = table["distribution"]
    if family == "Uniform":
        return np.full(np.shape(values), -math.log(table["high"] - table["low"]))
    if family == "LogUniform":
        return -np.log(values) - math.log(math.log(table["high"] / table["low"]))
    spec = confined(spec, table)
    low, high, scale, at = spec.low, spec.high, table.get("scale", table.get("sigma")), values
    middle = table.get("loc", 0.0)
    if family == "HalfNormal":
        low = max(low, 0.0)
    if family == "LogNormal":
        middle, at = math.log(table["median"]), np.log(values)
        low, high = (math.log(bound) if bound > 0.0 else -math.inf for bound in (low, high))
    inside = stats.norm.cdf((high - middle) / scale) - stats.norm.cdf((low - middle) / scale)
    found = -0.5 * ((at - middle) / scale) ** 2 - math.log(scale * math.sqrt(2.0 * math.pi) * inside)
    return found - at if family == "LogNormal" else found


def _number(name: str, value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{name} = {value!r} is not a finite number", where=where, remedy="give a number")
    if name in ("scale", "sigma", "median") and value <= 0:
        raise InputError(f"{name} = {value:g} is not positive", where=where, remedy="give a positive number")
    return float(value)


def _check_inside(spec: ParameterSpec, family: str, numbers: Mapping[str, float], where: str) -> None:
    """A range must lie inside the hard bounds; a bell must have at least half of its mass there."""
    bounds = f"the hard bounds of {spec.name} are [{spec.low:g}, {spec.high:g}] {spec.unit}"
    low, high = numbers.get("low", -math.inf), numbers.get("high", math.inf)
    if low >= high:
        raise InputError(f"low = {low:g} is not below high = {high:g}", where=where, remedy="swap them")
    if family in ("Uniform", "LogUniform"):
        if low < spec.low or high > spec.high or (family == "LogUniform" and low <= 0):
            raise InputError(f"the prior [{low:g}, {high:g}] reaches outside the bounds", where=where, remedy=bounds)
        return
    if family == "HalfNormal":
        inside = 2 * (
            stats.norm.cdf(spec.high / numbers["scale"]) - stats.norm.cdf(max(0.0, spec.low) / numbers["scale"])
        )
    elif family == "LogNormal":
        bell = stats.lognorm(numbers["sigma"], scale=numbers["median"])
        inside = bell.cdf(spec.high) - bell.cdf(max(spec.low, 0.0))
    else:
        ends = (np.array([low, high]) - numbers["loc"]) / numbers["scale"]
        bell = stats.truncnorm(*ends, loc=numbers["loc"], scale=numbers["scale"])
        inside = bell.cdf(spec.high) - bell.cdf(spec.low)
    if inside < 0.5:
        raise InputError(f"only {100 * inside:.0f} % of the prior lies within the bounds", where=where, remedy=bounds)
