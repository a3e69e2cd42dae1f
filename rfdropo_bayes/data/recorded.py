"""Parts of a `Trajectory`, from a file or from arrays, in SI units."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float

from rfdropo_bayes.data import checks
from rfdropo_bayes.data.held_readings import new_readings, present_readings
from rfdropo_bayes.data.sample_times import sample_time
from rfdropo_bayes.errors import InputError

AXES = ("x", "y", "z")
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
SCHEMA = "rfdropo_bayes.trajectory/1"
FIRST_COMMAND = "first_command"  # among the settings: which command was in force before the first row
GOAL_AXES = "goal_axes"  # among the settings: coordinates in which a pushed object is to come to its goal
MISSING = "missing_readings"  # among the settings: how many tensions, motor angles and poses a recording lacks


@dataclass(frozen=True)
class Origin:
    """Origin of a recording."""

    name: str  # name of the recording in reports
    robot: str  # name of the robot description; empty if the file does not state it
    format: str  # format of the file, as in an experiment's [data]
    synthetic: bool = False  # whether a simulator made it
    provenance: str = ""  # file or creation of the recording, in words
    frame: str = "robot base: x, y across, z along the axis away from the base"  # frame of the positions, in words
    # facts about the recording that a model may need (JSON); with a ``motor_angle_hold`` [s], only new motor angles are
    # used (`held_readings`)
    settings: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class SentCommands:
    """Commands as they were sent, cumulative, pull > 0, each in force until the next."""

    command_time: Float[np.ndarray, " command_time"]  # start time of each command [s], on the clock of the observations
    command: Float[np.ndarray, "command_time cable"]  # values, unclipped
    command_unit: str  # "m" of cable or "rad" of a motor
    cable_names: Sequence[str]  # names of the channels
    initial_command: Float[np.ndarray, " cable"] | None = None  # command before the first; zero by default
    largest: float | None = None  # largest plausible command, in their unit; None for the default limits

    def of_poses(self) -> SentCommands:
        """Commands in force if the pose in a row belongs to the command in the same row. A command acts from the middle
        between its row and the row before, so that simulators with any time step apply it in its row.
        """
        time, command = np.asarray(self.command_time), np.asarray(self.command)
        between = 0.5 * (time[:-1] + time[1:])
        return replace(self, command_time=between, command=command[1:], initial_command=command[0])

    def trusted(self) -> SentCommands:
        """The same commands of a simulator or a controller's own log, whose largest command is plausible."""
        size = np.abs(np.asarray(self.command, dtype=float))
        return replace(self, largest=float(size.max())) if size.size and np.isfinite(size).all() else self


@dataclass(frozen=True)
class Measured:
    """Observations; NaN marks missing tensions, motor angles and poses."""

    time: Float[np.ndarray, " time"]  # times of the observations [s]; the first becomes 0
    position: Float[np.ndarray, "time marker 3"]  # positions of the markers in the robot's base frame [m]
    marker_names: Sequence[str]  # base to tip
    position_mask: Bool[np.ndarray, "time marker"] | None = None  # False for a recording fault; all True by default
    tension: Float[np.ndarray, "time cable"] | None = None  # cable tensions [N]
    motor_angle: Float[np.ndarray, "time cable"] | None = None  # motor angles [rad]
    object_pose: Float[np.ndarray, "time 7"] | None = None  # centre [m] and unit quaternion x, y, z, w of a pushed body
    # orientations of sections, unit quaternions x, y, z, w from the base's axes to the section's
    orientation: Float[np.ndarray, "time section 4"] | None = None
    section_names: Sequence[str] = ()  # names of these sections


class Recorded(NamedTuple):
    """All parts of a recording before the checks of ``Trajectory.build(*recorded)``."""

    origin: Origin
    sent: SentCommands
    measured: Measured


def assembled(recorded: Recorded) -> xr.Dataset:
    """A recording as a data set with its attributes; readings that are missing are left out and counted.

    Raises:
        InputError: lengths that do not fit together.
    """
    origin, sent, measured = recorded
    facts = dict(origin.settings)
    checks.check_pose(measured.object_pose, len(measured.time), origin.name)
    tension, tension_mask = present_readings(measured.tension)
    motor_angle, angle_mask = present_readings(measured.motor_angle)
    facts |= _missing(tension_mask, angle_mask, measured.object_pose, measured.orientation)
    facts |= {} if sent.largest is None else {checks.LARGEST: float(sent.largest)}
    new = _angle_mask(measured.time, motor_angle, float(facts.get("motor_angle_hold", 0.0)))
    pose, mask, initial = measured.object_pose, measured.position_mask, sent.initial_command
    arrays = {
        "position": measured.position,
        "position_mask": np.ones(np.shape(measured.position)[:2], dtype=bool) if mask is None else mask,
        "command": sent.command,
        "initial_command": np.zeros(len(sent.cable_names)) if initial is None else initial,
        "tension": tension,
        "tension_mask": tension_mask,
        "motor_angle": motor_angle,
        "motor_angle_mask": angle_mask if new is None else (new if angle_mask is None else new & angle_mask),
        "object_pose": None if pose is None else continuous_quaternions(pose),
        "orientation": measured.orientation,
    }
    dataset = _dataset(recorded, arrays)
    dataset["command"].attrs["unit"] = sent.command_unit
    time = measured.time
    dataset.attrs = {
        "schema": SCHEMA,
        "name": origin.name,
        "robot": origin.robot,
        "format": origin.format,
        "provenance": origin.provenance,
        "frame": origin.frame,
        "sample_time": sample_time(np.asarray(time, dtype=float)) if len(time) > 1 else 0.0,
        "synthetic": int(origin.synthetic),
        "settings": json.dumps(facts, sort_keys=True),
    }
    return dataset


def _dataset(recorded: Recorded, arrays: Mapping[str, Any]) -> xr.Dataset:
    sent, measured = recorded.sent, recorded.measured
    start = measured.time[0] if len(measured.time) else 0.0
    coords = {
        "time": np.asarray(measured.time, dtype=float) - start,
        "command_time": np.asarray(sent.command_time, dtype=float) - start,
        "marker": list(measured.marker_names),
        "cable": list(sent.cable_names),
        "axis": list(AXES),
    }
    if arrays["object_pose"] is not None:
        coords["pose"] = list(POSE)
    if arrays["orientation"] is not None:
        coords |= {"section": list(measured.section_names), "quaternion": list("xyzw")}
    try:
        data = {key: (checks.DIMS[key], np.array(value)) for key, value in arrays.items() if value is not None}
        return xr.Dataset(data, coords=coords)
    except ValueError as error:
        raise InputError(
            f"recording and commands do not fit together ({error})",
            where=recorded.origin.name,
            remedy="check their lengths",
        ) from None


def _angle_mask(time: np.ndarray, angle: np.ndarray | None, hold: float) -> Bool[np.ndarray, "time cable"] | None:
    fits = angle is not None and len(np.shape(angle)) == 2 and len(angle) == len(time) > 1  # else checked later
    return new_readings(np.asarray(time), np.asarray(angle), hold) if hold > 0.0 and fits else None


def _missing(
    tension_mask: np.ndarray | None,
    angle_mask: np.ndarray | None,
    pose: np.ndarray | None,
    orientation: np.ndarray | None,
) -> dict[str, dict[str, int]]:
    counts = {
        "tensions": 0 if tension_mask is None else int((~tension_mask).sum()),
        "motor angles": 0 if angle_mask is None else int((~angle_mask).sum()),
        "poses of the object": 0 if pose is None else int((~np.isfinite(pose).all(axis=-1)).sum()),
        "orientations": 0 if orientation is None else int((~np.isfinite(orientation).all(axis=-1)).sum()),
    }
    missing = {kind: count for kind, count in counts.items() if count}
    return {MISSING: missing} if missing else {}


def continuous_quaternions(pose: Float[np.ndarray, "time 7"]) -> Float[np.ndarray, "time 7"]:
    """Poses whose quaternion keeps its sign from one that is known to the next, the first with w >= 0.

    The quaternions q and -q are the same rotation; rows without a pose are left as they are.
    """
    pose = np.array(pose, dtype=float)
    known = np.flatnonzero(np.isfinite(pose[:, 3:]).all(axis=1))
    seen = pose[known, 3:]
    turn = np.where((seen[1:] * seen[:-1]).sum(axis=1) < 0.0, -1.0, 1.0)
    first = -1.0 if len(seen) and seen[0, 3] < 0.0 else 1.0
    pose[known, 3:] *= first * np.concatenate([[1.0], np.cumprod(turn)])[:, None][: len(known)]
    return pose
