"""Which climbs stand on one summit: those with no valley between them."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from rfdropo_bayes.bayes.problem import ResidualProblem
from rfdropo_bayes.inference.straight import StraightProblem

SAME = 0.02  # largest difference of any coordinate between two climbs that ended at one point
# Places on the line between two climbs, as shares of it, and how far below the higher end the density may lie there and
# at the other end [nat]. Summits that repeat at even distances have none of these between them; and a climb that came
# to rest further down may arrive elsewhere when the horizon grows.
BETWEEN, LEVEL = (0.21, 0.39, 0.61, 0.79), 2.0

Density = Callable[[np.ndarray], np.ndarray]
OneSummit = Callable[[Density, np.ndarray, np.ndarray], bool]


def one_point(density: Density, first: Float[np.ndarray, " d"], second: Float[np.ndarray, " d"]) -> bool:
    """Whether two climbs ended at the same point."""
    return bool(np.max(np.abs(first - second)) <= SAME)


def one_ridge(problem: ResidualProblem, key: PRNGKeyArray) -> OneSummit:
    """Whether two climbs ended on one ridge, on which a climb ends anywhere: what data leave open, such as a common
    scale of stiffness and mass, is a straight line in the logarithms of positive parameters.

    The answer takes a few rollouts.

    Args:
        problem: with residuals.
        key: see `StraightProblem`.
    """
    straight = StraightProblem(problem, key)

    def same(density: Density, first: np.ndarray, second: np.ndarray) -> bool:
        if one_point(density, first, second):
            return True
        ends = np.stack([first, second])
        v = np.asarray(straight.to_unconstrained(problem.from_unconstrained(jnp.asarray(ends))))
        line = v[0] + np.array([0.0, *BETWEEN, 1.0])[:, None] * (v[1] - v[0])
        found = density(np.asarray(problem.to_unconstrained(straight.from_unconstrained(line)), dtype=float))
        return bool(found.min() > max(found[0], found[-1]) - LEVEL)

    return same


def summits(
    positions: Float[np.ndarray, "n d"], heights: Float[np.ndarray, " n"], density: Density, same: OneSummit
) -> Int[np.ndarray, " k"]:
    """The highest climb of each summit, in the order of their heights."""
    kept: list[int] = []
    for index in np.argsort(-heights, kind="stable"):
        if not any(same(density, positions[index], positions[other]) for other in kept):
            kept.append(int(index))
    return np.array(kept)
