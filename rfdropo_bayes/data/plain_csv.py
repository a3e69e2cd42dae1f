"""Any CSV, plain or gzipped, through a mapping of its columns (`named_columns`): for any robot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.data.commands_alone import commands_alone
from rfdropo_bayes.data.csv_table import CsvTable
from rfdropo_bayes.data.named_columns import (
    CsvColumns,
    command_clock,
    coordinates,
    marker_names,
    origin_of,
    points,
    read_commands,
)
from rfdropo_bayes.data.sample_times import PER_SECOND
from rfdropo_bayes.data.trajectory import Trajectory


def csv_table(path: Path, columns: CsvColumns) -> CsvTable:
    """The file of the observations."""
    return CsvTable(path, coordinates(columns), names=columns.names, machine_written=False)


def command_table(path: Path | None, columns: CsvColumns) -> CsvTable | None:
    """The file of the commands, if it is separate."""
    if path is None:
        return None
    return CsvTable(path, columns.commands, names=columns.command_names, machine_written=False)


def read_csv_start(path: Path, columns: CsvColumns, start: CsvTable | None) -> Trajectory:
    """Commands with the start pose at most, from the first row of the observations ``start``; see `commands_alone`.

    Raises:
        InputError: the file is damaged, or lacks a column.
    """
    table = _commands_alone(path, columns)
    return commands_alone(
        origin_of(table, columns),
        read_commands(table, columns),
        marker_names(columns),
        start=None if start is None else points(start, columns, mask_missing=True),
        poses=columns.commands_with_poses,
    )


def command_columns(
    columns: CsvColumns, time: Float[np.ndarray, " rows"], command: Float[np.ndarray, "rows cable"]
) -> dict[str, Float[np.ndarray, " rows"]]:
    """Times [s] and commands [m or rad] as the columns of a file that this table describes."""
    clock, unit = command_clock(columns)
    stamped = {} if clock is None else {clock: time * PER_SECOND[unit]}
    sizes = columns.sized(columns.command_unit)[1] * columns.factors(columns.commands)
    return stamped | dict(zip(columns.commands, (command / sizes).T, strict=True))


def _commands_alone(path: Path, columns: CsvColumns) -> CsvTable:
    """A file of commands to predict from, with the columns of either file of a recording."""
    return CsvTable(path, columns.commands, names=columns.command_names or columns.names, machine_written=False)


def holds_commands_alone(path: Path, columns: CsvColumns) -> bool:
    """Whether a file holds commands with their times, and no positions."""
    table = _commands_alone(path, columns)
    clock, _ = command_clock(columns)
    timed = clock is None or clock in table
    return timed and not any(name in table for point in columns.positions for name in point)
