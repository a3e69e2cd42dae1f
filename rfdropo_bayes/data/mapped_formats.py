"""Formats whose columns may be anything, described by the table [data.columns]; and the kind of a file."""

from __future__ import annotations

import gzip
import zlib
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from rfdropo_bayes.data import lerobot, motive_csv, named_arrays, named_columns, rosbag
from rfdropo_bayes.data.csv_table import MOTIVE, CsvTable
from rfdropo_bayes.data.named_columns import CsvColumns, command_clock, coordinates, read_tables
from rfdropo_bayes.data.plain_csv import command_table, csv_table
from rfdropo_bayes.data.recorded import Origin
from rfdropo_bayes.data.trajectory import Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.tables import changed

MAPPED = (named_columns.FORMAT, motive_csv.FORMAT, rosbag.FORMAT, lerobot.FORMAT, *named_arrays.FORMATS)
FOLDERS = (rosbag.FORMAT, lerobot.FORMAT)  # formats in which a recording, or several, may be a folder
_MAGIC = {b"#ROSBAG": rosbag.FORMAT, b"\x89MCAP0": rosbag.FORMAT, b"SQLite format 3\x00": rosbag.FORMAT}


class Observed(NamedTuple):
    """A table of observations, and its columns, completed with facts from the file."""

    table: CsvTable
    columns: CsvColumns


def recognised_format(path: Path) -> str:
    """Which of `MAPPED` a file or folder is, by its content; "csv" for a file that is none of the others.

    Raises:
        InputError: the folder is neither a bag nor a LeRobotDataset, or the path does not exist.
    """
    if path.is_dir():
        if (path / lerobot.INFO).is_file():
            return lerobot.FORMAT
        if (path / rosbag.METADATA).is_file() or any(file.suffix in rosbag.STORAGE for file in path.iterdir()):
            return rosbag.FORMAT
        raise InputError(
            "is a folder, but neither a ROS 2 bag nor a LeRobotDataset",
            where=str(path),
            remedy=f'name its files, e.g. "{path.name}/*.csv"',
        )
    try:
        with path.open("rb") as file:
            first = file.read(64)
        if first.startswith(b"\x1f\x8b"):
            with gzip.open(path) as inner, suppress(EOFError, gzip.BadGzipFile, zlib.error):  # said when it is read
                first = inner.read(64)
    except OSError as error:
        remedy = "correct the path"
        raise InputError(f"cannot be read ({error.strerror})", where=str(path), remedy=remedy) from None
    for magic, format in _MAGIC.items():
        if first.startswith(magic):
            return format
    arrays = named_arrays.array_format(path, first)
    if arrays is not None:
        return arrays
    return (
        motive_csv.FORMAT if first.removeprefix(b"\xef\xbb\xbf").startswith(MOTIVE.encode()) else named_columns.FORMAT
    )


def observed_table(format: str, path: Path, columns: CsvColumns, episode: int | None = None) -> Observed:
    """The observations of a recording in one of the formats `MAPPED`.

    Raises:
        InputError: the file has another format, is damaged, or lacks a column.
    """
    recognised = recognised_format(path)
    if recognised != format:
        raise InputError(
            f"is of the format {recognised!r}, not {format!r}", where=str(path), remedy=f'use "{recognised}"'
        )
    places = coordinates(columns)
    if format == rosbag.FORMAT:
        return Observed(rosbag.read_observations(path, columns), _in_seconds(columns, path))
    if format == lerobot.FORMAT:
        number = lerobot.episode_numbers(path)[0] if episode is None else episode
        frame = lerobot.read_episode(path, number)
        return Observed(CsvTable.of_frame(frame, f"{path}, episode {number}", places), columns)
    if format in named_arrays.FORMATS:
        return Observed(CsvTable.of_frame(named_arrays.read_arrays(path), str(path), places), columns)
    if format == motive_csv.FORMAT:
        file = motive_csv.read_motive(path)
        file.table.require(places)
        unit = file.length_unit or columns.position_unit
        return Observed(file.table, changed(_in_seconds(columns, path), where=str(path), position_unit=unit))
    return Observed(csv_table(path, columns), columns)


def _in_seconds(columns: CsvColumns, path: Path) -> CsvColumns:
    """Units of times for a format with times in seconds; commands in a CSV keep the CSV's unit."""
    unit = command_clock(columns)[1]
    return changed(columns, where=str(path), time_unit="s", command_time_unit=unit)


def read_mapped(
    format: str,
    path: Path,
    columns: CsvColumns,
    commands: Path | None = None,
    episode: int | None = None,
    *,
    mask_missing: bool = False,
) -> Trajectory:
    """One recording.

    Args:
        format: one of `MAPPED`.
        path: file or folder with the observations, and the commands unless they have their own file.
        columns: mapping of the columns.
        commands: a CSV of the commands.
        episode: number of the episode in a LeRobotDataset.
        mask_missing: mask lost marker positions instead of rejecting the file.

    Raises:
        InputError: a file is damaged or lacks a column, or the files do not match.
    """
    table, columns = observed_table(format, path, columns, episode)
    source = command_table(commands, columns)
    name = path.name.removesuffix(".gz")
    if format == rosbag.FORMAT and source is None:
        source, clock = rosbag.read_commands(path, columns), rosbag.clock_of(columns)
        columns = changed(columns, where=str(path), command_time=clock, command_time_unit="s")
        if columns.time is None:  # rows are numbered from 0, and so are the times of commands
            source.frame[clock] -= table.frame[clock].iloc[0]
    if format == motive_csv.FORMAT and source is None:
        raise InputError(
            "has no commands: Motive records none",
            where=str(path),
            remedy="give {observations = ..., commands = ...}, the latter a CSV with its own times (command_time)",
        )
    for ending in (".csv", ".mat", ".npz", *rosbag.STORAGE):
        name = name.removesuffix(ending)
    recorded = read_tables(
        table,
        source or table,
        columns,
        mask_missing=mask_missing,
        origin=Origin(name if episode is None else f"{name}_{episode}", columns.robot, format, provenance=path.name),
    )
    return Trajectory.build(*recorded)
