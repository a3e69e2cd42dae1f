"""Notes on valid but suspicious command times: lost commands, and two commanding programs."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

REGULAR, NEAR = 0.7, 0.25
"""Commands come regularly if this share of their intervals is as near to the median, as a share of it."""
FEWEST = 10  # least number of intervals that give a rate
HOLE = 4.0  # multiple of the usual interval above which an interval is noted
LOST = 0.04  # share of commands that are lost one by one, at or above which they are noted
ALTERNATING = 8  # commands in a row that go to and fro between two others, at or above which two programs are suspected
SAME = 0.2  # share of a change of command within which the command after the next one counts as equal


def command_notes(time: Float[np.ndarray, " command"], command: Float[np.ndarray, "command channel"]) -> list[str]:
    """Suspicious times, each with a remedy for the user.

    Args:
        time: times of the commands [s], increasing.
        command: values in any unit.
    """
    return [*_lost(time), *_alternating(time, command)]


def _lost(time: np.ndarray) -> list[str]:
    """Gaps in commands that come regularly otherwise."""
    gaps = np.diff(time)
    if len(gaps) < FEWEST:
        return []
    usual = float(np.median(gaps))
    if np.mean(np.abs(gaps - usual) <= NEAR * usual) < REGULAR:
        return []
    missing = np.rint(gaps / usual) - 1.0
    holes = np.flatnonzero(gaps > HOLE * usual)
    if not len(holes) and missing.sum() < LOST * len(gaps):
        return []
    longest = int(np.argmax(gaps))
    return [
        f"commands come every {1e3 * usual:.4g} ms, and {int(missing.sum())} of them are missing: the longest gap is "
        f"{gaps[longest]:.4g} s, from {time[longest]:.4g} s on; each command is taken to hold until the next one. If "
        "the recorder lost commands, leave these seconds out with rows"
    ]


def _alternating(time: np.ndarray, command: np.ndarray) -> list[str]:
    """Notes on alternating commands, as from two programs that publish the same channels."""
    if len(time) < ALTERNATING:
        return []
    next_one = np.linalg.norm(command[1:-1] - command[:-2], axis=1)
    after = np.linalg.norm(command[2:] - command[:-2], axis=1)
    fro = np.concatenate([[0], ((next_one > 0.0) & (after < SAME * next_one)).astype(int), [0]])
    starts, ends = np.flatnonzero(np.diff(fro) == 1), np.flatnonzero(np.diff(fro) == -1)
    runs = ends - starts
    if not len(runs) or runs.max() < ALTERNATING:
        return []
    first = int(starts[np.argmax(runs >= ALTERNATING)])
    zero = (command[first : first + 2] == 0.0).all(axis=1).any()
    return [
        f"commands go to and fro between two values{', one of them zero,' * bool(zero)} {int(runs.sum())} "
        f"times, first from {time[first]:.4g} s on: if two programs sent the same channels, record the "
        "program that the drives obeyed"
    ]
