"""The parameters that are inferred: each with its name, unit, bounds, prior, and the recordings it belongs to."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Array, Float, PRNGKeyArray

from rfdropo_bayes.bayes.pooling import Pooled, deviation_spec, spread_spec
from rfdropo_bayes.bayes.priors import confined, prior_from_table
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.posteriors import SPREAD
from rfdropo_bayes.simulators.parameters import ParameterSpec, check_names

SEPARATOR = "@"
HALF_NORMAL_MEDIAN = 0.6745
INTERIOR = 15.0  # in unconstrained space: within 3e-7 of the width of a bound
FORCES = frozenset({"N", "kg", "Pa", "J", "W"})  # units that hold one force each


@dataclass(frozen=True)
class InferredParameter:
    """One inferred parameter.

    Attributes:
        spec: name, unit, hard bounds and meaning of the physical parameter.
        prior: numpyro distribution, in the parameter's unit, within its hard bounds.
        recording: name of the only recording, or group of recordings, that it belongs to; empty if all share it.
        table: the prior as it was written, for the record.
        members: recordings of the group.
        added_to: the parameter that it is added to; empty if it is a value of its own.
        scaled_by: the parameter that is its standard deviation, in place of that of its prior; empty if none is. Its
            coordinate in the unconstrained space is then the ratio of the two (a non-centred parametrisation).
        scoped: whether it is a value of its own of the group ``recording``, which other groups do not have.
    """

    spec: ParameterSpec
    prior: dist.Distribution
    recording: str = ""
    table: Mapping[str, Any] | None = None
    members: tuple[str, ...] = ()
    added_to: str = ""
    scaled_by: str = ""
    scoped: bool = False

    @property
    def name(self) -> str:
        """Name in posteriors: ``young_modulus``, or ``offset_x@AKLWI_1`` for a parameter of one recording."""
        return f"{self.spec.name}{SEPARATOR}{self.recording}" if self.recording else self.spec.name

    @property
    def physical(self) -> str:
        """Name of the simulator's parameter that it sets or adds to."""
        return self.added_to or self.spec.name

    @property
    def of_recordings_alone(self) -> bool:
        """Whether it is that of one recording, and neither a deviation nor the property of a group."""
        return bool(self.recording) and not self.added_to and not self.scoped

    def holds_for(self, recording: str) -> bool:
        """Whether it is one of a recording's parameters."""
        return not self.recording or recording == self.recording or recording in self.members

    @cached_property
    def transform(self) -> dist.transforms.Transform:
        """Bijection from the real line to the support of the prior."""
        return dist.biject_to(self.prior.support)

    @property
    def ends(self) -> tuple[float, float]:
        """Where the prior ends, see `ParameterInfo.ends`."""
        support = self.prior.support
        if self.spec.name.endswith(SPREAD):
            return -np.inf, self.spec.high
        low, high = getattr(support, "lower_bound", -np.inf), getattr(support, "upper_bound", np.inf)
        return max(self.spec.low, float(low)), min(self.spec.high, float(high))

    def scaled(self, spread: float) -> InferredParameter:
        """The same parameter where its standard deviation is known."""
        table = {**(self.table or {}), "scale": float(spread)}
        return replace(self, prior=dist.Normal(0.0, float(spread)), table=table, scaled_by="")

    def inside(self, values: Float[Array, " n"], otherwise: Float[Array, " n"]) -> Float[Array, " n"]:
        """Values, those on the edge of the support moved inside, and ``otherwise`` for those beyond it."""
        u = self.transform.inv(values)
        u = jnp.where(jnp.isnan(u), self.transform.inv(otherwise), u)
        return self.transform(jnp.where(jnp.isinf(u), jnp.sign(u) * INTERIOR, u))


@dataclass(frozen=True)
class ParameterSpace:
    """The inferred parameters, and how a set of their values becomes the parameters of one recording's rollout."""

    parameters: tuple[InferredParameter, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names, in sampling order."""
        return tuple(parameter.name for parameter in self.parameters)

    def __getitem__(self, name: str) -> InferredParameter:
        return self.parameters[self.names.index(name)]

    def for_recording(self, values: Mapping[str, Float[Array | np.ndarray, "..."]], recording: str) -> dict[str, Any]:
        """The physical parameters that hold for one recording, under their physical names."""
        values_of_its_own = [p for p in self.parameters if not p.added_to]
        chosen = {p.spec.name: values[p.name] for p in values_of_its_own if not p.recording}
        chosen |= {p.spec.name: values[p.name] for p in values_of_its_own if p.recording and p.holds_for(recording)}
        for p in self.parameters:
            if p.added_to and p.holds_for(recording):
                chosen[p.added_to] = chosen[p.added_to] + values[p.name]
        return chosen

    @cached_property
    def scales(self) -> dict[str, tuple[str, ...]]:
        """Names of the parameters that are standard deviations of others, with those of the others."""
        found = dict.fromkeys(p.scaled_by for p in self.parameters if p.scaled_by)
        return {name: tuple(p.name for p in self.parameters if p.scaled_by == name) for name in found}

    @property
    def typical_scales(self) -> dict[str, float]:
        """The median of the half-normal prior of each of ``scales``."""
        return {name: HALF_NORMAL_MEDIAN * float((self[name].table or {})["scale"]) for name in self.scales}

    def holding(self, values: Mapping[str, float]) -> ParameterSpace:
        """The space without some parameters, which are known."""
        kept = [p for p in self.parameters if p.name not in values]
        return ParameterSpace(tuple(p.scaled(values[p.scaled_by]) if p.scaled_by in values else p for p in kept))

    def sample(self, key: PRNGKeyArray, n: int) -> dict[str, Float[Array, " n"]]:
        """Independent draws from the prior, one array of length n per parameter."""
        keys = jax.random.split(key, len(self.parameters))
        drawn = {p.name: p.prior.sample(k, (n,)) for p, k in zip(self.parameters, keys, strict=True)}
        return {p.name: drawn[p.name] * self._ratio(p, drawn) for p in self.parameters}

    def _ratio(self, parameter: InferredParameter, values: Mapping[str, Any]) -> Any:
        """Standard deviation of a parameter over that of its prior; one where it is that of its prior."""
        return values[parameter.scaled_by] / parameter.prior.scale if parameter.scaled_by else 1.0

    def sample_around(
        self, earlier: Mapping[str, Float[Array | np.ndarray, " m"]], key: PRNGKeyArray, n: int
    ) -> dict[str, Float[Array, " n"]]:
        """Prior draws with draws of an earlier posterior in the place of the parameters that it holds.

        The first takes the first of these, the others take them at random. A parameter of one recording takes the value
        of the same recording, else that which all recordings shared, else that of another recording; a deviation of one
        group takes that of the same group or none.
        """
        prior_key, choice = jax.random.split(key)
        values = self.sample(prior_key, n)
        for parameter in self.parameters:
            alike = [name for name in earlier if name.partition(SEPARATOR)[0] == parameter.spec.name]
            alike = [] if parameter.added_to else alike
            known = [name for name in (parameter.name, parameter.spec.name, *alike) if name in earlier]
            if known:
                # The same rows for all parameters: their values belong together.
                draws = jnp.asarray(earlier[known[0]])
                chosen = draws[jax.random.randint(choice, (n,), 0, len(draws)).at[0].set(0)]
                values[parameter.name] = parameter.inside(chosen, values[parameter.name])
        return values

    def log_prior(self, values: Mapping[str, Float[Array, "..."]]) -> Float[Array, "..."]:
        """Log density of the prior in physical units."""
        ratios = [self._ratio(p, values) for p in self.parameters]
        each = zip(self.parameters, ratios, strict=True)
        return sum(p.prior.log_prob(values[p.name] / ratio) - jnp.log(ratio) for p, ratio in each)

    def to_unconstrained(self, values: Mapping[str, Float[Any, "..."]]) -> Float[Array, "... d"]:
        """Map values to the real line, parameter by parameter in the order of ``names``."""
        ratios = [self._ratio(p, values) for p in self.parameters]
        each = zip(self.parameters, ratios, strict=True)
        return jnp.stack([p.transform.inv(jnp.asarray(values[p.name]) / ratio) for p, ratio in each], axis=-1)

    def from_unconstrained(self, u: Float[Array, "... d"]) -> dict[str, Float[Array, "..."]]:
        """Inverse of `to_unconstrained`."""
        drawn = {p.name: p.transform(u[..., i]) for i, p in enumerate(self.parameters)}
        return {p.name: drawn[p.name] * self._ratio(p, drawn) for p in self.parameters}

    def log_prior_unconstrained(self, u: Float[Array, "... d"]) -> Float[Array, "..."]:
        """Log density of the prior in unconstrained coordinates, with the Jacobian."""
        total = jnp.zeros(u.shape[:-1])
        for i, p in enumerate(self.parameters):
            value = p.transform(u[..., i])
            total += p.prior.log_prob(value) + p.transform.log_abs_det_jacobian(u[..., i], value)
        return total


def build_space(
    specs: Sequence[ParameterSpec],
    priors: Mapping[str, Any],
    per_recording: Mapping[str, Sequence[str]],
    recordings: Sequence[str],
    *,
    pooled: Mapping[str, Pooled] | None = None,
    scoped: Mapping[str, Mapping[str, Sequence[str]]] | None = None,
    where: str = "[model.priors]",
) -> ParameterSpace:
    """Join specifications and prior tables.

    Args:
        specs: every parameter of the model.
        priors: which are inferred, and their prior tables; a number instead of a table fixes nothing here (the caller
            has taken fixed values out), ``{}`` asks for the default prior.
        per_recording: parameters that are free in the named recordings only.
        recordings: names of all recordings.
        pooled: parameters that differ between groups of recordings, about a value that all share.
        scoped: parameters that some groups have and others do not: recordings by group.

    Raises:
        InputError: an unknown name, an unusable prior, nothing to infer, or a pooled parameter without a shared value.
    """
    by_name = {spec.name: spec for spec in specs}
    pooled, scoped = pooled or {}, scoped or {}
    check_names(list(priors) + list(per_recording) + list(pooled), specs, where=where)
    for name in pooled:
        alone = name in per_recording
        if name not in priors or alone:
            raise InputError(
                f"{name} differs between groups about a value that all share, and has none",
                where="[model.per_group]",
                remedy="take it out of [model.per_recording]" if alone else "name it under [model.priors], too",
            )
    parameters: list[InferredParameter] = []
    for name, table in priors.items():
        spec = by_name[name]
        chosen = dict(table) if table else dict(spec.prior)
        prior = prior_from_table(spec, chosen, where=f"{where} {name}")
        if name in scoped:
            own = InferredParameter(confined(spec, chosen), prior, "", chosen, scoped=True)
            parameters += [replace(own, recording=g, members=tuple(m)) for g, m in scoped[name].items()]
            continue
        for recording in per_recording.get(name, ("",)):
            if recording and recording not in recordings:
                raise InputError(
                    f"{name} is per recording, but no recording is called {recording!r}",
                    where="[model.per_recording]",
                    remedy=f"recordings: {', '.join(recordings)}",
                )
            parameters.append(InferredParameter(confined(spec, chosen), prior, recording, chosen))
        if name in pooled:
            spread = spread_of(spec, pooled[name])
            known = [parameter.name for parameter in parameters]
            parameters += [p for p in spread if p.name not in known] + deviations(spec, pooled[name])
    if not parameters:
        raise InputError("no parameter has a prior", where=where, remedy="give at least one")
    return ParameterSpace(tuple(parameters))


def spread_of(spec: ParameterSpec, pooled: Pooled) -> list[InferredParameter]:
    """The standard deviation between groups, where it is inferred."""
    if not pooled.family:
        return []
    own = spread_spec(spec, pooled)
    return [
        InferredParameter(own, prior_from_table(own, dict(own.prior), where="[model.per_group]"), "", dict(own.prior))
    ]


def deviations(spec: ParameterSpec, pooled: Pooled) -> list[InferredParameter]:
    """What each group's value of a parameter is off the shared one."""
    own = deviation_spec(spec, pooled.spread)
    prior = prior_from_table(own, dict(own.prior), where=f"[model.per_group] {spec.name}")
    scale = spread_spec(spec, pooled).name if pooled.family else ""
    return [
        InferredParameter(own, prior, group, dict(own.prior), tuple(members), spec.name, scale)
        for group, members in pooled.groups.items()
    ]


def force_power(unit: str) -> int:
    """Power of the unit of force in a unit such as "kg", "N/m", "Pa s" or "1/Pa"; exponents of its parts do not count.

    1 for masses, forces and stiffnesses, -1 for compliances. Of equations of motion in which every such parameter is
    multiplied by one factor to that power, no motion changes: where only positions are measured and lengths commanded,
    data say nothing of that factor (Buckingham's theorem).
    """
    above, *below = [sum(part in FORCES for part in re.findall(r"[A-Za-z]+", side)) for side in unit.split("/")]
    return above - sum(below)
