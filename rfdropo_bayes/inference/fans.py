"""Starts for climbs that went astray as the recording grew: draws from around where they stood before.

Where a contact begins in the rows that come in, the likelihood has cliffs that it did not have before, and a climb from
the optimum of the shorter prefix comes to rest thousands of nats too low, though the optimum of the longer lies well
within the posterior of the shorter. Draws of that posterior, looked at with the new rows, tell where.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from rfdropo_bayes.bayes.problem import ResidualProblem
from rfdropo_bayes.inference.levenberg import Climbable, Laplace
from rfdropo_bayes.inference.mixture import joint_covariance, prior_moments
from rfdropo_bayes.inference.proposals import host_generator
from rfdropo_bayes.inference.straight import StraightProblem

ASTRAY = 100.0  # nats by which rows that came in may be explained worse than those before, in proportion
TEMPERATURES = (1.0, 4.0, 16.0, 64.0)  # of the draws: the shorter posterior is known from derivatives at its optimum
DRAWS = 24  # at each
STARTS = 2


def astray(rows: int, before: float, more: int, after: float) -> bool:
    """Whether the rows that came in are explained much worse than those before, by the log densities of the optima."""
    return before / rows * (more - rows) - (after - before) > ASTRAY


def fanned(
    problem: ResidualProblem,
    mode: Laplace,
    earlier: Float[np.ndarray, "climb d"],
    target: Climbable,
    key: PRNGKeyArray,
) -> Float[np.ndarray, "start d"]:
    """Where to climb from instead.

    Args:
        problem: to be climbed.
        mode: normal approximation of the shorter prefix.
        earlier: where all climbs of that prefix ended, in unconstrained coordinates, as are the answers.
        target: posterior of the longer prefix, which is charged for the draws.
        key: random key.
    """
    straight_key, prior_key, draw_key = jax.random.split(key, 3)
    straight = StraightProblem(problem, straight_key)
    seen = straight.mode(mode)
    assert seen.information is not None
    prior = prior_moments(straight, prior_key)[1]
    generator = host_generator(draw_key)
    drawn = []
    for temperature in TEMPERATURES:
        factor = np.linalg.cholesky(joint_covariance(seen.information / temperature, prior))
        drawn.append(seen.mean + generator.standard_normal((DRAWS, len(seen.mean))) @ factor.T)
    v = np.concatenate(drawn)
    v[:, target.noise] = seen.mean[target.noise]
    u = np.asarray(problem.to_unconstrained(straight.from_unconstrained(jnp.asarray(v))), dtype=float)
    points = np.concatenate([earlier, u[np.isfinite(u).all(axis=1)]])
    heights = target.density(points)
    best = np.argsort(-heights, kind="stable")[:STARTS]
    return points[best[np.isfinite(heights[best])]]
