"""Residuals of a fit at rest, as pictures: over time, against each command and its direction, and by marker."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rfdropo_bayes.report import style
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
