"""Possible differences between groups of recordings, such as sessions: candidates of an audit of recordings in groups.

A difference is added to a value that all groups share. A base parameter is higher in one group, or a mechanism is
present, larger or absent in one group only. A mechanism that all groups lack is a candidate as
well, under its plain name: without it, an error of the base model could be taken for a difference between groups.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import jax
import numpy as np

from rfdropo_bayes.bayes.inferred_parameter import InferredParameter, deviation
from rfdropo_bayes.bayes.priors import prior_from_table
from rfdropo_bayes.bayes.scopes import Scopes
from rfdropo_bayes.discrepancy.candidates import Candidate
from rfdropo_bayes.discrepancy.coordinates import MEASURED_FROM_NULL, PRIOR_DRAWS
from rfdropo_bayes.discrepancy.fixed_quantities import OwnParameter, families, stem
from rfdropo_bayes.posteriors import Scope
from rfdropo_bayes.simulators.parameters import ParameterSpec

WHERE = "--between"


@dataclass(frozen=True)
class Groups:
    """Groups of recordings.

    Attributes:
        members: fitted and unseen recordings of each, by the group's name.
        left_out: recordings without a group; ignored if two groups are compared.
        compared: whether an audit tests only differences between two groups.
        complements: recordings outside a group, by "all but NAME", if their fitted recordings are not a group.
    """

    members: Mapping[str, tuple[str, ...]]
    left_out: tuple[str, ...] = ()
    compared: bool = True
    complements: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the groups."""
        return tuple(self.members)

    @property
    def shifted(self) -> tuple[str, ...]:
        """Groups in which a shared value may differ. For two groups without other recordings this is the second group,
        since the difference is the same for both.
        """
        return self.names[1:] if len(self.members) == 2 and not self.complements else self.names

    def recordings(self, scope: str) -> tuple[str, ...]:
        """Recordings of a group, or of all groups but one."""
        return self.members[scope] if scope in self.members else self.complements[scope]

    def group_of(self, recording: str) -> str:
        """The group of a recording; empty if it belongs to none."""
        return next((name for name, own in self.members.items() if recording in own), "")


@dataclass
class _Space:
    """Parameters in order of addition, with the index of each."""

    parameters: list[InferredParameter]

    def add(self, parameter: InferredParameter) -> int:
        self.parameters.append(parameter)
        return len(self.parameters) - 1


def with_differences(
    space: Scopes,
    base: int,
    simulated: Sequence[ParameterSpec],
    library: Sequence[Candidate],
    groups: Groups,
    *,
    spreads: Mapping[str, float],
    fixed: Sequence[str] = (),
) -> tuple[Scopes, list[Candidate]]:
    """Parameters and candidates, including possible differences between groups.

    Args:
        space: base parameters, then the library's.
        base: number of base parameters.
        simulated: every parameter of the base simulator.
        library: candidates that all groups may lack.
        groups: groups of the recordings.
        spreads: standard deviations between groups that the model states, by parameter [its unit].
        fixed: fixed parameters, which therefore do not differ.
    """
    extended = _Space(list(space.parameters))
    candidates = list(library)
    shared = {p.spec.name: p for p in space.parameters[:base] if not p.scope.owner}
    free = {p.physical for p in space.parameters[:base] if p.scope.owner}  # differ between recordings or groups already
    places: dict[str, dict[str, int]] = {}  # by group, by parameter
    known = {*fixed, *free}
    specs = [spec for spec in simulated if spec.name not in known and (spec.name in shared or spec.prior)]
    for spec in specs:
        spread = np.sqrt(2.0) * spreads[spec.name] if spec.name in spreads else _deviation_of(spec, shared)
        for group in groups.shifted if spec.name in shared else groups.names:
            places.setdefault(group, {})[spec.name] = extended.add(_difference(spec, spread, group, groups))
    for group in groups.names:
        own = places.get(group, {})
        candidates += [_changed([spec], [own[spec.name]], group, groups) for spec in specs if spec.name in own]
        for family in families([spec for spec in specs if spec.name in own]):
            candidates.append(_changed(family, [own[spec.name] for spec in family], group, groups))
        candidates += [_in_one_group(candidate, group, groups, extended) for candidate in library]
    # an effect of either sign is added to the shared value, and so may be absent in one
    for scope in groups.complements:
        candidates += [_in_one_group(each, scope, groups, extended) for each in library if _one_sided(each, extended)]
    return replace(space, parameters=tuple(extended.parameters)), candidates


def _deviation_of(spec: ParameterSpec, shared: Mapping[str, InferredParameter]) -> float:
    """Standard deviation of a parameter's prior: the difference has the same scale as the parameter."""
    known = shared.get(spec.name)
    prior = known.prior if known else prior_from_table(spec, dict(spec.prior), where=f"{WHERE} {spec.name}")
    return float(np.std(np.asarray(prior.sample(jax.random.key(0), (PRIOR_DRAWS,)))))


def _difference(spec: ParameterSpec, spread: float, group: str, groups: Groups) -> InferredParameter:
    """Deviation of one group's value from the others', Normal(0, ``spread``)."""
    width = spec.high - spec.low
    scope = Scope(group, group=True, added_to=spec.name)
    return deviation(spec, spread, scope, groups.recordings(group), width, where=WHERE)


def _changed(specs: Sequence[ParameterSpec], places: Sequence[int], group: str, groups: Groups) -> Candidate:
    name = specs[0].name if len(specs) == 1 else stem(specs)
    described = specs[0].description if len(specs) == 1 else f"{name.replace('_', ' ')} ({len(specs)} of them)"
    elsewhere = next(name for name in groups.names if name != group) if groups.compared else "other groups"
    cause = f"{described}: differs between {group} and {elsewhere}"
    remedy = f"measure it in {group} and in {elsewhere}, and undo the change"
    change = OwnParameter(name, tuple(specs), cause, remedy)
    return Candidate(name, tuple(places), change, name, group)


def _in_one_group(candidate: Candidate, group: str, groups: Groups, extended: _Space) -> Candidate:
    """A mechanism of the library in one group only. Shapes, which have no effect without it, are shared."""
    parameters = [extended.parameters[i] for i in candidate.indices]
    sized = [p.table.get("distribution") in MEASURED_FROM_NULL for p in parameters]
    indices = []
    for index, parameter, has_size in zip(candidate.indices, parameters, sized, strict=True):
        if has_size:
            indices.append(extended.add(_of_one_group(parameter, group, groups)))
        elif any(sized):
            indices.append(index)
        else:
            spread = float(np.std(np.asarray(parameter.prior.sample(jax.random.key(0), (PRIOR_DRAWS,)))))
            indices.append(extended.add(_difference(parameter.spec, spread, group, groups)))
    return replace(candidate, indices=tuple(indices), group=group)


def _one_sided(candidate: Candidate, extended: _Space) -> bool:
    """Whether a size of a mechanism has one sign only, so that nothing added to it takes it away."""
    specs = [extended.parameters[i].spec for i in candidate.indices]
    return any(spec.low >= spec.nominal or spec.high <= spec.nominal for spec in specs)


def _of_one_group(parameter: InferredParameter, group: str, groups: Groups) -> InferredParameter:
    """The size of a mechanism in one group, measured from its null value and added to the shared value."""
    spec, table = parameter.spec, dict(parameter.table)
    for key in ("loc", "low", "high"):
        if key in table:
            table[key] -= spec.nominal
    low, high, grid = spec.low - spec.nominal, spec.high - spec.nominal, tuple(g - spec.nominal for g in spec.grid)
    own = spec._replace(low=low, high=high, nominal=0.0, prior=table, grid=grid)
    scope = Scope(group, group=True, added_to=spec.name)
    return InferredParameter.of(own, table, scope, groups.recordings(group), where=WHERE)
