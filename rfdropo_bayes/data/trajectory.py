"""The type of all measured or simulated motion in the program."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from rfdropo_bayes.data import checks, in_memory
from rfdropo_bayes.data.faults import NOTES
from rfdropo_bayes.data.first_command import begun_from
from rfdropo_bayes.data.named_columns import UNTIMED, CsvColumns
from rfdropo_bayes.data.recorded import (
    FIRST_COMMAND,
    MISSING,
    SCHEMA,
    Measured,
    Origin,
    Recorded,
    SentCommands,
    assembled,
    continuous_quaternions,
)
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import whole
from rfdropo_bayes.signatures import see_keywords, with_keywords_of

_HASHED = ("time", "command_time", "position", "position_mask", "command", "initial_command")
_OPTIONAL = ("tension", "tension_mask", "motor_angle", "motor_angle_mask", "object_pose", "orientation")


@dataclass(frozen=True, repr=False)
class Trajectory:
    """One recording: commands, observations and their times.

    ``dataset`` holds, in SI units and in the robot's base frame (x, y across, z along the axis, away from the base):

    - ``position(time, marker, axis)`` [m] and ``position_mask(time, marker)``: False for a recording fault; the value
      there is a finite placeholder that no likelihood may use;
    - ``command(command_time, cable)``, unit in its attribute ("m" or "rad"): cumulative command, pull > 0, unclipped,
      piecewise constant. Row k is in force from ``command_time[k]`` until the next row's time, the last forever;
    - ``initial_command(cable)``: command before ``command_time[0]``, hence the initial state of the recording;
    - optionally ``tension(time, cable)`` [N] and its ``tension_mask``, False for a missing tension; ``motor_angle(time,
      cable)`` [rad] and its ``motor_angle_mask``, False for a missing or repeated reading; ``object_pose(time, pose)``
      (x y z [m], unit quaternion x y z w; NaN if missing); ``orientation(time, section, quaternion)``, unit quaternions
      x y z w from the base's axes to a section's axes.

    ``time`` is in seconds from the first observation row. ``command_time`` shares that clock.

    Raises:
        InputError: on shapes that do not fit, times that do not increase, values that are not finite, or lengths that
            cannot be in metres.
    """

    dataset: xr.Dataset

    def __post_init__(self) -> None:
        checks.check_dataset(self.dataset)
        object.__setattr__(self, "dataset", self.dataset.assign_attrs(sha256=_digest(self.dataset)))

    @classmethod
    def build(cls, origin: Origin, sent: SentCommands, measured: Measured) -> Trajectory:
        """Assemble and check a recording, see the records for meanings and shapes.

        Times are shifted so that the first observation is at 0. Tensions, motor angles and poses that are not a number
        are missing: they are left out and counted.
        """
        return cls(assembled(Recorded(origin, sent, measured)))

    @classmethod
    @with_keywords_of(in_memory.from_arrays)
    def from_arrays(cls, *, initial_command: Any = None, **given: Any) -> Trajectory:
        """A recording from arrays in any unit.

        Args:
            initial_command: command before the first command, in the same unit: "first" (the first command was already
                in force), "zero", or one value per channel; recognised from motor angles or the first rows by default,
                as in files (`first_command`).
            given: ``time`` (time,), numbers in ``time_unit`` ("s", "ms", "us", "ns") or dates; ``position`` (time,
                marker, 3) in ``position_unit`` ("m", "cm", "mm"), in the frame of the robot's base, z along the axis
                away from the clamp, lost positions as NaN; ``command`` (command, channel) in ``command_unit`` ("m",
                "cm", "mm" of cable, "rad", "deg" of a motor, "N", "N m", "Pa", "-"), cumulative, pull > 0, each in
                force until the next; ``markers`` and ``channels``, their names. These five are required.
                ``command_time``: start time of each command, on the clock of ``time``; ``largest_command``: largest
                plausible command of drives of many turns. ``tension`` (time, channel) [N], ``motor_angle`` (time,
                channel) [rad], ``object_pose`` (time, 7): centre and unit quaternion x, y, z, w. ``orientation`` (time,
                section, 4), unit quaternions x, y, z, w, and ``sections``, their names. ``name`` of the recording;
                ``robot``: name of the recorded robot.

        Raises:
            InputError: an unknown or missing keyword, an unknown unit, values that are not numbers, shapes that do not
                fit, times that do not increase, or lengths that cannot be in the unit that was given.
        """
        see_keywords(given, in_memory.from_arrays, "Trajectory.from_arrays")
        recording = cls.build(*in_memory.from_arrays(**given))
        if not (initial_command is None or isinstance(initial_command, str)):
            unit, channels = given.get("command_unit", "m"), len(recording.cable_names)
            value = in_memory.initial_command(initial_command, unit, channels, recording.name)
            return recording.with_initial_command(value, {"rule": "given", "why": "initial_command"})
        return begun_from(recording, in_memory.beginning(initial_command, recording.name))

    @classmethod
    def from_pandas(
        cls, frame: Any, columns: CsvColumns | Mapping[str, Any], name: str = "recording", *, mask_missing: bool = True
    ) -> Trajectory:
        """A recording from a table.

        Args:
            frame: a table of pandas, Polars or PyArrow, one row per observation.
            columns: meaning of each column, as in an experiment file's [data.columns]; see `CsvColumns`. The index is a
                column under its name, or "index".
            name: name of the recording.
            mask_missing: mask and count NaN positions; otherwise they are an error.

        Raises:
            InputError: a missing or non-numeric column, or columns that do not fit together.
        """
        return begun_from(cls.build(*in_memory.from_pandas(frame, columns, name, mask_missing)), None)

    @classmethod
    def from_xarray(cls, dataset: xr.Dataset, name: str = "recording", *, robot: str = "") -> Trajectory:
        """A recording from a data set with ``position(time, marker, axis)`` and ``command(time, channel)``.

        Dimensions may be in any order; ``command`` may have its own clock, ``command_time``. Markers and channels
        are named by their coordinates, units stand in the variables' attribute ``units`` ("m" if missing, and "s" of
        ``time``, which may hold dates). Further variables are ``initial_command``, ``tension`` [N], ``motor_angle``
        [rad] and ``object_pose``; their own units, and the unit of ``command_time``, count if stated.

        Raises:
            InputError: a variable, dimension or coordinate that is missing, or see `from_arrays`.
        """
        if "schema" in dataset.attrs:  # one of ours
            return cls(dataset)
        return cls.from_arrays(name=name, robot=robot, **in_memory.labelled_arrays(dataset, name))

    def __repr__(self) -> str:
        rows, last = len(self.time), float(self.time[-1])
        channels = f"{len(self.cable_names)} commands [{self.command_unit}]: {', '.join(self.cable_names)}"
        masked = int((~self.position_mask).sum())
        out = f"; {masked} of {self.position_mask.size} positions left out" if masked else ""
        markers = f"markers {', '.join(self.marker_names)}"
        return f"<Trajectory {self.name}: {rows} rows over {last:.4g} s; {markers}; {channels}{out}>"

    def _repr_html_(self) -> str:
        return f"<p>{escape(repr(self)[1:-1])}</p>{self.dataset._repr_html_()}"

    @property
    def name(self) -> str:
        """Name of this recording in reports."""
        return str(self.dataset.attrs["name"])

    @property
    def robot(self) -> str:
        """Name of the robot that was recorded; empty if the file does not name it."""
        return str(self.dataset.attrs["robot"])

    @property
    def time(self) -> Float[np.ndarray, " time"]:
        """Times of the observations [s], the first is 0."""
        return self._array("time")

    @property
    def command_time(self) -> Float[np.ndarray, " command_time"]:
        """Times from which each command row is in force [s], same clock as ``time``."""
        return self._array("command_time")

    @property
    def command(self) -> Float[np.ndarray, "command_time cable"]:
        """Cumulative command, pull > 0, unclipped, in ``command_unit``."""
        return self._array("command")

    @property
    def initial_command(self) -> Float[np.ndarray, " cable"]:
        """Command in force before ``command_time[0]``: the recording starts in its equilibrium."""
        return self._array("initial_command")

    @property
    def command_unit(self) -> str:
        """``"m"`` (cable displacement), ``"rad"`` (motor angle), ``"N"``, ``"N m"``, ``"Pa"`` or ``"-"``."""
        return str(self.dataset["command"].attrs["unit"])

    @property
    def position(self) -> Float[np.ndarray, "time marker 3"]:
        """Marker positions in the base frame [m]."""
        return self._array("position")

    @property
    def position_mask(self) -> Bool[np.ndarray, "time marker"]:
        """True for usable positions."""
        return self._array("position_mask")

    @property
    def tension(self) -> Float[np.ndarray, "time cable"] | None:
        """Cable tensions [N], if measured."""
        return self._array("tension") if "tension" in self.dataset else None

    @property
    def motor_angle(self) -> Float[np.ndarray, "time cable"] | None:
        """Measured motor angles [rad], if measured."""
        return self._array("motor_angle") if "motor_angle" in self.dataset else None

    @property
    def motor_angle_mask(self) -> Bool[np.ndarray, "time cable"] | None:
        """True for new readings of the motor angles; None if they were not measured."""
        return self._array("motor_angle_mask") if "motor_angle_mask" in self.dataset else None

    @property
    def object_pose(self) -> Float[np.ndarray, "time 7"] | None:
        """Pose of the manipulated object (x y z [m], quaternion x y z w), if there is one."""
        return self._array("object_pose") if "object_pose" in self.dataset else None

    @property
    def orientation(self) -> Float[np.ndarray, "time section 4"] | None:
        """Orientations of sections, unit quaternions x y z w from the base's axes to the section's, if measured."""
        return self._array("orientation") if "orientation" in self.dataset else None

    @property
    def section_names(self) -> tuple[str, ...]:
        """Names of the sections whose orientation was measured."""
        return tuple(str(name) for name in self.dataset["section"].values) if "section" in self.dataset else ()

    @property
    def tension_mask(self) -> Bool[np.ndarray, "time cable"] | None:
        """True for measured tensions; None without tensions."""
        if "tension_mask" in self.dataset:
            return self._array("tension_mask")
        return np.ones(self.dataset["tension"].shape, dtype=bool) if "tension" in self.dataset else None

    @property
    def unsent(self) -> bool:
        """Whether no drive has carried the commands out: a session in the shadow."""
        return self.settings.get("mode") == "shadow"

    @property
    def left_out(self) -> str:
        """Masked parts of this recording, faulty or missing, in words; empty if nothing is."""
        faults = self.settings.get("faults", {})
        counts = {"held poses": "held", "jumps": "jump", "lost markers": "missing"}
        counts |= {"lost markers at zero": "zero", "positions under other markers' names": "renamed"}
        parts = [f"{sum(faults[kind])} {name}" for name, kind in counts.items() if sum(faults.get(kind, ()))]
        return ", ".join([*parts, self.missing] if self.missing else parts)

    @property
    def notes(self) -> list[str]:
        """The importer's notes on valid but suspicious rows of the file, each with a remedy."""
        return list(self.settings.get(NOTES, ()))

    @property
    def timed(self) -> bool:
        """Whether rows have times of their own; without them one a second is assumed."""
        return UNTIMED not in self.notes

    @property
    def missing(self) -> str:
        """Numbers of missing tensions, motor angles and poses of an object, in words; empty if none is."""
        return ", ".join(f"{count} missing {kind}" for kind, count in self.settings.get(MISSING, {}).items())

    @property
    def marker_names(self) -> tuple[str, ...]:
        """Names of the markers, base to tip."""
        return tuple(str(name) for name in self.dataset["marker"].values)

    @property
    def cable_names(self) -> tuple[str, ...]:
        """Names of the command channels."""
        return tuple(str(name) for name in self.dataset["cable"].values)

    @property
    def sha256(self) -> str:
        """Hash of the content (numbers and names, not provenance)."""
        return str(self.dataset.attrs["sha256"])

    @property
    def synthetic(self) -> bool:
        """True if a simulator made it."""
        return bool(self.dataset.attrs["synthetic"])

    @property
    def settings(self) -> dict[str, Any]:
        """Facts about the recording, as the importer knew them."""
        return dict(json.loads(str(self.dataset.attrs["settings"])))

    @property
    def first_command(self) -> str:
        """Which command was in force before the first row, and how that is known."""
        known = self.settings.get(FIRST_COMMAND, {"why": "as the file has it"})
        if not np.any(self.initial_command):
            return f"zero ({known['why']})"
        shown = ", ".join(f"{value:.3g}" for value in self.initial_command)
        return f"{shown} {self.command_unit} ({known['why']})"

    def _array(self, name: str) -> np.ndarray:
        values = self.dataset[name].values.view()
        values.flags.writeable = False
        return values

    def command_at(self, time: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n cable"]:
        """Command in force at each time [s], a new row counting from its own instant on (zero-order hold)."""
        row = np.searchsorted(self.command_time, np.asarray(time) + _INSTANT, side="right") - 1
        return np.concatenate([self.initial_command[None], self.command])[row + 1]

    def with_attributes(self, **attributes: Any) -> Trajectory:
        """Same content under other attributes (``name``, ``provenance``, ...); ``settings`` are merged."""
        settings = self.settings | attributes.pop("settings", {})
        return Trajectory(self.dataset.assign_attrs(settings=json.dumps(settings, sort_keys=True), **attributes))

    def with_initial_command(self, initial: Float[np.ndarray, " cable"], beginning: Mapping[str, str]) -> Trajectory:
        """Same content with another command before ``command_time[0]``, and how that is known (`first_command`)."""
        dataset = self.dataset.assign(initial_command=(checks.DIMS["initial_command"], np.array(initial, dtype=float)))
        return Trajectory(dataset).with_attributes(settings={FIRST_COMMAND: dict(beginning)})

    def slice_rows(self, first: int, last: int, lead_in: float = 0.0) -> Trajectory:
        """Observation rows ``first`` to ``last``, both included, with the clock set back to 0 at ``first``.

        The commands kept begin before time[last], and at most ``lead_in`` seconds before time[first]: motion of drives
        and body in the first row began earlier. ``initial_command`` becomes the last command before these.

        Raises:
            InputError: the rows do not exist.
        """
        rows = self.time.size
        if not 0 <= first < last < rows:
            raise InputError(
                f"rows [{first}, {last}] are out of range",
                where=self.name,
                remedy=f"choose 0 <= first < last <= {rows - 1} (rows of the observations, both included)",
            )
        start, end = self.time[first], self.time[last]
        before = self.command_time < start - lead_in - _INSTANT
        kept = ~before & (self.command_time < end - _INSTANT)
        history = np.concatenate([self.initial_command[None], self.command[before]])
        dataset = self.dataset.isel(time=slice(first, last + 1))
        if kept.any():
            dataset = dataset.isel(command_time=np.flatnonzero(kept))
        else:
            dataset = dataset.isel(command_time=[0])
            dataset["command"] = dataset["command"].copy(data=history[-1:])
            dataset = dataset.assign_coords(command_time=[start])
        dataset["initial_command"] = dataset["initial_command"].copy(data=history[-1])
        dataset = dataset.assign_coords(time=dataset.time - start, command_time=dataset.command_time - start)
        piece = Trajectory(dataset.assign_attrs(name=f"{self.name}[{first}:{last}]"))
        if not before.any():
            return piece
        earlier = f"{lead_in:g} s " if lead_in > 0.0 else ""
        why = f"in force {earlier}before row {first}"
        return piece.with_attributes(settings={FIRST_COMMAND: {"rule": "given", "why": why}})

    def thin(self, every: int, timed: bool = True) -> Trajectory:
        """Each ``every``-th observation row, from the first; commands stay. Without ``timed``, rows have no times of
        their own: kept rows follow each other as all rows did.
        """
        dataset = self.dataset.isel(time=slice(None, None, every)).assign_attrs(name=f"{self.name}[::{every}]")
        if not timed:
            clocks = {"time": dataset.time / every, "command_time": dataset.command_time / every}
            dataset = dataset.assign_coords(clocks)
        return Trajectory(dataset)

    def resample(self, sample_time: float) -> Trajectory:
        """Observations on the grid 0, sample_time, 2 sample_time, ... [s] by linear interpolation (quaternions: slerp).

        Commands are events and are unchanged. A resampled value is masked if one of its source rows is masked. Nothing
        is
        filtered: resampling to a coarser grid picks rows, and their noise stays independent.

        Raises:
            InputError: if the sample time is not positive, longer than the recording, or far below the recording's own.
        """
        duration = float(self.time[-1])
        if not (np.isfinite(sample_time) and 0.0 < sample_time <= duration):
            raise InputError(
                f"cannot resample to every {sample_time} s",
                where=self.name,
                remedy=f"choose 0 < resample <= {duration:g} s, the length of the recording",
            )
        if duration / sample_time > FINEST * self.time.size:
            raise InputError(
                f"every {sample_time:g} s would be {duration / sample_time:.3g} rows of {self.time.size} over "
                f"{duration:.4g} s",
                where=self.name,
                remedy="correct resample, or the unit of the times ([data.columns] time_unit)",
            )
        grid = sample_time * np.arange(int(np.floor(duration / sample_time + 1e-9)) + 1)
        before, weight = _brackets(self.time, grid)
        after = np.minimum(before + 1, self.time.size - 1)
        data: dict[str, Any] = {}
        for key in ("position", "tension", "motor_angle", "object_pose"):
            if key in self.dataset:
                values = self.dataset[key].values
                share = weight.reshape((-1,) + (1,) * (values.ndim - 1))
                data[key] = (self.dataset[key].dims, (1.0 - share) * values[before] + share * values[after])
        if "object_pose" in data:
            data["object_pose"][1][:, 3:] = _slerp(self.dataset["object_pose"].values[:, 3:], before, after, weight)
        if "orientation" in self.dataset:
            turns = self.dataset["orientation"].values
            resampled = [_slerp(turns[:, k], before, after, weight) for k in range(turns.shape[1])]
            data["orientation"] = (self.dataset["orientation"].dims, np.stack(resampled, axis=1))
        for key in checks.MASKS & set(self.dataset.variables):
            mask = self.dataset[key].values
            usable = (mask[before] | (weight == 1.0)[:, None]) & (mask[after] | (weight == 0.0)[:, None])
            data[key] = (self.dataset[key].dims, usable)
        dataset = self.dataset.drop_dims("time").assign(data).assign_coords(time=grid)
        return Trajectory(dataset.assign_attrs(sample_time=float(sample_time)))

    def save(self, path: Path) -> None:
        """Write our NetCDF.

        Raises:
            InputError: if the file cannot be written.
        """
        with whole(path) as partial:
            self.dataset.to_netcdf(partial, engine="h5netcdf")

    @classmethod
    def load(cls, path: Path) -> Trajectory:
        """Read our NetCDF.

        Raises:
            InputError: if the file is missing, corrupt, written by something else, or its content does not match the
                hash stored in it.
        """
        dataset = open_netcdf(path)
        if dataset.attrs.get("schema") != SCHEMA:
            raise InputError(
                f"is a NetCDF file, but not a trajectory of ours (attribute schema = {SCHEMA!r} is missing)",
                where=str(path),
                remedy="convert it with Trajectory.build(...).save(path)",
            )
        missing = [key for key in (*_HASHED, "marker", "cable", "axis") if key not in dataset.variables]
        if missing:
            raise InputError(f"lacks the variable {missing[0]!r}", where=str(path), remedy="fetch it again")
        stored = dataset.attrs.get("sha256")
        for key in checks.MASKS & set(dataset.variables):
            dataset[key] = dataset[key].astype(bool)
        trajectory = cls(dataset)
        if stored != trajectory.sha256:
            raise InputError("its content does not match its hash", where=str(path), remedy="fetch it again")
        return trajectory


def open_netcdf(path: Path) -> xr.Dataset:
    """All of a NetCDF file.

    Raises:
        InputError: the file is missing or damaged.
    """
    if not Path(path).is_file():
        raise InputError("no such file", where=str(path), remedy="correct the path")
    try:
        with xr.open_dataset(path, engine="h5netcdf") as opened:
            return opened.load()
    except Exception as error:  # the HDF5 stack raises many types on damaged files, none of them ours
        raise InputError(
            f"is not a readable NetCDF file ({type(error).__name__})", where=str(path), remedy="fetch or make it again"
        ) from None


FINEST = 100.0  # rows of a new grid for one that was recorded: more are another unit of time
_INSTANT = 1e-9  # [s]: times that differ by less are the same instant


def _brackets(time: Float[np.ndarray, " rows"], grid: Float[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray]:
    """Row before each grid time and the weight of the row after it; exactly 0 or 1 on a row."""
    before = np.clip(np.searchsorted(time, grid, side="right") - 1, 0, time.size - 2)
    weight = (grid - time[before]) / (time[before + 1] - time[before])
    weight[np.abs(weight) < 1e-6] = 0.0
    weight[np.abs(weight - 1.0) < 1e-6] = 1.0
    return before, np.clip(weight, 0.0, 1.0)


def _slerp(quaternion: np.ndarray, before: np.ndarray, after: np.ndarray, weight: np.ndarray) -> np.ndarray:
    known = np.isfinite(quaternion[before]).all(axis=1) & np.isfinite(quaternion[after]).all(axis=1)
    start, end = Rotation.from_quat(quaternion[before[known]]), Rotation.from_quat(quaternion[after[known]])
    turn = (start.inv() * end).as_rotvec()
    between = np.full((len(before), 4), np.nan)
    between[known] = (start * Rotation.from_rotvec(weight[known, None] * turn)).as_quat()
    return continuous_quaternions(np.hstack([np.zeros((len(between), 3)), between]))[:, 3:]


def _digest(dataset: xr.Dataset) -> str:
    digest = hashlib.sha256()
    for key in (*_HASHED, *_OPTIONAL):
        if key in dataset.variables:
            values = np.ascontiguousarray(dataset[key].values)
            digest.update(f"{key}{values.shape}".encode())
            digest.update(values.astype("<f8").tobytes())
    for key in ("marker", "cable"):
        digest.update("\x1f".join(str(name) for name in dataset[key].values).encode())
    digest.update(str(dataset["command"].attrs.get("unit", "")).encode())
    return digest.hexdigest()
