"""Recordings given to a verb: checked to be a list."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rfdropo_bayes.data.trajectory import Trajectory
from rfdropo_bayes.errors import InputError

READ = 'read files with rb.read("monday/*.csv", format="csv", columns=...), arrays with rb.Trajectory.from_arrays'


def given_recordings(given: Any, where: str) -> list[Trajectory]:
    """A list of recordings; a single recording is a list of one.

    Args:
        given: argument of the caller.
        where: name of the argument.

    Raises:
        InputError: the argument holds no recordings; the remedy shows how to read them.
    """
    if isinstance(given, Trajectory):
        return [given]
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise InputError(f"{_words(given)} is not a list of recordings", where=where, remedy=READ)
    recordings = list(given)
    for each in recordings:
        if not isinstance(each, Trajectory):
            raise InputError(f"{_words(each)} is not a recording", where=where, remedy=READ)
    return recordings


def given_recording(given: Any, where: str) -> Trajectory:
    """A single recording.

    Raises:
        InputError: something else was given, a list of one recording among it.
    """
    if isinstance(given, Trajectory):
        return given
    if isinstance(given, list | tuple) and given and all(isinstance(each, Trajectory) for each in given):
        raise InputError(
            f"a list of {len(given)} is not a recording", where=where, remedy="give one of them, as runs[-1]"
        )
    raise InputError(f"{_words(given)} is not a recording", where=where, remedy=READ)


def _words(given: Any) -> str:
    """A short name of the argument."""
    return repr(given) if isinstance(given, str | int | float) or given is None else f"a {type(given).__name__}"
