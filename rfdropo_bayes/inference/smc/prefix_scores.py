"""Evidence of prefixes by importance sampling around their own optima, where a sampler has not passed them."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from scipy.special import logsumexp

from rfdropo_bayes.bayes.problem import ResidualProblem
from rfdropo_bayes.inference.evaluations import Ledger, evaluate_prior, evaluate_rows
from rfdropo_bayes.inference.modes.climb import Laplace, laplace, maximise
from rfdropo_bayes.inference.modes.targets import make_target, prior_derivatives
from rfdropo_bayes.inference.schedules import log_effective_sample_size
from rfdropo_bayes.inference.smc.mixture import ModeMixture

INFLATION, DEGREES, PRIOR_SHARE = 1.3, 5.0, 0.2  # a short prefix says little: its posterior is near the prior
MOST_STEPS = 12  # of the climb from the optimum of all rows to that of a prefix
MOST_DRAWS, FEWEST_DRAWS = 400, 30


class PrefixEvidence(NamedTuple):
    """Log evidence of a prefix, its Monte-Carlo deviation, and the share of effective draws behind it."""

    horizon: int
    value: float
    sd: float
    ess: float


def prefix_evidence(
    problem: ResidualProblem,
    mode: Laplace,
    noise: np.ndarray,
    horizons: tuple[int, ...],
    budget: float | None,
    key: PRNGKeyArray,
    ledger: Ledger,
) -> list[PrefixEvidence]:
    """Evidence of the prefixes ``horizons``, longest first in the work and shortest first in the answer.

    Args:
        problem: with residuals.
        mode: of all rows, from which the climbs to the prefixes' optima start.
        noise: noise coordinates.
        horizons: prefix lengths.
        budget: full-length rollouts for all of it, half for climbs and half for draws; None for no limit.
        key: random key.
        ledger: is charged.

    Returns:
        nothing where the budget does not allow it.
    """
    steps, draws = _affordable(problem, noise, horizons, budget)
    if steps < 1 or draws < FEWEST_DRAWS:
        return []
    prior, start, found = prior_derivatives(problem), mode.mean, []
    for horizon in sorted(horizons, reverse=True):
        target = make_target(problem, horizon, ledger, start, prior, "auto", noise)
        state, _ = maximise(target, start, max_steps=steps, tolerance=1e-2)
        start = state.position
        mixture = ModeMixture(problem, [laplace(target, state)], INFLATION, DEGREES, PRIOR_SHARE)
        u = mixture.sample(jax.random.fold_in(key, horizon), draws)
        density = evaluate_prior(problem, u) + evaluate_rows(problem, u, horizon, ledger).sum(axis=1)
        found.append(_estimate(horizon, density - mixture.log_density(u)))
    return found[::-1]


def _affordable(
    problem: ResidualProblem, noise: np.ndarray, horizons: tuple[int, ...], budget: float | None
) -> tuple[int, int]:
    """Steps of each climb, and draws for each prefix."""
    if budget is None or not horizons:
        return MOST_STEPS, MOST_DRAWS
    share = 0.5 * budget * problem.n_rows / sum(horizons)  # rollouts of a prefix, climb and draws each
    d, k = len(noise), int(noise.sum())
    step = 4.0 * d + 7.0  # a Jacobian by differences, noise coordinates, six dampings
    around = 3.0 * step + 8.0 * k**2  # the normal approximation at the end, twice: the second along its own axes
    return min(MOST_STEPS, int((share - around) / step)), min(MOST_DRAWS, int(share))


def _estimate(horizon: int, log_weights: Float[np.ndarray, " n"]) -> PrefixEvidence:
    n = len(log_weights)
    value = float(logsumexp(log_weights) - np.log(n))
    if not np.isfinite(value):
        return PrefixEvidence(horizon, -np.inf, float("nan"), 0.0)
    share = float(np.exp(log_effective_sample_size(log_weights))) / n
    return PrefixEvidence(horizon, value, float(np.sqrt(max(1.0 / share - 1.0, 0.0) / n)), share)


def block_scores(prefixes: list[PrefixEvidence]) -> list[dict[str, Any]]:
    """Scores of the blocks between consecutive prefixes, as samplers that pass them report them."""
    scores, before = [], PrefixEvidence(0, 0.0, 0.0, 1.0)
    for now in prefixes:
        score, sd = now.value - before.value, float(np.hypot(now.sd, before.sd))
        scores.append({"first_row": before.horizon + 1, "last_row": now.horizon, "log_score": score, "sd": sd})
        before = now
    return scores
