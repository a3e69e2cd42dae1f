"""One look for all figures: sizes that read at 100 % in a browser, colours that colour-blind readers can tell apart."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from typing import Any, ParamSpec

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure

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
class Picture:
    """A figure inside a page.

    Attributes:
        source: data URI.
        alt: what it shows, for those who cannot see it.
        caption: how to read it.
        width: in CSS pixels.
    """

    source: str
    alt: str
    caption: str
    width: int


@contextmanager
def _our_style() -> Iterator[None]:
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE)
        yield


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Run a drawing function under the common style, whatever the user's matplotlibrc says."""

    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with _our_style():
            return draw(*args, **kwargs)

    return drawn


def embed(figure: Figure, alt: str, caption: str = "") -> Picture:
    """Figure as SVG inside a data URI."""
    buffer = io.BytesIO()
    with _our_style():
        engine = figure.get_layout_engine()
        if engine is not None:  # once, here: savefig would draw everything a second time for it
            engine.execute(figure)
            figure.set_layout_engine("none")
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    return Picture(f"data:image/svg+xml;base64,{data}", alt, caption, round(96 * figure.get_figwidth()))


def thin(rows: int) -> np.ndarray:
    """Indices of the rows that a line shows: all of them, or an even choice that ends with the last."""
    return np.arange(rows) if rows <= POINTS else np.unique(np.linspace(0, rows - 1, POINTS).round().astype(int))


def label_with_unit(name: str, unit: str) -> str:
    return f"{display_name(name)} [{unit}]" if unit else display_name(name)


def empty(axes: Axes) -> None:
    """A cell of a grid that shows nothing."""
    axes.set_axis_off()
