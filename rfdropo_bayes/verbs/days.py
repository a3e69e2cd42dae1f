"""Days of recordings by the names of their files, and the pieces of files that are fitted or tested."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

FEWEST_ROWS = 60  # rows of a recording whose last third, 20 rows, is worth a test
ROWS_AT_REST = 200
"""Rows at rest that a fit takes, seven for each parameter of a robot with nine cables. There 405 of 1,620 rows left the
error on unseen rows as it was; with 203 the minutes hold twice the rollouts."""
_DAY = re.compile(
    r"\d{4}-?[01]\d-?[0-3]\d|(?<![a-z])(mon|tue|tues|wed|wednes|thu|thurs|fri|sat|satur|sun)(day)?(?![a-z])|"
    r"(?<![a-z])(montag|dienstag|mittwoch|donnerstag|freitag|samstag|sonntag)(?![a-z])|"
    r"(?<![a-z])(lundi|mardi|mercredi|jeudi|vendredi|samedi|dimanche)(?![a-z])|(?<![a-z])(day|session)[-_ ]?\d+",
    re.IGNORECASE,
)


class Piece(NamedTuple):
    """An entry of fit or test."""

    file: int  # number of its recording
    rows: Mapping[str, Any]  # keys ``rows`` and ``every``; empty for all rows
    tested: bool


def days_of(recordings: Sequence[Path]) -> dict[str, list[int]]:
    """Numbers of the recordings of each day that their names tell; empty if not every name does, or all are of one day.

    Files of one name in different folders are named by their folders.
    """
    stems = [path.name.partition(".")[0] for path in recordings]
    days: dict[str, list[int]] = {}
    for number, (path, stem) in enumerate(zip(recordings, stems, strict=True)):
        found = _DAY.search(stem) or (_DAY.search(path.parent.name) if stems.count(stem) > 1 else None)
        if found is None:
            return {}
        days.setdefault(found[0], []).append(number)
    return days if len(days) > 1 else {}


def last_third(recordings: Sequence[int]) -> Sequence[int]:
    """The last third of several recordings, at least one; nothing of a single recording."""
    return recordings[-max(1, len(recordings) // 3) :] if len(recordings) > 1 else ()


def unseen_third(recordings: Sequence[int], repeats: Sequence[Sequence[int]]) -> Sequence[int]:
    """As `last_third`, without repeats of fitted commands: repeats are fitted or tested together, and a sequence with
    too many repeats for a test is fitted. If all recordings are repeats, the last third of them.
    """
    families = {k: [member for member in group if member in recordings] for group in repeats for k in group}
    chosen: list[int] = []
    for k in reversed(recordings):
        if k not in chosen and len(chosen) + len(families[k]) <= max(1, len(recordings) // 3):
            chosen += families[k]
    return sorted(chosen) if chosen and len(recordings) > 1 else last_third(recordings)


def pieces_of(
    counts: Sequence[int],
    days: Mapping[str, Sequence[int]],
    repeats: Sequence[Sequence[int]],
    *,
    rests: bool = False,
    timed: bool = True,
    kept: int = 0,
) -> list[Piece]:
    """Entries of fit and test: of each day the last third is the test, of its recordings (see `unseen_third`) or of its
    single recording; or the last ``kept`` recordings.

    Poses without times have no order, so rows between the fitted ones are the test if there are enough.

    Args:
        counts: rows of every recording.
        days: numbers of the recordings of each day; empty for one day.
        repeats: numbers of the recordings of each command sequence.
        rests: whether every row is an equilibrium; a fit may then leave out rows.
        timed: whether rows have times.
        kept: number of recordings that were named for the test.
    """
    groups = list(days.values()) or [range(len(counts))]
    alone = [group[0] for group in groups if not kept and len(group) == 1 and counts[group[0]] >= FEWEST_ROWS]
    tested = set(range(len(counts))[-kept:] if kept else (k for group in groups for k in unseen_third(group, repeats)))
    fitted = sum(
        (2 * count // 3 if number in alone and timed else count)
        for number, count in enumerate(counts)
        if number not in tested
    )
    every = max(1, fitted // ROWS_AT_REST) if rests else 1
    thinned = {"every": every} if every > 1 else {}
    pieces = []
    for number, count in enumerate(counts):
        last, cut = count - 1, 2 * count // 3
        if number not in alone:
            pieces.append(Piece(number, {} if number in tested else thinned, number in tested))
        elif thinned and not timed:
            pieces.append(Piece(number, {"rows": [0, last], **thinned}, False))
            pieces.append(Piece(number, {"rows": [every // 2, last], **thinned}, True))
        else:
            pieces.append(Piece(number, {"rows": [0, cut - 1], **thinned}, False))
            pieces.append(Piece(number, {"rows": [cut, last]}, True))
    return pieces


def group_lines(days: Mapping[str, Sequence[int]]) -> list[str]:
    """The table [model.groups] of recordings of several days; empty for one day."""
    if not days:
        return []
    # The pattern of day 1 must not hold day 10.
    numbered = [day for day in days if day[0].isalpha() and day[-1].isdigit()]
    lines = [f'"{day}" = ["*{day}", "*{day}[!0-9]*"]' if day in numbered else f'"{day}" = "*{day}*"' for day in days]
    return ["[model.groups]  # ASSUMED: days, by the names of the recordings", *lines, ""]
