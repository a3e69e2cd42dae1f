"""Value of each parameter in each recording: inferred and fixed values, and the owner of each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from rfdropo_bayes.bayes.inferred_parameter import InferredParameter, Pooled, deviations, spread_of
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.groups import Patterns, gather_groups, whole
from rfdropo_bayes.posteriors import DrawsByOwner, ParameterInfo, Scope
from rfdropo_bayes.simulators.parameters import ParameterSpec, check_names

HALF_NORMAL_MEDIAN = 0.6745

WHERE = "[model.priors]"


@dataclass(frozen=True)
class Scopes:
    """The parameters of a model, and the value of each in each recording.

    Values and draws are mappings from labels, see `InferredParameter.name`.
    """

    parameters: tuple[InferredParameter, ...]  # inferred parameters in sampling order; a spread precedes its parameters
    # every parameter that a recording may have, by name
    specs: Mapping[str, ParameterSpec] = field(default_factory=dict)
    fixed: Mapping[str, float] = field(default_factory=dict)  # fixed values, by label
    known: tuple[InferredParameter, ...] = ()  # formerly inferred parameters whose values are now in ``fixed``

    @classmethod
    def read(
        cls,
        infos: Iterable[ParameterInfo],
        specs: Sequence[ParameterSpec],
        fixed: Mapping[str, float],
        fixed_parameters: Sequence[tuple[ParameterInfo, float]] = (),
    ) -> Scopes:
        """The parameters of a posterior; `extended` has the recordings of each group.

        Args:
            infos: facts about the inferred parameters.
            specs: every parameter of the model.
            fixed: values known to the model.
            fixed_parameters: parameters that the fit fixed, with their values.

        Raises:
            InputError: a parameter that the model lacks.
        """
        by_name = {spec.name: spec for spec in specs}

        def read(info: ParameterInfo) -> InferredParameter:
            scope, own = info.scope, by_name.get(info.parameter)
            if scope.spread or scope.added_to in by_name:
                rest = (info.unit, info.low, info.high, 0.0, info.prior, info.description)
                own = ParameterSpec(info.parameter, *rest)
            if own is None:
                raise InputError(
                    f"the posterior holds {info.parameter!r}, which the experiment's model lacks",
                    where="--from",
                    remedy="predict with the experiment that was calibrated, mechanisms included",
                )
            members = () if scope.group or not scope.owner else (scope.owner,)
            return InferredParameter.of(own, info.prior, scope, members, where="posterior")

        known = {info.name: value for info, value in fixed_parameters}
        return cls(
            tuple(map(read, infos)), by_name, {**fixed, **known}, tuple(read(info) for info, _ in fixed_parameters)
        )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Labels, in sampling order."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def infos(self) -> tuple[ParameterInfo, ...]:
        """Facts about the inferred parameters for the record."""
        return tuple(parameter.info for parameter in self.parameters)

    def __getitem__(self, name: str) -> InferredParameter:
        return self.parameters[self.names.index(name)]

    def values_in(self, recording: str, values: Mapping[str, Any]) -> dict[str, Any]:
        """The values that hold in one recording, by parameter; without parameters that are nominal everywhere.

        Parameters of other recordings are nominal. The sum of a shared value and a group's deviation is clipped to the
        parameter's hard bounds.
        """
        values_here = {name: self.specs[name].nominal for name in self._partly if name in self.specs}
        labels = {p.name for p in self.known}
        values_here |= {name: value for name, value in self.fixed.items() if name not in labels}
        given = {**self.fixed, **values}
        every = [p for p in (*self.known, *self.parameters) if p.holds_for(recording)]
        own = [p for p in every if not p.scope.added_to]
        values_here |= {p.spec.name: given[p.name] for p in own if not p.scope.owner}
        values_here |= {p.spec.name: given[p.name] for p in own if p.scope.owner}
        for p in every:
            if p.scope.added_to:
                values_here[p.scope.added_to] = values_here[p.scope.added_to] + given[p.name]
        ends = {name: self.specs[name] for name in self._summed if name in self.specs}
        return values_here | {name: jnp.clip(values_here[name], spec.low, spec.high) for name, spec in ends.items()}

    @cached_property
    def _summed(self) -> frozenset[str]:
        """Parameters that are a shared value and a group's deviation from it."""
        return frozenset(p.scope.added_to for p in (*self.known, *self.parameters) if p.scope.added_to)

    @cached_property
    def _partly(self) -> frozenset[str]:
        """Parameters that some recordings have to themselves."""
        return self._summed | {p.spec.name for p in (*self.known, *self.parameters) if p.scope.owner}

    @cached_property
    def scales(self) -> dict[str, tuple[str, ...]]:
        """Labels of the parameters that are standard deviations of others, with the labels of these others."""
        scales = dict.fromkeys(p.scope.scaled_by for p in self.parameters if p.scope.scaled_by)
        return {name: tuple(p.name for p in self.parameters if p.scope.scaled_by == name) for name in scales}

    @property
    def typical_scales(self) -> dict[str, float]:
        """The median of the half-normal prior of each of ``scales``."""
        return {name: HALF_NORMAL_MEDIAN * float(self[name].table["scale"]) for name in self.scales}

    @cached_property
    def groups_alone(self) -> dict[str, list[str]]:
        """Parameters that some groups have and others do not, with these groups."""
        owners: dict[str, list[str]] = {}
        for p in self.parameters:
            if p.scope.group and not p.scope.added_to:
                owners.setdefault(p.spec.name, []).append(p.scope.owner)
        return owners

    @property
    def deviating(self) -> tuple[InferredParameter, ...]:
        """Deviations of groups of recordings from the shared values."""
        return tuple(p for p in self.parameters if p.scope.added_to)

    def recordings_known(self, fitted: Sequence[str]) -> set[str]:
        """Recordings that were fitted, or that an adapted posterior has values of from the fit before."""
        return {whole(name) for name in (*fitted, *(p.scope.owner for p in self.parameters if p.of_recording))}

    def holding(self, values: Mapping[str, float]) -> Scopes:
        """The scopes with some parameters known instead of inferred."""
        kept = [p for p in self.parameters if p.name not in values]
        kept = [p.scaled(values[p.scope.scaled_by]) if p.scope.scaled_by in values else p for p in kept]
        known = tuple(p for p in self.parameters if p.name in values)
        return replace(self, parameters=tuple(kept), fixed={**self.fixed, **values}, known=(*self.known, *known))

    def with_further(self, parameters: Iterable[InferredParameter]) -> Scopes:
        """The scopes with further parameters at the end."""
        return replace(self, parameters=(*self.parameters, *parameters))

    def extended(self, recordings: Sequence[str], fitted: Sequence[str], groups: Patterns) -> Extension:
        """The parameters of new recordings.

        A parameter that every fitted recording had separately takes, in a new recording, the value of any of them. A
        parameter of some fitted recordings only, such as a payload, applies to these recordings and their further
        pieces. A parameter of some groups also applies to their new recordings. Each group, fitted or not, deviates
        from the shared values.

        Args:
            recordings: names of the new recordings; fitted: names of the fitted recordings.
            groups: recordings that belong together; by default each recording is a group.
        """
        known, shared = self.recordings_known(fitted), [p for p in self.parameters if not p.scope.owner]
        like: dict[str, tuple[str, ...]] = {p.name: (p.name,) for p in shared}
        parameters = list(shared)

        def add(parameter: InferredParameter, owner: str, members: tuple[str, ...], sources: Iterable[str]) -> None:
            own = replace(parameter, scope=replace(parameter.scope, owner=owner), members=members)
            like[own.name] = tuple(sources)
            parameters.append(own)

        families: dict[str, list[InferredParameter]] = {}
        for p in self.parameters:
            if p.of_recording:
                families.setdefault(p.spec.name, []).append(p)
        for recording in recordings:
            for family in families.values():
                own = [p for p in family if whole(p.scope.owner) == whole(recording)]
                of_fit = [p for p in family if p.scope.owner in fitted]
                if not own and len(of_fit) == len(fitted) and whole(recording) not in known:
                    own = of_fit
                if own:
                    add(own[0], recording, (recording,), [p.name for p in own])
        gathered = gather_groups(recordings, groups)
        for p in self.parameters:
            if p.scope.group and not p.scope.added_to and p.scope.owner in gathered:
                add(p, p.scope.owner, gathered[p.scope.owner], [p.name])
        kinds = {p.spec.name: p for p in self.deviating}
        for group, members in gathered.items():
            for name, p in kinds.items():
                known_of = [q.name for q in self.deviating if (q.spec.name, q.scope.owner) == (name, group)]
                add(p, group, members, known_of)
        return Extension(replace(self, parameters=tuple(parameters)), like)

    def of_session(
        self, session: str, recordings: Sequence[str], fitted: Sequence[str], pooled: Mapping[str, Pooled]
    ) -> Scopes:
        """The shared parameters, and the parameters of a session and its recordings.

        Args:
            session: name of the session.
            recordings: its recordings.
            fitted: names of the fitted recordings.
            pooled: parameters that vary between sessions, also if they were shared in the fit.

        Raises:
            InputError: a pooled parameter that the recordings do not share.
        """
        members = tuple(recordings)

        def own(p: InferredParameter, owner: str) -> InferredParameter:
            return replace(p, scope=replace(p.scope, owner=owner), members=members)

        shared = [p for p in self.parameters if not p.scope.owner]
        added = [own(p, session) for p in {p.spec.name: p for p in self.deviating}.values()]
        spreads: list[InferredParameter] = []
        for name, each in pooled.items():
            if any(p.scope.added_to == name for p in added):
                continue
            spec = next((p.spec for p in shared if p.spec.name == name), None)
            if spec is None:
                raise InputError(
                    f"{name} differs between groups about a shared value, but has no shared value",
                    where="[model.per_group]",
                    remedy="give it a prior, and calibrate again",
                )
            known = [p.name for p in [*shared, *spreads]]
            spreads += [p for p in spread_of(spec, each) if p.name not in known]
            added += deviations(spec, replace(each, groups={session: members}))
        added += [
            own(p, session)
            for p in self.parameters
            if p.scope.group and not p.scope.added_to and p.scope.owner == session
        ]
        families: dict[str, list[InferredParameter]] = {}
        for p in self.parameters:
            if p.of_recording and p.scope.owner in fitted:
                families.setdefault(p.spec.name, []).append(p)
        # A parameter that some fitted recordings only had free, as the payload of one of them, is theirs alone.
        every = [ps[0] for ps in families.values() if len(ps) == len(fitted)]
        return replace(self, parameters=(*shared, *spreads, *added, *(own(p, recordings[0]) for p in every)))

    def sample(self, key: PRNGKeyArray, n: int) -> dict[str, Float[Array, " n"]]:
        """Independent draws from the prior, one array of length n per parameter."""
        keys = jax.random.split(key, len(self.parameters))
        drawn = {p.name: p.prior.sample(k, (n,)) for p, k in zip(self.parameters, keys, strict=True)}
        return {p.name: drawn[p.name] * _ratio(p, drawn) for p in self.parameters}

    def sample_around(self, earlier: DrawsByOwner, key: PRNGKeyArray, n: int) -> dict[str, Float[Array, " n"]]:
        """Prior draws, with draws of an earlier posterior for its parameters.

        The first draw takes the first earlier draw, the others take random draws. A parameter of one recording takes
        the value of the same recording, else the shared value, else the value of another recording. A deviation of a
        group takes the value of the same group or none.
        """
        prior_key, choice = jax.random.split(key)
        values = self.sample(prior_key, n)
        for parameter in self.parameters:
            draws_of = earlier.get(parameter.spec.name, {})
            alike = () if parameter.scope.added_to else ("", *draws_of)
            known = [owner for owner in (parameter.scope.owner, *alike) if owner in draws_of]
            if known:
                # The same rows for all parameters: their values belong together.
                draws = jnp.asarray(draws_of[known[0]])
                chosen = draws[jax.random.randint(choice, (n,), 0, len(draws)).at[0].set(0)]
                values[parameter.name] = parameter.inside(chosen, values[parameter.name])
        return values

    def log_prior(self, values: Mapping[str, Float[Array, "..."]]) -> Float[Array, "..."]:
        """Log density of the prior in physical units."""
        ratios = [_ratio(p, values) for p in self.parameters]
        each = zip(self.parameters, ratios, strict=True)
        return sum(p.prior.log_prob(values[p.name] / ratio) - jnp.log(ratio) for p, ratio in each)

    def to_unconstrained(self, values: Mapping[str, Float[Any, "..."]]) -> Float[Array, "... d"]:
        """Map values to the real line, parameter by parameter in the order of ``names``."""
        ratios = [_ratio(p, values) for p in self.parameters]
        each = zip(self.parameters, ratios, strict=True)
        return jnp.stack([p.transform.inv(jnp.asarray(values[p.name]) / ratio) for p, ratio in each], axis=-1)

    def from_unconstrained(self, u: Float[Array, "... d"]) -> dict[str, Float[Array, "..."]]:
        """Inverse of `to_unconstrained`."""
        drawn = {p.name: p.transform(u[..., i]) for i, p in enumerate(self.parameters)}
        return {p.name: drawn[p.name] * _ratio(p, drawn) for p in self.parameters}

    def log_prior_unconstrained(self, u: Float[Array, "... d"]) -> Float[Array, "..."]:
        """Log density of the prior in unconstrained coordinates, with the Jacobian."""
        total = jnp.zeros(u.shape[:-1])
        for i, p in enumerate(self.parameters):
            value = p.transform(u[..., i])
            total += p.prior.log_prob(value) + p.transform.log_abs_det_jacobian(u[..., i], value)
        return total


class Extension(NamedTuple):
    """The parameters of new recordings."""

    scopes: Scopes  # scopes with them instead of the fitted recordings' parameters
    # labels of fitted parameters from which each takes its values; none for the deviation of a new group
    like: Mapping[str, tuple[str, ...]]


def _ratio(parameter: InferredParameter, values: Mapping[str, Any]) -> Any:
    """Standard deviation of a parameter over its prior's; 1 if it is the prior's."""
    scale = parameter.scope.scaled_by
    return values[scale] / parameter.prior.scale if scale else 1.0


def build_scopes(
    specs: Sequence[ParameterSpec],
    priors: Mapping[str, Any],
    per_recording: Mapping[str, Sequence[str]],
    recordings: Sequence[str],
    *,
    pooled: Mapping[str, Pooled] | None = None,
    only_in: Mapping[str, Mapping[str, Sequence[str]]] | None = None,
    fixed: Mapping[str, float] | None = None,
) -> Scopes:
    """Combine specifications, prior tables and parameters of single recordings.

    Args:
        specs: every parameter of the model.
        priors: inferred parameters with their prior tables; ``{}`` is the default prior.
        per_recording: parameters that are free in the named recordings only.
        recordings: names of all recordings.
        pooled: parameters that differ between groups of recordings, about a shared value.
        only_in: parameters that some groups have and others do not: recordings by group.
        fixed: fixed values.

    Raises:
        InputError: an unknown name, an unusable prior, nothing to infer, or a pooled parameter without a shared value.
    """
    by_name = {spec.name: spec for spec in specs}
    pooled, only_in = pooled or {}, only_in or {}
    check_names(list(priors) + list(per_recording) + list(pooled), specs, where=WHERE)
    for name in pooled:
        alone = name in per_recording
        if name not in priors or alone:
            raise InputError(
                f"{name} differs between groups about a shared value, but has no shared value",
                where="[model.per_group]",
                remedy="take it out of [model.per_recording]" if alone else "also name it under [model.priors]",
            )
    parameters: list[InferredParameter] = []
    for name, table in priors.items():
        for recording in per_recording.get(name, ()):
            if recording not in recordings:
                raise InputError(
                    f"{name} is per recording, but no recording is called {recording!r}",
                    where="[model.per_recording]",
                    remedy=f"recordings: {', '.join(recordings)}",
                )
        first = InferredParameter.of(by_name[name], table, where=WHERE)
        if name not in per_recording and name not in only_in:
            parameters.append(first)
        parameters += [replace(first, scope=Scope(r), members=(r,)) for r in per_recording.get(name, ())]
        groups = only_in.get(name, {})
        parameters += [replace(first, scope=Scope(g, True), members=tuple(own)) for g, own in groups.items()]
        if name in pooled:
            known = [parameter.name for parameter in parameters]
            spread = [p for p in spread_of(by_name[name], pooled[name]) if p.name not in known]
            parameters += [*spread, *deviations(by_name[name], pooled[name])]
    if not parameters:
        raise InputError("no parameter has a prior", where=WHERE, remedy="give at least one")
    return Scopes(tuple(parameters), by_name, fixed or {})
