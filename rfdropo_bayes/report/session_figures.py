"""Figures of a motor session: cables beside their set-points, commands, the way to the goal, and punctuality."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.report.style import WIDTH, empty, styled

MILLIMETRES = 1e3
MOST_COLUMNS = 4


ROW_HEIGHT = 1.7  # inches


@styled
def drives_figure(session: Trajectory) -> Figure:
    """Set-point and reached length of the cable of every drive."""
    set_point, length = (MILLIMETRES * session.dataset[name].to_numpy() for name in ("set_point", "length"))

    def draw(axes: Axes, k: int) -> None:
        axes.plot(session.time, set_point[:, k], label="set-point")
        axes.plot(session.time, length[:, k], "--", label="reached")

    return _grid(session, draw, "cable [mm]")


@styled
def commands_figure(session: Trajectory) -> Figure:
    """The command that the policy asked for, and the command in force, of every channel."""
    factor, unit = (MILLIMETRES, "mm") if session.command_unit == "m" else (1.0, session.command_unit)
    asked = factor * session.dataset["asked_command"].to_numpy()

    def draw(axes: Axes, k: int) -> None:
        axes.step(session.command_time, asked[:, k], where="post", label="asked for")
        axes.step(session.command_time, factor * session.command[:, k], "--", where="post", label="in force")

    return _grid(session, draw, f"command [{unit}]")


@styled
def goal_figure(time: Float[np.ndarray, " row"], distance: Float[np.ndarray, " row"]) -> Figure:
    """Distance [m] from the goal, in rows in which the last marker or the object was seen."""
    figure = Figure(figsize=(WIDTH, 2.4))
    axes = figure.add_subplot()
    axes.plot(time, MILLIMETRES * distance, marker="." if len(time) < 2 else None)
    axes.set(xlabel="time [s]", ylabel="distance to the goal [mm]")
    axes.set_ylim(bottom=0.0)
    return figure


@styled
def punctuality_figure(session: Trajectory, period: float) -> Figure:
    """Delay of every cycle's start, over time and sorted; ``period`` of the loop [s]."""
    late = 1e3 * session.dataset["lateness"].to_numpy()
    figure = Figure(figsize=(WIDTH, 2.4))
    left, right = figure.subplots(1, 2)
    left.plot(session.time, late, linestyle="none", marker=".", markersize=3)
    left.set(xlabel="time [s]", ylabel="a cycle begins late by [ms]")
    right.plot(np.sort(late), 100.0 * np.arange(1, len(late) + 1) / len(late), marker="." if len(late) < 2 else None)
    right.set(xlabel="late by [ms]", ylabel="cycles at most as late [%]")
    if late.max() > 500.0 * period:
        left.axhline(1e3 * period, color="0.6", linewidth=0.8)
        right.axvline(1e3 * period, color="0.6", linewidth=0.8)
    return figure


def _grid(session: Trajectory, draw: Callable[[Axes, int], None], label: str) -> Figure:
    """A cell for every channel, with its name above."""
    names = session.cable_names
    columns = min(MOST_COLUMNS, len(names))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(WIDTH, ROW_HEIGHT * rows + 0.6))
    cells = figure.subplots(rows, columns, squeeze=False).ravel()
    for k, axes in enumerate(cells):
        if k >= len(names):
            empty(axes)
            continue
        draw(axes, k)
        axes.set_title(names[k])
        axes.set_xlabel("time [s]")
        if k % columns == 0:
            axes.set_ylabel(label)
    cells[0].legend()
    return figure
