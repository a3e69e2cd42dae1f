"""Effect of each candidate of the library on the data, at its null value and for trial values of its shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.discrepancy.fit import Fit, FitTarget
from rfdropo_bayes.discrepancy.score import VISIBLE, Signature, project_out, signature, span
from rfdropo_bayes.posteriors import label
from rfdropo_bayes.simulators.mechanisms import Mechanism

LEVELS = (0.1, 0.3, 0.5, 0.7, 0.9)  # quantiles of the prior at which a shape is tried
LEVELS_OF_TWO = (0.2, 0.5, 0.8)  # if there are two of them
CROSSED = 2  # shapes with the same grid, or without a grid of their own, that are tried in every combination
WAY = np.geomspace(0.05, 1.5, 12)  # shares of the path from null to a trial shape
NEIGHBOURS = 1.001  # a ladder that is no wider is not divided again: it ends after four divisions at the most
SIZES = np.geomspace(0.03, 3.0, 12)  # of an amplitude, in prior deviations; the slope at null shows small sizes


def spoken(name: str) -> str:
    """A candidate's name in words: ``payload@april`` is "payload in april"."""
    return name.replace("_", " ").replace("@", " in ")


@dataclass(frozen=True)
class Probe:
    """One possible effect of a candidate on the data.

    Attributes:
        candidate: its name.
        point: coordinates of its parameters there, by index.
        columns: whitened effect of prior-sized changes of its amplitudes.
        amplitudes: indices of the parameters the columns belong to; empty for a secant, the effect of `point` itself.
        mark: the part that base parameters cannot imitate.
    """

    candidate: str
    point: dict[int, float]
    columns: Float[np.ndarray, "n k"]
    amplitudes: tuple[int, ...]
    mark: Signature

    def start(self, fit: Fit) -> Float[np.ndarray, " d"]:
        """Start of a fit of this candidate: base parameters and amplitudes from the linear model."""
        return start_together(fit, [self])


def start_together(fit: Fit, probes: Sequence[Probe]) -> Float[np.ndarray, " d"]:
    """Start of a fit of several candidates, see `Probe.start`."""
    x, columns = fit.x.copy(), np.concatenate([probe.columns for probe in probes], axis=1)
    for probe in probes:
        x[list(probe.point)] = list(probe.point.values())
    design = np.concatenate([fit.jacobian, columns], axis=1)
    ridge = np.concatenate([np.sqrt(np.diag(np.linalg.inv(fit.covariance))) * 1e-3, np.ones(columns.shape[1])])
    step = np.linalg.lstsq(
        np.concatenate([design, np.diag(ridge)]), np.concatenate([fit.residual, np.zeros(len(ridge))]), rcond=None
    )[0]
    x[fit.free] += np.clip(step[: len(fit.free)], -1.0, 1.0)
    values = np.split(step[len(fit.free) :], np.cumsum([probe.columns.shape[1] for probe in probes])[:-1])
    for probe, own in zip(probes, values, strict=True):
        for index, value in zip(probe.amplitudes, own, strict=False):
            x[index] += value
    return x


@dataclass(frozen=True)
class Candidate:
    """A mechanism that may be named.

    Attributes:
        title: registry name.
        indices: coordinates of its parameters.
        mechanism: the mechanism.
        source: its name in an experiment file.
        group: group of recordings with this candidate; empty for all.
    """

    title: str
    indices: tuple[int, ...]
    mechanism: Mechanism
    source: str
    group: str = ""

    @property
    def name(self) -> str:
        """Title and group in one word, by which it is known."""
        return label(self.title, self.group)


def probe_all(target: FitTarget, fit: Fit, candidates: Sequence[Candidate]) -> list[Probe]:
    """Probes of every candidate at a fit of the present model, all in a few batches of rollouts.

    A parameter without visible effect at null is a shape (a time constant, a threshold). Its prior is tried on a grid.
    If the shape alone changes the data visibly, that change is the direction; otherwise the amplitudes are
    differentiated at the trial value. Rounding of a solver is an effect, too, but not a visible one. More than two
    shapes with the same grid, or without a grid of their own, move along it together: every combination of 63 offsets
    would be 3^63 points.
    """
    base, coordinates = span(fit.jacobian), target.forward.coordinates
    open_ = [c for c in candidates if c.indices]
    indices = [i for c in open_ for i in c.indices]
    at_null = np.zeros((len(fit.residual), 0))
    if indices:
        points, directions = np.repeat(fit.x[None], len(indices), axis=0), np.eye(len(fit.x))[indices]
        at_null = target.recall(
            "null", [points, directions], lambda: {"slopes": target.visible_slopes(points, directions)}
        )["slopes"].T
    column = dict(zip(indices, at_null.T, strict=True))
    jobs: list[tuple[Candidate, dict[int, float]]] = []
    probes: list[Probe] = []
    for candidate in open_:
        unseen = [i for i in candidate.indices if np.linalg.norm(column[i]) < VISIBLE]
        grids = {i: coordinates.space.parameters[i].spec.grid for i in unseen}
        # If an amplitude has an effect, another amplitude without effect (a tilt about gravity itself) is no shape.
        all_unseen = len(unseen) == len(candidate.indices)
        shapes = [i for i in unseen if all_unseen or not coordinates.affine[i] or grids[i]]
        if not shapes:
            columns = np.stack([column[i] for i in candidate.indices], axis=1)
            probes.append(_probe(target, base, candidate, {}, columns, candidate.indices))
            continue
        levels = LEVELS if len(shapes) < 2 else LEVELS_OF_TWO
        axes: list[list[dict[int, float]]] = []
        for grid in dict.fromkeys(grids[i] for i in shapes):
            alike = [i for i in shapes if grids[i] == grid]
            values = [coordinates.encode_one(i, grid) if grid else coordinates.quantiles(i, levels) for i in alike]
            if len(alike) <= CROSSED:
                axes += [[{i: value} for value in own] for i, own in zip(alike, values, strict=True)]
            else:
                axes.append([dict(zip(alike, row, strict=True)) for row in zip(*values, strict=True)])
        jobs += [(candidate, {k: v for part in parts for k, v in part.items()}) for parts in product(*axes)]
    return probes + _probe_grid(target, fit, base, jobs)


def score_test_rollouts(target: FitTarget, candidates: Sequence[Candidate]) -> int:
    """Rollouts that `probe_all` takes: a slope for each parameter, and the grids of shapes."""
    forward, parameters = target.forward, target.forward.coordinates.space.parameters
    rollouts = 0
    for candidate in candidates:
        own = [parameters[i] for i in candidate.indices]
        touched = sum(any(p.holds_for(name) for p in own) for name in target.measurements.names)
        shapes = [len(p.spec.grid) for p in own if p.spec.grid]
        rollouts += touched * ((forward.lanes.slope_rollouts + 2) * len(own) + int(np.prod(shapes)) * bool(shapes))
    return rollouts


def _probe_grid(
    target: FitTarget, fit: Fit, base: np.ndarray, jobs: Sequence[tuple[Candidate, dict[int, float]]]
) -> list[Probe]:
    if not jobs:
        return []
    points = np.repeat(fit.x[None], len(jobs), axis=0)
    for row, (_, point) in enumerate(jobs):
        for index, value in point.items():
            points[row, index] = value
    residual = target.recall("grid", [points], lambda: {"residual": target.residual(points)})["residual"]
    secants = np.clip(fit.residual - residual, -1e3, 1e3)
    alone = np.linalg.norm(secants, axis=1) > VISIBLE
    slots = [(row, i) for row, (c, p) in enumerate(jobs) if not alone[row] for i in c.indices if i not in p]
    rows = np.array([row for row, _ in slots], dtype=int)
    directions = np.eye(points.shape[1])[[i for _, i in slots]] if slots else np.zeros((0, points.shape[1]))
    slopes = target.recall(
        "slopes", [points[rows], directions], lambda: {"slopes": target.visible_slopes(points[rows], directions)}
    )
    probes = []
    for row, (candidate, point) in enumerate(jobs):
        if alone[row]:
            probes.append(_probe(target, base, candidate, point, secants[row][:, None], ()))
        else:
            amplitudes = tuple(i for i in candidate.indices if i not in point)
            if amplitudes:
                probes.append(_probe(target, base, candidate, point, slopes["slopes"][rows == row].T, amplitudes))
    return probes


def _probe(
    target: FitTarget,
    base: np.ndarray,
    candidate: Candidate,
    point: dict[int, float],
    columns: np.ndarray,
    amplitudes: tuple[int, ...],
) -> Probe:
    sign = 1 if not amplitudes else int(target.forward.coordinates.one_sided[amplitudes[0]])
    mark = signature(base, columns, sign if columns.shape[1] == 1 else 0)
    return Probe(candidate.name, point, columns, amplitudes, mark)


def lead(target: FitTarget, fit: Fit, probe: Probe, lm: float) -> tuple[float, Float[np.ndarray, " d"]]:
    """Possible drop of the sum of squares by a candidate, and the start of a refit.

    The score statistic is the drop for an effect proportional to its amplitude. An effect that shifts a motion by its
    own period is not proportional, so that several sizes of a single amplitude are also tried. A shape alone has no
    amplitude: its effect has a fixed size, and may be too large at the trial value. The path from its null value is
    searched, with places and times fixed if there is also a size.
    """
    coordinates = target.forward.coordinates
    if len(probe.amplitudes) == 1:
        (index,) = probe.amplitudes
        sign = coordinates.one_sided[index]
        sizes = SIZES * sign if sign else np.concatenate([-SIZES, SIZES])
        points = np.repeat(fit.x[None], len(sizes), axis=0)
        points[:, list(probe.point)] = list(probe.point.values())
        points[:, index] = coordinates.null[index] + coordinates.prior_sd[index] * sizes
        drop, start, _ = _best_of(target, fit, np.clip(points, *coordinates.bounds))
        return (drop, start) if drop > lm else (lm, probe.start(fit))
    if probe.amplitudes:
        return lm, probe.start(fit)
    sized = [i for i in probe.point if coordinates.affine[i] and not coordinates.space.parameters[i].spec.grid]
    ladder = WAY
    while True:
        points = np.repeat(fit.x[None], len(ladder), axis=0)
        for index, value in probe.point.items():
            null = coordinates.null[index]
            points[:, index] = null + ladder * (value - null) if index in sized or not sized else value
        drop, start, best = _best_of(target, fit, np.clip(points, *coordinates.bounds))
        low, high = ladder[max(best - 1, 0)], ladder[min(best + 1, len(ladder) - 1)]
        # For a stop that cables seldom reach, a rung has no effect and the next far too much: the optimum lies between
        # them.
        if drop > VISIBLE**2 or high < NEIGHBOURS * low:
            return drop, start
        ladder = np.geomspace(low, high, len(WAY))


def _best_of(
    target: FitTarget, fit: Fit, points: Float[np.ndarray, "way d"]
) -> tuple[float, Float[np.ndarray, " d"], int]:
    """Largest decrease of the sum of squares over the points, with refitted base parameters; this point; and its index,
    the last of several with the same decrease.
    """
    base = span(fit.jacobian)
    residuals = target.recall("way", [points], lambda: {"residual": target.residual(points)})["residual"]
    remaining = np.sum(project_out(base, residuals.T) ** 2, axis=0)
    best = len(remaining) - 1 - int(np.argmin(remaining[::-1]))
    at_null = float(np.sum(project_out(base, fit.residual[:, None]) ** 2))
    start = points[best]
    step = np.linalg.lstsq(fit.jacobian, residuals[best], rcond=1e-6)[0]
    start[fit.free] += np.clip(step, -1.0, 1.0)
    return at_null - float(remaining[best]), start, best
