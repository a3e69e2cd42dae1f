"""Least squares of many draws at once, each with its own optimum: fits the parameters of a recording for every draw.

Every draw has k standard normal coordinates and m whitened residuals. Its cost is half the sum of squares of the
residuals and of the distance to a prior draw. With perturbed data and the prior draw as the centre, the optimum is a
draw from the posterior, exactly so for linear residuals (randomised maximum likelihood, Oliver, He & Reynolds 1996).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

STEP = 0.05  # of a central difference, in prior deviations
TOLERANCE = 0.01  # nats of predicted or actual gain: the remaining distance is a seventh of a posterior deviation
CREDIBLE = 100.0  # tolerances of predicted gain without actual gain: finite differences see gains of the size of kinks
MOST_STEPS = 60
LEAST_GAIN = 0.5  # of the predicted gain, below which updated slopes are not trusted with another step
DAMPINGS = (0.1, 1.0, 10.0, 100.0)  # of a draw's last damping: the first that lowers its cost is taken
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-9, 1e6

Residuals = Callable[[Float[np.ndarray, "b k"], Int[np.ndarray, " b"]], Float[np.ndarray, "b m"]]


class OwnFit(NamedTuple):
    """Optima of all draws."""

    point: Float[np.ndarray, "n k"]  # coordinates of each draw's optimum
    residual: Float[np.ndarray, "n m"]  # residuals at the point; not finite if the simulation failed
    slope: Float[np.ndarray, "n m k"]  # derivatives of the residuals there
    converged: Bool[np.ndarray, " n"]  # draws whose predicted or last gain is less than `TOLERANCE`
    steps: int  # number of steps


def fit_own(
    residuals: Residuals,
    centre: Float[np.ndarray, "n k"],
    start: Float[np.ndarray, "n k"] | None = None,
    report: Callable[[int, float], None] = lambda step, share: None,
) -> OwnFit:
    """Levenberg-Marquardt steps of all draws in one batch, until the predicted gain of each is negligible.

    Derivatives cost two rollouts per coordinate. All draws start with the derivatives of the first draw, and each step
    updates them (Broyden 1965). Derivatives are computed at a draw if the predicted gain exceeds twice the actual gain,
    and before the draw counts as converged.

    Args:
        residuals: function of points and draw indices, returns whitened residuals.
        centre: prior draw at the centre of each draw's penalty.
        start: start of each draw; its centre by default.
        report: called with the step and the share of converged draws.
    """
    draws, (count, k) = np.arange(len(centre)), centre.shape
    point = (centre if start is None else start).copy()
    value, damping = residuals(point, draws), np.full(count, FIRST_DAMPING)
    converged, own = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    slope = np.zeros((*value.shape, k))

    def solve(matrices: Float[np.ndarray, "n k k"], vectors: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        return np.linalg.solve(matrices, vectors[..., None])[..., 0]

    def costs(
        value: Float[np.ndarray, "n m"], point: Float[np.ndarray, "n k"], draws: Int[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        cost = 0.5 * np.sum(value**2, axis=1) + 0.5 * np.sum((point - centre[draws]) ** 2, axis=1)
        return np.where(np.isfinite(cost), cost, np.inf)

    def slopes(draws: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n m k"]:
        """Central differences along every coordinate, all draws and directions in one batch."""
        moved = np.concatenate([point[draws] + sign * STEP * row for row in np.eye(k) for sign in (1.0, -1.0)])
        values = residuals(moved, np.tile(draws, 2 * k)).reshape(k, 2, len(draws), -1)
        return np.moveaxis((values[:, 0] - values[:, 1]) / (2.0 * STEP), 0, 2)

    todo, step = draws[np.isfinite(value).all(axis=1)], 0
    if len(todo):
        slope[:] = slopes(todo[:1])
    while len(todo) and step < MOST_STEPS:
        gradient = np.einsum("nij,ni->nj", slope[todo], value[todo]) + (point - centre)[todo]
        curvature = np.einsum("nij,nik->njk", slope[todo], slope[todo]) + np.eye(k)
        promised = 0.5 * np.einsum("nj,nj->n", gradient, solve(curvature, gradient))
        chosen = promised >= TOLERANCE
        going, delivered = todo[chosen], np.zeros(count)
        if len(going):  # the least damped step that lowers each cost; unchanged if none does
            before, waiting = costs(value[going], point[going], going), np.arange(len(going))
            down, bent, first = gradient[chosen], curvature[chosen], damping[going]
            diagonal = np.einsum("njj->nj", bent)[:, None] * np.eye(k)
            moved, moved_value = point[going], value[going]
            for factor in DAMPINGS:
                damping[going[waiting]] = np.maximum(factor * first[waiting], LEAST_DAMPING)
                damped = bent[waiting] + damping[going[waiting], None, None] * diagonal[waiting]
                ahead = point[going[waiting]] - solve(damped, down[waiting])
                ahead_value = residuals(ahead, going[waiting])
                better = costs(ahead_value, ahead, going[waiting]) < before[waiting]
                moved[waiting[better]], moved_value[waiting[better]] = ahead[better], ahead_value[better]
                waiting = waiting[~better]
                if not len(waiting):
                    break
            way = moved - point[going]  # Broyden's update; derivatives of a draw that has not moved are unchanged
            missing = moved_value - value[going] - np.einsum("nij,nj->ni", slope[going], way)
            length = np.sum(way**2, axis=1)
            slope[going] += missing[:, :, None] * (way / np.where(length > 0.0, length, 1.0)[:, None])[:, None]
            point[going], value[going] = moved, moved_value
            delivered[going] = before - costs(moved_value, moved, going)
        still = delivered[todo] < TOLERANCE
        # Six decades of damping without gain: the gain predicted by differences is rounding, or the edge of a cliff.
        lost = todo[still & own[todo] & (promised >= CREDIBLE * TOLERANCE) & (damping[todo] >= MOST_DAMPING)]
        done = todo[still & own[todo] & (promised < CREDIBLE * TOLERANCE)]
        converged[done] = True
        own[todo[~still]] = False
        kept = delivered[todo] > LEAST_GAIN * np.maximum(promised, TOLERANCE)
        active = ~np.isin(todo, np.concatenate([done, lost]))
        todo, kept = todo[active], kept[active]
        anew = todo[~kept & ~own[todo]]
        if len(anew):
            slope[anew] = slopes(anew)
            own[anew], damping[anew] = True, FIRST_DAMPING
            todo = todo[np.isfinite(slope[todo]).all(axis=(1, 2))]
        step += 1
        report(step, float(np.mean(converged)))
    return OwnFit(point, value, slope, converged, step)
