"""What is a day's own, found from one short recording of it under every draw of the body.

The body keeps its posterior. Under each of its draws the day's parameters are fitted to the recording and to draws
from their priors, perturbed (`fit_own`), which makes the optimum a draw from their posterior given that body. Each body
then counts by its evidence: the likelihood of the recording with the day's parameters integrated out. For a linear
model with normal noise the draws are those of the joint posterior.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from blackjax.smc import resampling
from jax.scipy.stats import norm
from jaxtyping import Float, Int, PRNGKeyArray
from scipy.special import softmax
from scipy.stats import chi2

from rfdropo_bayes.bayes.calibration_problem import CalibrationProblem
from rfdropo_bayes.bayes.inferred_parameter import InferredParameter
from rfdropo_bayes.inference import next_step
from rfdropo_bayes.prediction.first_row import LEAST_SHARE, SURE
from rfdropo_bayes.prediction.own_fit import OwnFit, fit_own

Batch = dict[str, Float[np.ndarray, " n"]]


class DayFit(NamedTuple):
    """Draws of body and day together.

    Attributes:
        values: of all parameters, each draw as often as its body counts.
        chosen: which draw of the body each is.
        log_evidence: of each body's draw, up to a constant.
        power: that the evidences were raised to, so that a tenth of the draws is left; 1 where it is no less.
        excess: how many times as large as stated the noise is, by what the fits leave; at least 1.
        unconverged: draws whose fit did not converge.
        steps: that the fits took.
    """

    values: Batch
    chosen: Int[np.ndarray, " n"]
    log_evidence: Float[np.ndarray, " n"]
    power: float
    excess: float
    unconverged: int
    steps: int


def fit_day(
    problem: CalibrationProblem,
    body: Batch,
    own: Sequence[InferredParameter],
    key: PRNGKeyArray,
    report: Callable[[int, float], None] = lambda step, share: None,
    *,
    share: float = 1.0,
) -> DayFit:
    """Draws of a day's parameters, and of the body, given one recording of the day.

    Args:
        problem: of that recording, under noise whose size is a lower bound: where the recording is fitted worse than it
            says, the noise is taken for as much larger (the ratio of Birge 1932), and the day is fitted again.
        body: draws of all other parameters.
        own: the day's: deviations of its group, and parameters of the recording.
        key: of draws from the priors, perturbations of the data, and the choice of the body's draws.
        report: is told the step, and the share of the draws that have converged.
        share: what a coordinate of a row counts, because markers err together (`ModelError.share`).
    """
    count = len(next(iter(body.values())))
    centre_key, noise_key, choice_key = jax.random.split(key, 3)
    centre = np.asarray(jax.random.normal(centre_key, (count, len(own))))
    horizon = problem.n_rows

    def values_at(point: Float[np.ndarray, "b k"], draw: Int[np.ndarray, " b"]) -> Batch:
        given = {name: column[draw] for name, column in body.items()}
        return given | {p.name: physical_of_normal(p, x, given) for p, x in zip(own, point.T, strict=True)}

    def white(point: np.ndarray, draw: np.ndarray) -> np.ndarray:
        return np.sqrt(share) * problem.residual_batch(values_at(point, draw), horizon)

    seen = np.flatnonzero(problem.model.markers.valid)
    noise = np.asarray(jax.random.normal(noise_key, (count, len(seen))))

    def residuals(point: np.ndarray, draw: np.ndarray, excess: float = 1.0) -> np.ndarray:
        return white(point, draw)[:, seen] / excess + noise[draw]

    fit = fit_own(residuals, centre, start=np.zeros_like(centre), report=lambda step, done: report(step, 0.5 * done))
    misfit, excess = 2.0 * float(np.median(_least_cost(fit, noise))), 1.0
    independent = share * len(seen)
    if misfit > chi2.ppf(SURE, independent):
        excess = float(np.sqrt(misfit / independent))
        fit = fit_own(partial(residuals, excess=excess), centre, start=fit.point, report=report)
    evidence = _log_evidence(fit, noise)
    power, _ = next_step(partial(np.multiply, evidence), 1.0, LEAST_SHARE)
    chosen = np.asarray(resampling.systematic(choice_key, softmax(power * evidence), count))
    unconverged = int((~fit.converged).sum())
    return DayFit(values_at(fit.point[chosen], chosen), chosen, evidence, float(power), excess, unconverged, fit.steps)


def physical_of_normal(
    parameter: InferredParameter, normal: Float[np.ndarray, " b"], given: Mapping[str, np.ndarray]
) -> np.ndarray:
    """Values of a parameter at standard normal coordinates of its prior."""
    if parameter.scope.added_to:
        return normal * parameter.info.spread_of(given, len(normal))
    return np.asarray(parameter.prior.icdf(norm.cdf(normal)))


def _log_evidence(fit: OwnFit, noise: Float[np.ndarray, "n m"]) -> Float[np.ndarray, " n"]:
    """Of the data as they were measured, for every body, from the linearisation at its own optimum."""
    found = -_least_cost(fit, noise) - 0.5 * np.linalg.slogdet(_curvature(fit))[1]
    return np.where(np.isfinite(found), found, -np.inf)


def _least_cost(fit: OwnFit, noise: Float[np.ndarray, "n m"]) -> Float[np.ndarray, " n"]:
    """Half of the least sum of squares for the data as they were measured; half of their number is expected."""
    residual = fit.residual - noise
    gradient = np.einsum("nij,ni->nj", fit.slope, residual) + fit.point
    gain = np.einsum("nj,nj->n", gradient, np.linalg.solve(_curvature(fit), gradient[..., None])[..., 0])
    cost = 0.5 * (np.sum(residual**2, axis=1) + np.sum(fit.point**2, axis=1) - gain)
    return np.where(np.isfinite(cost), cost, np.inf)


def _curvature(fit: OwnFit) -> Float[np.ndarray, "n k k"]:
    return np.einsum("nij,nik->njk", fit.slope, fit.slope) + np.eye(fit.point.shape[1])
