"""Markers and axes that a caller of a plot names, as numbers."""

from __future__ import annotations

from collections.abc import Sequence

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.tables import nearest


def entry_number(given: str | int, names: Sequence[str], what: str) -> int:
    """The number of an entry, from 0 on, for a name or a number (negative numbers count from the end).

    Args:
        given: name or number.
        names: names of all entries.
        what: kind of entry, such as "marker".

    Raises:
        InputError: no such entry.
    """
    if isinstance(given, str) and given in names:
        return list(names).index(given)
    if isinstance(given, int) and -len(names) <= given < len(names):
        return given % len(names)
    remedy = nearest(given, names) if isinstance(given, str) else f"there are {len(names)}: {', '.join(names)}"
    raise InputError(f"no {what} {given!r}", where="plot", remedy=remedy)
