"""Groups of recordings, for example of one day, one robot or one set-up."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase

from rfdropo_bayes.errors import InputError

_PIECE = re.compile(r"(\[\d+:\d+\])+$")

Patterns = Mapping[str, str | Sequence[str]]
"""Names of recordings, or wildcards, by the name of their group."""


def whole(recording: str) -> str:
    """The recording that a piece is cut from, such as "run" of "run[0:99]"; brackets elsewhere belong to its name."""
    return _PIECE.sub("", recording)


def group_of(recording: str, patterns: Patterns) -> str:
    """Name of the group a recording belongs to; a recording without a group forms its own.

    A group that names the recording takes precedence over wildcards.

    Args:
        recording: name of the recording or of a piece of it.
        patterns: names of recordings, or wildcards, by group.

    Raises:
        InputError: the recording is in two groups.
    """
    name = whole(recording)
    listed = _listed(patterns)
    found = [group for group, entries in listed.items() if name in map(whole, entries)]
    if not found:
        found = [group for group, entries in listed.items() if any(fnmatchcase(name, entry) for entry in entries)]
    if len(found) > 1:
        raise InputError(
            f"{name} is in two groups: {found[0]} and {found[1]}", where="[model.groups]", remedy="keep it in one"
        )
    return found[0] if found else name


def gather_groups(recordings: Sequence[str], patterns: Patterns) -> dict[str, tuple[str, ...]]:
    """Recordings by group, in the order in which the groups are first met."""
    groups: dict[str, tuple[str, ...]] = {}
    for recording in recordings:
        group = group_of(recording, patterns)
        groups[group] = (*groups.get(group, ()), recording)
    return groups


def unmatched(recordings: Sequence[str], patterns: Patterns) -> list[tuple[str, str]]:
    """Entries of the patterns that name none of the recordings, each with its group."""
    names = [whole(recording) for recording in recordings]
    return [
        (group, entry)
        for group, entries in _listed(patterns).items()
        for entry in entries
        if not any(name == whole(entry) or fnmatchcase(name, entry) for name in names)
    ]


def in_group(recording: str, group: str, patterns: Patterns) -> dict[str, list[str]]:
    """Patterns with a recording moved to a group."""
    name = whole(recording)
    found = {each: [entry for entry in entries if whole(entry) != name] for each, entries in _listed(patterns).items()}
    found[group] = [*found.get(group, []), name]
    return {each: entries for each, entries in found.items() if entries}


def _listed(patterns: Patterns) -> dict[str, list[str]]:
    return {group: [entries] if isinstance(entries, str) else list(entries) for group, entries in patterns.items()}
