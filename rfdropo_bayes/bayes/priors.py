"""Prior distributions from the tables of an experiment file, truncated to a parameter's hard bounds; and the reverse,
tables of numpyro's distributions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import transforms
from numpyro.distributions.truncated import (
    LeftTruncatedDistribution,
    RightTruncatedDistribution,
    TwoSidedTruncatedDistribution,
)
from scipy import stats
from scipy.special import ndtr

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.parameters import ParameterSpec
from rfdropo_bayes.tables import nearest

# The arguments are checked below; a value that rounding puts a hair outside the support needs no warning.
UNCHECKED = {"validate_args": False}
KINDS: dict[type, tuple[str, tuple[str, ...]]] = {
    dist.Normal: ("Normal", ("loc", "scale")),
    dist.HalfNormal: ("HalfNormal", ("scale",)),
    dist.Uniform: ("Uniform", ("low", "high")),
    dist.LogUniform: ("LogUniform", ("low", "high")),
}
"""Distributions by the arguments of a table."""
TRUNCATED = (LeftTruncatedDistribution, RightTruncatedDistribution, TwoSidedTruncatedDistribution)
TRANSFORMED = (dist.TransformedDistribution, dist.LogNormal)
WRAPPERS = (dist.Independent, dist.ExpandedDistribution)


def _normal(spec: ParameterSpec, loc: float, scale: float) -> dist.Distribution:
    return dist.TruncatedNormal(loc, scale, low=_open(spec.low), high=_open(spec.high), **UNCHECKED)


def _half_normal(spec: ParameterSpec, scale: float) -> dist.Distribution:
    return dist.TruncatedNormal(0.0, scale, low=max(0.0, spec.low), high=_open(spec.high), **UNCHECKED)


class TruncatedLogNormal(dist.TransformedDistribution):
    """Log-normal distribution confined to an interval.

    Its support is set explicitly: a transformed distribution would use all positive numbers, the codomain of its
    transform, and ignore the ends of its base.
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

    Normal, HalfNormal and LogNormal priors are truncated to the hard bounds, a TruncatedNormal also to its own ends;
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
    """The parameter with the ends of a TruncatedNormal as its bounds; unchanged under another prior."""
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
    inside = ndtr((high - middle) / scale) - ndtr((low - middle) / scale)
    density = -0.5 * ((at - middle) / scale) ** 2 - math.log(scale * math.sqrt(2.0 * math.pi) * inside)
    return density - at if family == "LogNormal" else density


def _number(name: str, value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{name} = {value!r} is not a finite number", where=where, remedy="give a number")
    if name in ("scale", "sigma", "median") and value <= 0:
        raise InputError(f"{name} = {value:g} is not positive", where=where, remedy="give a positive number")
    return float(value)


def _check_inside(spec: ParameterSpec, family: str, numbers: Mapping[str, float], where: str) -> None:
    """A range must lie inside the hard bounds; a normal distribution must have at least half of its mass inside."""
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


def table_of(prior: Any, *, where: str) -> dict[str, Any]:
    """The table of a prior that is given as one, or as a distribution of numpyro; None asks for the default, ``{}``.

    Numbers may be arrays of one element.

    Raises:
        InputError: neither, a distribution that no table describes, or one of several numbers.
    """
    if prior is None or isinstance(prior, Mapping):
        return {name: _plain(value, name, where) for name, value in (prior or {}).items()}
    if isinstance(prior, dist.Distribution):
        if (count := math.prod(prior.shape())) != 1:
            raise _several(type(prior).__name__, f"has {count} elements, shape {prior.shape()}", where)
        table = _table(prior, where)
        if table is not None:
            return table
    raise InputError(
        f"{type(prior).__name__} cannot be a prior",
        where=where,
        remedy=f"give a scalar {', '.join(FAMILIES)}, or a table; priors end at the hard bounds by themselves",
    )


def _table(prior: dist.Distribution, where: str) -> dict[str, Any] | None:
    """The table of a distribution of one element; None for other distributions."""
    if type(prior) in KINDS:
        family, names = KINDS[type(prior)]
        return {"distribution": family, **{name: _plain(getattr(prior, name), name, where) for name in names}}
    if isinstance(prior, WRAPPERS):
        return _table(prior.base_dist, where)
    if type(prior) in TRUNCATED:
        base = _table(prior.base_dist, where)
        if base is None or base["distribution"] != "Normal":
            return None
        ends = {name: _plain(getattr(prior, name), name, where) for name in ("low", "high") if hasattr(prior, name)}
        return {**base, "distribution": "TruncatedNormal", **ends}
    if type(prior) not in TRANSFORMED:
        return None
    table = _table(prior.base_dist, where)
    for transform in prior.transforms:
        table = None if table is None else _through(table, transform, where)
    return table


def _through(table: dict[str, Any], transform: transforms.Transform, where: str) -> dict[str, Any] | None:
    """The table of a transformed distribution; None for other distributions."""
    family = table["distribution"]
    if isinstance(transform, transforms.ExpTransform):
        if family == "Normal":
            return {"distribution": "LogNormal", "median": math.exp(table["loc"]), "sigma": table["scale"]}
        if family == "Uniform":
            return {"distribution": "LogUniform", **{name: math.exp(table[name]) for name in ("low", "high")}}
        return None
    if not isinstance(transform, transforms.AffineTransform):
        return None
    shift, factor = _plain(transform.loc, "loc", where), _plain(transform.scale, "scale", where)
    if family.startswith("Log"):  # a shifted variable is not log-normal
        sized: dict[str, float] = {name: factor * table[name] for name in ("median", "low", "high") if name in table}
        return {**table, **sized} if shift == 0.0 and factor > 0.0 else None
    if family == "HalfNormal":
        if shift == 0.0 and factor > 0.0:
            return {**table, "scale": factor * table["scale"]}
        table = {"distribution": "TruncatedNormal", "loc": 0.0, "scale": table["scale"], "low": 0.0}
    return _moved(table, shift, factor) if factor != 0.0 else None


def _moved(table: Mapping[str, Any], shift: float, factor: float) -> dict[str, Any]:
    """A Normal, TruncatedNormal or Uniform, shifted and stretched; a negative factor swaps the ends."""
    other = {"low": "high", "high": "low"} if factor < 0.0 else {}
    places = {name: shift + factor * table[name] for name in ("loc", "low", "high") if name in table}
    moved = {other.get(name, name): value for name, value in places.items()}
    if "scale" in table:
        moved["scale"] = abs(factor) * table["scale"]
    return {"distribution": table["distribution"], **moved}


def _plain(value: Any, name: str, where: str) -> Any:
    """An array of one element as a number; anything else that is no array as it is.

    Raises:
        InputError: several elements.
    """
    if not hasattr(value, "shape"):
        return value
    if (count := math.prod(value.shape)) != 1:
        raise _several(name, f"has {count} elements, shape {tuple(value.shape)}", where)
    return np.asarray(value).reshape(()).item()


def _several(what: str, size: str, where: str) -> InputError:
    return InputError(f"{what} {size}; a prior is of one number", where=where, remedy="give each parameter its own")
