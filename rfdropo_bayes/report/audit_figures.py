"""Figures of an audit: where and when the base model fails, how alike candidates look, what an extension changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from rfdropo_bayes.report import style
from rfdropo_bayes.report.units import display_name

MILLIMETRES = 1e3
BINS = 12

SIGNS = 3  # place of the panel whose abscissa is a sign


@dataclass(frozen=True)
class Residuals:
    """What a model leaves of the fitted recordings, beside what might have caused it; rows of all groups in a line.

    Attributes:
        main: the residual's dominant pattern over the channels, a coordinate per row [m].
        share: of the mean square that this pattern holds.
        time: [s]; command: of every channel at that time, and its rate per second; tension: of every cable [N].
        position: simulated coordinate along the same pattern [m].
        channels, cables: their names; unit: of the commands.
    """

    main: Float[np.ndarray, " row"]
    share: float
    time: Float[np.ndarray, " row"]
    command: Float[np.ndarray, "row channel"]
    rate: Float[np.ndarray, "row channel"]
    tension: Float[np.ndarray, "row cable"]
    position: Float[np.ndarray, " row"]
    channels: tuple[str, ...]
    cables: tuple[str, ...]
    unit: str


def _strongest(series: np.ndarray, main: np.ndarray) -> int:
    """Column that goes most closely with the residual."""
    centred = series - series.mean(axis=0)
    size = np.sqrt(np.sum(centred**2, axis=0)) + 1e-300
    return int(np.argmax(np.abs(centred.T @ (main - main.mean())) / size))


@style.styled
def panels_figure(residuals: Residuals) -> Figure:
    """The residual against time, command, rate, sign of rate, position and tension, with the mean in bins."""
    main = MILLIMETRES * residuals.main
    channel = _strongest(residuals.rate, main)
    held = _strongest(residuals.command, main)
    figure = Figure(figsize=(style.WIDTH, 5.2))
    panels = [
        ("time [s]", residuals.time),
        (f"command {residuals.channels[held]} [{residuals.unit}]", residuals.command[:, held]),
        (f"rate of {residuals.channels[channel]} [{residuals.unit}/s]", residuals.rate[:, channel]),
        (f"sign of the rate of {residuals.channels[channel]} [-]", np.sign(residuals.rate[:, channel])),
        ("position along the pattern [mm]", MILLIMETRES * residuals.position),
    ]
    if residuals.cables:  # a black box may have none
        cable = _strongest(residuals.tension, main)
        panels.append((f"tension of {residuals.cables[cable]} [N]", residuals.tension[:, cable]))
    grid = figure.subplots(2, 3, sharey=True).ravel()
    for axes in grid[len(panels) :]:
        style.empty(axes)
    for place, (axes, (label, values)) in enumerate(zip(grid, panels, strict=False)):
        signs = place == SIGNS
        spread = 0.12 * np.random.default_rng(0).standard_normal(len(values)) if signs else 0.0
        axes.scatter(values + spread, main, s=4, color=style.PRIOR, alpha=0.4, linewidths=0)
        centre, mean, error = _binned(values, main, 3 if signs else BINS)
        axes.errorbar(centre, mean, 2 * error, color=style.POSTERIOR, marker="o", markersize=3, capsize=2)
        axes.axhline(0.0, color=style.MEASURED, linewidth=0.8)
        axes.set_xlabel(label)
        axes.set_ylabel(f"residual, {100 * residuals.share:.0f} % of it [mm]")
        axes.tick_params(labelleft=True)  # each can be seen by itself
    return figure


def _binned(x: np.ndarray, y: np.ndarray, bins: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    edges = np.unique(np.quantile(x, np.linspace(0, 1, bins + 1))) if bins > 3 else np.array([-1.5, -0.5, 0.5, 1.5])
    index = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, max(len(edges) - 2, 0))
    rows = [(x[index == k], y[index == k]) for k in range(max(len(edges) - 1, 1)) if np.sum(index == k) > 2]
    if not rows:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    return tuple(
        np.array(part) for part in zip(*((a.mean(), b.mean(), b.std() / np.sqrt(len(b))) for a, b in rows), strict=True)
    )  # type: ignore[return-value]


@style.styled
def blocks_figure(blocks: Sequence[Sequence[float]], seconds: float, titles: Sequence[str]) -> Figure:
    """When the models fail: mean square of the block means, 1 where a model is right."""
    figure = Figure(figsize=(style.WIDTH, 2.6))
    axes = figure.subplots()
    for row, title in zip(blocks, titles, strict=True):
        axes.stairs(row, seconds * np.arange(len(row) + 1), baseline=None, label=title, linewidth=1.4)
    axes.axhline(1.0, color=style.MEASURED, linewidth=0.8)
    axes.set_yscale("log")
    for ticks in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
        ticks(LogFormatter(minor_thresholds=(1.5, 0.6)))
    axes.set_xlabel("time [s]")
    axes.set_ylabel("mean square / that of noise [-]")
    figure.legend(loc="outside upper center", ncols=4)
    return figure


@style.styled
def cosine_figure(names: Sequence[str], cosines: Float[np.ndarray, "k k"]) -> Figure:
    """How alike the candidates' signatures are, once the base parameters have done what they can."""
    size = 1.6 + 0.34 * len(names)
    figure = Figure(figsize=(min(style.WIDTH, size + 2.0), size))
    axes = figure.subplots()
    image = axes.imshow(np.abs(cosines), vmin=0.0, vmax=1.0, cmap="Blues")
    labels = [display_name(name) for name in names]
    axes.set_xticks(range(len(names)), labels, rotation=60, ha="right", rotation_mode="anchor")
    axes.set_yticks(range(len(names)), labels)
    axes.grid(False)
    for i, row in enumerate(cosines):
        for j, value in enumerate(row):
            if abs(value) > 0.3 and i != j:
                axes.text(
                    j,
                    i,
                    f"{abs(value):.2f}",
                    ha="center",
                    va="center",
                    fontsize=6.5,
                    color="white" if abs(value) > 0.6 else "black",
                )
    figure.colorbar(image, ax=axes, shrink=0.8, label="cosine [-]")
    return figure


@style.styled
def overlay_figure(
    time: Float[np.ndarray, " row"], series: Mapping[str, Float[np.ndarray, "row 3"]], title: str
) -> Figure:
    """The last marker of one unseen recording: measured, base model, extended model."""
    figure = Figure(figsize=(style.WIDTH, 2.8))
    colours = {"measured": style.MEASURED, "base model": style.TEST, "extended model": style.POSTERIOR}
    for axis, axes in enumerate(figure.subplots(1, 3)):
        for label, values in series.items():
            axes.plot(time, MILLIMETRES * values[:, axis], color=colours[label], label=label, linewidth=1.1)
        axes.set_xlabel("time [s]")
        axes.set_ylabel(f"{title}, {'xyz'[axis]} [mm]")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3)
    return figure


@style.styled
def remainder_figure(
    time: Float[np.ndarray, " row"], mean: Float[np.ndarray, "row 3"], sd: Float[np.ndarray, "row 3"], title: str
) -> Figure:
    """What the final model leaves of the last marker, as a Gaussian process with two standard deviations."""
    figure = Figure(figsize=(style.WIDTH, 2.4))
    axes = figure.subplots()
    for axis in range(3):
        centre, width = MILLIMETRES * mean[:, axis], MILLIMETRES * sd[:, axis]
        axes.plot(time, centre, color=style.AXIS_COLOURS[axis], label="xyz"[axis])
        axes.fill_between(
            time, centre - 2 * width, centre + 2 * width, color=style.AXIS_COLOURS[axis], alpha=0.18, linewidth=0
        )
    axes.axhline(0.0, color=style.MEASURED, linewidth=0.8)
    axes.set_xlabel("time [s]")
    axes.set_ylabel(f"{title} [mm]")
    axes.legend(loc="upper right", ncols=3)
    return figure
