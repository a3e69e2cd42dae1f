"""Commands whose outcome is to be predicted, with at most the first row of measurements.

All other measurements are masked here, so that no prediction can have seen it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from rfdropo_bayes.data import lerobot
from rfdropo_bayes.data.asl_csv import read_asl_start
from rfdropo_bayes.data.first_command import MEASURED, UNTOLD, angle_at_first, begun_from
from rfdropo_bayes.data.mapped_formats import FOLDERS, observed_table, recognised_format
from rfdropo_bayes.data.named_columns import FORMAT as CSV
from rfdropo_bayes.data.plain_csv import holds_commands_alone, read_csv_start
from rfdropo_bayes.data.spec import DataSpec, RecordingEntry, find_data_file, load_recordings
from rfdropo_bayes.data.trajectory import Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import find_files
from rfdropo_bayes.tables import changed


def load_unseen(
    spec: DataSpec,
    base: Path,
    commands: str,
    start: str | None = None,
    begun: str | None = None,
    episode: int | None = None,
) -> Trajectory:
    """The commands of a file in the format of an experiment, with the measurements that the file has.

    Formats that keep commands and observations in one file take the start pose from its first row. "asl-csv", and
    formats whose columns [data.columns] names with a CSV of commands alone, take it from the first row of ``start``, or
    begin at an unknown pose.

    Args:
        spec: the [data] table of the experiment; its recordings are not read.
        base: folder that paths are relative to.
        commands: the file of commands.
        start: file of observations, if separate; one row is used.
        begun: beginning of the fitted recordings, "zero" or "first" (`common_beginning`), if all begin by the same
            rule; it then applies to these commands unless [data] or the file has another.
        episode: number of the episode, if the file of observations is a LeRobotDataset.

    Raises:
        InputError: a file that is missing or bad, a start although the format has it in the same file, or a dataset
            without an episode number.
    """
    if spec.format == "asl-csv":
        observations = None if start is None else find_data_file(start, base)
        whole = read_asl_start(find_data_file(commands, base), observations)
        return spec.piece(_begun(whole, spec, begun), None)
    if spec.columns is not None:
        folders = spec.format in FOLDERS
        path = find_files(commands, base, folders=folders)[0]
        if recognised_format(path) == CSV and holds_commands_alone(path, spec.columns):
            path = find_data_file(commands, base)
            observations = None if start is None else find_data_file(start, base, folders=folders)
            known = None if observations is None else observed_table(spec.format, observations, spec.columns, episode)
            columns = spec.columns if known is None else known.columns
            whole = read_csv_start(path, columns, None if known is None else known.table)
            return spec.piece(_begun(whole, spec, begun), None)
    episodes = None if episode is None else [episode]
    if spec.columns is not None and start is not None:
        entry = RecordingEntry(observations=start, commands=commands, episodes=episodes)
    elif start is not None:
        raise InputError(
            f"format {spec.format!r} keeps commands and observations in one file",
            where=start,
            remedy="leave --start out: the first row of the command file is the start",
        )
    else:
        entry = RecordingEntry(observations=commands, episodes=episodes)
    changes: dict[str, Any] = {"fit": [entry], "test": [], "resample": None, "missing": "mask"}
    poses = spec.columns is not None and spec.columns.commands_with_poses
    if spec.initial_command is None and spec.format in UNTOLD and not poses:
        changes["initial_command"] = "first"  # recognition would use later rows
    recordings = load_recordings(changed(spec, where="[data]", **changes), base)
    if len(recordings) > 1:
        raise one_at_a_time(spec, commands, len(recordings), "predict")
    return spec.piece(_begun(recordings[0], spec, begun), None)


def one_at_a_time(spec: DataSpec, name: str, number: int, verb: str) -> InputError:
    """The error of a verb that takes one recording and was given several."""
    if spec.format == lerobot.FORMAT:
        return InputError(f"has {number} episodes", where=name, remedy=f"name the one to {verb}, e.g. --episode 0")
    return InputError(f"names {number} files", where=name, remedy=f"{verb} one at a time")


def _begun(whole: Trajectory, spec: DataSpec, begun: str | None) -> Trajectory:
    """With the command before the first row as [data], file, motors or fitted recordings have it; else the first."""
    if whole.settings.get("settled_poses"):
        return whole
    if spec.initial_command is not None or spec.format not in UNTOLD:
        return begun_from(whole, spec.initial_command)
    angle = angle_at_first(whole)
    if angle is not None:
        return whole.with_initial_command(angle, MEASURED)
    why = "assumed" if begun is None else "as in the fitted recordings"
    initial = 0.0 * whole.command[0] if begun == "zero" else whole.command[0]
    beginning = {"rule": begun or "first", "why": f"{why}; set data.initial_command if it was another"}
    return whole.with_initial_command(initial, beginning)


def first_row_only(trajectory: Trajectory) -> Trajectory:
    """The same commands and times with every measurement after the first row taken out."""
    dataset = trajectory.dataset.drop_vars(
        ["tension", "tension_mask", "motor_angle", "motor_angle_mask"], errors="ignore"
    ).copy()
    position, mask = dataset["position"].values.copy(), dataset["position_mask"].values.copy()
    position[1:], mask[1:] = position[:1], False
    if "object_pose" in dataset:
        pose = np.broadcast_to(dataset["object_pose"].values[:1], dataset["object_pose"].shape)
        dataset["object_pose"] = dataset["object_pose"].copy(data=pose.copy())
    return Trajectory(
        dataset.assign(
            position=xr.Variable(dataset["position"].dims, position, dataset["position"].attrs),
            position_mask=xr.Variable(dataset["position_mask"].dims, mask),
        )
    )


def start_is_known(trajectory: Trajectory) -> bool:
    """Whether any marker was measured in the first row."""
    return bool(np.any(trajectory.position_mask[0]))
