"""Groups of recordings in an audit, and their differences in a model's file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.discrepancy.candidates import Candidate
from rfdropo_bayes.discrepancy.differences import WHERE, Groups
from rfdropo_bayes.discrepancy.fit import widening
from rfdropo_bayes.discrepancy.fixed_quantities import OwnParameter
from rfdropo_bayes.discrepancy.pipeline import Answer
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.groups import Patterns, gather_groups, group_of, in_group, whole
from rfdropo_bayes.tables import nearest

Between = Sequence[str] | Mapping[str, Sequence[str | Trajectory] | str | Trajectory]
"""Two names of [model.groups], or the recordings of each group by its name."""


def find_groups(
    between: Between, patterns: Patterns, fitted: Sequence[Trajectory], tested: Sequence[Trajectory]
) -> tuple[Groups, list[Trajectory], list[Trajectory]]:
    """The two groups, and the fitted and unseen recordings that belong to one of them.

    Args:
        between: the two.
        patterns: [model.groups].
        fitted: fitted recordings; tested: unseen recordings.

    Raises:
        InputError: not two groups, an unknown group, a group without a fitted recording, or a recording in both.
    """
    if len(set(between)) != 2 or len(between) != 2 or isinstance(between, str):
        raise InputError(f"{len(set(between))} groups are named", where=WHERE, remedy="name two that differ")
    names = [trajectory.name for trajectory in [*fitted, *tested]]
    if isinstance(between, Mapping):
        members = {group: _matching(group, given, names) for group, given in between.items()}
    else:
        members = _named(list(between), patterns, names)
    first, second = (set(own) for own in members.values())
    if both := sorted(first & second):
        raise InputError(
            f"{both[0]} is in both groups, {' and '.join(members)}", where=WHERE, remedy="keep it in one of them"
        )
    for group, own in members.items():
        if not set(own) & {trajectory.name for trajectory in fitted}:
            raise InputError(
                f"no fitted recording is in the group {group!r}",
                where=WHERE,
                remedy=f"fitted recordings: {', '.join(t.name for t in fitted)}",
            )
    groups = Groups(members, tuple(name for name in names if name not in first | second))
    known = first | second
    return groups, [t for t in fitted if t.name in known], [t for t in tested if t.name in known]


def groups_at_hand(patterns: Patterns, fitted: Sequence[Trajectory], tested: Sequence[Trajectory]) -> Groups | None:
    """The groups of [model.groups], each of which may have its own candidates; None if the recordings contain a single
    group.

    Args:
        patterns: [model.groups].
        fitted: fitted recordings; tested: unseen recordings.
    """
    names, own = [t.name for t in [*fitted, *tested]], {t.name for t in fitted}
    gathered = gather_groups(names, patterns)
    members = {group: each for group, each in gathered.items() if group in patterns and own & set(each)}
    others = tuple(name for name in names if not any(name in each for each in members.values()))
    if len(members) < 2 and not (members and own & set(others)):
        return None
    outside = {group: tuple(name for name in names if name not in each) for group, each in members.items()}
    alone = [own & set(each) for each in members.values()]
    apart = {f"all but {group}": each for group, each in outside.items() if own & set(each) not in alone}
    return Groups(members, others, compared=False, complements=apart)


def _named(between: Sequence[str], patterns: Patterns, names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Recordings of the groups in the experiment; a recording in no group forms a group."""
    groups = gather_groups(names, patterns)
    for group in between:
        if group not in groups and group not in patterns:
            known = list(dict.fromkeys([*patterns, *groups]))
            raise InputError(
                f"unknown group {group!r}",
                where=WHERE,
                remedy=f"{nearest(group, known)}; [model.groups] names recordings of one day or one robot",
            )
    return {group: groups.get(group, ()) for group in between}


def _matching(
    group: str, given: Sequence[str | Trajectory] | str | Trajectory, names: Sequence[str]
) -> tuple[str, ...]:
    """Recordings of names, wildcards or recordings."""
    chosen: list[str] = []
    for entry in [given] if isinstance(given, str | Trajectory) else given:
        pattern = entry.name if isinstance(entry, Trajectory) else entry
        matching = [name for name in names if name == pattern or fnmatchcase(whole(name), pattern)]
        if not matching:
            raise InputError(
                f"no recording of the group {group!r} is called {pattern!r}",
                where=WHERE,
                remedy=f"recordings: {', '.join(names)}",
            )
        chosen += [name for name in matching if name not in chosen]
    return tuple(chosen)


def extend_groups(model: dict[str, Any], answer: Answer, candidate: Candidate) -> None:
    """Write the difference between groups into the table [model] of an experiment file.

    A mechanism named in a single scope (a group, or all groups but one) is added to these groups only, with a value for
    each. A mechanism named in several scopes is pooled.
    """
    coordinates, groups = answer.problem.coordinates, answer.problem.groups
    assert groups is not None
    factor = widening(answer.extended, coordinates)
    named = [answer.problem.candidate(step.name) for step in answer.adopted]
    scopes = {each.name for each in named if each is not None and each.title == candidate.title}
    alone = len(scopes) == 1 and not isinstance(candidate.mechanism, OwnParameter)
    for index in candidate.indices:
        parameter = coordinates.space.parameters[index]
        name = parameter.scope.added_to
        if not name:
            continue
        if groups.compared:
            model["groups"] = _naming(groups.members, model.get("groups", {}))
        if alone:
            own = _groups_of(candidate.group, groups, model.get("groups", {}))
            model["groups"] = _naming(own, model.get("groups", {}))
            model.setdefault("only_in", {})[name] = list(own)
            continue
        scale = float(parameter.table["scale"]) * float(factor[index]) / np.sqrt(2.0)
        model.setdefault("per_group", {})[name] = float(f"{scale:.3g}")
        if name not in coordinates.names:
            model.setdefault("priors", {}).setdefault(name, {})


def confine_laws(model: dict[str, Any], answer: Answer) -> None:
    """Say in the table [model] of an experiment file which groups have the terms of a law that act in one alone."""
    groups, law = answer.problem.groups, answer.law
    for refit in [] if law is None else law.search.terms:
        group = refit.term.scope.group
        if group and groups is not None:
            model["groups"] = _naming({group: groups.members[group]}, model.get("groups", {}))
            model.setdefault("only_in", {})[refit.term.spec.name] = [group]


def _groups_of(scope: str, groups: Groups, patterns: Patterns) -> dict[str, tuple[str, ...]]:
    """A single group, or all groups except one."""
    recordings = groups.recordings(scope)
    return {scope: recordings} if scope in groups.members else gather_groups(recordings, patterns)


def _naming(groups: Mapping[str, Sequence[str]], patterns: Patterns) -> Patterns:
    """Patterns of groups and of their recordings."""
    for group, recordings in groups.items():
        for recording in recordings:
            if group not in patterns or group_of(recording, patterns) != group:
                patterns = in_group(recording, group, patterns)
    return patterns
