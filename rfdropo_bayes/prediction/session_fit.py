"""Parameters of a new session, fitted to one short recording under every draw of the body.

The posterior of the body's parameters is unchanged. Under each draw the session's parameters are fitted to perturbed
data and perturbed prior means (`fit_own`), so that the optimum is a draw from their posterior given that body. Each
body is then weighted by its
evidence: the likelihood of the recording with the session's parameters integrated out. The draws are exact for a linear
model with normal noise.
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
from rfdropo_bayes.inference.smc.tempering import next_step
from rfdropo_bayes.prediction.first_row import LEAST_SHARE, SURE
from rfdropo_bayes.prediction.own_fit import OwnFit, fit_own

Batch = dict[str, Float[np.ndarray, " n"]]


class SessionFit(NamedTuple):
    """Joint draws of body and session parameters."""

    values: Batch  # draws of all parameters, resampled by the evidence of their body
    chosen: Int[np.ndarray, " n"]  # index of each draw's body
    log_evidence: Float[np.ndarray, " n"]  # log evidence of each body, up to a constant
    power: float  # exponent of the evidences that keeps an effective tenth of the draws; 1 if no less remains
    excess: float  # ratio of the noise in the residuals to the stated noise; at least 1
    unconverged: int  # number of draws whose fit did not converge
    steps: int  # steps of the fits


def fit_session(
    problem: CalibrationProblem,
    body: Batch,
    own: Sequence[InferredParameter],
    key: PRNGKeyArray,
    report: Callable[[int, float], None] = lambda step, share: None,
    *,
    share: float = 1.0,
) -> SessionFit:
    """Draws of a session's parameters and of the body, given one recording of the session.

    Args:
        problem: problem of that recording; its noise is a lower bound. If the residuals are larger, the noise is scaled
            up (the ratio of Birge 1932), and the session is fitted again.
        body: draws of all other parameters.
        own: parameters of the session: deviations of its group, and parameters of the recording.
        key: random key of prior draws, perturbations of the data, and resampling of the body's draws.
        report: called with the step and the share of converged draws.
        share: weight of a coordinate of a row, because errors of markers are correlated (`ModelError.share`).
    """
    count = len(next(iter(body.values())))
    centre_key, noise_key, choice_key = jax.random.split(key, 3)
    centre = np.asarray(jax.random.normal(centre_key, (count, len(own))))
    horizon = problem.n_rows

    def values_at(point: Float[np.ndarray, "b k"], draw: Int[np.ndarray, " b"]) -> Batch:
        given = {name: column[draw] for name, column in body.items()}
        return given | {p.name: physical_of_normal(p, x, given) for p, x in zip(own, point.T, strict=True)}

    def white(point: np.ndarray, draw: np.ndarray) -> np.ndarray:
        return np.sqrt(share) * problem.residuals(values_at(point, draw), horizon)

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
    return SessionFit(
        values_at(fit.point[chosen], chosen), chosen, evidence, float(power), excess, unconverged, fit.steps
    )


def physical_of_normal(
    parameter: InferredParameter, normal: Float[np.ndarray, " b"], given: Mapping[str, np.ndarray]
) -> np.ndarray:
    """Values of a parameter at standard normal coordinates of its prior."""
    if parameter.scope.added_to:
        return normal * parameter.info.spread_of(given, len(normal))
    return np.asarray(parameter.prior.icdf(norm.cdf(normal)))


def _log_evidence(fit: OwnFit, noise: Float[np.ndarray, "n m"]) -> Float[np.ndarray, " n"]:
    """Log evidence of the unperturbed data for every draw of the body, from the linearisation at its optimum."""
    evidence = -_least_cost(fit, noise) - 0.5 * np.linalg.slogdet(_curvature(fit))[1]
    return np.where(np.isfinite(evidence), evidence, -np.inf)


def _least_cost(fit: OwnFit, noise: Float[np.ndarray, "n m"]) -> Float[np.ndarray, " n"]:
    """Half of the least sum of squares for the data as they were measured; half of their number is expected."""
    residual = fit.residual - noise
    gradient = np.einsum("nij,ni->nj", fit.slope, residual) + fit.point
    gain = np.einsum("nj,nj->n", gradient, np.linalg.solve(_curvature(fit), gradient[..., None])[..., 0])
    cost = 0.5 * (np.sum(residual**2, axis=1) + np.sum(fit.point**2, axis=1) - gain)
    return np.where(np.isfinite(cost), cost, np.inf)


def _curvature(fit: OwnFit) -> Float[np.ndarray, "n k k"]:
    return np.einsum("nij,nik->njk", fit.slope, fit.slope) + np.eye(fit.point.shape[1])
