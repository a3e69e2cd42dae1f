"""Figures of policies: the learning curve, and success rates against distance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from PIL import Image

from rfdropo_bayes.policies.evaluation import Episode
from rfdropo_bayes.report.style import CYCLE, WIDTH, empty, styled

MILLIMETRES = 1e3
INTERVALS = 4  # between the ticks of a panel in a third of the page: the labels of more would overlap


@styled
def curve_figure(curve: Sequence[Mapping[str, float]]) -> Figure:
    """Reward and final distance of the evaluations during a training; a distance may be None, or infinite."""
    figure = Figure(figsize=(WIDTH, 2.6))
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    steps = [row["steps"] for row in curve]
    left.plot(steps, [row["reward"] for row in curve], marker=".")
    left.set(xlabel="environment steps", ylabel="reward of an episode")
    names = [f"distance_{name}" for name in ("q05", "median", "q95")]
    ends = MILLIMETRES * np.array([[row[name] for row in curve] for name in names], dtype=float)  # None becomes NaN
    low, middle, high = np.where(np.isfinite(ends), ends, np.nan)
    right.fill_between(steps, low, high, alpha=0.25, label="5 to 95 %")
    right.plot(steps, middle, marker=".", label="median")
    right.set(xlabel="environment steps", ylabel="final distance to the goal [mm]", yscale="log")
    right.legend()
    return figure


@styled
def success_figure(policies: Mapping[str, Sequence[Episode]], thresholds: Sequence[float]) -> Figure:
    """Share of the episodes that end within a distance, for every policy."""
    figure = Figure(figsize=(WIDTH, 3.2))
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for colour, (name, episodes) in zip(CYCLE * len(policies), policies.items(), strict=False):
        distances = MILLIMETRES * np.sort([episode.distance for episode in episodes])
        share = 100.0 * np.arange(1, len(distances) + 1) / len(distances)
        finite = np.isfinite(distances)
        axes.step(distances[finite], share[finite], where="post", color=colour, label=name)
    for threshold in thresholds:
        axes.axvline(MILLIMETRES * threshold, color="0.7", linewidth=0.8, zorder=0)
    axes.set(xscale="log", xlabel="final distance to the goal [mm]", ylabel="episodes within it [%]", ylim=(0, 101))
    axes.legend(loc="upper left")
    return figure


@styled
def draws_figure(parameters: Mapping[str, np.ndarray], distances: np.ndarray) -> Figure:
    """Final distance [m] of episodes against every parameter that differs between them."""
    columns = min(3, len(parameters))
    rows = -(-len(parameters) // columns)
    figure = Figure(figsize=(WIDTH, 2.4 * rows))
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, (name, values) in zip(panels, parameters.items(), strict=False):
        axes.plot(values, MILLIMETRES * distances, ".", markersize=4)
        axes.set(xlabel=name, ylabel="final distance [mm]", yscale="log")
        axes.xaxis.set_major_locator(MaxNLocator(INTERVALS))
    for axes in panels[len(parameters) :]:
        empty(axes)
    return figure


def save_animation(frames: Sequence[np.ndarray], path: Path, period: float) -> Path:
    """Write pictures at intervals of ``period`` [s] as a GIF that plays in real time."""
    pictures: list[Any] = [Image.fromarray(frame).convert("P", palette=Image.Palette.ADAPTIVE) for frame in frames]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=round(1e3 * period), loop=0)
    return path
