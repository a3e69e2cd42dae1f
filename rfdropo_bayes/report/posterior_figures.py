"""Figures of the posterior: pairs of parameters with their ridges, prior against posterior, per recording."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator
from scipy.ndimage import gaussian_filter

from rfdropo_bayes.posteriors import ParameterInfo, PosteriorRecord, ProductOfPowers
from rfdropo_bayes.report import style
from rfdropo_bayes.report.units import display_unit

MOST_PAIRED = 6
MOST_PANELS = 24
SHOWN_DRAWS = 1200
MARGIN = 0.08  # beside the values, in widths of their range
RIDGE = 0.9


def paired_names(record: PosteriorRecord) -> list[str]:
    """Parameters that the pair plot shows: varying shared parameters, the most correlated first if there are too
    many.
    """
    names = [i.name for i in record.free if not i.scope.owner and np.ptp(record.flat(i.name)) > 0]
    if len(names) <= MOST_PAIRED:
        return names
    strength = np.abs(np.corrcoef(np.stack([_transformed(record, name) for name in names])))
    np.fill_diagonal(strength, 0.0)
    chosen = np.argsort(-strength.max(axis=1), kind="stable")[:MOST_PAIRED]
    return [names[i] for i in sorted(chosen)]


def _transformed(record: PosteriorRecord, name: str) -> Float[np.ndarray, " n"]:
    draws = record.flat(name)
    info = next(i for i in record.parameters if i.name == name)
    return np.log(draws) if info.logarithmic and np.all(draws > 0) else draws


class _Scale:
    """Axis of the values of one parameter: unit, logarithm, range."""

    def __init__(self, info: ParameterInfo, values: Float[np.ndarray, " n"]) -> None:
        self.factor, unit = display_unit(info.unit, float(np.median(np.abs(values))))
        self.label = style.label_with_unit(info.name, unit)
        self.log = info.logarithmic and bool(np.all(values > 0))
        low, high = self.forward(np.quantile(values, [0.002, 0.998]))
        width = (high - low) or abs(high) or 1.0
        limits = self.backward(np.array([low - MARGIN * width, high + MARGIN * width]))
        self.limits = np.clip(limits, info.low / self.factor, info.high / self.factor)

    def forward(self, values: np.ndarray) -> np.ndarray:
        """Transform SI values to the scale of the axis."""
        values = np.asarray(values) / self.factor
        return np.log(values) if self.log else values

    def even(self, number: int) -> np.ndarray:
        """Evenly spaced places from one end of the axis to the other."""
        low, high = self.forward(self.limits * self.factor)
        return np.linspace(low, high, number)

    def backward(self, place: np.ndarray) -> np.ndarray:
        """Map from an even axis to displayed values."""
        return np.exp(place) if self.log else place

    def apply(self, axes: Axes, which: str, *, ticks: int = 4) -> None:
        """Scale, limits and ticks of one axis."""
        axis = getattr(axes, f"{which}axis")
        getattr(axes, f"set_{which}scale")("log" if self.log else "linear")
        getattr(axes, f"set_{which}lim")(*self.limits)
        decades = np.log10(self.limits[1] / self.limits[0]) if self.log else 0.0
        subs = (1.0,) if decades > 2.5 else (1.0, 3.0) if decades > 1.2 else (1.0, 2.0, 5.0)
        axis.set_major_locator(LogLocator(subs=subs, numticks=99) if decades > 0.7 else MaxNLocator(ticks))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"))
        axis.set_minor_formatter(NullFormatter())


@style.styled
def pair_figure(record: PosteriorRecord, names: Sequence[str]) -> Figure:
    """Scatter of every pair with the 50 % and 90 % regions; the axes of logarithmic priors are logarithmic.

    Above the diagonal stands the correlation. A pair on a ridge gets the line along which their ratio is constant.
    """
    n = len(names)
    size = min(style.WIDTH, 2.6 + 1.75 * n) if n < 5 else style.WIDTH
    figure = Figure(figsize=(size, 0.92 * size))
    draw_pairs(record, names, figure.subplots(n, n, squeeze=False))
    figure.align_labels()
    return figure


def draw_pairs(record: PosteriorRecord, names: Sequence[str], grid: np.ndarray) -> None:
    """The panels of `pair_figure` on a square grid of axes."""
    n = len(names)
    infos = {info.name: info for info in record.parameters}
    draws = {name: record.flat(name) for name in names}
    scales = {name: _Scale(infos[name], draws[name]) for name in names}
    shown = np.linspace(0, len(draws[names[0]]) - 1, min(SHOWN_DRAWS, len(draws[names[0]]))).astype(int)
    for i, row in enumerate(names):
        for j, column in enumerate(names):
            axes = grid[i, j]
            if i == j:
                _histogram(axes, draws[row], scales[row])
            elif i > j:
                _cloud(axes, draws[column], draws[row], scales[column], scales[row], shown)
            else:
                _correlation(axes, scales[row].forward(draws[row]), scales[column].forward(draws[column]))
                continue
            if i == n - 1:
                axes.set_xlabel(_wrapped(scales[column].label))
                axes.tick_params(axis="x", labelrotation=35)
            else:
                axes.tick_params(labelbottom=False)
            if j == 0 and i > 0:
                axes.set_ylabel(_wrapped(scales[row].label))
            elif i != j:
                axes.tick_params(labelleft=False)


def _wrapped(label: str, width: int = 20) -> str:
    words, lines = label.split(" "), [""]
    for word in words:
        lines = [*lines[:-1], f"{lines[-1]} {word}".strip()] if len(lines[-1]) + len(word) < width else [*lines, word]
    return "\n".join(line for line in lines if line)


def _histogram(axes: Axes, values: np.ndarray, scale: _Scale) -> None:
    axes.hist(
        values / scale.factor,
        bins=scale.backward(scale.even(_bins(len(values)))).tolist(),
        color=style.POSTERIOR,
        alpha=0.85,
    )
    scale.apply(axes, "x")
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)


def _bins(number: int) -> int:
    return int(np.clip(np.sqrt(number), 12, 36))


def _cloud(axes: Axes, x: np.ndarray, y: np.ndarray, across: _Scale, up: _Scale, shown: np.ndarray) -> None:
    axes.plot(
        x[shown] / across.factor,
        y[shown] / up.factor,
        ".",
        color=style.POSTERIOR,
        markersize=2.5,
        alpha=0.35,
        rasterized=True,
    )
    u, v = across.forward(x), up.forward(y)
    _regions(axes, u, v, across, up)
    if across.log and up.log and np.corrcoef(u, v)[0, 1] > RIDGE:
        line = np.quantile(u, [0.0, 1.0])
        axes.plot(
            across.backward(line),
            up.backward(np.median(v) + line - np.median(u)),
            "--",
            color=style.TEST,
            linewidth=1.2,
            label="constant ratio",
        )
        axes.legend(loc="upper left", handlelength=1.4, borderpad=0.1)
    across.apply(axes, "x")
    up.apply(axes, "y")


def _regions(axes: Axes, u: np.ndarray, v: np.ndarray, across: _Scale, up: _Scale) -> None:
    """Outlines of the smallest regions that hold 50 % and 90 % of the draws.

    The histogram lies along the principal axes of the draws, since bins along the parameters would blur a thin ridge.
    """
    points = np.stack([u, v])
    centre = points.mean(axis=1, keepdims=True)
    covariance = np.cov(points)
    if not np.all(np.linalg.eigvalsh(covariance) > 1e-12 * np.trace(covariance)):
        return
    root = np.linalg.cholesky(covariance)
    a, b = np.linalg.solve(root, points - centre)
    edges = np.linspace(-4.0, 4.0, 49)
    density = gaussian_filter(np.histogram2d(a, b, bins=[edges, edges])[0], 1.5)
    ordered = np.sort(density.reshape(-1))[::-1]
    cumulative = np.cumsum(ordered) / max(ordered.sum(), 1.0)
    levels = [ordered[np.searchsorted(cumulative, share)] for share in (0.9, 0.5)]
    if not 0 < levels[0] < levels[1]:
        return
    middle = 0.5 * (edges[1:] + edges[:-1])
    grid = np.stack(np.meshgrid(middle, middle, indexing="ij")).reshape(2, -1)
    back = (root @ grid + centre).reshape(2, *density.shape)
    axes.contour(
        across.backward(back[0]), up.backward(back[1]), density, levels=levels, colors=style.MEASURED, linewidths=0.9
    )


def _correlation(axes: Axes, u: np.ndarray, v: np.ndarray) -> None:
    r = float(np.corrcoef(u, v)[0, 1])
    style.empty(axes)
    text = f"{r:+.4f}" if abs(r) > 0.99 else f"{r:+.2f}"
    colour = style.TEST if abs(r) > RIDGE else style.MEASURED
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", fontsize=9 + 4 * abs(r), color=colour)


@style.styled
def prior_posterior_figure(record: PosteriorRecord, names: Sequence[str]) -> Figure:
    """Marginal densities before and after the data; hard bounds in view are marked."""
    columns = min(4, len(names))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(min(style.WIDTH, 3.2 * columns), 0.35 + 1.95 * rows))
    grid = figure.subplots(rows, columns, squeeze=False).reshape(-1)
    infos = {info.name: info for info in record.parameters}
    logarithmic = {q.name for q in record.derived if isinstance(q, ProductOfPowers)}
    for axes, name in zip(grid, names, strict=False):
        draw_before_and_after(axes, infos[name], record.flat(name), record.prior.get(name), log=name in logarithmic)
    for axes in grid[len(names) :]:
        style.empty(axes)
    handles, labels = grid[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3)
    return figure


def draw_before_and_after(
    axes: Axes, info: ParameterInfo, draws: np.ndarray, prior: np.ndarray | None, *, log: bool
) -> None:
    """Marginal densities of one parameter before and after the data."""
    if log and prior is not None and np.all(prior > 0):
        info = ParameterInfo(info.name, info.unit, info.low, info.high, {"distribution": "LogDerived"})
    scale = _Scale(info, draws if prior is None else np.concatenate([draws, prior]))
    edges = scale.even(2 * _bins(len(draws)))
    shown = scale.backward(edges)
    if prior is not None:
        height = _heights(scale.forward(prior), edges)
        axes.stairs(height, shown, color=style.PRIOR, fill=True, alpha=0.35, label="prior")
        axes.stairs(height, shown, color=style.PRIOR, linewidth=1.2)
    axes.stairs(
        _heights(scale.forward(draws), edges), shown, color=style.POSTERIOR, fill=True, alpha=0.8, label="posterior"
    )
    for bound in (info.low, info.high):
        if np.isfinite(bound) and scale.limits[0] <= bound / scale.factor <= scale.limits[1]:
            axes.axvline(bound / scale.factor, color=style.TEST, linestyle=":", linewidth=1.6, label="hard bound")
    scale.apply(axes, "x")
    axes.set_ylim(0.0, 1.08)
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    axes.set_xlabel(_wrapped(scale.label, 30))


def _heights(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Histogram with a peak of 1: otherwise a narrow posterior would flatten its prior."""
    counts = np.histogram(values, bins=edges)[0].astype(float)
    return counts / max(counts.max(), 1.0)


@style.styled
def forest_figure(record: PosteriorRecord, owned: Sequence[ParameterInfo]) -> Figure:
    """Median with 50 % and 90 % intervals of parameters that belong to one recording, recording by recording."""
    bases = list(dict.fromkeys(info.parameter for info in owned))
    recordings = list(dict.fromkeys(info.scope.owner for info in owned))
    columns = min(2, len(bases))
    rows = -(-len(bases) // columns)
    figure = Figure(figsize=(style.WIDTH, rows * (0.9 + 0.26 * len(recordings))))
    grid = figure.subplots(rows, columns, squeeze=False, sharey=True).reshape(-1)
    for axes, base in zip(grid, bases, strict=False):
        own = [info for info in owned if info.parameter == base]
        draws = [record.flat(info.name) for info in own]
        factor, unit = display_unit(own[0].unit, float(max(np.quantile(np.abs(d), 0.9) for d in draws)))
        for info, values in zip(own, draws, strict=True):
            y = recordings.index(info.scope.owner)
            q05, q25, q50, q75, q95 = np.quantile(values / factor, [0.05, 0.25, 0.5, 0.75, 0.95])
            axes.plot([q05, q95], [y, y], color=style.POSTERIOR, linewidth=1.2)
            axes.plot([q25, q75], [y, y], color=style.POSTERIOR, linewidth=4)
            axes.plot(q50, y, "o", color="white", markeredgecolor=style.POSTERIOR, markersize=4.5)
        axes.set_xlabel(style.label_with_unit(base, unit))
        axes.xaxis.set_major_locator(MaxNLocator(5))
    for axes in grid[len(bases) :]:
        style.empty(axes)
    for axes in grid[: len(bases)]:
        axes.tick_params(labelleft=True)  # each can be seen by itself
        axes.set_yticks(range(len(recordings)), [r if len(r) < 34 else f"…{r[-32:]}" for r in recordings])
        axes.set_ylim(len(recordings) - 0.5, -0.5)
    return figure
