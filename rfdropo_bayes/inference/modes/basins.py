"""Which climbs stand on one summit: those with no dip between them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from rfdropo_bayes.bayes.problem import ResidualProblem
from rfdropo_bayes.inference.smc.straight import StraightProblem

SAME = 0.02  # largest difference of any coordinate between two climbs that ended at one point
# Places on the line between two climbs, as shares of it, and how far below the higher end the density may lie there and
# at the other end [nat]: a climb that came to rest further down may arrive elsewhere when the horizon grows. Of summits
# at even distances, up to thirty of them, never do all places lie within 0.3 of that distance of a summit.
BETWEEN, LEVEL = (0.11, 0.32, 0.5, 0.66, 0.74, 0.87), 2.0

Density = Callable[[np.ndarray], np.ndarray]


class Climb(NamedTuple):
    """Where a climb ended: an unconstrained point, and its log density."""

    position: Float[np.ndarray, " d"]
    height: float


OneSummit = Callable[[Density, Climb, Climb], bool]


def one_point(density: Density, first: Climb, second: Climb) -> bool:
    """Whether two climbs ended at the same point."""
    return bool(np.max(np.abs(first.position - second.position)) <= SAME)


def one_ridge(problem: ResidualProblem, key: PRNGKeyArray) -> OneSummit:
    """Whether two climbs ended on one ridge, on which a climb ends anywhere: what data leave open, such as a common
    scale of stiffness and mass, is a straight line in the logarithms of positive parameters.

    The answer takes a rollout for each of `BETWEEN`.

    Args:
        problem: with residuals.
        key: see `StraightProblem`.
    """
    straight = StraightProblem(problem, key)

    def same(density: Density, first: Climb, second: Climb) -> bool:
        if one_point(density, first, second):
            return True
        heights = np.array([first.height, second.height])
        least = heights.max() - LEVEL
        if not heights.min() > least:
            return False
        ends = problem.from_unconstrained(jnp.stack([first.position, second.position]))
        v = np.asarray(straight.to_unconstrained(ends))
        line = v[0] + np.array(BETWEEN)[:, None] * (v[1] - v[0])
        between = density(np.asarray(problem.to_unconstrained(straight.from_unconstrained(line)), dtype=float))
        return bool(between.min() > least)

    return same


def summits(
    positions: Float[np.ndarray, "n d"], heights: Float[np.ndarray, " n"], density: Density, same: OneSummit
) -> Int[np.ndarray, " k"]:
    """Indices of the highest climb of each summit, in the order of their heights."""
    climbs = [Climb(*pair) for pair in zip(positions, heights, strict=True)]
    kept: list[int] = []
    for index in np.argsort(-heights, kind="stable"):
        if not any(same(density, climbs[index], climbs[other]) for other in kept):
            kept.append(int(index))
    return np.array(kept)
