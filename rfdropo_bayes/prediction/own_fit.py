"""Least squares of many draws at once, each with its own optimum: what is a recording's own, fitted draw by draw.

Every draw has k standard normal coordinates and m whitened residuals. Its cost is half of the sum of squares of the
residuals, and of what the coordinates are off a draw from their prior. With residuals under perturbed data, and the
prior's draw as the centre, the optimum is a draw from the posterior, exactly where residuals are linear (randomised
maximum likelihood, Oliver, He & Reynolds 1996).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

STEP = 0.05  # of a central difference, in prior deviations
TOLERANCE = 1e-3  # nats that a draw's next step promises: less than any cost is known to
MOST_STEPS = 30
DAMPINGS = (0.1, 1.0, 10.0, 100.0)  # of a draw's last one: the first that lowers its cost is taken
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-9, 1e6

Residuals = Callable[[Float[np.ndarray, "b k"], Int[np.ndarray, " b"]], Float[np.ndarray, "b m"]]


class OwnFit(NamedTuple):
    """Optima of all draws.

    Attributes:
        point: coordinates of each draw.
        residual: at the point; not finite where the draw has none.
        slope: of the residuals there.
        converged: draws whose next step promises less than `TOLERANCE`.
        steps: that the last of them took.
    """

    point: Float[np.ndarray, "n k"]
    residual: Float[np.ndarray, "n m"]
    slope: Float[np.ndarray, "n m k"]
    converged: Bool[np.ndarray, " n"]
    steps: int


def fit_own(
    residuals: Residuals,
    centre: Float[np.ndarray, "n k"],
    start: Float[np.ndarray, "n k"] | None = None,
    report: Callable[[int, float], None] = lambda step, share: None,
) -> OwnFit:
    """Levenberg-Marquardt steps of all draws in one batch, until the next step of each promises nothing.

    Args:
        residuals: whitened residuals of points, and of the draw that each belongs to.
        centre: a draw from the prior, which its prior pulls each to.
        start: where each begins; its centre by default.
        report: is told the step, and the share of the draws that have converged.
    """
    draws = np.arange(len(centre))
    point = (centre if start is None else start).copy()
    value = residuals(point, draws)
    slope, damping = np.zeros((*value.shape, centre.shape[1])), np.full(len(centre), FIRST_DAMPING)
    converged, todo, step = np.zeros(len(centre), dtype=bool), draws[np.isfinite(value).all(axis=1)], 0
    while len(todo) and step < MOST_STEPS:
        slope[todo] = _slopes(residuals, point[todo], todo)
        todo = todo[np.isfinite(slope[todo]).all(axis=(1, 2))]
        gradient = np.einsum("nij,ni->nj", slope[todo], value[todo]) + (point - centre)[todo]
        curvature = np.einsum("nij,nik->njk", slope[todo], slope[todo]) + np.eye(centre.shape[1])
        promised = 0.5 * np.einsum("nj,nj->n", gradient, _solve(curvature, gradient))
        done = promised < TOLERANCE
        converged[todo[done]] = True
        report(step, float(np.mean(converged)))
        todo, gradient, curvature = todo[~done], gradient[~done], curvature[~done]
        if not len(todo):
            break
        moved, found, damping[todo] = _step(
            residuals, point[todo], value[todo], damping[todo], centre[todo], gradient, curvature, todo
        )
        point[todo], value[todo] = moved, found
        # Six decades of damping that gain nothing: what differences promise there is rounding, or the edge of a cliff.
        todo, step = todo[damping[todo] < MOST_DAMPING], step + 1
    return OwnFit(point, value, slope, converged, step)


def _step(
    residuals: Residuals,
    point: Float[np.ndarray, "n k"],
    value: Float[np.ndarray, "n m"],
    damping: Float[np.ndarray, " n"],
    centre: Float[np.ndarray, "n k"],
    gradient: Float[np.ndarray, "n k"],
    curvature: Float[np.ndarray, "n k k"],
    draws: Int[np.ndarray, " n"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, residuals and dampings after the least damped step that lowers each cost; where none does, as before."""
    before, waiting = _cost(value, point, centre), np.arange(len(point))
    diagonal = np.einsum("njj->nj", curvature)[:, None] * np.eye(point.shape[1])
    point, value, tried = point.copy(), value.copy(), damping.copy()
    for factor in DAMPINGS:
        tried[waiting] = np.maximum(factor * damping[waiting], LEAST_DAMPING)
        damped = curvature[waiting] + tried[waiting, None, None] * diagonal[waiting]
        moved = point[waiting] - _solve(damped, gradient[waiting])
        found = residuals(moved, draws[waiting])
        better = _cost(found, moved, centre[waiting]) < before[waiting]
        point[waiting[better]], value[waiting[better]] = moved[better], found[better]
        waiting = waiting[~better]
        if not len(waiting):
            break
    return point, value, tried


def _slopes(residuals: Residuals, point: Float[np.ndarray, "n k"], draws: Int[np.ndarray, " n"]) -> np.ndarray:
    """Central differences along every coordinate (n, m, k), all draws and directions in one batch."""
    n, k = point.shape
    moved = np.concatenate([point + sign * STEP * row for row in np.eye(k) for sign in (1.0, -1.0)])
    found = residuals(moved, np.tile(draws, 2 * k)).reshape(k, 2, n, -1)
    return np.moveaxis((found[:, 0] - found[:, 1]) / (2.0 * STEP), 0, 2)


def _cost(value: np.ndarray, point: np.ndarray, centre: np.ndarray) -> Float[np.ndarray, " n"]:
    cost = 0.5 * np.sum(value**2, axis=1) + 0.5 * np.sum((point - centre) ** 2, axis=1)
    return np.where(np.isfinite(cost), cost, np.inf)


def _solve(matrices: Float[np.ndarray, "n k k"], vectors: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
    return np.linalg.solve(matrices, vectors[..., None])[..., 0]
