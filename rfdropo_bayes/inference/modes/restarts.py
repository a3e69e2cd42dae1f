"""Starts for climbs that went astray as the recording grew: a search around where they stood before.

Where a contact begins in the rows that come in, the likelihood has cliffs that it did not have before, and a climb from
the optimum of the shorter prefix comes to rest thousands of nats too low, though the optimum of the longer lies well
within the posterior of the shorter, or a few of its deviations beyond. CMA-ES, which asks for no derivatives, begins
with draws of that posterior and looks at the new rows, too.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from rfdropo_bayes.bayes.problem import ResidualProblem
from rfdropo_bayes.inference.modes.climb import Climbable, Laplace
from rfdropo_bayes.inference.rfdropo.optimisers import make_optimiser
from rfdropo_bayes.inference.smc.mixture import joint_covariance, prior_moments
from rfdropo_bayes.inference.smc.moves import host_generator
from rfdropo_bayes.inference.smc.straight import StraightProblem

ASTRAY, SCATTERED = 100.0, 5.0  # nats, and deviations of noise, by which new rows may be explained worse than others
POPULATION = 24  # candidates of a generation: some of the first must lie on the right side of a cliff
FEWEST_GENERATIONS, MOST_GENERATIONS = 6, 20
REACH = 50.0  # deviations of the shorter posterior, to each side, within which the search stays


def affordable_generations(rollouts: float, d: int, noise: int) -> int:
    """Generations that so many rollouts of the longer prefix serve in so many coordinates, so many of them of noise;
    none where they serve fewer than `FEWEST_GENERATIONS`.

    Besides candidates they pay for residuals at two points, and for the derivatives of a normal approximation.
    """
    before = 2.0 + (2 * d + 1 + 2 * noise + 4 * noise**2)
    served = int(min((rollouts - before) / POPULATION, MOST_GENERATIONS))
    return served if served >= FEWEST_GENERATIONS else 0


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


def search(
    problem: ResidualProblem, mode: Laplace, target: Climbable, generations: int, key: PRNGKeyArray
) -> Float[np.ndarray, "start d"]:
    """Where to climb from instead: the best candidate of CMA-ES.

    Args:
        problem: to be climbed.
        mode: normal approximation of the shorter prefix, in unconstrained coordinates, as is the answer. The search
            begins there, in its deviations; coordinates of noise stay where they are.
        target: posterior of the longer prefix, which is charged for the candidates.
        generations: of `POPULATION` candidates.
        key: random key.

    Returns:
        one start; none where no candidate has a likelihood, or the approximation is no use.
    """
    straight_key, prior_key, search_key = jax.random.split(key, 3)
    straight = StraightProblem(problem, straight_key)
    seen, free = straight.mode(mode), np.flatnonzero(~target.noise)
    if seen.information is None or not np.isfinite(seen.information).all() or len(free) == 0:
        return np.empty((0, len(mode.mean)))
    covariance = joint_covariance(seen.information, prior_moments(straight, prior_key)[1])
    factor = np.linalg.cholesky(covariance[np.ix_(free, free)])
    seed = int(host_generator(search_key).integers(2**31))
    optimiser = make_optimiser("cma", len(free), high=2.0 * REACH, sigma=0.5 / REACH, population=POPULATION, seed=seed)
    best, height = np.empty((0, len(mode.mean))), -np.inf
    for _ in range(generations):
        candidates = optimiser.ask()
        v = np.tile(seen.mean, (POPULATION, 1))
        v[:, free] += (candidates - REACH) @ factor.T
        u = np.asarray(problem.to_unconstrained(straight.from_unconstrained(jnp.asarray(v))), dtype=float)
        within = np.isfinite(u).all(axis=1)
        heights = np.full(POPULATION, -np.inf)
        if within.any():
            heights[within] = target.density(u[within])
            heights[np.isnan(heights)] = -np.inf
        optimiser.tell(candidates, -heights)
        if heights.max() > height:
            best, height = u[[int(np.argmax(heights))]], float(heights.max())
    return best
