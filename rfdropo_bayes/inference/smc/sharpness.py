"""What the way from the prior to a posterior costs a sequential sampler, judged from the Laplace approximation.

A sampler that keeps a share e of effective particles between targets takes steps of length sqrt(ln 1/e) in the metric
Var(log weight). In coordinates whitened by the prior, where direction j holds the information ``lambda_j`` about a
value ``m_j`` prior deviations away, a likelihood brought in to the share b changes the log weights at the rate

    g(b) = sum_j [ lambda_j^2 / (2 (1 + b lambda_j)^2) + lambda_j^2 m_j^2 / (1 + b lambda_j)^3 ],

so that the number of stages is the integral of sqrt(g / ln(1/e)) over b from 0 to 1. With information that accrues
evenly along the data, b is also the prefix that a stage needs, which sets its cost.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, PRNGKeyArray

from rfdropo_bayes.bayes.problem import Problem
from rfdropo_bayes.inference.modes.climb import Laplace

MOVES = 4.0  # of a stage: about 3 where the posterior is normal, more where it is not
FARTHEST = 5.0  # prior deviations that a value is taken to be away; farther ones are a prior at odds with the data


class Way(NamedTuple):
    """From the prior to the posterior.

    Attributes:
        stages: expected number of targets in between.
        rollouts: full-length rollouts that each particle needs for it.
        information: entropy lost on the way if both ends are normal [nat].
    """

    stages: float
    rollouts: float
    information: float


def way_from_prior(
    problem: Problem, mode: Laplace, horizons: tuple[int, ...], target_ess: float, key: PRNGKeyArray, n: int = 1000
) -> Way:
    """Expected stages and rollouts of a sampler that starts at the prior and brings the data in at ``horizons``."""
    prior = np.asarray(problem.to_unconstrained(problem.sample_prior(key, n)), dtype=float)
    information, offset = _whitened(prior.mean(axis=0), np.atleast_2d(np.cov(prior.T)), mode)
    share = np.geomspace(1e-3 / max(float(information.max()), 1.0), 1.0, 2000)
    growth = 1.0 + share[:, None] * information
    speed = 0.5 * (information / growth) ** 2 + (information * offset) ** 2 / growth**3
    rate = np.sqrt(speed.sum(axis=1) / np.log(1.0 / target_ess))
    stages = 0.5 * (rate[1:] + rate[:-1]) * np.diff(share)
    prefix = np.asarray(horizons) / problem.n_rows
    cost = prefix[np.minimum(np.searchsorted(prefix, share[1:] - 1e-12), len(prefix) - 1)]
    rollouts = float(prefix.sum() + MOVES * (stages @ cost) + MOVES)
    return Way(float(stages.sum()), rollouts, float(0.5 * np.log1p(information).sum()))


def _whitened(
    mean: Float[np.ndarray, " d"], covariance: Float[np.ndarray, "d d"], mode: Laplace
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
    """Information of the likelihood and distance of its optimum from the prior mean, along its own directions."""
    inverse = np.linalg.inv(np.linalg.cholesky(covariance))
    precision, vectors = np.linalg.eigh(np.linalg.inv(inverse @ mode.covariance @ inverse.T))
    information = np.maximum(precision - 1.0, 0.0)
    moved = vectors.T @ (inverse @ (mode.mean - mean))
    offset = np.where(information > 0.1, moved * (1.0 + information) / np.maximum(information, 0.1), 0.0)
    return information, np.clip(offset, -FARTHEST, FARTHEST)
