"""The tables of priors that are given as distributions of numpyro."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import transforms
from numpyro.distributions.truncated import (
    LeftTruncatedDistribution,
    RightTruncatedDistribution,
    TwoSidedTruncatedDistribution,
)

from rfdropo_bayes.bayes.priors import FAMILIES
from rfdropo_bayes.errors import InputError

KINDS: dict[type, tuple[str, tuple[str, ...]]] = {
    dist.Normal: ("Normal", ("loc", "scale")),
    dist.HalfNormal: ("HalfNormal", ("scale",)),
    dist.Uniform: ("Uniform", ("low", "high")),
    dist.LogUniform: ("LogUniform", ("low", "high")),
}
"""Distributions whose arguments are those of a table."""
TRUNCATED = (LeftTruncatedDistribution, RightTruncatedDistribution, TwoSidedTruncatedDistribution)
TRANSFORMED = (dist.TransformedDistribution, dist.LogNormal)
WRAPPERS = (dist.Independent, dist.ExpandedDistribution)


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
    """The table of a distribution of one element; None where there is none."""
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
    found = _table(prior.base_dist, where)
    for transform in prior.transforms:
        found = None if found is None else _through(found, transform, where)
    return found


def _through(table: dict[str, Any], transform: transforms.Transform, where: str) -> dict[str, Any] | None:
    """The table of what a transform makes of a distribution; None where there is none."""
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
    if family.startswith("Log"):  # what is shifted is log-normal no more
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
