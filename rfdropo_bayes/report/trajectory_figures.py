"""Figures of one recording: the data as read beside the undeformed robot, measured against predicted positions, the
marker's path, and residuals.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.data.sample_times import sample_time
from rfdropo_bayes.posteriors import RecordingPrediction
from rfdropo_bayes.report import style
from rfdropo_bayes.report.coverage import predictive_bands
from rfdropo_bayes.report.robot_figure import draw_side
from rfdropo_bayes.report.scores import MILLIMETRES

MOST_MARKERS = 4
MOST_LABELS = 8
LEAST_SPAN = 4.0  # [mm]: a smaller range of an axis would blow noise up
AXES = ("x", "y", "z")


def shown_markers(count: int) -> list[int]:
    """Markers that get a row each: an even choice that includes the last."""
    return sorted(
        {round(i) for i in np.linspace(count - 1, 0, min(count, MOST_MARKERS) + (count > MOST_MARKERS))[:MOST_MARKERS]}
    )


@style.styled
def bands_figure(recording: RecordingPrediction) -> Figure:
    """Each coordinate of each shown marker over time, with the 50 % and 90 % predictive bands."""
    markers = shown_markers(len(recording.marker_names))
    figure = Figure(figsize=(style.WIDTH, 0.75 + 1.75 * len(markers)))
    grid = figure.subplots(len(markers), 3, sharex=True, squeeze=False)
    for row, marker in enumerate(markers):
        for axis in range(3):
            axes = grid[row, axis]
            draw_band(axes, recording, marker, axis)
            axes.tick_params(labelbottom=True)  # each can be seen by itself
            if row == len(markers) - 1:
                axes.set_xlabel("time [s]")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4)
    figure.align_ylabels()
    return figure


def draw_band(axes: Axes, recording: RecordingPrediction, marker: int, axis: int) -> None:
    """One coordinate of one marker [mm] over time [s]: measured, and its 50 % and 90 % predictive bands."""
    rows = style.thin(len(recording.time))
    time, measured = recording.time[rows], MILLIMETRES * recording.observed[rows, marker, axis]
    drawn = recording.predicted[:, rows, marker, axis][:, :, None, None]
    low90, low50, median, high50, high90 = (MILLIMETRES * q[:, 0, 0] for q in predictive_bands(drawn))
    axes.fill_between(time, low90, high90, color=style.POSTERIOR, alpha=0.22, linewidth=0, label="90 % band")
    axes.fill_between(time, low50, high50, color=style.POSTERIOR, alpha=0.38, linewidth=0, label="50 % band")
    axes.plot(time, median, color=style.POSTERIOR, linewidth=1.0, label="predicted median")
    seen = np.where(recording.mask[rows, marker], measured, np.nan)
    alone = np.isfinite(seen).sum() == 1  # a prediction has seen the first row only
    axes.plot(time, seen, "o" if alone else "-", color=style.MEASURED, linewidth=1.1, markersize=3, label="measured")
    _at_least(axes, LEAST_SPAN)
    axes.set_ylabel(f"{recording.marker_names[marker]} {AXES[axis]} [mm]")


def _at_least(axes: Axes, span: float) -> None:
    low, high = axes.get_ylim()
    if high - low < span:
        middle = 0.5 * (low + high)
        axes.set_ylim(middle - 0.5 * span, middle + 0.5 * span)


@style.styled
def path_figure(recording: RecordingPrediction) -> Figure:
    """Path of the last marker seen along each axis, and the whole trunk at its first and last row."""
    measured = np.where(recording.mask[..., None], MILLIMETRES * recording.observed, np.nan)
    predicted = MILLIMETRES * recording.central
    rows = style.thin(len(recording.time))
    figure = Figure(figsize=(style.WIDTH, 3.7))
    for axes, (across, up) in zip(figure.subplots(1, 3), ((2, 0), (2, 1), (0, 1)), strict=True):
        for values, colour, words in (
            (measured, style.MEASURED, "measured"),
            (predicted, style.POSTERIOR, "predicted"),
        ):
            tip = values[rows, -1]
            axes.plot(tip[:, across], tip[:, up], color=colour, linewidth=1.2, label=f"{words} path of the last marker")
            for row, dashes in ((0, ":"), (-1, "-")) if across == 2 else ():
                shape = values[row]
                axes.plot(
                    shape[:, across],
                    shape[:, up],
                    dashes,
                    marker="o",
                    markersize=3,
                    color=colour,
                    alpha=0.55,
                    linewidth=1,
                )
        axes.set_xlabel(f"{AXES[across]} [mm]")
        axes.set_ylabel(f"{AXES[up]} [mm]")
        axes.set_aspect("equal", adjustable="datalim")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2)
    return figure


@style.styled
def residual_figure(recording: RecordingPrediction, settled: int | None) -> Figure:
    """Residuals of the last marker: per axis over time, distance over time, and autocorrelation.

    Args:
        recording: measured and predicted.
        settled: first row of the held pose; None if the pose is not held.
    """
    rows = style.thin(len(recording.time))
    usable = recording.mask[:, -1]
    residual = MILLIMETRES * np.where(usable[:, None], recording.observed[:, -1] - recording.central[:, -1], np.nan)
    deviation = MILLIMETRES * (recording.predicted[:, rows, -1] - recording.central[rows, -1])
    figure = Figure(figsize=(style.WIDTH, 2.9))
    over_time, distance, memory = figure.subplots(1, 3, width_ratios=(1.25, 1.25, 0.9))
    low, high = np.quantile(deviation, [0.05, 0.95], axis=0).mean(axis=-1)
    over_time.fill_between(
        recording.time[rows], low, high, color=style.PRIOR, alpha=0.25, linewidth=0, label="90 % band"
    )
    for axis in range(3):
        over_time.plot(recording.time[rows], residual[rows, axis], color=style.AXIS_COLOURS[axis], label=AXES[axis])
    over_time.axhline(0.0, color=style.MEASURED, linewidth=0.8)
    over_time.set_ylabel("measured - predicted [mm]")
    _legend_above(over_time, columns=4)
    _at_least(over_time, 1.0)
    norm = np.linalg.norm(residual, axis=1)
    distance.plot(recording.time[rows], norm[rows], color=style.POSTERIOR, label="distance")
    root = float(np.sqrt(np.nanmean(norm**2))) if usable.any() else np.nan
    distance.axhline(root, color=style.TEST, linestyle="--", label=f"rms {root:.3g} mm")
    if settled is not None:
        distance.axvspan(recording.time[settled], recording.time[-1], color=style.PRIOR, alpha=0.15, label="pose held")
    distance.set_ylim(bottom=0.0)
    distance.set_ylabel("distance [mm]")
    _legend_above(distance, columns=3)
    for axes in (over_time, distance):
        axes.set_xlabel("time [s]")
    _memory(memory, recording.time, np.nan_to_num(residual))
    return figure


def _legend_above(axes: Axes, *, columns: int) -> None:
    axes.legend(
        loc="lower center",
        bbox_to_anchor=(0.5, 1.0),
        ncols=columns,
        handlelength=1.4,
        columnspacing=1.0,
        borderaxespad=0.2,
    )


def _memory(axes: Axes, time: np.ndarray, residual: Float[np.ndarray, "time 3"]) -> None:
    lags = min(len(time) - 1, max(10, len(time) // 3))
    step = sample_time(time) if len(time) > 1 else 1.0
    size = 2 ** int(np.ceil(np.log2(2 * len(time))))
    power = np.abs(np.fft.rfft(residual, size, axis=0)) ** 2
    correlation = np.fft.irfft(power, axis=0)[: lags + 1]
    correlation = correlation / np.where(correlation[:1] > 0, correlation[:1], 1.0)
    for axis in range(3):
        axes.plot(step * np.arange(lags + 1), correlation[:, axis], color=style.AXIS_COLOURS[axis], label=AXES[axis])
    axes.axhspan(-2 / np.sqrt(len(time)), 2 / np.sqrt(len(time)), color=style.PRIOR, alpha=0.2)
    axes.axhline(0.0, color=style.MEASURED, linewidth=0.8)
    axes.set_ylim(-1.05, 1.05)
    axes.set_xlabel("lag [s]")
    axes.set_ylabel("autocorrelation")


def save_recording(trajectory: Trajectory, rest: Mapping[str, Any] | None, path: Path) -> None:
    """Write the picture of a recording as PNG; ``rest`` is the robot's `robots.robot_shape`, if it has one."""
    recording_figure(trajectory, rest).savefig(path)


@style.styled
def recording_figure(trajectory: Trajectory, rest: Mapping[str, Any] | None) -> Figure:
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
    figure.suptitle(f"{trajectory.name}: data as read, in the frame of the robot's base")
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


def _rest(axes: Axes, trajectory: Trajectory, rest: Mapping[str, Any] | None, across: int) -> None:
    """The undeformed robot with its cables and markers, the first row, and the path of the last marker."""
    if rest is not None:
        draw_side(axes, rest, across, {})
    position = MILLIMETRES * np.where(trajectory.position_mask[..., None], trajectory.position, np.nan)
    axes.plot(position[:, -1, 2], position[:, -1, across], color=style.PRIOR, linewidth=0.8, label="last marker's path")
    axes.plot(position[0, :, 2], position[0, :, across], "x", color=style.POSTERIOR, label="first row")
    axes.set_xlabel("z [mm], away from the clamp" if rest is not None else "z [mm]")
    if across == 0:
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
