"""Figures of the run: errors beside the baselines, coverage of the bands, the sampler, when the model failed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from rfdropo_bayes.report import style
from rfdropo_bayes.report.coverage import TransformCurve

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
