"""Recordings of the ASL trunk: motion capture of three disks, and six motor commands, in two files.

Timing. Both files run at 100 Hz. Row k of the observations is the state just before command row k is sent, so command
row k is in force from ``time[k]`` until ``time[k + 1]``, and the observations have one row more than the commands. The
command before row 0 is not recorded, but the motors' angles show it (`first_command`); ``initial_command`` repeats
command row 0.

Frame. Motion capture has y up and the trunk hangs. Base frame: x = mocap x, y = mocap z, z = -mocap y (down, along the
axis); right-handed. No origin is subtracted: the mocap origin is arbitrary and moved by a centimetre between days, so a
rest offset per recording is a parameter of the model.

Settled poses. An observation file whose ID is the number of its command row holds, for each command in turn, the motion
to its settled pose and some rest. Its trajectory has one row per command: the median of the last 0.2 s, at its end;
command row k + 1 is in force from the first row of its own block, command 0 from the start.

Motor angles are in radians. In files of before June 2025 they are a 20 Hz zero-order hold, whose repeats are
masked; for settled poses they are stale and left out.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.data.commands_alone import commands_alone
from rfdropo_bayes.data.csv_table import CsvTable
from rfdropo_bayes.data.faults import Faults, fill_missing, find_faults
from rfdropo_bayes.data.held_readings import hold_time
from rfdropo_bayes.data.recorded import Measured, Origin, SentCommands
from rfdropo_bayes.data.trajectory import Trajectory
from rfdropo_bayes.errors import InputError

FORMAT = "asl-csv"
RATE = 100.0  # [Hz]
MOTORS = 6
NO_COMMANDS = "none"
FRAME = "robot base: x = mocap x, y = mocap z, z = -mocap y (down, along the axis); mocap origin"
MOCAP_TO_BASE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_DISKS = [f"{axis}{disk}" for disk in (1, 2, 3) for axis in "xyz"]
_COMMANDS = [f"u{motor}" for motor in range(1, MOTORS + 1)]
_ANGLES = [f"phi{motor}" for motor in range(1, MOTORS + 1)]
_SETTLED_ROWS = 20
_MARKERS = ("disk1", "disk2", "disk3")
_CABLES = [f"motor{motor}" for motor in range(1, MOTORS + 1)]


class _Recording(NamedTuple):
    table: CsvTable
    identity: Int[np.ndarray, " rows"]
    time: Float[np.ndarray, " rows"]
    position: Float[np.ndarray, "rows disk 3"]
    faults: Faults


class _Content(NamedTuple):
    sent: SentCommands
    measured: Measured
    settings: dict[str, Any]


def read_asl_csv(observations: Path, commands: Path | None, *, mask_missing: bool = False) -> Trajectory:
    """One recording: disks disk1 (base) ... disk3 (tip), motors motor1 ... motor6 [rad], pull as the file has it.

    Args:
        observations: file of observations.
        commands: file of commands; None for a recording at zero command.
        mask_missing: mask lost marker positions instead of rejecting the file.

    Raises:
        InputError: on a damaged file (see ``CsvTable``), missing rows, or two files that do not fit together.
    """
    table = CsvTable(observations, ["ID", *_DISKS])
    identity = table.numbers(["ID"])[:, 0].astype(int)
    position = table.points(_DISKS, allow_missing=mask_missing) @ MOCAP_TO_BASE.T
    time = np.arange(len(table)) / RATE
    faults = find_faults(time, position, where=str(observations), names=_MARKERS)
    recording = _Recording(table, identity, time, position, faults)
    command = _read_commands(commands) if commands is not None else np.zeros((len(table) - 1, MOTORS))
    settled = len(set(identity)) < len(identity)
    sent, measured, settings = (_settled_poses if settled else _motion)(recording, command, commands)
    payload = re.search(r"_(\d+)g$", _stem(observations))
    settings = faults.settings | settings | {"payload_mass": 1e-3 * float(payload.group(1)) if payload else 0.0}
    words = f"{observations.name}, commands {commands.name if commands else NO_COMMANDS}: ASL Trunk"
    return Trajectory.build(_origin(_stem(observations), words, settings), sent, measured)


def _origin(name: str, provenance: str, settings: Mapping[str, Any]) -> Origin:
    return Origin(name, "asl_trunk", FORMAT, provenance=provenance, frame=FRAME, settings=settings)


def read_asl_start(commands: Path, observations: Path | None) -> Trajectory:
    """Commands with the start pose at most, with motor angles, from the first row of a file of observations.

    Raises:
        InputError: on a damaged file.
    """
    command = _read_commands(commands)
    start = angle = None
    if observations is not None:
        table = CsvTable(observations, ["ID", *_DISKS])
        start = table.points(_DISKS, allow_missing=True) @ MOCAP_TO_BASE.T
        if all(name in table for name in _ANGLES):
            angle = np.full((len(command) + 1, MOTORS), np.nan)
            angle[0] = np.deg2rad(table.numbers(_ANGLES, allow_missing=True)[0])
    return commands_alone(
        _origin(_stem(observations or commands), commands.name, {}),
        SentCommands(np.arange(len(command)) / RATE, command, "rad", _CABLES),
        _MARKERS,
        start=start,
        motor_angle=angle,
    )


def _motion(recording: _Recording, command: np.ndarray, commands: Path | None) -> _Content:
    rows = len(recording.time)
    _check_consecutive(recording.identity, str(recording.table.path))
    if rows != len(command) + 1:
        raise InputError(
            f"{rows} observations do not fit {len(command)} commands: there must be one observation more",
            where=f"{recording.table.path} with {commands}",
            remedy="pair the files that were recorded together; use rows = [first, last] to cut both",
        )
    angle = None
    if all(name in recording.table for name in _ANGLES):
        angle = np.deg2rad(recording.table.numbers(_ANGLES, allow_missing=True))
    return _Content(
        SentCommands(recording.time[:-1], command, "rad", _CABLES, command[0]),
        Measured(
            recording.time,
            fill_missing(recording.time, recording.position),
            _MARKERS,
            recording.faults.mask,
            motor_angle=angle,
        ),
        {} if angle is None else {"motor_angle_hold": hold_time(recording.time, angle)},
    )


def _settled_poses(recording: _Recording, command: np.ndarray, commands: Path | None) -> _Content:
    numbers, first = np.unique(recording.identity, return_index=True)
    where = f"{recording.table.path} with {commands}"
    if np.any(np.diff(recording.identity) < 0):
        raise InputError("the rows are not in the order of the column ID", where=where, remedy="sort them")
    if commands is None or len(numbers) != len(command) or not np.array_equal(numbers, np.arange(len(command))):
        count = "no" if commands is None else str(len(command))
        raise InputError(
            f"poses with ID {numbers[0]} to {numbers[-1]} ({len(numbers)}) do not fit {count} commands",
            where=where,
            remedy="pair the files that were recorded together",
        )
    end = np.append(first[1:], len(recording.time)) - 1
    pose = np.zeros((len(numbers), *recording.position.shape[1:]))
    mask = np.zeros(pose.shape[:2], dtype=bool)
    for row, (start, stop) in enumerate(zip(first, end, strict=True)):
        window = slice(max(start, stop + 1 - _SETTLED_ROWS), stop + 1)
        for disk in range(pose.shape[1]):
            good = recording.faults.mask[window, disk]
            mask[row, disk] = good.any()
            pose[row, disk] = np.median(recording.position[window, disk][good if good.any() else slice(None)], axis=0)
    time = recording.time[end]
    return _Content(
        SentCommands(recording.time[first[1:]], command[1:], "rad", _CABLES, command[0]),
        Measured(time, fill_missing(time, pose), _MARKERS, mask),
        {"settled_poses": True, "motor_angle": "stale, left out"},
    )


def _read_commands(path: Path) -> Float[np.ndarray, "rows 6"]:
    table = CsvTable(path, ["ID", *_COMMANDS])
    _check_consecutive(table.numbers(["ID"])[:, 0].astype(int), str(path))
    return np.deg2rad(table.numbers(_COMMANDS))


def command_columns(
    time: Float[np.ndarray, " k"], command: Float[np.ndarray, "k 6"], seconds: float
) -> dict[str, np.ndarray]:
    """Commands [rad] and the times [s] from which they are in force, from a file with a row of degrees every 10 ms."""
    row = np.arange(max(1, round(seconds * RATE)))
    held = np.rad2deg(command)[np.searchsorted(time, row / RATE + 1e-9, side="right") - 1]
    return {"ID": row, **dict(zip(_COMMANDS, held.T, strict=True))}


def _check_consecutive(identity: np.ndarray, where: str) -> None:
    wrong = np.flatnonzero(identity != np.arange(len(identity)))
    if wrong.size:
        row = int(wrong[0])
        raise InputError(
            f"ID {identity[row]} instead of {row}: rows are missing or out of order",
            where=f"{where}, row {row}, column 'ID'",
            remedy="fetch it again, or use rows = [first, last] on a whole recording to leave rows out",
        )


def _stem(path: Path) -> str:
    return path.name.removesuffix(".gz").removesuffix(".csv")
