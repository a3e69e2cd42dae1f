"""Markers that change names: from a row on, a tracker gives the places of some markers under the names of others.

An exchange of markers shows in one row: each exchanged marker is near the expected position of the other marker, and
far from its own expected position. Two points of one body do not trade places within a row, so the change is certain;
the rows do not show which names are right; the names at the beginning are taken.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import linear_sum_assignment

APART = 5e-3  # [m]: nearer markers are not distinguishable
NEARER = 0.25  # share of the distance from itself within which the other marker was expected


class Change(NamedTuple):
    """From ``row`` on column ``taken_by[marker]`` has the marker that column ``marker`` had before."""

    row: int
    taken_by: dict[int, int]


def changed_names(
    position: Float[np.ndarray, "time marker 3"], usable: Bool[np.ndarray, "time marker"]
) -> tuple[Bool[np.ndarray, "time marker"], list[Change]]:
    """Mask of positions under the name of another marker, and the rows in which names change.

    Args:
        position: positions of the markers [m].
        usable: True if a marker was measured.
    """
    wrong, changes = np.zeros_like(usable), list[Change]()
    if len(position) < 2 or position.shape[1] < 2:
        return wrong, changes
    before, known = _expected(position, usable)
    own = _distance(before, position[None])
    moved = usable & known & (own > APART)
    holder = np.arange(position.shape[1])
    for row in np.flatnonzero(moved.sum(axis=1) >= 2):
        taken_by = _assigned(before[:, row], position[row], np.flatnonzero(usable[row] & known[row]), own[row])
        if not taken_by:
            continue
        changes.append(Change(int(row), taken_by))
        new = holder.copy()
        for marker, column in taken_by.items():
            new[column] = holder[marker]
        holder = new
        wrong[row:] = holder != np.arange(len(holder))
    return wrong, changes


def _expected(
    position: Float[np.ndarray, "time marker 3"], usable: Bool[np.ndarray, "time marker"]
) -> tuple[Float[np.ndarray, "2 time marker 3"], Bool[np.ndarray, "time marker"]]:
    """Expected positions of each marker in a row (the last position, and an extrapolation), and whether the marker was
    seen.
    """
    rows = np.arange(len(position))[:, None]
    last = np.maximum.accumulate(np.where(usable, rows, -1), axis=0)
    last = np.concatenate([np.full((1, last.shape[1]), -1), last[:-1]])
    known, at = last >= 0, np.maximum(last, 0)
    markers = np.arange(position.shape[1])
    still = position[at, markers]
    moving = (last == rows - 1) & (at > 0) & usable[np.maximum(at - 1, 0), markers]
    step = np.where(moving[..., None], still - position[np.maximum(at - 1, 0), markers], 0.0)
    return np.stack([still, still + step]), known


def _distance(expected: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """The smaller of the distances from the two expectations."""
    return np.min(np.linalg.norm(measured - expected, axis=-1), axis=0)


def _assigned(
    expected: Float[np.ndarray, "2 marker 3"],
    measured: Float[np.ndarray, "marker 3"],
    seen: np.ndarray,
    own: Float[np.ndarray, " marker"],
) -> dict[int, int]:
    """Markers at the expected positions of others, by column; empty if uncertain."""
    cost = _distance(expected[:, seen, None], measured[None, None, seen])
    markers, columns = linear_sum_assignment(cost)
    moved = markers != columns
    certain = (cost[markers, columns] < NEARER * own[seen[markers]]) & (own[seen[markers]] > APART)
    if not moved.any() or not certain[moved].all():
        return {}
    return {int(seen[m]): int(seen[c]) for m, c in zip(markers[moved], columns[moved], strict=True)}
