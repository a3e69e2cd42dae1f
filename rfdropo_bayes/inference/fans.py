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

ASTRAY, SCATTERED = 100.0, 5.0  # nats, and deviations of noise, by which new rows may be explained worse than others
TEMPERATURES = (1.0, 4.0, 16.0, 64.0)  # of the draws: the shorter posterior is known from derivatives at its optimum
DRAWS = 24  # at each
STARTS = 2
APART = 0.5  # of the draws' deviation, in some coordinate: how far the second start lies from the first


def fan_cost(d: int, noise: int) -> float:
    """Rollouts of a fan in so many coordinates, so many of them of noise: residuals at two points, the derivatives of a
    normal approximation, and the draws."""
    return 2.0 + (2 * d + 1 + 2 * noise + 4 * noise**2) + len(TEMPERATURES) * DRAWS


def astray(before: Float[np.ndarray, " m"], after: Float[np.ndarray, " n"]) -> bool:
    """Whether the rows that came in are explained much worse than those before.

    Args:
        before: whitened residuals of the shorter prefix at its optimum; zero where there are no data.
        after: those of the longer prefix at its own, at the same values of the noise parameters.
    """
    if not np.isfinite(after).all():
        return True
    fewer, data = np.count_nonzero(before), np.count_nonzero(after)
    if not 0 < fewer < data:
        return False
    usual = float(np.sum(before**2)) / fewer
    allowed = ASTRAY + SCATTERED * usual * np.sqrt(0.5 * (data - fewer))
    return bool(0.5 * (float(np.sum(after**2)) - usual * data) > allowed)


def fanned(
    problem: ResidualProblem, mode: Laplace, target: Climbable, key: PRNGKeyArray
) -> Float[np.ndarray, "start d"]:
    """Where to climb from instead: the best draw, and the best of those that are not beside it.

    Args:
        problem: to be climbed.
        mode: normal approximation of the shorter prefix, in unconstrained coordinates, as are the answers.
        target: posterior of the longer prefix, which is charged for the draws.
        key: random key.

    Returns:
        the starts; none where no draw has a likelihood, or the approximation is no use.
    """
    straight_key, prior_key, draw_key = jax.random.split(key, 3)
    straight = StraightProblem(problem, straight_key)
    seen = straight.mode(mode)
    if seen.information is None or not np.isfinite(seen.information).all():
        return np.empty((0, len(mode.mean)))
    prior = prior_moments(straight, prior_key)[1]
    generator = host_generator(draw_key)
    drawn = []
    for temperature in TEMPERATURES:
        factor = np.linalg.cholesky(joint_covariance(seen.information / temperature, prior))
        drawn.append(seen.mean + generator.standard_normal((DRAWS, len(seen.mean))) @ factor.T)
    v = np.concatenate(drawn)
    v[:, target.noise] = seen.mean[target.noise]
    u = np.asarray(problem.to_unconstrained(straight.from_unconstrained(jnp.asarray(v))), dtype=float)
    u = u[np.isfinite(u).all(axis=1)]
    if len(u) == 0:
        return u
    heights = target.density(u)
    order = np.argsort(-heights, kind="stable")
    order = order[np.isfinite(heights[order])]
    beside = np.all(np.abs(u[order] - u[order[:1]]) <= APART * u.std(axis=0), axis=1)
    return u[np.concatenate([order[:1], order[~beside][: STARTS - 1]])]
