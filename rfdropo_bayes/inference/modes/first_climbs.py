"""Where climbs start: at screened draws, or at the particles of a survey."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from rfdropo_bayes.bayes.problem import Problem
from rfdropo_bayes.errors import NoLikelihoodError
from rfdropo_bayes.inference.evaluations import Ledger, evaluate_prior, evaluate_rows
from rfdropo_bayes.inference.modes.survey import Survey

SURVEYS = 2  # of the last prefixes, whose particles climbs start from

Starts = tuple[Float[np.ndarray, "start d"], Float[np.ndarray, " start"]]


def screened(problem: Problem, screen: int, horizon: int, count: int, key: PRNGKeyArray, ledger: Ledger) -> Starts:
    """Some of many draws from the prior, or from where the problem says that climbs may start.

    Args:
        problem: to be climbed.
        screen: number of draws.
        horizon: first one of the climbs, at which draws are judged.
        count: of starts wanted; there may be fewer.
        key: random key.
        ledger: is charged.

    Returns:
        unconstrained points, the best first, and their log posterior at the horizon.

    Raises:
        NoLikelihoodError: none of the draws has a positive likelihood.
    """
    draw = getattr(problem, "sample_starts", problem.sample_prior)
    u = np.asarray(problem.to_unconstrained(draw(key, max(screen, count))), dtype=float)
    density = _heights(problem, u, horizon, ledger)
    order = _spread(u, density, count)
    return u[order], density[order]


def surveyed(problem: Problem, found: list[Survey], horizon: int, count: int, ledger: Ledger) -> Starts:
    """Particles of the last prefixes of a survey, as many of each; arguments and the rest as of `screened`.

    The longest prefix knows best where the summit is, unless all its particles lie in one basin and the summit in
    another; when those of a shorter one were drawn there was less between the two.
    """
    found = found[-SURVEYS:]
    chosen = []
    for index, population in enumerate(reversed(found)):
        wanted = count // len(found) + (index < count % len(found))
        order = _spread(population.positions, population.log_density, wanted)[:wanted]
        chosen.append(population.positions[order])
    u = np.concatenate(chosen)
    density = _heights(problem, u, horizon, ledger)
    order = np.argsort(-density, kind="stable")[: np.isfinite(density).sum()]
    return u[order], density[order]


def _heights(problem: Problem, u: Float[np.ndarray, "n d"], horizon: int, ledger: Ledger) -> Float[np.ndarray, " n"]:
    """Log posterior of a prefix at some points.

    Raises:
        NoLikelihoodError: none has a positive likelihood.
    """
    density = evaluate_prior(problem, u) + evaluate_rows(problem, u, horizon, ledger).sum(axis=1)
    if not np.isfinite(density).any():
        raise NoLikelihoodError(
            f"none of {len(u)} draws has a positive likelihood up to row {horizon} ({ledger.reasons})",
            where="[model.priors]",
            remedy="widen the priors, or look at what the simulator reports for them",
        )
    return density


def _spread(u: Float[np.ndarray, "n d"], density: Float[np.ndarray, " n"], count: int) -> Int[np.ndarray, " k"]:
    """The best draw, and then always the one of the best quarter that is farthest from those chosen.

    The best few alone often lie together, and then all climb to one optimum of several.
    """
    order = np.argsort(-density, kind="stable")
    order = order[np.isfinite(density[order]) & np.isfinite(u[order]).all(axis=1)]
    if len(order) == 0:
        return order
    spread = u[order].std(axis=0)
    order = order[: max(count, len(u) // 4)]
    scaled = u[order] / np.maximum(spread, 1e-300)
    chosen = [0]
    while len(chosen) < min(count, len(order)):
        distance = np.linalg.norm(scaled[:, None] - scaled[chosen], axis=2).min(axis=1)
        chosen.append(int(np.argmax(distance)))
    return order[chosen]
