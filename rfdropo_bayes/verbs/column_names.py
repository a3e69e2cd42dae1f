"""What the columns of a recording are, guessed from their names and sizes, for a first experiment file to look over."""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from rfdropo_bayes.data import lerobot, motive_csv, named_columns, rosbag
from rfdropo_bayes.data.csv_table import CsvTable
from rfdropo_bayes.data.mapped_formats import recognised_format
from rfdropo_bayes.data.sample_times import pace
from rfdropo_bayes.data.streams import side_by_side
from rfdropo_bayes.errors import InputError

TIME = re.compile(
    r"^\W*(t|ts|time|timestamp|stamp|date|datetime|secs?|seconds|millis|micros|nanos|clock)(?![a-z])", re.IGNORECASE
)
AXIS = re.compile(r"(?<![a-z])[xyz](?![a-z])", re.IGNORECASE)
FORCE = re.compile(r"force|tension|load|(?<![a-z])[fn]\d", re.IGNORECASE)
MEASURED = re.compile(
    r"meas|actual|encoder|enc(?![a-z])|feedback|(?<![a-z])fb|joint_?states?|observation", re.IGNORECASE
)
SENT = re.compile(r"cmd|command|action|setpoint", re.IGNORECASE)
"""Where any columns are called so, they alone are commands."""
COMMAND = re.compile(
    r"cmd|command|motor|servo|pull|cable|tendon|action|target|ref|theta|angle|(?<![a-z])[aucqm]_?\d", re.IGNORECASE
)
ANGLE = re.compile(r"motor|servo|joint|theta|angle|(?<![a-z])q_?\d", re.IGNORECASE)
NO_PLACE = re.compile(r"orient|quat|rotat|euler|angular|twist|veloc|accel|gyro|magnet|wrench|torque|force", re.I)
"""Columns in x, y and z that are no positions."""
RATE = re.compile(r"veloc|effort|accel", re.IGNORECASE)
BODY = re.compile(r"^Rigid Body\.|\.rigidbodies\[[^]]*\]\.pose", re.IGNORECASE)
"""Solved poses of bodies: where there are any, the markers that they were solved from are not used as well."""
MARKER = re.compile(r"^Marker\.(?!Unlabeled)", re.IGNORECASE)
"""Markers that Motive measured and somebody named."""
STRUCTURE = re.compile(
    r"(rigid|body|bodies|rigidbodies|markers?|position|poses?|point|transforms?|translation|tf|static|mocap|vrpn|"
    r"optitrack|vicon|qualisys|natnet|observation|state)"
)
"""Words that formats put around the name of a marker."""
WORD = re.compile(r"[a-z0-9]+")
UNITS = {unit: unit for unit in ("mm", "cm", "m", "deg", "rad")} | dict.fromkeys(
    ("count", "counts", "cnt", "cnts", "tick", "ticks", "pulse", "pulses", "steps", "qc"), named_columns.COUNTS
)
"""Words in the name of a column, and the unit they tell."""
ANGLES = ("rad", "deg", named_columns.COUNTS)
TIME_UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("ms", "msec", "millis", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "usec", "micros", "microseconds", "µs", "μs"), "us"),
    **dict.fromkeys(("ns", "nsec", "nanos", "nanoseconds"), "ns"),
}
"""Words in the name of a column of times, and the unit they tell."""
SHORTEST = {"ns": 0.9e6, "us": 0.9e3, "ms": 0.9}
"""A millisecond, the shortest time between rows, in each unit, a tenth off for jitter: rows come more often than once
in a second, so that a figure which is a second in one unit is a millisecond in the next."""
LOOKED_AT = 2000
"""Rows that sizes are taken from."""
MILLIMETRES_ABOVE, DEGREES_ABOVE = 5.0, 20.0
"""A soft arm moves by less than so many metres, and its drives turn by less than so many radians."""


class Guess(NamedTuple):
    """Columns of a file, by their part.

    Attributes:
        time, time_unit: column and unit of times, "s" where they are dates; None without one.
        commands, command_unit: columns and unit of the commands.
        positions, position_unit: columns of x, y and z of each marker, and their unit.
        markers: a name for each marker, made of its columns'; numbered where they tell none.
        tensions, motor_angles: columns of measured forces and angles, as many as commands; else empty.
        motor_angle_unit: of the latter.
        counts_per_turn: of the spool, where a unit is "counts".
        left: columns that are nothing of these.
        format: of the file, one of `mapped_formats.MAPPED`.
        command_time, command_time_unit: column and unit of the commands' own times; None without one.
    """

    time: str | None
    time_unit: str
    commands: list[str]
    command_unit: str
    positions: list[list[str]]
    position_unit: str
    markers: list[str]
    tensions: list[str]
    motor_angles: list[str]
    left: list[str]
    format: str = named_columns.FORMAT
    command_time: str | None = None
    command_time_unit: str = "s"
    motor_angle_unit: str = "rad"
    counts_per_turn: float | None = None

    @property
    def counts(self) -> bool:
        """Whether a unit is one of counts."""
        return named_columns.COUNTS in (self.command_unit, self.motor_angle_unit if self.motor_angles else "")


def guess_columns(path: Path, sent: Path | None = None) -> Guess:
    """Guess what the columns of a recording are.

    Args:
        path: a CSV, an export of Motive's, a bag or a LeRobotDataset.
        sent: a CSV with the commands, where they have a file of their own.

    Raises:
        InputError: a file that cannot be read, or in which no positions or commands are found.
    """
    format = recognised_format(path)
    whole, unit = _measured(format, path)
    table = whole.numeric().head(LOOKED_AT)
    names = [str(name) for name in table.columns]
    time = "header" if format == rosbag.FORMAT else _clock_of(whole)
    triples = _markers(_triples([name for name in names if name != time]))
    positions = list(triples.values())
    rest = [name for name in names if name != time and not any(name in triple for triple in positions)]
    tensions = [name for name in rest if FORCE.search(name)]
    angles = [name for name in rest if MEASURED.search(name) and name not in tensions]
    source, sending, clock, free = table, whole, None, [name for name in rest if name not in (*tensions, *angles)]
    if sent is not None:
        sending = CsvTable(sent, (), machine_written=False)
        source, clock = sending.numeric().head(LOOKED_AT), _clock_of(sending)
        commands = _commands([str(name) for name in source.columns if name != clock], any_name=True)
    else:
        commands = _commands(free, any_name=format == named_columns.FORMAT)
    for what, found in (("positions (columns in x, y and z)", positions), ("commands", commands)):
        if not found:
            raise InputError(
                f"found no {what} among the columns {', '.join(names)}",
                where=str(path),
                remedy="give the CSV of the commands with --commands"
                if format == motive_csv.FORMAT and positions
                else "leave the recording out, and write [data.columns] as docs/reference/experiment.md says",
            )
    unit_sent = _command_unit(source, commands)
    angles = angles if len(angles) == len(commands) else []
    unit_measured = (_written_unit(angles, ANGLES) or _angle_unit(table, angles)) if angles else "rad"
    if unit_measured == named_columns.COUNTS and unit_sent not in ANGLES:
        angles, unit_measured = [], "rad"  # nothing would use them, and their size is not known
    return Guess(
        time,
        "s" if format == rosbag.FORMAT else _time_unit(whole, time),
        commands,
        unit_sent,
        positions,
        unit or _written_unit(names_of(positions), named_columns.METRES) or _length_unit(table[names_of(positions)]),
        _marker_names(list(triples), None if format == named_columns.FORMAT else STRUCTURE),
        tensions if len(tensions) == len(commands) else [],
        angles,
        [name for name in free if name not in commands],
        format,
        clock,
        _time_unit(sending, clock),
        unit_measured,
    )


def lost_positions(recordings: list[Path], guess: Guess) -> dict[str, int]:
    """Recordings, by name, in which cells of positions are empty, and how many; of plain CSV alone."""
    if guess.format != named_columns.FORMAT:
        return {}
    counts = {}
    for path in recordings:
        frame = CsvTable(path, (), machine_written=False).frame
        known = [name for name in names_of(guess.positions) if name in frame]
        counts[path.name] = int(frame[known].isna().to_numpy().sum())
    return {name: count for name, count in counts.items() if count}


def _measured(format: str, path: Path) -> tuple[CsvTable, str | None]:
    """The table of a recording, and the unit of lengths where the file tells it."""
    if format == rosbag.FORMAT:
        return CsvTable.of_frame(side_by_side(rosbag.read_streams(path)), str(path), ()), "m"
    if format == lerobot.FORMAT:
        frame = lerobot.read_episode(path, lerobot.episode_numbers(path)[0])
        return CsvTable.of_frame(frame, str(path), ()), None
    if format == motive_csv.FORMAT:
        file = motive_csv.read_motive(path)
        return file.table, file.length_unit
    return CsvTable(path, (), machine_written=False), None


def _clock_of(table: CsvTable) -> str | None:
    """The first column that is called a time and holds times; else the first in a unit of time that always rises."""
    names = [str(name) for name in table.frame.columns]
    called = next((name for name in names if TIME.search(name) and _holds_times(table, name)), None)
    return called or next((name for name in names if _told_time_units(name) and _rises(table, name)), None)


def _markers(triples: dict[str, list[str]]) -> dict[str, list[str]]:
    """Those of the columns in x, y and z that are places of markers."""
    places = {common: names for common, names in triples.items() if not NO_PLACE.search(common)}
    for chosen in (BODY, MARKER):
        found = {common: names for common, names in places.items() if chosen.search(common)}
        if found:
            return found
    return places


def _commands(names: list[str], *, any_name: bool) -> list[str]:
    """Those of the columns that are commands; where none is called so, all of them in files of one's own."""
    return (
        [name for name in names if SENT.search(name) and not RATE.search(name)]
        or [name for name in names if COMMAND.search(name)]
        or (names if any_name else [])
    )


def names_of(positions: list[list[str]]) -> list[str]:
    """The columns of all markers."""
    return [name for triple in positions for name in triple]


def _triples(names: list[str]) -> dict[str, list[str]]:
    """Columns that differ in one letter, x, y or z: what they have in common, and the three in this order."""
    found: dict[str, dict[str, str]] = {}
    for name in names:
        for match in AXIS.finditer(name):
            common = f"{name[: match.start()]}*{name[match.end() :]}".lower()
            found.setdefault(common, {})[match[0].lower()] = name
    return {common: [axes[a] for a in "xyz"] for common, axes in found.items() if set(axes) == set("xyz")}


def _marker_names(commons: list[str], structure: re.Pattern[str] | None) -> list[str]:
    """Names that robot files allow, made of what the columns of each marker have in common, without some words."""
    names = []
    for number, common in enumerate(commons, start=1):
        words = [word for word in WORD.findall(common) if word not in UNITS]
        name = "_".join(word for word in words if structure is None or not structure.fullmatch(word))
        names.append(name if re.match(r"[a-z]", name) else f"m{name or number}")
    return names if len(set(names)) == len(names) else [f"m{k}" for k in range(1, len(names) + 1)]


def _written_unit(names: list[str], known: Collection[str] = frozenset(UNITS.values())) -> str | None:
    """The unit, one of ``known``, that all of some columns carry in their names, such as ``x1_mm`` or ``tip x [m]``."""
    told = [{UNITS[word] for word in WORD.findall(name.lower()) if UNITS.get(word) in known} for name in names]
    return told[0].pop() if told and all(len(each) == 1 and each == told[0] for each in told) else None


def _length_unit(table: pd.DataFrame) -> str:
    return "mm" if float(np.nanmax(np.abs(table.to_numpy()))) > MILLIMETRES_ABOVE else "m"


def _holds_times(table: CsvTable, name: str) -> bool:
    try:
        ticks = table.stamps(name, "s").ticks
    except InputError:
        return False
    return bool(len(ticks) == 1 or ticks[-1] != ticks[0])  # a date of the day alone is none


def _rises(table: CsvTable, name: str) -> bool:
    """Whether a column grows from every row to the next."""
    numbers = table.numeric()
    return len(numbers) > 1 and name in numbers and bool((numbers[name].diff().iloc[1:] > 0.0).all())


def _told_time_units(name: str) -> set[str]:
    """Units of time that words in a column's name tell."""
    return {TIME_UNITS[word] for word in re.findall(r"[^\W_]+", name.lower()) if word in TIME_UNITS}


def _time_unit(table: CsvTable, time: str | None) -> str:
    """The unit that the name of a column tells, or else the time from row to row."""
    if time is None or len(table) < 2:
        return "s"
    stamps = table.stamps(time, "s")
    told = _told_time_units(time)
    if stamps.dated or len(told) == 1:
        return "s" if stamps.dated else told.pop()
    interval = pace(stamps.since(stamps, str(table.path)))
    return next((unit for unit, shortest in SHORTEST.items() if interval >= shortest), "s")


def _command_unit(table: pd.DataFrame, commands: list[str]) -> str:
    written = _written_unit(commands)
    if written or not commands:
        return written or "mm"
    largest = float(np.nanmax(np.abs(table[commands].to_numpy())))
    if all(ANGLE.search(name) for name in commands):
        return _angle_unit(table, commands)
    return "mm" if largest > 0.2 else "m"


def _angle_unit(table: pd.DataFrame, names: list[str]) -> str:
    """The unit of angles by their size."""
    return "deg" if float(np.nanmax(np.abs(table[names].to_numpy()))) > DEGREES_ABOVE else "rad"
