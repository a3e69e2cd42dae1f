"""Guess of a recording's columns from their names and sizes, for a first experiment file."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from string import punctuation
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from rfdropo_bayes.data import lerobot, motive_csv, named_arrays, named_columns, rosbag
from rfdropo_bayes.data.csv_layout import is_value
from rfdropo_bayes.data.csv_table import CsvTable
from rfdropo_bayes.data.mapped_formats import recognised_format
from rfdropo_bayes.data.streams import side_by_side
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.verbs.column_units import (
    ANGLES,
    FORCE,
    FOREIGN,
    PRESSURE,
    UNITS,
    WORD,
    Unit,
    angle_unit,
    command_time_unit,
    command_unit,
    length_unit,
    time_unit,
    time_units_in_names,
    unit_in_names,
)

TIME = re.compile(
    r"(?<![a-z])(t(?![ _\[]?\d)|ts|times?|timestamps?|stamp|date|datetime|secs?|seconds|millis|micros|nanos|clock|"
    r"zeit|tiempo|tempo|时间|時間)(?![a-z])",
    re.IGNORECASE,
)
"""Names of times. Columns t1, t2, ... are anything but times."""
AXIS = re.compile(r"(?:(?<![a-z])|(?<=[^a-z]p)|(?<=^p))[xyz](?![a-z])", re.IGNORECASE)  # as in x1, tip_x and tip_px
MEASURED = re.compile(
    r"meas(ured)?|actual|present|encoder|enc(?![a-z])|feedback|(?<![a-z])fb|joint_?states?|observation", re.IGNORECASE
)
AIMED = re.compile(r"goal|target|desired|(?<![a-z])(ref|reference|set)(?![a-z])", re.IGNORECASE)
"""What a controller aims at: a command of its drives, or in x, y and z a place that the robot should reach."""
SENT = re.compile(rf"cmd|command|action|setpoint|{AIMED.pattern}", re.IGNORECASE)
COMMAND = re.compile(
    rf"{SENT.pattern}|motor|servo|pull|cable|tendon|ref|theta|angle|(?<![a-z])[aucqm](_?\d|\[|$)", re.IGNORECASE
)
NO_COMMAND = re.compile(
    r"(?<![a-z])(ids?|idx|index|frames?|seq|rows?|numbers?|nr|trial|episode|run|phase|pattern|label|flags?|status|mode|"
    r"roll|pitch|yaw|r[xyz]|q[xyzw]|quat\w*|euler|rot|orientation)(?![a-z])",
    re.IGNORECASE,
)
"""Columns that count or name rows, or hold an orientation."""
BESIDE = re.compile(r"current|temp|volt|power|torque|battery|error", re.IGNORECASE)
"""Readings of a motor beside its command; commands if there is nothing else."""
NO_PLACE = re.compile(
    r"orient|quat|rotat|euler|angular|twist|veloc|accel|gyro|magnet|wrench|torque|force|"
    r"(?<![a-z])(rot|rpy|vel|acc|imu|omega|tau|mag)(?![a-z])",
    re.IGNORECASE,
)
"""Columns in x, y and z that are no positions."""
DERIVED = re.compile(r"(?<![a-z])[fvwq][_. ]?\*|\*'", re.IGNORECASE)
"""The same under a single letter, or with X' and X'', if there are positions beside them: forces, velocities, ..."""
RATE = re.compile(r"veloc|effort|accel", re.IGNORECASE)
BODY = re.compile(r"^Rigid Body\.|\.rigidbodies\[[^]]*\]\.pose", re.IGNORECASE)
"""Solved poses of bodies: if there are any, the underlying markers are not used."""
MARKER = re.compile(r"^Marker\.(?!Unlabeled)", re.IGNORECASE)  # markers that Motive measured and somebody named
STRUCTURE = re.compile(
    r"(rigid|body|bodies|rigidbodies|markers?|position|poses?|point|transforms?|translation|tf|static|mocap|vrpn|"
    r"optitrack|vicon|qualisys|natnet|observation|state)"
)
"""Words that formats put around the name of a marker."""
LOOKED_AT = 2000  # rows that sizes are taken from
MOST_SHOWN = 12  # columns that an error names; and rows from which a pattern of values is told
EVEN = "no column is called a time, and this one alone rises evenly from row to row"
MOSTLY, UNEVEN = 0.9, 0.5  # share of the steps of a clock that go on, and by how much of the usual step they may differ
UNIT_LENGTH = 1e-3  # by how much the length of a quaternion may differ from one


class Guess(NamedTuple):
    """Columns of a file, by their part."""

    # time, time_unit: column and unit of times, "s" for dates; None without times
    time: str | None
    time_unit: str
    # commands, command_unit: columns and unit of the commands
    commands: list[str]
    command_unit: str
    # positions, position_unit: columns of x, y and z of each marker, and their unit
    positions: list[list[str]]
    position_unit: str
    markers: list[str]  # a name for each marker, made of its columns'; numbered if the columns have no names
    # tensions, motor_angles: columns of measured forces and angles, one per command; else empty
    tensions: list[str]
    motor_angles: list[str]
    motor_angle_unit: str  # unit of motor angles
    unused: list[str]  # other columns
    format: str  # format of the file, one of `mapped_formats.MAPPED`
    # command_time, command_time_unit: column and unit of the commands' own times; None without them
    command_time: str | None
    command_time_unit: str
    units: Mapping[str, str]  # units of columns other than command_unit or position_unit
    # names, command_names: given names of all columns, for files without names
    names: list[str] | None
    command_names: list[str] | None
    # why a unit was guessed, by its key in [data.columns]; no entry for a unit stated in the file
    evidence: Mapping[str, str]
    start: Float[np.ndarray, "marker 3"]  # first seen position of each marker, in the file's frame and unit
    sent: Float[np.ndarray, "command channel"]  # commands of the first rows
    seen: Float[np.ndarray, "row marker 3"]  # marker positions in the first rows, both in the file's units
    counts_per_turn: float | None = None  # counts per turn of the spool, if a unit is "counts"
    sample_time: float | None = None  # time from row to row [s], given or of the file's rate; None if rows have times
    unwrap: Mapping[str, float] = {}  # turn of each counter that begins anew in the first rows, by its column

    @property
    def reads_drives(self) -> bool:
        """Whether the commands are readings of the drives, which were taken with the poses."""
        return all(MEASURED.search(name) and not SENT.search(name) for name in self.commands)

    @property
    def counts(self) -> bool:
        """Whether a unit is a unit of counts."""
        return named_columns.COUNTS in (self.command_unit, self.motor_angle_unit if self.motor_angles else "")


def guess_columns(
    path: Path,
    sent: Path | None = None,
    names: Sequence[str] | None = None,
    command_names: Sequence[str] | None = None,
    unit: str | None = None,
) -> Guess:
    """Guess the meaning of a recording's columns.

    Args:
        path: a CSV, an export of Motive's, a bag, a LeRobotDataset, or a file of arrays.
        sent: a CSV with the commands, if separate.
        names: column names of a CSV without names; command_names: the same for the commands' file.
        unit: unit of the commands, if stated: of measured forces and angles, the forces are commands in N.

    Raises:
        InputError: a file that cannot be read, that has names and is given others, or in which no positions or
            commands are found.
    """
    format = recognised_format(path)
    own = format == named_columns.FORMAT or format in named_arrays.FORMATS
    whole, length = _measured(format, path, names)
    _check_names(whole, names, "--names")
    table = whole.numeric(LOOKED_AT)
    time = "header" if format == rosbag.FORMAT else _clock_of(whole)
    sample_time = None if time or whole.rate is None else 1.0 / whole.rate
    even = _even_clock(table) if time is None and sample_time is None and own else None
    time = time or even
    columns = [str(name) for name in table.columns if name not in (time, *whole.joined.get(str(time), ()))]
    triples, tensions, angles, free = _parts(columns, format)
    positions = list(triples.values())
    source, sending, clock = table, whole, None
    if sent is not None:
        sending = CsvTable(sent, (), names=command_names, machine_written=False)
        _check_names(sending, command_names, "--command-names")
        source, clock = sending.numeric(LOOKED_AT), _clock_of(sending)
        free = [str(name) for name in source.columns if name not in (clock, *sending.joined.get(str(clock), ()))]
    readings = (tensions, angles) if unit == "N" else (angles, tensions)
    measured = [] if sent is not None else next(filter(None, readings), [])
    commands = _commands(source, free, measured, any_name=own or sent is not None)
    if not positions:
        raise _not_found(whole, time, format, "positions (columns in x, y and z)")
    if not commands:
        raise _not_found(sending, time if sent is None else clock, format, "commands")
    tensions, angles = ([] if commands == measured else other for other in (tensions, angles))
    tensions = tensions if len(tensions) == len(commands) else []
    units = {
        "command_unit": command_unit(sending, source, commands),
        "position_unit": (Unit(length) if length else unit_in_names(whole, names_of(positions), named_columns.METRES))
        or length_unit(table[names_of(positions)]),
        "time_unit": Unit("s")
        if format == rosbag.FORMAT
        else time_unit(whole, time, table[names_of(positions)].to_numpy()),
    }
    units["command_time_unit"] = command_time_unit(sending, clock, _seconds(whole, time, units["time_unit"].unit))
    angles, units["motor_angle_unit"] = _measured_angles(
        whole, table, angles if len(angles) == len(commands) else [], commands, units["command_unit"].unit
    )
    used = {*commands, *names_of(positions), *tensions, *angles}
    return Guess(
        time=time,
        commands=commands,
        positions=positions,
        markers=_marker_names(list(triples), None if own else STRUCTURE),
        tensions=tensions,
        motor_angles=angles,
        unused=[name for name in columns if name not in used]
        + [f"all of the block {title}" for title in whole.left_out],
        format=format,
        command_time=clock,
        units={**units["command_unit"].others, **units["position_unit"].others},
        names=None if names is None else list(names),
        command_names=None if command_names is None else list(command_names),
        evidence=({"time": EVEN} if even else {})
        | ({"sample_time": f"the file says {whole.rate:g} Hz"} if sample_time else {})
        | {key: unit.evidence for key, unit in units.items() if unit.evidence},
        start=table[names_of(positions)].bfill().iloc[0].to_numpy(dtype=float).reshape(-1, 3),
        sent=source[commands].ffill().to_numpy(dtype=float),
        seen=table[names_of(positions)].to_numpy(dtype=float).reshape(len(table), -1, 3),
        time_unit=units["time_unit"].unit,
        command_unit=units["command_unit"].unit,
        position_unit=units["position_unit"].unit,
        command_time_unit=units["command_time_unit"].unit,
        motor_angle_unit=units["motor_angle_unit"].unit,
        sample_time=sample_time,
    )


def _parts(columns: list[str], format: str) -> tuple[dict[str, list[str]], list[str], list[str], list[str]]:
    """Columns in x, y and z of each marker, of forces, of measured angles, and possible commands."""
    places = _array_triples(columns) if format in named_arrays.FORMATS else _triples(columns)
    placed = names_of(list(places.values()))
    rest = [
        name
        for name in columns
        if (SENT.search(name) or name not in placed) and not (AIMED.search(name) and AXIS.search(_parted(name)))
    ]
    tensions = [name for name in rest if FORCE.search(name)]
    read = [name for name in rest if MEASURED.search(name) and not SENT.search(name) and name not in tensions]
    angles = [name for name in read if not (BESIDE.search(name) or RATE.search(name))]
    return _markers(places), tensions, angles, [name for name in rest if name not in (*tensions, *read)]


def _check_names(table: CsvTable, given: Sequence[str] | None, option: str) -> None:
    own = [str(name) for name in table.frame.columns]
    if given is not None and own != list(given):
        raise InputError(
            f"has names of its columns: {_shown(own)}",
            where=str(table.path),
            remedy=f"leave {option} out, or write the new names into the file",
        )


def _shown(names: list[str]) -> str:
    return ", ".join(names[:MOST_SHOWN]) + (", ..." if len(names) > MOST_SHOWN else "")


def _not_found(table: CsvTable, time: str | None, format: str, what: str) -> InputError:
    """The error of a file without positions or commands: its columns, and the first that is none for its text."""
    columns = [str(name) for name in table.numeric(LOOKED_AT).columns]
    words = f"found no {what} among the columns {_shown(columns)}" if columns else f"found no {what}"
    for name in table.frame.columns.difference([*columns, time], sort=False)[:1]:
        try:
            table.numbers([name], allow_missing=True)
        except InputError as error:
            words += f"; text was left out, the first in {error.where.removeprefix(f'{table.path}, ')}: {error.what}"
    remedy = "call x, y and z of each marker tip_x, tip_y, tip_z, and commands motor1, motor2, ..."
    if format == motive_csv.FORMAT and what == "commands":
        remedy = "give the CSV of the commands with --commands"
    elif format in (rosbag.FORMAT, lerobot.FORMAT):
        remedy = "write [data.columns] by hand, as docs/reference/experiment.md says"
    return InputError(words, where=str(table.path), remedy=remedy)


def _measured_angles(
    whole: CsvTable, table: pd.DataFrame, angles: list[str], commands: list[str], sent: str
) -> tuple[list[str], Unit]:
    """Columns of measured angles that are of use beside ``commands`` in the unit ``sent``, and their unit.

    Without a unit of their own, readings that are called as the commands are in the unit of the commands.
    """
    unit = unit_in_names(whole, angles, ANGLES)
    if unit is None and angles:
        same = [_stem(name) for name in angles] == [_stem(name) for name in commands]
        unit = Unit(sent, evidence=f"{angles[0]} is called as {commands[0]}") if same else angle_unit(table, angles)
    useful = () if unit is None or unit.others else ANGLES if sent in ANGLES else ("deg", "rad")
    if unit is None or unit.unit not in useful:
        return [], Unit("rad")  # nothing would use them, or their size is not known
    return angles, unit


def suggested_names(rows: Sequence[Sequence[str]], commands: int | None, markers: Sequence[str]) -> list[str] | None:
    """Names for the columns of a file without names: times, commands, and x, y and z of each marker; or those of a pose
    that ``ros2 topic echo --csv`` wrote.

    None if the number of columns does not match.

    Args:
        rows: cells of the table's first rows.
        commands: number of commands, if known.
        markers: their names.
    """
    width, places = len(rows[0]), [f"{marker}_{axis}" for marker in markers for axis in "xyz"]
    frames = ["frame_id", "child_frame_id"][: sum(not is_value(cell) for cell in rows[0][2:])]
    echoed = ["sec", "nanosec", *frames, *places, "qx", "qy", "qz", "qw"]
    if frames and len(markers) == 1 and width == len(echoed) and all(cell.isdigit() for cell in rows[0][:2]):
        return echoed
    rest = width - len(places)
    stamps = pd.to_numeric(pd.Series([row[0] for row in rows]), errors="coerce")
    clock = rest > 1 and (bool(stamps.diff().iloc[1] > 0.0) or (stamps.isna().all() and is_value(rows[0][0])))
    clock = clock if commands is None else rest == commands + 1
    if not places or rest < 1 + clock or (commands is not None and rest != commands + clock):
        return None
    return [*(["t"] if clock else []), *(f"c{k + 1}" for k in range(rest - clock)), *places]


def lost_positions(recordings: list[Path], guess: Guess) -> dict[str, int]:
    """Recordings with empty cells of positions, and their number, by name; of plain CSV alone."""
    if guess.format != named_columns.FORMAT:
        return {}
    counts = {}
    for path in recordings:
        frame = CsvTable(path, (), names=guess.names, machine_written=False).frame
        known = [name for name in names_of(guess.positions) if name in frame]
        counts[path.name] = int(frame[known].isna().to_numpy().sum())
    return {name: count for name, count in counts.items() if count}


def _measured(format: str, path: Path, names: Sequence[str] | None) -> tuple[CsvTable, str | None]:
    """The table of a recording, and the unit of lengths if the file states it."""
    if format == rosbag.FORMAT:
        return CsvTable.of_frame(side_by_side(rosbag.read_streams(path)), str(path), ()), "m"
    if format == lerobot.FORMAT:
        frame = lerobot.read_episode(path, lerobot.episode_numbers(path)[0])
        return CsvTable.of_frame(frame, str(path), ()), None
    if format == motive_csv.FORMAT:
        file = motive_csv.read_motive(path)
        return file.table, file.length_unit
    if format in named_arrays.FORMATS:
        return CsvTable.of_frame(named_arrays.read_arrays(path), str(path), ()), None
    return CsvTable(path, (), names=names, machine_written=False), None


def _clock_of(table: CsvTable) -> str | None:
    """The first column whose name begins with a word for a time and that holds times; else the first with such a word
    or a unit of time in its name that rises: times that something took rise and fall."""
    joined = {name: parts for name, parts in table.joined.items() if _rises(table, name)}
    parts = {part for two in joined.values() for part in two}
    names = [*(str(name) for name in table.frame.columns if name not in parts), *joined]
    called = {name: _parted(name) for name in names if TIME.search(_parted(name))}
    first = (
        name for name, words in called.items() if TIME.match(words.lstrip(punctuation)) and _holds_times(table, name)
    )
    rising = (name for name in names if (name in called or time_units_in_names(table, name)) and _rises(table, name))
    return next(first, None) or next(rising, None)


def _even_clock(table: pd.DataFrame) -> str | None:
    """The only column that rises evenly, if its name does not say that it is anything else."""
    found = [str(name) for name in table.columns if not _told(str(name)) and _rises_evenly(table[name])]
    return found[0] if len(found) == 1 else None


def _told(name: str) -> bool:
    """Whether a name or the unit in it says that a column is something else than a time."""
    words = _parted(name)
    parts = (COMMAND, MEASURED, FORCE, BESIDE, NO_COMMAND, PRESSURE, AXIS, *FOREIGN.values())
    return any(part.search(words) for part in parts) or not UNITS.keys().isdisjoint(WORD.findall(words.lower()))


def _markers(triples: dict[str, list[str]]) -> dict[str, list[str]]:
    """The triples of columns in x, y and z that are marker positions."""
    places = {
        common: names for common, names in triples.items() if not (NO_PLACE.search(common) or SENT.search(common))
    }
    for chosen in (BODY, MARKER):
        chosen_places = {common: names for common, names in places.items() if chosen.search(common)}
        if chosen_places:
            return chosen_places
    return {common: names for common, names in places.items() if not DERIVED.search(common)} or places


def _commands(table: pd.DataFrame, names: list[str], measured: list[str], *, any_name: bool) -> list[str]:
    """Columns of commands. If no name matches: all columns in files of a user's own format, or the ``measured`` angles
    or forces of drives whose commands nobody recorded.

    One kind is meant of aims and other columns that are called commands: the larger, the others if there are as many.
    Other columns that are called as the aims are read back.
    """
    sent = [name for name in names if SENT.search(AIMED.sub("", name))]
    names = sent or [name for name in names if not (NO_COMMAND.search(name) or _numbers_rows(table[name], name))]
    turns = {name for four in _quaternions(table, names) for name in four}
    names = [name for name in names if name not in turns]
    called = [name for name in names if COMMAND.search(name)]
    driven = [name for name in called if not BESIDE.search(name) and not RATE.search(name)]
    aims = [name for name in driven if AIMED.search(name)]
    others = [name for name in driven if name not in aims and _stem(name) not in map(_stem, aims)]
    return (
        [name for name in names if sent and not RATE.search(name)]
        or max(others, aims, key=len)
        or called
        or [name for name in names if PRESSURE.search(name)]
        or ([name for name in names if not BESIDE.search(name)] if any_name else [])
        or measured
        or (names if any_name else [])
    )


def _stem(name: str) -> str:
    """A name without the words that tell what was sent from what was measured: of the same motor, it is the same."""
    return "".join(WORD.findall(SENT.sub("", MEASURED.sub("", name)).lower()))


def _numbers_rows(values: pd.Series, name: str) -> bool:
    """Whether a column goes up by one from every row to the next, or evenly, as times do, if its name allows times."""
    by_one = len(values) > MOST_SHOWN and bool((values.diff().iloc[1:] == 1.0).all())
    return by_one or (_rises_evenly(values) and not _told(name))


def _rises_evenly(values: pd.Series) -> bool:
    """Whether a column goes up from every row to the next, mostly by the usual step, and not by one as numbers do."""
    steps = values.diff().iloc[1:]
    usual = (steps / steps.median() - 1.0).abs() < UNEVEN
    return len(values) > MOST_SHOWN and bool((steps > 0.0).all() and usual.mean() > MOSTLY and (steps != 1.0).any())


def _quaternions(table: pd.DataFrame, names: list[str]) -> list[list[str]]:
    """Four columns side by side that are of unit length in all rows, and not at rest on an axis."""
    quaternions = []
    for first in range(len(names) - 3):
        four = names[first : first + 4]
        values = table[four].to_numpy(dtype=float)
        seen = values[np.isfinite(values).all(axis=1)]
        if len(seen) > MOST_SHOWN and np.all(np.abs(np.linalg.norm(seen, axis=1) - 1.0) < UNIT_LENGTH):
            quaternions += [four] if (np.abs(seen).max(axis=1) < 1.0).any() else []
    return quaternions


def _parted(name: str) -> str:
    """A name whose words begin with capitals, such as tipX, with a low line between them."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name)


def names_of(positions: list[list[str]]) -> list[str]:
    """The columns of all markers."""
    return [name for triple in positions for name in triple]


def _triples(names: list[str]) -> dict[str, list[str]]:
    """Columns whose names differ in one letter, x, y or z: the common name, and the three columns in this order."""
    triples: dict[str, dict[str, str]] = {}
    for name in names:
        words = _parted(name)
        for match in AXIS.finditer(words):
            common = f"{words[: match.start()]}*{words[match.end() :]}".lower()
            triples.setdefault(common, {})[match[0].lower()] = name
    return {common: [axes[a] for a in "xyz"] for common, axes in triples.items() if set(axes) == set("xyz")}


def _array_triples(names: list[str]) -> dict[str, list[str]]:
    """Arrays of three columns for each marker that are not called commands or readings."""
    arrays: dict[str, list[str]] = {}
    for name in names:
        arrays.setdefault(name.partition("[")[0], []).append(name)
    triples = _triples(names)
    for array, columns in arrays.items():
        other = any(pattern.search(f"{array}[") for pattern in (COMMAND, SENT, FORCE, PRESSURE, MEASURED, NO_COMMAND))
        if len(columns) % 3 or other or any(name in triple for triple in triples.values() for name in columns):
            continue
        for k in range(0, len(columns), 3):
            triples[f"{array}[{k // 3}]*" if len(columns) > 3 else f"{array}*".lower()] = columns[k : k + 3]
    return triples


def _marker_names(commons: list[str], structure: re.Pattern[str] | None) -> list[str]:
    """Names that robot files allow, made of the common name of each marker's columns, without some words."""
    names = []
    for number, common in enumerate(commons, start=1):
        words = [word for word in WORD.findall(common) if word not in {*UNITS, "in"}]
        name = "_".join(word for word in words if structure is None or not structure.fullmatch(word))
        names.append(name if re.match(r"[a-z]", name) else f"m{name or number}")
    return names if len(set(names)) == len(names) else [f"m{k}" for k in range(1, len(names) + 1)]


def _holds_times(table: CsvTable, name: str) -> bool:
    ticks = _ticks(table, name)
    return len(ticks) == 1 or bool(len(ticks) > 1 and ticks[-1] != ticks[0])  # a date without a time of day is no clock


def _rises(table: CsvTable, name: str) -> bool:
    """Whether a column holds times that never fall and mostly grow from row to row."""
    steps = np.diff(_ticks(table, name))
    return len(steps) > 0 and bool((steps >= 0).all() and np.mean(steps > 0) > MOSTLY)


def _ticks(table: CsvTable, name: str) -> np.ndarray:
    """Times of the rows, as they are written; empty if a cell holds none."""
    try:
        return table.stamps(name, "s").ticks
    except InputError:
        return np.zeros(0)


def _seconds(table: CsvTable, time: str | None, unit: str) -> float:
    """Length of a recording [s]; zero if unknown."""
    if time is None and table.rate is not None:
        return (len(table) - 1) / table.rate
    if time is None or time not in table:
        return 0.0
    stamps = table.stamps(time, unit)
    return float(stamps.ticks[-1] - stamps.ticks[0]) / stamps.per_second
