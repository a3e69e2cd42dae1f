"""Common style of all figures: sizes that read at 100 % in a browser, colours that colour-blind readers can
distinguish.
"""

from __future__ import annotations

import base64
import io
import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from typing import Any, Literal, ParamSpec

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter
from matplotlib.transforms import Bbox

from rfdropo_bayes.report.units import display_name

# Okabe and Ito's palette.
POSTERIOR = "#0072B2"
PRIOR = "#8A8A8A"
MEASURED = "#1A1A1A"
TEST = "#D55E00"
ACCENT = "#E69F00"
AXIS_COLOURS = ("#0072B2", "#E69F00", "#009E73")
CYCLE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#1A1A1A")

WIDTH = 10.0  # [inch]; 960 px in a browser
POINTS = 800  # of a line, at most
LEAST_CELL, ROW_GAP = 2.2, 0.05  # [inch]: of the width of a cell that can stand by itself; above and below it

STYLE: Any = {
    "figure.dpi": 96,
    "savefig.dpi": 192,
    "figure.facecolor": "white",
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.labelsize": 9,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "grid.color": "#E3E3E3",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.prop_cycle": cycler(color=CYCLE),
    "axes.unicode_minus": True,
    "lines.linewidth": 1.4,
    "figure.constrained_layout.use": True,
    "svg.fonttype": "path",
    "svg.hashsalt": "rfdropo_bayes",
}

P = ParamSpec("P")


@dataclass(frozen=True)
class Panel:
    """A part of a figure: one cell of its grid, or its legend."""

    source: str  # data URI
    share: float  # share of the figure's width, in percent
    kind: Literal["cell", "legend", "whole"]  # "cell"; "legend"; "whole" if the figure has no parts


@dataclass(frozen=True)
class Picture:
    """A figure inside a page: panels that fill its rows side by side, or stand below each other on a narrow screen."""

    panels: tuple[Panel, ...]  # panels from the upper left to the lower right
    alt: str  # text for readers who cannot see it
    caption: str  # explanation of the figure
    width: int  # width in CSS pixels


@contextmanager
def _our_style() -> Iterator[None]:
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE)
        yield


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Run a drawing function under the common style, independently of the user's matplotlibrc."""

    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with _our_style():
            return draw(*args, **kwargs)

    return drawn


def embed(figure: Figure, alt: str, caption: str = "", *, whole: bool = False) -> Picture:
    """Figure as SVGs inside data URIs, without a background: the page's shows through.

    ``whole`` keeps it in one piece, for panels that share their axes' labels.
    """
    with _our_style():
        engine = figure.get_layout_engine()
        if engine is not None:  # once, here: savefig would draw everything a second time for it
            engine.execute(figure)
            figure.set_layout_engine("none")
        cells = [] if whole else _cells(figure)
        panels = [Panel(_svg(figure, None), 100.0, "whole")] if not cells else _panels(figure, cells)
    return Picture(tuple(panels), alt, caption, round(96 * figure.get_figwidth()))


def _svg(figure: Figure, box: Bbox | None) -> str:
    """The part of a figure in a box [inch] as a data URI."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None}, transparent=True, bbox_inches=box)
    return f"data:image/svg+xml;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"


def _panels(figure: Figure, cells: Sequence[tuple[Axes, Bbox]]) -> list[Panel]:
    """A picture of each legend and each cell, with everything else hidden."""
    width = figure.get_figwidth()
    parts: list[tuple[Artist, Bbox, Literal["cell", "legend"]]] = []
    for legend in figure.legends:
        parts.append((legend, _inches(figure, legend.get_window_extent()).padded(0.04), "legend"))
    parts += [(axes, box, "cell") for axes, box in cells]
    artists = [*figure.legends, *figure.axes]
    seen = [artist.get_visible() for artist in artists]
    panels = []
    for own, box, kind in parts:
        for artist in artists:
            artist.set_visible(artist is own)
        panels.append(Panel(_svg(figure, box), 100.0 * box.width / width, kind))
    for artist, visible in zip(artists, seen, strict=True):
        artist.set_visible(visible)
    return panels


def _inches(figure: Figure, box: Bbox) -> Bbox:
    return box.transformed(figure.dpi_scale_trans.inverted())


def _cells(figure: Figure) -> list[tuple[Axes, Bbox]]:
    """Axes in a grid, each with its cell [inch]; cells of a row fill the width of the figure.

    None if the figure is one piece: a single column, axes outside of a grid, or a grid too fine to be taken apart.
    """
    shown = [axes for axes in figure.axes if axes.axison]
    specs = {axes: axes.get_subplotspec() for axes in shown}
    if len(shown) < 2 or any(spec is None or len(spec.rowspan) > 1 for spec in specs.values()) or figure.texts:
        return []
    boxes = {axes: _inches(figure, box) for axes in shown if (box := axes.get_tightbbox()) is not None}
    rows: dict[int, list[Axes]] = {}
    for axes in sorted(boxes, key=lambda own: boxes[own].x0):  # an invisible cell has no box
        rows.setdefault(specs[axes].rowspan.start, []).append(axes)  # type: ignore[union-attr]
    width = figure.get_figwidth()
    if width / max(len(row) for row in rows.values()) < LEAST_CELL:
        return []
    cells = []
    for _, row in sorted(rows.items()):
        low, high = min(boxes[a].y0 for a in row), max(boxes[a].y1 for a in row)
        between = [0.5 * (boxes[a].x1 + boxes[b].x0) for a, b in itertools.pairwise(row)]
        last = width if len(row) == max(len(r) for r in rows.values()) else boxes[row[-1]].x1 + 0.02
        for axes, left, right in zip(row, [0.0, *between], [*between, last], strict=True):
            cells.append((axes, Bbox([[left, low - ROW_GAP], [right, high + ROW_GAP]])))
    return cells


def thin(rows: int) -> np.ndarray:
    """Indices of the rows that a line shows: all of them, or an even choice that ends with the last."""
    return np.arange(rows) if rows <= POINTS else np.unique(np.linspace(0, rows - 1, POINTS).round().astype(int))


def label_with_unit(name: str, unit: str) -> str:
    """Displayed name with its unit in brackets, if it has a unit."""
    return f"{display_name(name)} [{unit}]" if unit else display_name(name)


class PlainLogFormatter(LogFormatter):
    """Plain numbers on a logarithmic axis: 0.6, and not 6e-01."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return f"{x:g}" if super().__call__(x, pos) else ""


def empty(axes: Axes) -> None:
    """A cell of a grid that shows nothing."""
    axes.set_axis_off()
