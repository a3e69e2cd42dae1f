"""Conditions on every trajectory, from any file."""

from __future__ import annotations

import json

import numpy as np
import xarray as xr

from rfdropo_bayes.data.sample_times import check_times
from rfdropo_bayes.errors import InputError

DIMS: dict[str, tuple[str, ...]] = {
    "position": ("time", "marker", "axis"),
    "position_mask": ("time", "marker"),
    "command": ("command_time", "cable"),
    "initial_command": ("cable",),
    "tension": ("time", "cable"),
    "tension_mask": ("time", "cable"),
    "motor_angle": ("time", "cable"),
    "motor_angle_mask": ("time", "cable"),
    "object_pose": ("time", "pose"),
    "orientation": ("time", "section", "quaternion"),
}
GAPPED = frozenset({"object_pose", "orientation"})  # quantities that may be missing in a row
MASKS = frozenset({"position_mask", "tension_mask", "motor_angle_mask"})
_LARGEST_EXTENT = 5.0  # [m]: no soft robot on a bench sweeps more; millimetres taken for metres always do
_SMALLEST_EXTENT = 1e-3  # [m]: several markers on one robot are never this close; metres taken for millimetres are
_UNLIMITED = {"N": np.inf, "N m": np.inf, "Pa": np.inf, "-": np.inf}
_LARGEST_COMMAND = {"m": 5.0, "rad": 20.0} | _UNLIMITED  # unclipped cumulative commands stay below in the right unit
LARGEST = "largest_command"  # among the settings of a recording: in its unit, of drives that go farther than most
_LARGEST_COMMAND_STEP = {"m": 0.5, "rad": 20.0} | _UNLIMITED


def check_dataset(dataset: xr.Dataset) -> None:
    """Raise an InputError on wrong shapes, times, values that are not finite, or implausible units."""
    name = str(dataset.attrs.get("name", "recording"))
    for key, dims in DIMS.items():
        if key in dataset and dataset[key].dims != dims:
            raise InputError(f"{key} has dimensions {dataset[key].dims}, not {dims}", where=name)
    if dataset.sizes["axis"] != 3:
        raise InputError(f"positions have {dataset.sizes['axis']} coordinates", where=name, remedy="give x, y and z")
    if dataset.sizes["time"] < 2 or dataset.sizes["command_time"] < 1:
        raise InputError(
            f"has {dataset.sizes['time']} observation and {dataset.sizes['command_time']} command rows",
            where=name,
            remedy="at least 2 and 1 are needed",
        )
    for key in ("marker", "cable"):
        names = [str(value) for value in dataset[key].values]
        if len(set(names)) != len(names):
            raise InputError(f"{key} names are not unique: {', '.join(names)}", where=name, remedy="rename them")
    for key in ("time", "command_time"):
        check_times(dataset[key].values, name, key)
    _check_finite(dataset, name)
    _check_lengths(dataset, name)
    _check_commands(dataset, name)
    if "object_pose" in dataset:
        _check_turns(dataset["object_pose"].values[:, 3:], "the quaternion of the object", name)
    if "orientation" in dataset:
        for k, section in enumerate(dataset["section"].values):
            _check_turns(dataset["orientation"].values[:, k], f"the quaternion of the section {section}", name)


def _check_turns(turn: np.ndarray, what: str, name: str) -> None:
    """Raise an InputError if quaternions are not of unit length."""
    norm = np.linalg.norm(turn, axis=1)
    norm = np.where(np.isfinite(norm), norm, 1.0)
    if np.any(np.abs(norm - 1.0) > 1e-2):
        row = int(np.argmax(np.abs(norm - 1.0)))
        remedy = "give a unit quaternion as x, y, z, w"
        raise InputError(f"{what} has norm {norm[row]:.3g}", where=f"{name}, row {row}", remedy=remedy)


def check_pose(pose: np.ndarray | None, rows: int, name: str) -> None:
    """Raise an InputError if the poses of an object are not seven numbers a row."""
    if pose is not None and np.shape(pose) != (rows, 7):
        raise InputError(
            f"poses of the object have the shape {np.shape(pose)}, not ({rows}, 7)",
            where=name,
            remedy="give x, y, z and the quaternion x, y, z, w in every row",
        )


def _check_finite(dataset: xr.Dataset, name: str) -> None:
    for key in DIMS:
        if key in dataset and key not in GAPPED:
            bad = ~np.isfinite(dataset[key].values.astype(float))
            if bad.any():
                index = np.argwhere(bad)[0]
                place = ", ".join(f"{dim} {dataset[dim].values[i]}" for dim, i in zip(DIMS[key], index, strict=True))
                raise InputError(
                    f"{key} is NaN or infinite ({int(bad.sum())} values)",
                    where=f"{name}, {place}",
                    remedy="repair the recording",
                )


def _check_lengths(dataset: xr.Dataset, name: str) -> None:
    position = dataset["position"].values[dataset["position_mask"].values.astype(bool)]
    if position.size == 0:
        if json.loads(str(dataset.attrs["settings"])).get("unseen"):
            return
        remedy = "look at time_unit and position_unit: in wrong units all positions seem to jump"
        raise InputError("every position is masked", where=name, remedy=remedy)
    extent = float(np.ptp(position, axis=0).max())
    if extent > _LARGEST_EXTENT:
        raise InputError(
            f"the positions span {extent:.4g} m",
            where=name,
            remedy="they look like millimetres given as metres: state the unit the file is in",
        )
    seen = int(dataset["position_mask"].values.any(axis=0).sum())
    size = extent if seen > 1 else float(np.abs(position).max())  # one marker may stand still
    if size < _SMALLEST_EXTENT:
        raise InputError(
            f"the positions span {extent * 1e3:.3g} mm in all",
            where=name,
            remedy="they look like metres given as millimetres: state the unit the file is in",
        )


def _check_commands(dataset: xr.Dataset, name: str) -> None:
    unit = dataset["command"].attrs.get("unit")
    if unit not in _LARGEST_COMMAND:
        raise InputError(f"command unit {unit!r} is unknown", where=name, remedy="use one of m, rad, N, N m, -")
    command = np.concatenate([dataset["initial_command"].values[None], dataset["command"].values])
    largest = float(np.abs(command).max())
    step = float(np.abs(np.diff(command, axis=0)).max())
    stated = float(json.loads(str(dataset.attrs.get("settings", "{}"))).get(LARGEST, 0.0))
    if largest > max(_LARGEST_COMMAND[unit], stated) or step > max(_LARGEST_COMMAND_STEP[unit], stated):
        other = "millimetres given as metres" if unit == "m" else "degrees given as radians"
        raise InputError(
            f"commands reach {largest:.4g} {unit} with steps of {step:.4g} {unit}",
            where=name,
            remedy=f"they look like {other}: state the unit the file is in; if drives really travel this far, as "
            "a winch or lead screw does, also state largest_command",
        )
