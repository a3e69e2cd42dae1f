"""The table [data.columns]: the meaning of each column of a table, and the recording read with it.

Timing. The command in row k is in force from the time of row k until the time of row k + 1, as for a loop that measures
and then commands; `first_command` finds the command before row 0. With `CsvColumns.commands_with_poses` it is in force
from half-way after row k - 1 on, so that row k shows its pose. Commands may stand in their own table, with n or
n - 1 rows for n observations; or with their own times and any number of rows. An empty cell of a command holds the
command above it, as loggers write that note changes only.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal, get_args

import numpy as np
import pandas as pd
from jaxtyping import Float
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator
from scipy.spatial.transform import Rotation

from rfdropo_bayes.data.command_notes import command_notes
from rfdropo_bayes.data.counters import Column, Motion, counter_notes, read_on, turns_of
from rfdropo_bayes.data.csv_table import CsvTable
from rfdropo_bayes.data.faults import fill_missing, find_faults
from rfdropo_bayes.data.held_commands import averaged_while_held
from rfdropo_bayes.data.held_readings import hold_time
from rfdropo_bayes.data.recorded import Measured, Origin, Recorded, SentCommands
from rfdropo_bayes.data.sample_times import TimeUnit, repeated_rows, rounded_notes, spread_repeats
from rfdropo_bayes.errors import InputError

FORMAT = "csv"
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
PASCALS = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "mbar": 1e2, "bar": 1e5, "psi": 6894.757293168}
COMMAND_UNITS = {name: ("m", factor) for name, factor in METRES.items()} | {
    "rad": ("rad", 1.0),
    "deg": ("rad", np.pi / 180.0),
    "N": ("N", 1.0),
    "N m": ("N m", 1.0),
    **{name: ("Pa", factor) for name, factor in PASCALS.items()},
    **dict.fromkeys(("-", "V", "A", "%"), ("-", 1.0)),
}
COUNTS = "counts"  # encoder counts, or steps of a drive: angles, once `CsvColumns.counts_per_turn` is known
CommandUnit = Literal[
    "m",
    "cm",
    "mm",
    "in",
    "rad",
    "deg",
    "counts",
    "N",
    "N m",
    "Pa",
    "kPa",
    "MPa",
    "mbar",
    "bar",
    "psi",
    "V",
    "A",
    "%",
    "-",
]


ROWS = "rows"  # stands for a column of times if rows have no times: the row number counts
SAME_RATE = 1e-3  # share by which sample_time may differ from the rate that the file states
ROW_SECONDS = 1.0  # nominal time from row to row [s] of rows without times
UNTIMED = "rows have no times: one a second is assumed, which means nothing but for poses at rest"


def _each_once(axes: tuple[str, str, str]) -> tuple[str, str, str]:
    if not np.isclose(abs(np.linalg.det(axes_matrix(axes))), 1.0):
        raise ValueError('axes must name x, y and z once each, each with a sign or without, e.g. ["x", "z", "-y"]')
    return axes


_ORIENTATION = re.compile("orient|quat|euler|rot|imu|acc|gyro|magnet|angular|inert", re.IGNORECASE)
_POSITIONS_ONLY = (
    "a marker is a position: leave orientations and inertial readings out (columns that are not named are not read). "
    "From a rigid body's pose, a second point on the body can be computed and named as a marker; object_pose is the "
    "pose of a pushed body"
)


class CsvColumns(BaseModel):
    """The table [data.columns]: the meaning and unit of each column. Other columns are not read.

    Times come from the column ``time`` or from a constant ``sample_time``.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    names: list[str] | None = Field(
        default=None, description="names of all columns, in their order, of a CSV without a line of names"
    )
    command_names: list[str] | None = Field(
        default=None, description="names of all columns of the file of commands, for a CSV without a line of names"
    )
    time: str | None = Field(
        default=None,
        description="column of the times: numbers in time_unit, or dates (ISO 8601); or give sample_time; "
        '"rows" for rows without any time, such as poses at rest: one a second is assumed; for '
        '"rosbag": "header", stamps if messages have them, or "log", the recorder\'s times',
    )
    time_unit: TimeUnit = Field(
        default="s", description='unit of the times; dates, durations, "rosbag" and "motive-csv" need no unit'
    )
    sample_time: float | None = Field(
        default=None, gt=0, description="time between rows [s], if no column has times, or only times of arrival"
    )
    commands: list[str] = Field(
        min_length=1,
        description="columns of the sent commands, one for each channel of the robot, in the robot's order",
    )
    command_unit: CommandUnit = Field(
        description="unit of the commands: a length of cable, an angle of a motor or its counts, a force, torque or "
        'pressure; "-" for commands of your own simulator'
    )
    counts_per_turn: float | None = Field(
        default=None,
        gt=0,
        description="counts of an encoder, or steps of a drive, in one turn of the spool, gear included; for values in "
        "counts",
    )
    largest_command: float | None = Field(
        default=None,
        gt=0,
        description="largest plausible command, in command_unit, if drives travel more than 20 rad or 5 m, as a "
        "winch or lead screw does",
    )
    units: dict[str, str] = Field(
        {},
        description="unit by name of the column, for columns of commands or positions whose unit differs from "
        "command_unit or position_unit",
    )
    commands_with_poses: bool = Field(
        default=False,
        description="whether the pose of a row results from the command in the same row: true for robots at rest, "
        "and if commands were measured with the pose; by default a command acts after its row",
    )
    command_time: str | None = Field(
        default=None,
        description="column of the commands' own times, in their file; by default command k is sent in row k of the "
        "observations",
    )
    command_time_unit: TimeUnit | None = Field(default=None, description="unit of command_time; time_unit by default")
    command_offset: float = Field(
        default=0.0,
        description="added to the commands' own times [s]: reading of the observations' clock when the commands' "
        "clock shows zero",
    )
    positions: list[tuple[str, str, str]] = Field(
        min_length=1, description="columns of x, y and z of each marker, base to tip"
    )
    position_unit: Literal["m", "cm", "mm", "in"] = Field(
        description='unit of the positions; the header of a "motive-csv" file overrides it'
    )
    axes: Annotated[tuple[str, str, str], AfterValidator(_each_once)] = Field(
        ("x", "y", "z"),
        description="the base frame's x, y, z in terms of the file's axes, e.g. "
        '["x", "z", "-y"] for a trunk that hangs in a frame with y up; left-handed axes if the file\'s frame '
        "is left-handed, as in Unity",
    )
    origin: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0),
        description="position of the robot's base in the file's frame: x, y, z along the file's axes, in "
        "position_unit; the base is the centre of the body at the clamp",
    )
    base_marker: tuple[str, str, str] | None = Field(
        default=None,
        description="columns of x, y and z of a marker on the base, if cameras or base moved; positions and origin "
        "are then relative to this marker",
    )
    markers: list[str] | None = Field(
        default=None, description="the robot's name of each marker in positions; m1, m2, ... by default"
    )
    cables: list[str] | None = Field(
        default=None, description="name of each channel in commands; the column names by default"
    )
    tensions: list[str] | None = Field(
        default=None, description="columns of the cable tensions [N], one for each command; empty cells are left out"
    )
    motor_angles: list[str] | None = Field(
        default=None, description="columns of the measured motor angles, one for each command; empty cells are left out"
    )
    motor_angle_unit: Literal["rad", "deg", "counts"] = Field(default="rad", description="unit of the motor angles")
    unwrap: dict[str, float] = Field(
        {},
        description="size of a turn, by column, for commands or motor angles that begin anew after each turn; in the "
        "unit of the column: 4096 of an encoder, 360 of an angle in degrees",
    )
    object_pose: list[str] | None = Field(
        default=None,
        min_length=7,
        max_length=7,
        description="columns of the pushed body's centre x, y, z and unit quaternion x, y, z, w; empty rows are left "
        "out",
    )
    orientations: list[list[str]] | None = Field(
        default=None,
        description="columns of the orientation of each of sections: a unit quaternion x, y, z, w, or a rotation "
        "vector x, y, z in rotation_unit, from the undeformed body, along the file's axes; empty rows are left "
        "out",
    )
    sections: list[str] | None = Field(
        default=None,
        description="names of orientations in the robot file ([[orientations]]), in the order of the columns",
    )
    rotation_unit: Literal["rad", "deg"] = Field(default="rad", description="unit of rotation vectors")
    robot: str = Field("", description="name of the robot that was recorded")

    @model_validator(mode="before")
    @classmethod
    def _positions_only(cls, table: Any) -> Any:
        if isinstance(table, dict):
            unknown = set(table) - set(cls.model_fields)
            for key in unknown:
                if _ORIENTATION.search(str(key)):
                    raise InputError(f"unknown key {key!r}", where="[data.columns]", remedy=_POSITIONS_ONLY)
            if "positions" not in table and not unknown:
                remedy = f'add positions = [["x1", "y1", "z1"], ...]; {_POSITIONS_ONLY}'
                raise InputError("no positions of markers", where="[data.columns]", remedy=remedy)
            points = table.get("positions")
            for point in points if isinstance(points, list) else []:
                if isinstance(point, list) and len(point) != 3:
                    raise InputError(
                        f"the marker {', '.join(str(name) for name in point)} has {len(point)} columns, not x, y and z",
                        where="[data.columns] positions",
                        remedy=_POSITIONS_ONLY if len(point) > 3 else "name its three columns",
                    )
        return table

    @model_validator(mode="after")
    def _fits(self) -> CsvColumns:
        if (self.time is None) == (self.sample_time is None):
            raise ValueError("give either time (a column) or sample_time (seconds)")
        if (COUNTS in (self.command_unit, self.motor_angle_unit, *self.units.values())) != (
            self.counts_per_turn is not None
        ):
            raise ValueError(f'counts_per_turn belongs to the unit "{COUNTS}": give both or neither')
        for key, names, count in (
            ("markers", self.markers, len(self.positions)),
            ("cables", self.cables, len(self.commands)),
            ("tensions", self.tensions, len(self.commands)),
            ("motor_angles", self.motor_angles, len(self.commands)),
        ):
            if names is not None and len(names) != count:
                what = "marker in positions" if key == "markers" else "channel in commands"
                raise ValueError(f"{key} has {len(names)} entries instead of {count}, one for each {what}")
        if self.commands_with_poses and self.command_time is not None:
            raise ValueError("commands_with_poses and command_time contradict each other: leave out one of them")
        if len(self.orientations or ()) != len(self.sections or ()):
            raise ValueError("give one name in sections for each of orientations")
        for turn in self.orientations or ():
            if len(turn) not in (3, 4):
                raise ValueError(f"an orientation has 4 columns (quaternion) or 3 (rotation vector), not {len(turn)}")
        for number, point in enumerate(self.positions):
            if point in self.positions[:number]:
                first = self.positions.index(point) + 1
                raise ValueError(f"markers {first} and {number + 1} of positions have the same columns {list(point)}")
        if self.object_pose is not None and self.left_handed:
            raise ValueError("object_pose needs axes of a right-handed frame: quaternions have no mirror image")
        for name in self.units:
            self._factor(name)
        for name, period in self.unwrap.items():
            if name not in (*self.commands, *(self.motor_angles or ())):
                raise ValueError(f"unwrap names {name!r}, which is no column of commands or motor_angles")
            if not (np.isfinite(period) and period > 0.0):
                raise ValueError(f"unwrap gives {name!r} a turn of {period:g}, which must be positive")
        return self

    def sized(self, unit: CommandUnit) -> tuple[str, float]:
        """The unit in which a recording keeps values of ``unit``, and the size of ``unit`` in it."""
        if unit == COUNTS and self.counts_per_turn is not None:
            return "rad", 2.0 * np.pi / self.counts_per_turn
        return COMMAND_UNITS[unit]

    @property
    def left_handed(self) -> bool:
        """Whether the file's frame is left-handed, by ``axes``."""
        return bool(np.linalg.det(axes_matrix(self.axes)) < 0.0)

    def factors(self, names: Sequence[str]) -> Float[np.ndarray, " column"]:
        """Factors from the columns' units to command_unit or position_unit."""
        return np.array([self._factor(name) if name in self.units else 1.0 for name in names])

    def _factor(self, name: str) -> float:
        unit = self.units[name]
        if name in self.commands:
            common, sizes = self.command_unit, {key: self.sized(key) for key in get_args(CommandUnit) if self._has(key)}
        elif name in coordinates(self):
            common, sizes = self.position_unit, {key: ("m", size) for key, size in METRES.items()}
        else:
            raise ValueError(f"units names {name!r}, which is no column of commands or positions")
        if unit not in sizes or sizes[unit][0] != sizes[common][0]:
            raise ValueError(f"units gives {name!r} in {unit!r}, which cannot be brought to {common!r}")
        return sizes[unit][1] / sizes[common][1]

    def _has(self, unit: str) -> bool:
        return unit != COUNTS or self.counts_per_turn is not None


def axes_matrix(axes: tuple[str, str, str]) -> Float[np.ndarray, "3 3"]:
    """Rotation from the file's frame to the base frame, from names such as ("x", "z", "-y")."""
    matrix = np.zeros((3, 3))
    for row, name in enumerate(axes):
        sign, letter = (-1.0, name[1:]) if name.startswith("-") else (1.0, name.lstrip("+"))
        if letter in ("x", "y", "z"):
            matrix[row, "xyz".index(letter)] = sign
    return matrix


def axes_words(matrix: Float[np.ndarray, "3 3"]) -> str:
    """The inverse of `axes_matrix`, as ``axes`` of [data.columns] is written in a file."""
    names = [f'"{"-" if row.min() < 0.0 else ""}{"xyz"[np.argmax(np.abs(row))]}"' for row in matrix]
    return f"[{', '.join(names)}]"


def read_frame(frame: pd.DataFrame, columns: CsvColumns, name: str, *, mask_missing: bool = False) -> Recorded:
    """One recording from a table in memory."""
    table = CsvTable.of_frame(frame, name, coordinates(columns))
    return read_tables(table, table, columns, mask_missing=mask_missing)


def coordinates(columns: CsvColumns) -> list[str]:
    """The columns of the positions."""
    return [name for point in columns.positions for name in point]


def read_tables(
    table: CsvTable, source: CsvTable, columns: CsvColumns, *, mask_missing: bool = False, origin: Origin | None = None
) -> Recorded:
    """The recording in a table, whose commands are in ``source``, which may be the same.

    ``origin`` describes a CSV by default.
    """
    source, held = _held(source, columns.commands)
    position, time = points(table, columns, mask_missing=mask_missing), _times(table, columns)
    markers = marker_names(columns)
    read, unit = _commands(table, source, columns), columns.sized(columns.command_unit)[0]
    of_rows = read if len(read) == len(time) and columns.command_time is None and columns.time != ROWS else None
    faults = find_faults(time, position, command=of_rows, where=str(table.path), names=markers)
    command, averaged = averaged_while_held(read, unit) if columns.commands_with_poses else (read, [])
    sent = time[: len(command)] if columns.command_time is None else _command_times(table, source, columns)
    angle = _angles(table, columns)
    commands = SentCommands(sent, command, *_channels(columns), command[0], _largest(columns))
    commands = commands.of_poses() if columns.commands_with_poses else commands
    notes = [*faults.notes, *_timing_notes(table, columns, time), *held, *averaged]
    notes += [note for file in {table.path: table, source.path: source}.values() for note in file.notes]
    if columns.command_time is not None:
        notes += command_notes(commands.command_time, commands.command)
    seen = np.where(faults.mask[:, :, None], position, np.nan).reshape(len(time), -1)
    notes += _counter_notes(table, source, columns, Motion(commands.command_time, time, seen))
    settings = faults._replace(notes=notes).settings
    settings |= {"settled_poses": True} if columns.commands_with_poses else {}
    settings |= {} if angle is None else {"motor_angle_hold": hold_time(time, angle)}
    return Recorded(
        replace(origin or origin_of(table, columns), settings=settings),
        commands,
        Measured(
            time=time,
            position=fill_missing(time, position),
            marker_names=markers,
            position_mask=faults.mask,
            tension=None if columns.tensions is None else table.numbers(columns.tensions, allow_missing=True),
            motor_angle=angle,
            object_pose=_pose(table, columns),
            orientation=_orientations(table, columns),
            section_names=columns.sections or (),
        ),
    )


def read_commands(table: CsvTable, columns: CsvColumns) -> SentCommands:
    """The commands in a table, which may have no other columns; times count from the first command."""
    clock, unit = command_clock(columns)
    time = _times(table, columns) if clock is None else _from_first(table, clock, unit)
    return SentCommands(time, _commands(table, table, columns), *_channels(columns), largest=_largest(columns))


def origin_of(table: CsvTable, columns: CsvColumns) -> Origin:
    """Origin of a recording in a CSV."""
    file = table.path.name
    return Origin(file.removesuffix(".gz").removesuffix(".csv"), columns.robot, FORMAT, provenance=file)


def marker_names(columns: CsvColumns) -> list[str]:
    """Names of the markers, as they are given, or m1, m2, ..."""
    return columns.markers or [f"m{marker}" for marker in range(1, len(columns.positions) + 1)]


def _channels(columns: CsvColumns) -> tuple[str, list[str]]:
    """Unit of the commands in a recording, and the names of their channels."""
    return columns.sized(columns.command_unit)[0], columns.cables or columns.commands


def _largest(columns: CsvColumns) -> float | None:
    """Largest plausible command, in the unit of a recording; None for the default limits."""
    stated = columns.largest_command
    return None if stated is None else columns.sized(columns.command_unit)[1] * stated


def points(table: CsvTable, columns: CsvColumns, *, mask_missing: bool) -> Float[np.ndarray, "rows marker 3"]:
    """Positions of the markers [m] in the base frame."""
    place = table.points(coordinates(columns), allow_missing=mask_missing)
    if columns.base_marker is not None:
        place = place - table.points(list(columns.base_marker), allow_missing=mask_missing)
    return in_base(place, columns)


def in_base(place: Float[np.ndarray, "*rows marker 3"], columns: CsvColumns) -> Float[np.ndarray, "*rows marker 3"]:
    """Positions of a file, converted to the base frame [m]."""
    place = place * columns.factors(coordinates(columns)).reshape(-1, 3)
    return METRES[columns.position_unit] * (place - columns.origin) @ axes_matrix(columns.axes).T


def _times(table: CsvTable, columns: CsvColumns) -> Float[np.ndarray, " rows"]:
    if columns.time is None or untimed(columns):
        return float(columns.sample_time or ROW_SECONDS) * np.arange(len(table))
    return spread_repeats(_from_first(table, columns.time, columns.time_unit))


def untimed(columns: CsvColumns) -> bool:
    """Whether row numbers replace times."""
    return columns.time == ROWS


def _timing_notes(table: CsvTable, columns: CsvColumns, time: Float[np.ndarray, " rows"]) -> list[str]:
    """Notes on doubtful times."""
    if untimed(columns):
        return [UNTIMED]
    if columns.time is None:
        step = columns.sample_time
        if table.rate is None or step is None or abs(step * table.rate - 1.0) < SAME_RATE:
            return []
        return [
            f"the file says {table.rate:g} Hz, and sample_time = {step:g} is {1.0 / step:.4g} Hz: it is taken; "
            "recordings at several rates need an experiment each"
        ]
    repeated = repeated_rows(_from_first(table, columns.time, columns.time_unit))
    words = (
        f"{len(repeated)} of {len(table)} rows, first row {repeated[0]}, have the stamp of the row before: they are "
        "taken to lie evenly between their neighbours; leave them out if they are copies"
        if len(repeated)
        else ""
    )
    return [words] * bool(words) + rounded_notes(table.stamps(columns.time, columns.time_unit), time)


def _from_first(table: CsvTable, clock: str, unit: TimeUnit) -> Float[np.ndarray, " rows"]:
    stamps = table.stamps(clock, unit)
    return stamps.since(stamps, str(table.path))


def command_clock(columns: CsvColumns) -> tuple[str | None, TimeUnit]:
    """Column of times in a file of commands, and its unit; None if its rows have no times."""
    shared = None if untimed(columns) else columns.time
    return columns.command_time or shared, columns.command_time_unit or columns.time_unit


def _command_times(table: CsvTable, source: CsvTable, columns: CsvColumns) -> Float[np.ndarray, " command"]:
    """The commands' own times [s] from the first observation on.

    Raises:
        InputError: commands that were sent at other times than the recording.
    """
    clock, unit = command_clock(columns)
    stamps, where = source.stamps(str(clock), unit), f"{table.path} with {source.path}"
    if columns.time is None or untimed(columns):
        sent = stamps.ticks / stamps.per_second
    else:
        sent = stamps.since(table.stamps(columns.time, columns.time_unit), where)
    sent, last = sent + columns.command_offset, float(_times(table, columns)[-1])
    if sent[0] > last or sent[-1] < -last:  # a command long before may hold throughout, but is likelier another clock's
        raise InputError(
            f"commands were sent from {sent[0]:.6g} to {sent[-1]:.6g} s, and {last:.6g} s were recorded from 0 s on",
            where=where,
            remedy="correct command_offset, of [data.columns] or of each entry, or pair files that were recorded "
            'together; for a bag with stamps of several clocks write time = "log"',
        )
    return sent


def _angles(table: CsvTable, columns: CsvColumns) -> Float[np.ndarray, "rows cable"] | None:
    """Motor angles [rad], if they were measured."""
    if columns.motor_angles is None:
        return None
    values = table.numbers(columns.motor_angles, allow_missing=True)
    return columns.sized(columns.motor_angle_unit)[1] * read_on(values, columns.motor_angles, columns.unwrap)


def _counter_notes(table: CsvTable, source: CsvTable, columns: CsvColumns, motion: Motion) -> list[str]:
    """Jumps of counters, of commands and of motor angles, that no marker follows."""
    sent = (columns.commands, columns.command_unit, source.numbers(columns.commands), motion)
    names, angle_motion = columns.motor_angles or [], motion._replace(sent=motion.time)
    read = (names, columns.motor_angle_unit, table.numbers(names, allow_missing=True) if names else None, angle_motion)
    notes = []
    for names, unit, values, seen in (sent, read):
        if values is not None:
            values = read_on(values, names, columns.unwrap)
            own = [
                Column(n, v, turns_of(unit, columns.counts_per_turn, v)) for n, v in zip(names, values.T, strict=True)
            ]
            notes += counter_notes(own, seen, unit)
    return notes


def _held(source: CsvTable, names: Sequence[str]) -> tuple[CsvTable, list[str]]:
    """The table with the command above in empty cells of commands, and a note if there are any.

    Raises:
        InputError: a column of commands begins with an empty cell.
    """
    source.require(names)
    cells = source.frame[list(names)]
    empty = cells.isna().to_numpy()
    if not empty.any():
        return source, []
    if empty[0].any():
        column = int(np.argmax(empty[0]))
        first = int(np.argmin(empty[:, column]))
        raise InputError(
            f"the first command is in row {first}" if first else "holds no command",
            where=f"{source.path}, row 0, column {names[column]!r}",
            remedy="write the command that was in force into row 0"
            + (f", or leave out the rows above row {first}" if first else ""),
        )
    held = copy.copy(source)
    held.frame = source.frame.copy()
    held.frame[list(names)] = cells.ffill()
    row, column = np.argwhere(empty)[0]
    return held, [
        f"{int(empty.sum())} of {empty.size} cells of commands are empty, the first in row {row} of {names[column]}: "
        "each holds the command above it, as if only changes were logged; if commands were lost, leave these rows out"
    ]


def _commands(table: CsvTable, source: CsvTable, columns: CsvColumns) -> Float[np.ndarray, "rows cable"]:
    factors = columns.sized(columns.command_unit)[1] * columns.factors(columns.commands)
    values = factors * read_on(source.numbers(columns.commands), columns.commands, columns.unwrap)
    if columns.command_time is None and len(values) not in (len(table), len(table) - 1):
        raise InputError(
            f"{len(table)} observations do not fit {len(values)} commands: give the same number, or one fewer",
            where=f"{table.path} with {source.path}",
            remedy="pair the files that were recorded together, or name the commands' own times: command_time",
        )
    return values


def _pose(table: CsvTable, columns: CsvColumns) -> Float[np.ndarray, "rows 7"] | None:
    if columns.object_pose is None:
        return None
    pose = table.numbers(columns.object_pose, allow_missing=True)
    pose[:, :3] = METRES[columns.position_unit] * (pose[:, :3] - columns.origin)
    rotation, known = axes_matrix(columns.axes), np.isfinite(pose).all(axis=1)
    turned = np.full((len(pose), 4), np.nan)
    turned[known] = (Rotation.from_matrix(rotation) * Rotation.from_quat(pose[known, 3:])).as_quat()
    return np.hstack([pose[:, :3] @ rotation.T, turned])


def _orientations(table: CsvTable, columns: CsvColumns) -> Float[np.ndarray, "rows section 4"] | None:
    """Quaternions from the base's axes to the sections' axes, which coincide in the undeformed body."""
    if not columns.orientations:
        return None
    turned = np.full((len(table), len(columns.orientations), 4), np.nan)
    axes = Rotation.from_matrix(axes_matrix(columns.axes))
    for k, names in enumerate(columns.orientations):
        read = table.numbers(names, allow_missing=True)
        known = np.isfinite(read).all(axis=1)
        vector = COMMAND_UNITS[columns.rotation_unit][1] * read[known]
        turn = Rotation.from_rotvec(vector) if len(names) == 3 else Rotation.from_quat(read[known])
        turned[known, k] = (axes * turn * axes.inv()).as_quat()
    return turned
