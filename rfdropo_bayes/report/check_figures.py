"""Figures of the run: errors beside the baselines, coverage of the bands, the sampler, when the model failed.

Residuals of a fit at rest, as pictures: over time, against each command and its direction, and by marker.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from rfdropo_bayes.report import style
from rfdropo_bayes.report.residuals import TransformCurve
from rfdropo_bayes.report.scores import MILLIMETRES

COLUMNS = 3


class ShownRows(Protocol):
    """Rows that are shown."""

    @property
    def command(self) -> Float[np.ndarray, "row channel"]:
        """As recorded."""

    @property
    def time(self) -> Float[np.ndarray, " row"]:
        """In each recording [s]."""


class RestResiduals(Protocol):
    """Residuals of a fit at rest; see `verbs.rest_fit.RestFit`."""

    @property
    def rows(self) -> ShownRows: ...

    @property
    def residual(self) -> Float[np.ndarray, "row marker 3"]: ...

    @property
    def ways(self) -> Float[np.ndarray, "row channel"]: ...

    @property
    def markers(self) -> tuple[str, ...]: ...

    @property
    def recording(self) -> np.ndarray: ...


TRACES = {
    "horizon": "horizon [rows]",
    "progress": "rows passed",
    "temperature": "temperature",
    "ess": "effective sample size",
    "acceptance": "acceptance rate",
    "loss": "loss",
    "log_evidence": "log evidence [nat]",
    "moves": "moves per stage",
    "gradient": "gradient norm",
    "rollouts": "rollouts so far",
}


@style.styled
def error_figure(rows: Sequence[Mapping[str, Any]], noise_floor: float | None) -> Figure:
    """Errors of the last marker, the model's first, the predictors without a simulator below.

    Args:
        rows: ``title``, ``own`` (is it the calibrated simulator) and errors [mm] under ``fit``, ``test`` and, if
            recordings end in a hold, ``moving`` and ``final`` (of the test recordings; of the fit recordings without
            any).
        noise_floor: spread between repeats [mm], None without repeats.
    """
    titles = {"test": "test, over time", "fit": "fit, over time", "moving": "moving part", "final": "final pose"}
    keys = [key for key in titles if any(row.get(key) is not None for row in rows)]
    columns = min(2, len(keys))
    lines = -(-len(keys) // columns)
    figure = Figure(figsize=(style.WIDTH, lines * (0.9 + 0.34 * len(rows))))
    grid = figure.subplots(lines, columns, squeeze=False).reshape(-1)
    for axes in grid[len(keys) :]:
        style.empty(axes)
    for axes, key in zip(grid, keys, strict=False):
        _bars(axes, rows, key, noise_floor)
        axes.set_title(titles[key])
        axes.set_xlabel("error of the last marker [mm]")
        axes.set_yticks(range(len(rows)), [row["title"] for row in rows])
        for label, row in zip(axes.get_yticklabels(), rows, strict=False):
            label.set_fontweight("bold" if row["own"] else "normal")
        axes.invert_yaxis()
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside upper right")
    return figure


def _bars(axes: Axes, rows: Sequence[Mapping[str, Any]], key: str, noise_floor: float | None) -> None:
    longest = max(row[key] for row in rows if row.get(key) is not None)
    for place, row in enumerate(rows):
        value = row.get(key)
        if value is None:
            axes.text(0.01 * longest, place, "not available", va="center", color=style.PRIOR, fontsize=8)
            continue
        axes.barh(place, value, height=0.65, color=style.POSTERIOR if row["own"] else "#B9C4CC")
        axes.text(value + 0.015 * longest, place, f"{value:.3g}", va="center", fontsize=8.5)
    if noise_floor is not None:
        axes.axvline(noise_floor, color=style.TEST, linestyle="--", linewidth=1.2, label="repeats differ by this")
    axes.set_xlim(0.0, 1.22 * longest)
    axes.grid(axis="y", visible=False)
    axes.xaxis.set_major_locator(MaxNLocator(4))


@style.styled
def coverage_figure(curves: Mapping[str, TransformCurve], shares: Mapping[str, Mapping[float, float | None]]) -> Figure:
    """PIT-ECDF minus the diagonal for each role, and observed against nominal coverage.

    Args:
        curves: "fit" and "test".
        shares: observed coverage by nominal coverage, per role.
    """
    figure = Figure(figsize=(style.WIDTH, 3.3))
    left, right = figure.subplots(1, 2, width_ratios=(1.5, 1.0))
    colours = {"fit": style.POSTERIOR, "test": style.TEST}
    for role, curve in curves.items():
        band = curve.half_width
        left.fill_between(curve.grid, -band, band, color=colours[role], alpha=0.12, linewidth=0)
        label = f"{role} (worth {curve.independent:.0f} independent rows)"
        left.plot(curve.grid, curve.ecdf - curve.grid, color=colours[role], label=label)
    left.axhline(0.0, color=style.MEASURED, linewidth=0.8)
    left.set_xlabel("share of predictive draws below the measured value")
    left.set_ylabel("ECDF - uniform")
    left.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    right.plot([0, 1], [0, 1], color=style.MEASURED, linewidth=0.8)
    for role, row in shares.items():
        known = {p: s for p, s in row.items() if s is not None}
        right.plot(list(known), list(known.values()), "o-", color=colours[role], label=role, markersize=4)
    right.set_xlabel("nominal content of the band")
    right.set_ylabel("share of measurements inside")
    right.set_xlim(0, 1)
    right.set_ylim(0, 1)
    right.legend(loc="lower right")
    return figure


@style.styled
def trace_figure(trace: Sequence[Mapping[str, float]]) -> Figure:
    """Numbers of the sampler over its stages; one line per replicate."""
    keys = [key for key in TRACES if any(key in row for row in trace)][:8]
    replicates = sorted({row.get("replicate", 0.0) for row in trace})
    columns = min(4, len(keys))
    lines = -(-len(keys) // columns)
    figure = Figure(figsize=(style.WIDTH, 0.4 + 2.0 * lines))
    grid = figure.subplots(lines, columns, squeeze=False).reshape(-1)
    for axes, key in zip(grid, keys, strict=False):
        for number, replicate in enumerate(replicates):
            rows = [row for row in trace if row.get("replicate", 0.0) == replicate]
            points = [(stage, row[key]) for stage, row in enumerate(rows) if key in row]
            if points:
                axes.plot(
                    *zip(*points, strict=True), ".-", markersize=3.5, color=style.CYCLE[number % len(style.CYCLE)]
                )
        axes.set_xlabel("stage")
        axes.set_title(TRACES[key])
        axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    for axes in grid[len(keys) :]:
        style.empty(axes)
    return figure


@style.styled
def block_figure(blocks: Sequence[Mapping[str, float]]) -> Figure:
    """Log score per row of each block of rows, given the rows before it: the simulator fails in blocks with a low
    score.
    """
    figure = Figure(figsize=(style.WIDTH, 2.6))
    axes = figure.subplots()
    first = np.array([block["first_row"] for block in blocks])
    last = np.array([block["last_row"] for block in blocks])
    length = last - first + 1
    score = np.array([block["log_score"] for block in blocks]) / length
    axes.stairs(score, np.append(first - 0.5, last[-1] + 0.5), color=style.POSTERIOR, linewidth=1.6, baseline=None)
    deviation = np.array([block.get("sd", np.nan) for block in blocks]) / length
    known = np.isfinite(deviation)
    if known.any():
        middle = 0.5 * (first + last)
        axes.errorbar(
            middle[known], score[known], deviation[known], fmt="none", ecolor=style.MEASURED, capsize=2, label="± 1 sd"
        )
        axes.legend(loc="best")
    axes.set_xlabel("row")
    axes.set_ylabel("log score per row [nat]")
    return figure


@style.styled
def rest_figure(fit: RestResiduals) -> Figure:
    """One cell over time, one for the markers, and one for each command."""
    channels = fit.rows.command.shape[1]
    lines = -(-(2 + channels) // COLUMNS)
    figure = Figure(figsize=(style.WIDTH, 0.6 + 2.1 * lines))
    cells = figure.subplots(lines, COLUMNS, squeeze=False).reshape(-1)
    residual = MILLIMETRES * fit.residual
    _over_time(cells[0], fit, residual[:, -1])
    _by_marker(cells[1], fit.markers, residual)
    for channel in range(channels):
        _against_command(cells[2 + channel], fit, residual[:, -1], channel)
    for cell in cells[2 + channels :]:
        style.empty(cell)
    figure.suptitle(f"measured less a fitted robot at rest: {fit.markers[-1]}")
    return figure


def _over_time(axes: Axes, fit: RestResiduals, residual: Float[np.ndarray, "row 3"]) -> None:
    for axis, colour in enumerate(style.AXIS_COLOURS):
        for number in np.unique(fit.recording):
            own = fit.recording == number
            label = "xyz"[axis] if number == fit.recording[0] else None
            axes.plot(fit.rows.time[own], residual[own, axis], ".", color=colour, markersize=3, label=label)
    axes.set(xlabel="time [s]", ylabel="residual [mm]")
    axes.legend(loc="best", ncols=3)


def _by_marker(axes: Axes, markers: tuple[str, ...], residual: Float[np.ndarray, "row marker 3"]) -> None:
    size = np.sqrt(np.nanmean(np.sum(residual**2, axis=2), axis=0))
    axes.barh(range(len(markers)), size, color=style.POSTERIOR)
    axes.set_yticks(range(len(markers)), markers)
    axes.set(xlabel="residual, root mean square [mm]")


def _against_command(axes: Axes, fit: RestResiduals, residual: Float[np.ndarray, "row 3"], channel: int) -> None:
    distance = np.linalg.norm(residual, axis=1)
    for way, colour, word in ((1.0, style.TEST, "rose"), (-1.0, style.POSTERIOR, "fell")):
        own = fit.ways[:, channel] == way
        axes.plot(fit.rows.command[own, channel], distance[own], ".", color=colour, markersize=3, label=word)
    axes.set(xlabel=f"command {channel + 1}", ylabel="residual [mm]")
    axes.legend(loc="best", ncols=2)
