"""An inferred parameter, its prior and its recordings.

A pooled parameter differs between groups of recordings (days, robots). Each group has a deviation from a shared value,
and the standard deviation of these deviations is the spread.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Array, Float

from rfdropo_bayes.bayes.priors import confined, prior_from_table
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.posteriors import SHARED, ParameterInfo, Scope
from rfdropo_bayes.simulators.parameters import ParameterSpec

INTERIOR = 15.0  # in unconstrained space: within 3e-7 of the width of a bound


@dataclass(frozen=True)
class InferredParameter:
    """One inferred parameter."""

    spec: ParameterSpec  # name, unit, hard bounds and meaning of the parameter, in any scope
    prior: dist.Distribution  # numpyro distribution, in the parameter's unit, within its hard bounds
    table: Mapping[str, Any]  # the prior as written, for the record
    # its owner. The unconstrained coordinate of a scaled parameter is its ratio to the scale (a non-centred
    # parametrisation).
    scope: Scope = SHARED
    members: tuple[str, ...] = ()  # recordings for which it holds, if it has an owner

    @classmethod
    def of(
        cls,
        spec: ParameterSpec,
        table: Mapping[str, Any],
        scope: Scope = SHARED,
        members: tuple[str, ...] = (),
        *,
        where: str,
    ) -> InferredParameter:
        """A parameter under a prior, or under its default prior if the table is empty."""
        chosen = dict(table) if table else dict(spec.prior)
        prior = prior_from_table(spec, chosen, where=f"{where} {spec.name}")
        return cls(confined(spec, chosen), prior, chosen, scope, members)

    @cached_property
    def info(self) -> ParameterInfo:
        """For the record."""
        spec = self.spec
        return ParameterInfo(spec.name, spec.unit, spec.low, spec.high, self.table, spec.description, self.scope)

    @cached_property
    def name(self) -> str:
        """Its label, under which values and draws are."""
        return self.info.name

    @property
    def physical(self) -> str:
        """Name of the simulator's parameter that it sets or adds to."""
        return self.scope.added_to or self.spec.name

    @property
    def of_recording(self) -> bool:
        """Whether the parameter belongs to a single recording."""
        return bool(self.scope.owner) and not self.scope.group

    def holds_for(self, recording: str) -> bool:
        """Whether the parameter belongs to recordings."""
        return not self.scope.owner or recording in self.members

    @cached_property
    def transform(self) -> dist.transforms.Transform:
        """Bijection from the real line to the support of the prior."""
        return dist.biject_to(self.prior.support)

    @property
    def ends(self) -> tuple[float, float]:
        """Ends of the prior, see `ParameterInfo.ends`."""
        support = self.prior.support
        if self.scope.spread:
            return -np.inf, self.spec.high
        low, high = getattr(support, "lower_bound", -np.inf), getattr(support, "upper_bound", np.inf)
        return max(self.spec.low, float(low)), min(self.spec.high, float(high))

    def scaled(self, spread: float) -> InferredParameter:
        """The same parameter with a fixed standard deviation."""
        table = {**self.table, "scale": float(spread)}
        return replace(
            self, prior=dist.Normal(0.0, float(spread)), table=table, scope=replace(self.scope, scaled_by="")
        )

    def inside(self, values: Float[Array, " n"], otherwise: Float[Array, " n"]) -> Float[Array, " n"]:
        """Values, moved inside if on the edge of the support, and ``otherwise`` if beyond it."""
        u = self.transform.inv(values)
        u = jnp.where(jnp.isnan(u), self.transform.inv(otherwise), u)
        return self.transform(jnp.where(jnp.isinf(u), jnp.sign(u) * INTERIOR, u))


@dataclass(frozen=True)
class Pooled:
    """Pooling of one parameter."""

    # standard deviation between groups, in the parameter's unit: the scale of its half-normal prior, or its value if
    # known
    spread: float
    groups: Mapping[str, tuple[str, ...]]  # recordings of each group, by the group's name
    # parameters with the same family have one spread, ``<family>_spread``; empty if the spread is known
    family: str = ""


def spread_of(spec: ParameterSpec, pooled: Pooled) -> list[InferredParameter]:
    """The standard deviation between groups of all parameters of a family, if it is inferred.

    Half-normal, because two or three groups leave the upper end to the prior (Gelman 2006).

    Raises:
        InputError: a scale that is not positive.
    """
    if not pooled.family:
        return []
    _check_spread(spec, pooled.spread)
    table = {"distribution": "HalfNormal", "scale": pooled.spread}
    words = f"standard deviation of the {pooled.family.replace('_', ' ')} between groups of recordings"
    own = ParameterSpec(_spread_name(pooled.family), spec.unit, 0.0, float("inf"), pooled.spread, table, words)
    return [InferredParameter.of(own, table, Scope(spread=True), where="[model.per_group]")]


def deviations(spec: ParameterSpec, pooled: Pooled) -> list[InferredParameter]:
    """Deviations of each group's value of a parameter from the shared value."""
    scale = _spread_name(pooled.family) if pooled.family else ""
    return [
        deviation(spec, pooled.spread, Scope(group, True, spec.name, scale), tuple(members), where="[model.per_group]")
        for group, members in pooled.groups.items()
    ]


def deviation(
    spec: ParameterSpec,
    spread: float,
    scope: Scope,
    members: tuple[str, ...],
    ends: float = float("inf"),
    *,
    where: str,
) -> InferredParameter:
    """Deviation of a group's value from the shared value, Normal(0, ``spread``), in the parameter's unit.

    Args:
        spec: the shared parameter.
        spread: standard deviation between groups.
        scope, members: scope of the parameter, and its recordings.
        ends: largest absolute value.
        where: entry of the experiment file, for errors.

    Raises:
        InputError: a spread that is not positive.
    """
    _check_spread(spec, spread)
    table = {"distribution": "Normal", "loc": 0.0, "scale": spread}
    words = f"of one group of recordings, from the {spec.name.replace('_', ' ')} that all share"
    own = ParameterSpec(f"{spec.name}_deviation", spec.unit, -ends, ends, 0.0, table, words)
    return InferredParameter.of(own, table, scope, members, where=where)


def _spread_name(family: str) -> str:
    return f"{family}_spread"


def _check_spread(spec: ParameterSpec, spread: float) -> None:
    if not spread > 0.0:
        raise InputError(
            f"the spread between groups is {spread}",
            where=f"[model.per_group] {spec.name}",
            remedy="give a positive number",
        )
