"""Readings with their own times, such as the topics of a bag, brought to one table.

Observations get the times of the first marker's stream. Readings of the other streams are interpolated linearly between
two that are no further apart than one and a half rows; a single reading is assigned to the nearest row; other cells are
missing. Nothing is held or extrapolated.

Commands are events and keep their times: each command of a channel makes a row, in which the other channels keep their
commands.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from rfdropo_bayes.data.csv_table import closest
from rfdropo_bayes.data.recorded import continuous_quaternions
from rfdropo_bayes.errors import InputError

ADJACENT = 1.5  # largest gap between neighbouring readings, in rows; a gap of two rows means a lost reading


class Stream(NamedTuple):
    """Readings that share their times."""

    name: str  # name of the topic, and of the element if elements have their own times
    time: Float[np.ndarray, " reading"]  # increasing times [s]
    values: pd.DataFrame  # a column for each quantity, by its full name; NaN if a message has none
    frames: frozenset[str] = frozenset()  # coordinate frames that the messages name


def in_order(name: str, time: Float[np.ndarray, " reading"], values: pd.DataFrame, frames: frozenset[str]) -> Stream:
    """A stream of readings sorted by time; the last of several readings at one time counts."""
    order = np.argsort(time, kind="stable")
    kept = order[np.append(np.diff(time[order]) > 0.0, True)]
    if len(kept) < len(time):
        message = "%s: %d of %d readings have the time of another reading and are left out"
        logging.getLogger(__name__).warning(message, name, len(time) - len(kept), len(time))
    return Stream(name, time[kept], values.iloc[kept].reset_index(drop=True), frames)


def side_by_side(streams: Sequence[Stream]) -> pd.DataFrame:
    """All columns, as long as the longest: all readings, without regard to times."""
    return pd.concat([stream.values for stream in streams], axis=1) if streams else pd.DataFrame()


def observed(
    streams: Sequence[Stream], clock: str, names: Sequence[str], pose: Sequence[str] | None, where: str
) -> pd.DataFrame:
    """Columns ``names`` at the times of the first column, stored in the column ``clock``.

    Args:
        streams: streams with these columns.
        clock: name of the new column of times [s].
        names: columns that are interpolated one by one.
        pose: columns of a position and a unit quaternion x, y, z, w, which are interpolated together.
        where: the file, for messages.

    Raises:
        InputError: a column that no stream has.
    """
    owner = _owners(streams, [*names, *(pose or ())], where)
    rows = owner[names[0]].time
    table = {clock: rows} | {name: _at_rows(rows, owner[name].time, owner[name].values[name]) for name in names}
    if pose:
        source = owner[pose[0]]
        values = continuous_quaternions(np.column_stack([owner[name].values[name] for name in pose]))
        values = np.column_stack([_at_rows(rows, source.time, column) for column in values.T])
        values[:, 3:] /= np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
        table |= dict(zip(pose, values.T, strict=True))
    return pd.DataFrame(table)


def commanded(streams: Sequence[Stream], clock: str, names: Sequence[str], where: str) -> pd.DataFrame:
    """Columns ``names`` at every time at which any of them is given, with these times as the column ``clock``.

    Raises:
        InputError: a column that no stream has, or that holds nothing.
    """
    owner = _owners(streams, names, where)
    given = [pd.Series(np.asarray(owner[name].values[name], dtype=float), index=owner[name].time) for name in names]
    held = pd.concat([series.dropna() for series in given], axis=1, keys=list(names)).sort_index().ffill()
    late = held.isna().sum()
    for name in names:
        if held[name].isna().all():
            raise InputError("holds no commands", where=f"{where}, {name}", remedy="name another column")
        if late[name]:
            message = "%s: %s is not commanded in the first %d rows; its first command is taken for them"
            logging.getLogger(__name__).warning(message, where, name, late[name])
    held = held.bfill()
    held.insert(0, clock, held.index)
    return held.reset_index(drop=True)


def one_frame(streams: Sequence[Stream], names: Sequence[str], where: str) -> None:
    """Raise an InputError if positions are given in several coordinate frames."""
    frames = {frame for name in names for stream in streams if name in stream.values for frame in stream.frames}
    if len(frames) > 1:
        raise InputError(
            f"the positions are in several coordinate frames: {', '.join(sorted(frames))}",
            where=where,
            remedy="name positions of one frame; transforms are not chained",
        )


def _owners(streams: Sequence[Stream], names: Sequence[str], where: str) -> dict[str, Stream]:
    owner = {name: stream for stream in streams for name in stream.values.columns}
    for name in names:
        if name not in owner:
            raise InputError(
                f"column {name!r} is missing; {closest(name, sorted(owner))}",
                where=where,
                remedy="correct it under [data.columns]",
            )
    return {name: owner[name] for name in names}


def _at_rows(
    rows: Float[np.ndarray, " row"], time: Float[np.ndarray, " reading"], value: pd.Series | np.ndarray
) -> Float[np.ndarray, " row"]:
    """A quantity at the times of rows; NaN if no reading is near."""
    value = np.asarray(value, dtype=float)
    time, value = time[np.isfinite(value)], value[np.isfinite(value)]
    filled = np.full(len(rows), np.nan)
    if not len(time) or len(rows) < 2:
        return filled
    step = float(np.median(np.diff(rows)))
    after = np.clip(np.searchsorted(rows, time), 1, len(rows) - 1)
    nearest = np.where(time - rows[after - 1] < rows[after] - time, after - 1, after)
    distance = np.abs(rows[nearest] - time)
    closest_last = np.argsort(-distance, kind="stable")
    lone = closest_last[distance[closest_last] <= 0.5 * step]
    filled[nearest[lone]] = value[lone]
    before = np.searchsorted(time, rows, side="right") - 1
    inside = (before >= 0) & (before < len(time) - 1)
    before = before[inside]
    span = time[before + 1] - time[before]
    weight = (rows[inside] - time[before]) / span
    between = (1.0 - weight) * value[before] + weight * value[before + 1]
    filled[inside] = np.where(span <= ADJACENT * step, between, filled[inside])
    return filled
