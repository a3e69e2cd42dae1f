"""One recording before any fit: markers and commands over time, and its first row beside the undeformed robot."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.report import style
from rfdropo_bayes.report.robot_figure import draw_side
from rfdropo_bayes.report.trajectory_figures import AXES, shown_markers

MILLIMETRES = 1e3
MOST_LABELS = 8


def save_recording(trajectory: Trajectory, rest: Mapping[str, Any], path: Path) -> None:
    """Write the picture of a recording as PNG; ``rest`` is the robot's `robots.robot_shape`."""
    recording_figure(trajectory, rest).savefig(path)


@style.styled
def recording_figure(trajectory: Trajectory, rest: Mapping[str, Any]) -> Figure:
    """Left: coordinates of up to four markers over time, then the commands; right: the robot at rest from two sides."""
    markers = shown_markers(len(trajectory.marker_names))
    rows = len(markers) + 1
    figure = Figure(figsize=(style.WIDTH * 1.2, 1.0 + 1.7 * max(rows, 3)))
    grid = figure.add_gridspec(rows, 2, width_ratios=(1.6, 1.0))
    over_time = [figure.add_subplot(grid[row, 0]) for row in range(rows)]
    for axes, marker in zip(over_time, markers, strict=False):
        _coordinates(axes, trajectory, marker)
    over_time[0].legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4)
    _commands(over_time[-1], trajectory)
    for axes in over_time[1:]:
        axes.sharex(over_time[0])
    half = (rows + 1) // 2
    for place, across in ((grid[:half, 1], 0), (grid[half:, 1], 1)):
        _rest(figure.add_subplot(place), trajectory, rest, across)
    figure.suptitle(f"{trajectory.name}: what was read, in the frame of the robot's base")
    return figure


def _coordinates(axes: Axes, trajectory: Trajectory, marker: int) -> None:
    mask = trajectory.position_mask[:, marker]
    rows = style.thin(len(trajectory.time))
    values = MILLIMETRES * np.where(mask[:, None], trajectory.position[:, marker], np.nan)
    for axis, colour in enumerate(style.AXIS_COLOURS):
        axes.plot(trajectory.time[rows], values[rows, axis], color=colour, label=AXES[axis])
    for row in np.flatnonzero(~mask):
        low, high = max(int(row) - 1, 0), min(int(row) + 1, len(mask) - 1)
        axes.axvspan(trajectory.time[low], trajectory.time[high], color=style.TEST, alpha=0.15)
    if not mask.all():
        axes.axvspan(np.nan, np.nan, color=style.TEST, alpha=0.15, label="masked")
    axes.set_ylabel(f"{trajectory.marker_names[marker]} [mm]")


def _commands(axes: Axes, trajectory: Trajectory) -> None:
    start = min(0.0, float(trajectory.command_time[0])) - 0.03 * float(trajectory.time[-1])
    time = np.concatenate([[start], trajectory.command_time, [trajectory.time[-1]]])
    command = np.concatenate([trajectory.initial_command[None], trajectory.command, trajectory.command[-1:]])
    for column, name in enumerate(trajectory.cable_names):
        axes.step(time, command[:, column], where="post", label=name)
    axes.axvline(0.0, color=style.MEASURED, linewidth=0.8, linestyle=":")
    axes.set(xlabel="time [s]; dotted: the first row", ylabel=f"command [{trajectory.command_unit}]")
    if len(trajectory.cable_names) <= MOST_LABELS:
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def _rest(axes: Axes, trajectory: Trajectory, rest: Mapping[str, Any], across: int) -> None:
    """The undeformed robot with its cables and markers, the first row, and the path of the last marker."""
    draw_side(axes, rest, across, {})
    position = MILLIMETRES * np.where(trajectory.position_mask[..., None], trajectory.position, np.nan)
    axes.plot(position[:, -1, 2], position[:, -1, across], color=style.PRIOR, linewidth=0.8, label="last marker's path")
    axes.plot(position[0, :, 2], position[0, :, across], "x", color=style.POSTERIOR, label="first row")
    axes.set_xlabel("z [mm], away from the clamp")
    if across == 0:
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
