"""A picture of the robot as its file describes it: body, cables and markers at rest."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rfdropo_bayes.report import style

MILLIMETRES = 1e3
MOST_NAMED = 12  # cables, or markers; more names would lie on each other
AXES = "xyz"


@style.styled
def robot_figure(outline: Mapping[str, Any]) -> Figure:
    """Seen from the side, with gravity in the picture if it points across the robot, and seen from the base.

    Args:
        outline: outline of the robot from `robots.robot_shape`.
    """
    figure = Figure(figsize=(style.WIDTH, 3.0))
    side, section = figure.subplots(1, 2, width_ratios=(1.4, 1.0))
    colours = {name: style.CYCLE[i % (len(style.CYCLE) - 1)] for i, name in enumerate(outline["cables"])}
    gravity = np.abs(outline["gravity"])
    across = 0 if gravity[0] > gravity[1] else 1
    draw_side(side, outline, across, colours)
    _gravity(side, outline["gravity"], 2, across)
    side.margins(0.04, 0.3)
    _section(section, outline, colours)
    return figure


def draw_side(axes: Axes, outline: Mapping[str, Any], across: int, colours: Mapping[str, str]) -> None:
    """Draw the robot along its axis, one of the two directions across it upwards; cables in their colours, if any."""
    station = MILLIMETRES * np.asarray(outline["station"])
    half = MILLIMETRES * np.asarray(outline["half_width"])[:, across]
    axes.fill_between(station, -half, half, color=style.PRIOR, alpha=0.25, linewidth=0, label="at rest")
    axes.axvline(station[0], color=style.PRIOR, linewidth=3)
    for name, points in outline["cables"].items():
        line = MILLIMETRES * np.asarray(points)
        colour = colours.get(name, style.PRIOR)
        axes.plot(line[:, 2], line[:, across], ".-", color=colour, markersize=2.5, linewidth=0.9)
    points = MILLIMETRES * np.array(list(outline["markers"].values()))
    axes.plot(points[:, 2], points[:, across], "D", color=style.TEST, markersize=4.5, label="markers at rest")
    for name, point in zip(outline["markers"], points, strict=True):
        if len(points) <= MOST_NAMED:
            axes.annotate(name, point[[2, across]], (0, 7), textcoords="offset points", ha="center", fontsize=8)
    axes.set_xlabel("z [mm]")
    axes.set_ylabel(f"{AXES[across]} [mm]")
    axes.set_aspect("equal", adjustable="datalim")


def _section(axes: Axes, outline: Mapping[str, Any], colours: Mapping[str, str]) -> None:
    """The section at the base, with the starting points of the cables."""
    wide, high = MILLIMETRES * np.asarray(outline["half_width"])[0]
    angle = np.linspace(0.0, 2.0 * np.pi, 100)
    axes.fill(wide * np.cos(angle), high * np.sin(angle), color=style.PRIOR, alpha=0.25, linewidth=0)
    for name, points in outline["cables"].items():
        x, y = MILLIMETRES * np.asarray(points[0])[:2]
        axes.plot(x, y, "o", color=colours[name], markersize=4.5)
        if len(outline["cables"]) <= MOST_NAMED:
            axes.annotate(name, (x, y), (4, 4), textcoords="offset points", fontsize=8)
    _gravity(axes, outline["gravity"], 0, 1)
    axes.set_xlabel("x [mm]")
    axes.set_ylabel("y [mm]")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.25)


def _gravity(axes: Axes, gravity: list[float], across: int, up: int) -> None:
    """An arrow in the corner; a dot if gravity points out of the picture or into it."""
    size = float(np.linalg.norm(gravity))
    if size == 0.0:
        return
    dx, dy = 0.16 * gravity[across] / size, 0.16 * gravity[up] / size
    if np.hypot(dx, dy) > 0.01:
        arrow = {"arrowstyle": "->", "color": style.MEASURED}
        axes.annotate(
            "", (0.9 + dx, 0.9 + dy), (0.9, 0.9), xycoords="axes fraction", textcoords="axes fraction", arrowprops=arrow
        )
    else:
        axes.plot(0.9, 0.9, "o", color=style.MEASURED, markersize=5, transform=axes.transAxes)
    axes.text(0.92, 0.92, "g", transform=axes.transAxes, fontsize=9, va="bottom")
