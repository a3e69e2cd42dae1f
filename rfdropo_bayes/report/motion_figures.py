"""Pictures of a motion with matplotlib: in space, from the side and from above; one still, or an animation."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.animation import FFMpegWriter, FuncAnimation, PillowWriter
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from scipy.spatial import ConvexHull

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.report.motion import CUBE_FACES, DrawnMotion, silhouette, tube
from rfdropo_bayes.report.style import ACCENT, MEASURED, WIDTH, styled

PLANES = {"from the side": (0, 2), "from above": (0, 1)}
AXES = ("along [mm]", "across [mm]", "up [mm]")
INSTANTS = 6  # instants that a still shows
TICKS = 5  # ticks along the longest axis in space; shorter axes have fewer, so that their labels do not meet
GROUND = "#D9D9D9"
MILLIMETRES = 1e3


def _frame(motion: DrawnMotion) -> tuple[Figure, Axes, dict[str, Axes]]:
    """Figure with a view in space and two projections, of equal scale."""
    figure = Figure(figsize=(WIDTH, 4.6))
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.15, 1.0))
    space: Any = figure.add_subplot(grid[:, 0], projection="3d")
    low, high = MILLIMETRES * motion.bounds()
    margin = 15.0 + MILLIMETRES * float(motion.radius.max())
    low, high = low - margin, high + margin
    if motion.plate is not None:
        low[2] = min(low[2], MILLIMETRES * motion.plate - 5.0)
    space.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    space.set_box_aspect(high - low, zoom=0.87)  # room for the labels of the axes
    space.view_init(elev=22, azim=-60)
    space.set(xlabel=AXES[0], ylabel=AXES[1], zlabel=AXES[2])
    for axis, extent in zip((space.xaxis, space.yaxis, space.zaxis), high - low, strict=True):
        axis.set_major_locator(MaxNLocator(max(2, round(TICKS * extent / float(np.max(high - low))))))
    flat = {}
    for row, (name, (i, j)) in enumerate(PLANES.items()):
        axes = figure.add_subplot(grid[row, 1])
        axes.set(xlim=(low[i], high[i]), ylim=(low[j], high[j]), xlabel=AXES[i], ylabel=AXES[j], title=name)
        axes.set_aspect("equal", adjustable="box")
        if j == 2 and motion.plate is not None:
            axes.axhspan(low[2] - 1e3, MILLIMETRES * motion.plate, color=GROUND, zorder=0)
        flat[name] = axes
    if motion.plate is not None:
        x, y = (
            low[0] + (high[0] - low[0]) * np.array([0, 1, 1, 0, 0]),
            low[1] + (high[1] - low[1]) * np.array([0, 0, 1, 1, 0]),
        )
        space.plot(x, y, MILLIMETRES * motion.plate, color=MEASURED, linewidth=0.8)
    return figure, space, flat


def _hull(points: Float[np.ndarray, "corner 2"]) -> Float[np.ndarray, "outline 2"]:
    return points[ConvexHull(points).vertices]


def _draw(motion: DrawnMotion, row: int, space: Any, flat: dict[str, Axes], colour: Any, alpha: float) -> list[Any]:
    """Trunk, cube and measured markers at one instant; returns the artists."""
    centre, radius = MILLIMETRES * motion.centre[row], MILLIMETRES * motion.radius
    rings = tube(centre, radius)
    drawn: list[Any] = [space.plot_surface(*np.moveaxis(rings, 2, 0), color=colour, alpha=alpha, linewidth=0)]
    cube = None if motion.cube is None else MILLIMETRES * motion.cube[row]
    if cube is not None:
        faces = Poly3DCollection(cube[CUBE_FACES], facecolor=ACCENT, edgecolor="#8A5A00", linewidth=0.6, alpha=alpha)
        drawn.append(space.add_collection3d(faces))
    for name, (i, j) in PLANES.items():
        axes = flat[name]
        if cube is not None:
            shape = Polygon(_hull(cube[:, (i, j)]), facecolor=ACCENT, edgecolor="#8A5A00", alpha=alpha, zorder=2)
            drawn.append(axes.add_patch(shape))
        outline = silhouette(centre[:, (i, j)], radius)
        drawn.append(axes.add_patch(Polygon(outline, facecolor=colour, edgecolor="none", alpha=alpha, zorder=3)))
        if motion.measured is not None:
            place = MILLIMETRES * motion.measured[row][:, (i, j)]
            drawn.extend(axes.plot(*place.T, ".", color=MEASURED, markersize=3, zorder=4))
    return drawn


@styled
def still(motion: DrawnMotion) -> Figure:
    """Several instants in one picture, from light to dark; dots are measured markers."""
    rows = np.unique(np.linspace(0, len(motion.time) - 1, INSTANTS).astype(int))
    figure, space, flat = _frame(motion)
    shades = colormaps["Blues"](np.linspace(0.35, 0.95, len(rows)))
    for row, shade, alpha in zip(rows, shades, np.linspace(0.35, 0.95, len(rows)), strict=True):
        _draw(motion, int(row), space, flat, shade, float(alpha))
    times = ", ".join(f"{motion.time[row] - motion.time[0]:.2g}" for row in rows)
    figure.suptitle(f"{motion.title}: t = {times} s, from light to dark")
    return figure


def save_still(motion: DrawnMotion, path: Path) -> None:
    """Write a still as PNG, SVG or PDF, by the suffix of the name."""
    still(motion).savefig(path)


def save_animation(motion: DrawnMotion, path: Path, frames_per_second: int) -> None:
    """Write an animation in real time as GIF, or as MP4 if ffmpeg is installed.

    Raises:
        InputError: an MP4 without ffmpeg.
    """
    if path.suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise InputError("MP4 needs ffmpeg", where=str(path), remedy="install ffmpeg, or write a .gif")
    writer = FFMpegWriter(fps=frames_per_second) if path.suffix == ".mp4" else PillowWriter(fps=frames_per_second)
    _animation(motion, frames_per_second, writer, path)


@styled
def _animation(motion: DrawnMotion, frames_per_second: int, writer: Any, path: Path) -> Figure:
    figure, space, flat = _frame(motion)
    count = max(2, round(float(motion.time[-1] - motion.time[0]) * frames_per_second))
    rows = np.searchsorted(motion.time, np.linspace(motion.time[0], motion.time[-1], count))
    shown: list[Any] = []

    def draw(row: int) -> list[Any]:
        while shown:
            shown.pop().remove()
        shown.extend(_draw(motion, int(row), space, flat, colormaps["Blues"](0.75), 0.9))
        figure.suptitle(f"{motion.title}: t = {motion.time[row] - motion.time[0]:.2f} s")
        return shown

    FuncAnimation(figure, draw, frames=rows, init_func=lambda: []).save(path, writer=writer, dpi=80)
    return figure
