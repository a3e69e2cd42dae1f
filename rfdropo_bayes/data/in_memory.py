"""Recordings from objects in memory: arrays, a table of pandas, a data set of xarray; units are converted here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Float

from rfdropo_bayes.data.command_notes import command_notes
from rfdropo_bayes.data.faults import fill_missing, find_faults
from rfdropo_bayes.data.first_command import MEMORY, Rule
from rfdropo_bayes.data.named_columns import COMMAND_UNITS, METRES, CsvColumns, read_frame
from rfdropo_bayes.data.recorded import AXES, Measured, Origin, Recorded, SentCommands
from rfdropo_bayes.data.sample_times import PER_SECOND, check_times, read_stamps, rounded_notes
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.tables import nearest, parse_table


def from_arrays(
    *,
    time: Float[Any, " time"],
    position: Float[Any, "time marker 3"],
    command: Float[Any, "command channel"],
    markers: Sequence[str],
    channels: Sequence[str],
    command_time: Float[Any, " command"] | None = None,
    time_unit: str = "s",
    position_unit: str = "m",
    command_unit: str = "m",
    largest_command: float | None = None,
    tension: Float[Any, "time channel"] | None = None,
    motor_angle: Float[Any, "time channel"] | None = None,
    object_pose: Float[Any, "time 7"] | None = None,
    orientation: Float[Any, "time section 4"] | None = None,
    sections: Sequence[str] = (),
    name: str = "recording",
    robot: str = "",
) -> Recorded:
    """A recording from arrays that begins with its first command; `Trajectory.from_arrays` is the way in.

    Args:
        time: times of the observations, in ``time_unit``, or dates or durations of any type.
        position: positions of the markers, in the robot's base frame: x, y across, z along the axis away from the base.
            NaN positions are masked and counted.
        command: cumulative commands, pull > 0, each in force until the next.
        markers, channels: their names, in the order of the arrays.
        command_time: start time of each command, on the clock of ``time``; the first times of the observations by
            default.
        time_unit: "s", "ms", "us" or "ns".
        position_unit: "m", "cm" or "mm"; also of ``object_pose``.
        command_unit: "m", "cm" or "mm" of cable, "rad" or "deg" of a motor, "N", "N m",
            "Pa", "kPa", "MPa", "mbar", "bar", "psi", or "-".
        largest_command: largest plausible command, in ``command_unit``, for drives that travel more than 20 rad or 5 m.
        tension: cable tensions [N]; NaN if missing.
        motor_angle: motor angles [rad]; NaN if missing.
        object_pose: centre and unit quaternion x, y, z, w of a pushed body.
        orientation: orientations of sections, unit quaternions x, y, z, w from the base's axes to the section's, which
            are the same in the undeformed body; NaN if missing.
        sections: names of these sections.
        name: name of the recording; robot: name of the recorded robot.

    Raises:
        InputError: an unknown unit, values that are not numbers, shapes that do not fit, times that do not increase, or
            lengths that cannot be in the unit that was given.
    """
    metres, (unit, factor) = _unit(position_unit, METRES, name), _unit(command_unit, COMMAND_UNITS, name)
    begins = read_stamps(time, _known(time_unit, PER_SECOND, name), where=name)
    clock = begins.since(begins, name)
    rows: dict[str, int | None] = {"times": len(clock)}
    width: dict[str, int | None] = {"channels": len(channels)}
    place = metres * _numbers(position, "positions", rows | {"markers": len(markers), "": 3}, name)
    sent = factor * _numbers(command, "commands", {"times": None} | width, name)
    stamps = clock[: len(sent)]
    if command_time is not None:
        stamps = read_stamps(command_time, time_unit, where=name, column="command_time").since(begins, name)
        check_times(stamps, name, "command_time")
    if len(sent) != len(stamps) or not len(sent):
        wanted = f"({len(stamps)} times, {len(channels)} channels)"
        raise InputError(f"commands have the shape {sent.shape}, and not {wanted}", where=name)
    of_rows = sent if len(sent) == len(clock) and command_time is None else None
    faults = find_faults(clock, place, command=of_rows, where=name, names=markers)
    notes = [
        *faults.notes,
        *rounded_notes(begins, clock),
        *(() if command_time is None else command_notes(stamps, sent)),
    ]
    faults = faults._replace(notes=notes)
    pose = None
    if object_pose is not None:
        pose = _numbers(object_pose, "poses", rows | {"": 7}, name) * np.repeat([metres, 1.0], [3, 4])
    return Recorded(
        Origin(name, robot, MEMORY, settings=faults.settings),
        SentCommands(
            stamps, sent, unit, channels, sent[0], None if largest_command is None else factor * largest_command
        ),
        Measured(
            clock,
            fill_missing(clock, place),
            markers,
            faults.mask,
            tension=None if tension is None else _numbers(tension, "tensions", rows | width, name),
            motor_angle=None if motor_angle is None else _numbers(motor_angle, "motor angles", rows | width, name),
            object_pose=pose,
            orientation=None
            if orientation is None
            else _numbers(orientation, "orientations", rows | {"sections": len(sections), "": 4}, name),
            section_names=sections,
        ),
    )


def from_pandas(frame: Any, columns: CsvColumns | Mapping[str, Any], name: str, mask_missing: bool) -> Recorded:
    """A recording from a table; see `Trajectory.from_pandas`."""
    frame = _table(frame, name)
    if not isinstance(columns, CsvColumns):
        columns = parse_table(CsvColumns, _as_lists(columns), where="columns")
    return read_frame(frame, columns, name, mask_missing=mask_missing)


def _table(frame: Any, name: str) -> pd.DataFrame:
    """A table of pandas from one of pandas, Polars or PyArrow.

    Raises:
        InputError: something else.
    """
    if isinstance(frame, pd.DataFrame):
        return frame
    for convert in ("collect", "to_pandas"):  # a lazy table of Polars is computed first
        if hasattr(frame, convert):
            try:
                frame = getattr(frame, convert)()
            except ImportError as error:
                raise InputError(f"{error}", where=name, remedy="pip install pyarrow") from None
    if isinstance(frame, pd.DataFrame):
        return frame
    raise InputError(
        f"a {type(frame).__name__} is not a table",
        where=name,
        remedy=("give a DataFrame of pandas, or a table that has to_pandas(), as tables of Polars and PyArrow have"),
    )


def labelled_arrays(dataset: xr.Dataset, name: str) -> dict[str, Any]:
    """Arguments of `Trajectory.from_arrays` in a labelled data set; see `Trajectory.from_xarray`.

    Raises:
        InputError: a missing variable, other dimensions or axes, or an unknown unit.
    """
    channel = "cable" if "cable" in dataset.dims else "channel"
    for key in ("position", "command", "marker", channel, "time"):
        if key not in dataset.variables:
            raise InputError(f"has no {key}", where=name, remedy="see Trajectory.from_xarray for the names")
    clock = "command_time" if "command_time" in dataset["command"].dims else "time"
    if list(dataset.indexes.get("axis", AXES)) != list(AXES):
        raise InputError("the coordinates of axis are not x, y, z", where=name)
    dims = {"position": ("time", "marker", "axis"), "command": (clock, channel), "initial_command": (channel,)}
    dims |= {"tension": ("time", channel), "motor_angle": ("time", channel), "object_pose": ("time", "pose")}
    dims |= {"orientation": ("time", "section", "quaternion")}
    known = {key: wanted for key, wanted in dims.items() if key in dataset}
    for key, wanted in known.items():
        if set(dataset[key].dims) != set(wanted):
            raise InputError(f"{key} has the dimensions {dataset[key].dims}, and not {wanted}", where=name)
    arrays: dict[str, Any] = {key: dataset[key].transpose(*wanted).values for key, wanted in known.items()}
    arrays |= {"time": dataset["time"].values, "command_time": dataset[clock].values[: len(arrays["command"])]}
    stated = {key: str(dataset[key].attrs.get("units", unit)) for key, unit in _UNITS.items()}
    own = {key: dataset[clock if key == "command_time" else key].attrs.get("units") for key in arrays}
    for key, (unit, sizes) in _further_units(stated, name).items():
        if own.get(key, unit) not in (None, unit):
            arrays[key] = _rescaled(key, arrays[key], _unit(str(own[key]), sizes, f"{name}, {key}") / sizes[unit])
    if "orientation" in arrays:
        arrays["sections"] = [str(section) for section in dataset["section"].values]
    return arrays | {
        "markers": [str(marker) for marker in dataset["marker"].values],
        "channels": [str(value) for value in dataset[channel].values],
        **{f"{key}_unit": unit for key, unit in stated.items()},
    }


_UNITS = {"position": "m", "command": "m", "time": "s"}  # units of a data set's variables if they state none


def _further_units(stated: Mapping[str, str], where: str) -> dict[str, tuple[str, dict[str, float]]]:
    """In which unit `from_arrays` takes each further variable, and the sizes of the units that it may be in."""
    kind, _ = _unit(stated["command"], COMMAND_UNITS, where)
    commands = {unit: factor for unit, (own, factor) in COMMAND_UNITS.items() if own == kind}
    times = {unit: 1.0 / count for unit, count in PER_SECOND.items()}
    for key, known in (("position", METRES), ("time", PER_SECOND)):
        _known(stated[key], known, where)
    return {
        "command_time": (stated["time"], times),
        "initial_command": (stated["command"], commands),
        "tension": ("N", {"N": 1.0}),
        "motor_angle": ("rad", {unit: COMMAND_UNITS[unit][1] for unit in ("rad", "deg")}),
        "object_pose": (stated["position"], METRES),
    }


def _rescaled(key: str, values: np.ndarray, factor: float) -> np.ndarray:
    """Values in another unit; of a pose the centre alone has one."""
    return values * np.repeat([factor, 1.0], [3, 4]) if key == "object_pose" else values * factor


def beginning(rule: str | None, where: str) -> Rule | None:
    """The named rule for the command before the first row; None to recognise it; InputError for other names."""
    rules: dict[str | None, Rule | None] = {None: None, "first": "first", "zero": "zero"}
    if rule not in rules:
        remedy = 'give "first", "zero", or one value per channel'
        raise InputError(f"initial_command is {rule!r}", where=where, remedy=remedy)
    return rules[rule]


def initial_command(values: Any, unit: str, channels: int, where: str) -> Float[np.ndarray, " channel"]:
    """Values of the command before the first row [m or rad] from values in ``unit``."""
    return COMMAND_UNITS[unit][1] * _numbers(values, "initial commands", {"channels": channels}, where)


def _unit(unit: str, known: Mapping[str, Any], where: str) -> Any:
    return known[_known(unit, known, where)]


def _known(unit: str, known: Mapping[str, Any], where: str) -> str:
    if unit not in known:
        raise InputError(f"unknown unit {unit!r}", where=where, remedy=nearest(unit, known))
    return unit


def _numbers(values: Any, what: str, sizes: Mapping[str, int | None], where: str) -> np.ndarray:
    """Values as floats, NaN if missing, with one axis per entry of ``sizes``; a size of None allows any."""
    try:
        array = np.ma.filled(np.ma.asarray(values).astype(float), np.nan)
    except (TypeError, ValueError):  # None and pd.NA among others, or text
        cells = np.asarray(values, dtype=object)
        try:
            flat = pd.to_numeric(pd.Series(cells.ravel()))
        except (TypeError, ValueError) as error:
            raise InputError(f"{what} are not all numbers ({error})", where=where, remedy="convert them") from None
        array = flat.to_numpy(dtype=float, na_value=np.nan).reshape(cells.shape)
    wanted = tuple(length if size is None else size for size, length in zip(sizes.values(), array.shape, strict=False))
    if array.ndim != len(sizes) or array.shape != wanted:
        words = ", ".join(f"{'' if size is None else size} {name}".strip() for name, size in sizes.items())
        raise InputError(f"{what} have the shape {array.shape}, and not ({words})", where=where)
    return array


def _as_lists(columns: Mapping[str, Any]) -> dict[str, Any]:
    return {key: list(value) if isinstance(value, tuple) and key != "axes" else value for key, value in columns.items()}
