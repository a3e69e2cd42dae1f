"""Figures of an audit: place and time of the base model's misfit, similarity of candidates, effect of an extension."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from rfdropo_bayes.report import style
from rfdropo_bayes.report.replay import Track
from rfdropo_bayes.report.units import display_name

MILLIMETRES = 1e3
BINS = 12
MOST_SIGNALS = 4  # recordings side by side
SIGN = "direction"  # the cause that is a sign


@dataclass(frozen=True)
class Residuals:
    """Residuals of the fitted recordings and their possible causes; rows of all groups in sequence."""

    main: Float[np.ndarray, " row"]  # the residual's dominant pattern over the channels, a coordinate per row [m]
    share: float  # part of the mean square in this pattern
    time: Float[np.ndarray, " row"]  # [s]
    command: Float[np.ndarray, "row channel"]  # of every channel at that time, and its rate per second
    rate: Float[np.ndarray, "row channel"]
    tension: Float[np.ndarray, "row cable"]  # of every cable [N]
    position: Float[np.ndarray, " row"]  # simulated coordinate along the same pattern [m]
    channels: tuple[str, ...]  # channels, cables: their names
    cables: tuple[str, ...]
    unit: str  # of the commands


def _strongest(series: np.ndarray, main: np.ndarray) -> int:
    """Column that goes most closely with the residual."""
    centred = series - series.mean(axis=0)
    size = np.sqrt(np.sum(centred**2, axis=0)) + 1e-300
    return int(np.argmax(np.abs(centred.T @ (main - main.mean())) / size))


@dataclass(frozen=True)
class ClassEffect:
    """Part of the residuals explained by a class of candidates, row by row as in `Residuals`."""

    names: tuple[str, ...]  # candidates of the class, the leading one first
    # before, after: mean square of the whitened residual of the markers, without and with its linear effect
    before: Float[np.ndarray, " row"]
    after: Float[np.ndarray, " row"]
    # markers, recordings: both mean squares of each marker and each group of repeats, by name
    markers: Mapping[str, tuple[float, float]]
    recordings: Mapping[str, tuple[float, float]]

    @property
    def share(self) -> float:
        """Explained share of the sum of squares."""
        return 1.0 - float(self.after.sum() / max(float(self.before.sum()), 1e-300))


@dataclass(frozen=True)
class Signal:
    """A signal at a port, with its band."""

    # port, unit: port, and unit of the signal
    port: str
    unit: str
    recordings: tuple[str, ...]  # names, the first of each group of repeats
    time: Float[np.ndarray, " spline"]  # [s]
    # mean, sd: posterior mean and deviation in every recording [unit]
    mean: Float[np.ndarray, "recording spline"]
    sd: Float[np.ndarray, "recording spline"]


@dataclass(frozen=True)
class Shown:
    """Data of the figures of an audit."""

    residuals: Residuals  # residuals of the base model
    blocks: Sequence[Sequence[float]]  # misfit of each block of rows, for each model; 1 if a model is right
    seconds: float  # length of a block [s]
    models: Sequence[str]  # names of the base model and of its extensions, in the order of ``blocks``
    names: Sequence[str]  # names of the tested candidates
    cosines: Float[np.ndarray, "k k"]  # cosines between their signatures
    # time [s] and position [m] of the last marker in the unseen recording that the base model predicts worst: measured,
    # base model, extended model; None without the model
    unseen: tuple[Float[np.ndarray, " row"], Mapping[str, Float[np.ndarray, "row 3"]]] | None
    # time [s], mean and deviation [m] of the final model's residual at the last marker; None if nothing remains
    remainder: tuple[Float[np.ndarray, " row"], Float[np.ndarray, "row 3"], Float[np.ndarray, "row 3"]] | None
    tracks: Sequence[Track] = ()  # replays of unseen recordings
    # the signal at the port with an effect that the library lacks; None without such an effect
    port: Signal | None = None
    classes: Sequence[ClassEffect] = ()  # leading classes of candidates


def causes(residuals: Residuals) -> dict[str, tuple[str, np.ndarray]]:
    """Abscissae of the residual plots, by name: a label and a value for each row."""
    strongest = _strongest(residuals.command, residuals.main)
    turned = _strongest(residuals.rate, residuals.main)
    channel, unit = residuals.channels[turned], residuals.unit
    abscissae = {
        "time": ("time [s]", residuals.time),
        "command": (f"command {residuals.channels[strongest]} [{unit}]", residuals.command[:, strongest]),
        "rate": (f"rate of {channel} [{unit}/s]", residuals.rate[:, turned]),
        SIGN: (f"sign of the rate of {channel} [-]", np.sign(residuals.rate[:, turned])),
        "position": ("position along the pattern [mm]", MILLIMETRES * residuals.position),
    }
    if residuals.cables:  # a black box may have none
        cable = _strongest(residuals.tension, residuals.main)
        abscissae["tension"] = (f"tension of {residuals.cables[cable]} [N]", residuals.tension[:, cable])
    return abscissae


def draw_residual(axes: Axes, residuals: Residuals, against: str) -> None:
    """Draw the residual's dominant pattern against one of `causes`, with its mean in bins and two standard errors."""
    label, values = causes(residuals)[against]
    main, signs = MILLIMETRES * residuals.main, against == SIGN
    jitter = 0.12 * np.random.default_rng(0).standard_normal(len(values)) if signs else 0.0
    axes.scatter(values + jitter, main, s=4, color=style.PRIOR, alpha=0.4, linewidths=0)
    centre, mean, error = _binned(values, main, 3 if signs else BINS)
    axes.errorbar(centre, mean, 2 * error, color=style.POSTERIOR, marker="o", markersize=3, capsize=2)
    axes.axhline(0.0, color=style.MEASURED, linewidth=0.8)
    axes.set_xlabel(label)
    axes.set_ylabel(f"residual, {100 * residuals.share:.0f} % of it [mm]")


@style.styled
def panels_figure(residuals: Residuals) -> Figure:
    """The residual against time, command, rate, sign of rate, position and tension."""
    figure = Figure(figsize=(style.WIDTH, 5.2))
    grid, names = figure.subplots(2, 3, sharey=True).ravel(), list(causes(residuals))
    for axes, name in zip(grid, names, strict=False):
        draw_residual(axes, residuals, name)
        axes.tick_params(labelleft=True)  # each can be seen by itself
    for axes in grid[len(names) :]:
        style.empty(axes)
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


def draw_blocks(axes: Axes, shown: Shown) -> None:
    """Draw when each model fails: mean square of the block means, 1 if a model is right."""
    for row, model in zip(shown.blocks, shown.models, strict=True):
        axes.stairs(row, shown.seconds * np.arange(len(row) + 1), baseline=None, label=model, linewidth=1.4)
    axes.axhline(1.0, color=style.MEASURED, linewidth=0.8)
    axes.set_yscale("log")
    for ticks in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
        ticks(style.PlainLogFormatter(minor_thresholds=(1.5, 0.6)))
    axes.set_xlabel("time [s]")
    axes.set_ylabel("mean square / noise variance [-]")


@style.styled
def blocks_figure(shown: Shown) -> Figure:
    """When the models fail."""
    figure = Figure(figsize=(style.WIDTH, 2.6))
    draw_blocks(figure.subplots(), shown)
    figure.legend(loc="outside upper center", ncols=4)
    return figure


def draw_cosines(axes: Axes, shown: Shown) -> AxesImage:
    """Draw the cosines between the candidates' signatures, after projection on the base parameters."""
    image = axes.imshow(np.abs(shown.cosines), vmin=0.0, vmax=1.0, cmap="Blues")
    labels = [display_name(name) for name in shown.names]
    axes.set_xticks(range(len(labels)), labels, rotation=60, ha="right", rotation_mode="anchor")
    axes.set_yticks(range(len(labels)), labels)
    axes.grid(False)
    for (i, j), value in np.ndenumerate(np.abs(shown.cosines)):
        if value > 0.3 and i != j:
            colour = "white" if value > 0.6 else "black"
            axes.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=6.5, color=colour)
    return image


@style.styled
def cosine_figure(shown: Shown) -> Figure:
    """Cosines between the candidates' signatures."""
    size = 1.6 + 0.34 * len(shown.names)
    figure = Figure(figsize=(min(style.WIDTH, size + 2.0), size))
    axes = figure.subplots()
    figure.colorbar(draw_cosines(axes, shown), ax=axes, shrink=0.8, label="cosine [-]")
    return figure


def draw_unseen(axes: Axes, shown: Shown, axis: int) -> None:
    """Draw one coordinate of the last marker of an unseen recording: measured, base model, extended model."""
    assert shown.unseen is not None
    time, series = shown.unseen
    for (label, values), colour in zip(series.items(), (style.MEASURED, style.TEST, style.POSTERIOR), strict=True):
        axes.plot(time, MILLIMETRES * values[:, axis], color=colour, label=label, linewidth=1.1)
    axes.set_xlabel("time [s]")
    axes.set_ylabel(f"last marker, {'xyz'[axis]} [mm]")


@style.styled
def unseen_figure(shown: Shown) -> Figure:
    """The last marker of one unseen recording, all coordinates."""
    figure = Figure(figsize=(style.WIDTH, 2.8))
    for axis, axes in enumerate(figure.subplots(1, 3)):
        draw_unseen(axes, shown, axis)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3)
    return figure


def draw_remainder(axes: Axes, shown: Shown) -> None:
    """Draw the final model's residual at the last marker as a Gaussian process with two standard deviations."""
    assert shown.remainder is not None
    time, mean, sd = shown.remainder
    for axis, colour in enumerate(style.AXIS_COLOURS):
        centre, width = MILLIMETRES * mean[:, axis], MILLIMETRES * sd[:, axis]
        axes.plot(time, centre, color=colour, label="xyz"[axis])
        axes.fill_between(time, centre - 2 * width, centre + 2 * width, color=colour, alpha=0.18, linewidth=0)
    axes.axhline(0.0, color=style.MEASURED, linewidth=0.8)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("residual of the last marker [mm]")


@style.styled
def remainder_figure(shown: Shown) -> Figure:
    """Residual of the final model at the last marker."""
    figure = Figure(figsize=(style.WIDTH, 2.4))
    axes = figure.subplots()
    draw_remainder(axes, shown)
    axes.legend(loc="upper right", ncols=3)
    return figure


def draw_signal(axes: Axes, signal: Signal, recording: int) -> None:
    """Draw the signal at a port in one recording, with two standard deviations."""
    mean, sd = signal.mean[recording], signal.sd[recording]
    axes.plot(signal.time, mean)
    axes.fill_between(signal.time, mean - 2 * sd, mean + 2 * sd, alpha=0.18, linewidth=0)
    axes.axhline(0.0, color=style.MEASURED, linewidth=0.8)
    axes.set_title(signal.recordings[recording])
    axes.set_xlabel("time [s]")


@style.styled
def signal_figure(signal: Signal) -> Figure:
    """The signal at a port in the first fitted recordings."""
    count = min(len(signal.mean), MOST_SIGNALS)
    figure = Figure(figsize=(style.WIDTH, 2.4))
    every = np.atleast_1d(figure.subplots(1, count, sharey=True))
    for recording, axes in enumerate(every):
        draw_signal(axes, signal, recording)
    unit = "" if signal.unit == "-" else f" [{signal.unit}]"
    every[0].set_ylabel(f"{signal.port}{unit}")
    return figure


@style.styled
def class_figure(residuals: Residuals, effect: ClassEffect) -> Figure:
    """Residuals with and without a class of candidates, against time, command, direction, marker and recording."""
    figure = Figure(figsize=(style.WIDTH, 2.2))
    every = figure.subplots(1, 5, sharey=True)
    channel = _strongest(residuals.command, residuals.main)
    against = (
        ("time [s]", residuals.time),
        (f"{residuals.channels[channel]} [{residuals.unit}]", residuals.command[:, channel]),
        ("direction", np.sign(residuals.rate[:, channel])),
    )
    for axes, (label, cause) in zip(every, against, strict=False):
        centres, means = binned(cause, np.stack([effect.before, effect.after]))
        for mean, colour in zip(means, (style.TEST, style.POSTERIOR), strict=True):
            axes.plot(centres, mean, color=colour, marker=".", linewidth=1.0)
        axes.set_xlabel(label)
    for axes, bars, label in zip(every[3:], (effect.markers, effect.recordings), ("marker", "recording"), strict=True):
        place = np.arange(len(bars))
        for shift, colour, which in ((-0.2, style.TEST, 0), (0.2, style.POSTERIOR, 1)):
            axes.bar(place + shift, [pair[which] for pair in bars.values()], width=0.4, color=colour)
        axes.set_xticks(place, list(bars) if len(bars) <= MOST_SIGNALS else [""] * len(bars))
        axes.set_xlabel(label)
    every[0].set_ylabel("mean square [noise]")
    return figure


def binned(
    cause: Float[np.ndarray, " row"], values: Float[np.ndarray, "k row"]
) -> tuple[Float[np.ndarray, " bin"], Float[np.ndarray, "k bin"]]:
    """Means over rows with equal values of a cause; over quantiles for more than `BINS` values."""
    known = np.unique(cause)
    if len(known) > BINS:
        edges = np.unique(np.quantile(cause, np.linspace(0.0, 1.0, BINS + 1)))
        place = np.clip(np.searchsorted(edges, cause, side="right") - 1, 0, len(edges) - 2)
    else:
        place = np.searchsorted(known, cause)
    counts = np.bincount(place)
    kept = counts > 0
    means = [np.bincount(place, weights=value)[kept] / counts[kept] for value in (cause, *values)]
    return means[0], np.stack(means[1:])
