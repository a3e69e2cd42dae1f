"""Optima on plateaus: where a parameter stops mattering, and the climbs did not arrive.

A cube too heavy to slip has the same motion whatever it weighs. A climb from lighter ones ends at the edge of that
plateau, on one of the small summits that the beginning of slip leaves there, and its derivatives see a parameter that
is well determined. Yet most of the posterior may be on the plateau, for its width. It is looked for along each
coordinate, up to `REACHES` away.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.inference.modes.climb import Climbable, Laplace, LevenbergState, climb_cost, maximise

REACHES = np.array([0.05, 0.1, 0.2, 0.4, 0.8, 1.6])  # from the optimum, in deviations of the prior
LEVEL = 5.0  # nats by which the density may change from one reach to the next of a plateau
BELOW = 100.0  # nats below the optimum that a plateau may lie before a climb has seen to the other coordinates
NONE = 1e9  # nats below the optimum where there is no density
MOST_CLIMBS, MOST_STEPS = 2, 6


class Plateau(NamedTuple):
    """A point off an optimum, and the coordinate that does not seem to matter there."""

    point: Float[np.ndarray, " d"]
    coordinate: int


class Held:
    """A log posterior whose climbs leave one coordinate where it is: from the middle of a plateau to no edge of it."""

    def __init__(self, target: Climbable, coordinate: int) -> None:
        self.target, self.coordinate = target, coordinate

    def __getattr__(self, name: str) -> Any:
        return getattr(self.target, name)

    def quadratic(self, u: Float[np.ndarray, " d"]) -> tuple[np.ndarray, np.ndarray]:
        """See `Climbable.quadratic`; no gradient along the coordinate, and no correlation with others."""
        gradient, curvature = (part.copy() for part in self.target.quadratic(u))
        gradient[self.coordinate] = 0.0
        curvature[self.coordinate] = curvature[:, self.coordinate] = 0.0
        curvature[self.coordinate, self.coordinate] = 1.0
        return gradient, curvature


def plateaus(target: Climbable, mode: Laplace, widths: Float[np.ndarray, " d"], rival: float) -> list[Plateau]:
    """Where along coordinates, far from an optimum, the density does not change; the widest plateau first.

    Args:
        target: log posterior.
        mode: the best optimum so far.
        widths: deviations of the prior.
        rival: nats that the normal approximation has it change by there, at least.

    Returns:
        a point in the middle of each plateau.
    """
    physical = np.flatnonzero(~target.noise)
    if len(physical) == 0:
        return []
    steps = np.multiply.outer(widths[physical], np.multiply.outer([1.0, -1.0], REACHES))
    points = mode.mean + steps[..., None] * np.eye(len(mode.mean))[physical][:, None, None, :]
    values = target.density(points.reshape(-1, len(mode.mean))).reshape(steps.shape)
    drops = np.minimum(mode.log_density - values, NONE)
    # Where the normal approximation would have it so, too, it is no news.
    promised = 0.5 * steps**2 * np.diag(np.linalg.inv(mode.covariance))[physical][:, None, None]
    pairs = (np.abs(np.diff(drops)) < LEVEL) & (np.diff(promised) > rival) & (drops[..., 1:] < BELOW)
    level = np.pad(pairs, ((0, 0), (0, 0), (0, 1))) | np.pad(pairs, ((0, 0), (0, 0), (1, 0)))
    counts = level.sum(axis=2)
    widest = sorted(zip(*np.nonzero(counts), strict=True), key=lambda place: -counts[place])
    inside = [np.flatnonzero(level[place]) for place in widest]
    return [
        Plateau(points[place][at[len(at) // 2]], int(physical[place[0]]))
        for place, at in zip(widest, inside, strict=True)
    ]


def climbs_from(target: Climbable, found: list[Plateau], tolerance: float, rollouts: float) -> list[LevenbergState]:
    """Where short climbs on the widest of the plateaus end, each with its coordinate where it was.

    Args:
        target: log posterior.
        found: the plateaus, widest first; at most `MOST_CLIMBS` are climbed on.
        tolerance: a climb ends when a step promises less [nat].
        rollouts: for all climbs together; where they allow no step, the climbs end where they start.
    """
    found = found[:MOST_CLIMBS]
    grid, step = climb_cost(len(target.noise), int(target.noise.sum()))
    steps = int(np.clip((rollouts / max(len(found), 1) - grid) / step, 0, MOST_STEPS))
    held = [cast(Climbable, Held(target, plateau.coordinate)) for plateau in found]
    return [
        maximise(view, plateau.point, max_steps=steps, tolerance=tolerance)[0]
        for view, plateau in zip(held, found, strict=True)
    ]
