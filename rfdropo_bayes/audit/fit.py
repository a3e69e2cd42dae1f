"""Posterior modes of the base model and its extensions by Gauss-Newton within bounds, with Laplace's evidence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import least_squares
from scipy.stats import norm

from rfdropo_bayes.audit.coordinates import Coordinates
from rfdropo_bayes.audit.forward import Forward
from rfdropo_bayes.audit.journal import Arrays, Journal, digest
from rfdropo_bayes.audit.measurements import Measurements
from rfdropo_bayes.bayes.noise.autoregression import Autoregression

FIRST, ALL = 8, 40  # evaluations of a short climb, and of one to its end
CLOSE = 1e-3  # of the squared misfit: climbs end where steps bring less than a thousandth of that
FAILED = 1e6  # whitened residual of a rollout that did not end well: no step is ever taken there


@dataclass(frozen=True)
class Fit:
    """A mode and the normal approximation around it.

    Attributes:
        x: coordinates of all parameters.
        free: which of them were fitted.
        residual: whitened, without the prior's rows.
        jacobian: of the whitened prediction with respect to the free coordinates.
        covariance: of the free coordinates, prior included.
        log_evidence: Laplace's, up to the noise's normaliser, which all models under one noise share.
        promise: what a Gauss-Newton step from here still promises [nat]; see `converged`.
    """

    x: Float[np.ndarray, " d"]
    free: Int[np.ndarray, " free"]
    residual: Float[np.ndarray, " n"]
    jacobian: Float[np.ndarray, "n free"]
    covariance: Float[np.ndarray, "free free"]
    log_evidence: float
    promise: float

    @property
    def converged(self) -> bool:
        """Whether no step promises more than a nat, or more than what the accuracy of a large misfit allows."""
        return self.promise < 1.0 + CLOSE * float(self.residual @ self.residual)

    def draws(self, rng: np.random.Generator, count: int, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Draws of all coordinates, folded back at the bounds."""
        values, vectors = np.linalg.eigh(self.covariance)
        z = rng.standard_normal((count, len(self.free))) * np.sqrt(np.maximum(values, 0.0))
        points = np.repeat(self.x[None], count, axis=0)
        points[:, self.free] += z @ vectors.T
        points = np.where(points < low, 2 * low - points, np.where(points > high, 2 * high - points, points))
        return np.clip(points, low, high)


@dataclass(frozen=True)
class Target:
    """What is fitted: measurements under a noise, by a simulator; ``journal`` keeps what was computed."""

    forward: Forward
    measurements: Measurements
    noise: Autoregression
    journal: Journal = field(default_factory=Journal)

    @cached_property
    def identity(self) -> str:
        """Digest of everything that a residual depends on beside the parameters."""
        data, noise = self.measurements, self.noise
        across = np.zeros(0) if noise.correlation is None else noise.correlation
        return digest(self.forward.identity, data.position, data.count, noise.scale, noise.autocorrelation, across)

    def recall(self, what: str, inputs: Sequence[np.ndarray], compute: Callable[[], Arrays]) -> Arrays:
        """A computation with this target, looked up where the journal has it; its rollouts count either way."""
        before = self.forward.rollouts

        def counted() -> Arrays:
            found = compute()
            return {**found, "rollouts": np.asarray(self.forward.rollouts - before)}

        found = self.journal.recall(digest(self.identity, what, *inputs), counted)
        self.forward.rollouts = before + int(found["rollouts"])
        return {name: value for name, value in found.items() if name != "rollouts"}

    def residual(self, points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n m"]:
        """Whitened residuals, measured less simulated, of a batch of points."""
        position, fine = self.forward.positions(points)
        white = self.measurements.whiten(self.measurements.position - position, self.noise)
        return np.where(fine[:, None], white, FAILED)

    def jacobian(self, x: Float[np.ndarray, " d"], free: Int[np.ndarray, " free"]) -> Float[np.ndarray, "m free"]:
        """Derivatives of the whitened prediction."""
        directions = np.eye(len(x))[free]
        return self.measurements.whiten(self.forward.derivatives(x, directions), self.noise).T


def climb(
    target: Target, start: Float[np.ndarray, " d"], free: Int[np.ndarray, " free"], *, evaluations: int = ALL
) -> Fit:
    """Posterior mode over the free coordinates from one start, the others held."""

    def compute() -> Arrays:
        found = _climb(target, start, free, evaluations)
        return {part.name: np.asarray(getattr(found, part.name)) for part in fields(Fit)}

    found = target.recall("climb", [start, free, np.array(evaluations)], compute)
    numbers = {name: float(found[name]) for name in ("log_evidence", "promise")}
    return Fit(**{**found, **numbers})  # type: ignore[arg-type]


def _climb(target: Target, start: np.ndarray, free: np.ndarray, evaluations: int) -> Fit:
    coordinates = target.forward.coordinates
    low, high = (bound[free] for bound in coordinates.bounds)
    mean, sd = coordinates.prior_mean[free], coordinates.prior_sd[free]

    def place(z: np.ndarray) -> np.ndarray:
        x = start.copy()
        x[free] = z
        return x

    def residual(z: np.ndarray) -> np.ndarray:
        return np.concatenate([target.residual(place(z)[None])[0], (z - mean) / sd])

    def jacobian(z: np.ndarray) -> np.ndarray:
        return np.concatenate([-target.jacobian(place(z), free), np.diag(1.0 / sd)])

    inside = np.clip(start[free], low + 1e-9 * (high - low), high - 1e-9 * (high - low))
    found = least_squares(
        residual, inside, jacobian, bounds=(low, high), x_scale=sd, ftol=1e-6, xtol=1e-6, gtol=1e-9,
        max_nfev=evaluations,
    )  # fmt: skip
    rows = len(found.fun) - len(free)  # those after them are the prior's
    return _around(target, place(found.x), free, found.fun[:rows], -found.jac[:rows])


def _around(target: Target, x: np.ndarray, free: np.ndarray, residual: np.ndarray, jacobian: np.ndarray) -> Fit:
    """The normal approximation around a point that is taken for the mode."""
    coordinates = target.forward.coordinates
    low, high = (bound[free] for bound in coordinates.bounds)
    mean, sd = coordinates.prior_mean[free], coordinates.prior_sd[free]
    precision = jacobian.T @ jacobian + np.diag(1.0 / sd**2)
    covariance = np.linalg.inv(precision)
    z = (x[free] - mean) / sd
    log_prior = float(np.sum(-0.5 * z**2 - np.log(sd)))  # the 2 pi cancel against those of the integral
    spread = np.sqrt(np.diag(covariance))
    # Where a prior ends at a bound, it is higher by what lies beyond, and only part of the peak is inside.
    beyond = np.log(norm.cdf((high - mean) / sd) - norm.cdf((low - mean) / sd))
    inside = np.log(np.maximum(norm.cdf((high - x[free]) / spread) - norm.cdf((low - x[free]) / spread), 1e-12))
    evidence = -0.5 * float(residual @ residual) + log_prior + 0.5 * float(np.linalg.slogdet(covariance)[1])
    slope = jacobian.T @ residual - (x[free] - mean) / sd**2
    # At a bound a step leads nowhere.
    slope = np.where(
        ((x[free] <= low + 1e-6 * sd) & (slope < 0)) | ((x[free] >= high - 1e-6 * sd) & (slope > 0)), 0.0, slope
    )
    promise = 0.5 * float(slope @ covariance @ slope)
    return Fit(x, free, residual, jacobian, covariance, evidence + float(np.sum(inside - beyond)), promise)


def best_between(
    target: Target,
    here: Float[np.ndarray, " d"],
    there: Float[np.ndarray, " d"],
    held: Sequence[int],
    shares: Float[np.ndarray, " share"],
) -> Float[np.ndarray, " d"]:
    """The best point, at some shares of the way, between one and a linear extrapolation from it, which a large misfit
    carries too far. Coordinates that are held, places and times, mean the same however large an effect is."""
    coordinates = target.forward.coordinates
    points = here + shares[:, None] * (there - here)
    points[:, list(held)] = there[list(held)]
    points = np.clip(points, *coordinates.bounds)
    residual = target.recall("shares", [points], lambda: {"residual": target.residual(points)})["residual"]
    z = (points - coordinates.prior_mean) / coordinates.prior_sd
    return points[int(np.argmin(np.sum(residual**2, axis=1) + np.sum(z**2, axis=1)))]


def widened(fit: Fit, coordinates: Coordinates) -> Fit:
    """A fit as it would be under priors no narrower than the sizes found, to first order.

    The prior of a candidate's size says what is usual, and decides whether the candidate is believed. Once it is, a
    size of many prior deviations would be drawn back towards null by several posterior deviations. Sizes below one
    prior deviation stay as they are.
    """
    sd = coordinates.prior_sd[fit.free]
    less = (1.0 - 1.0 / widening(fit, coordinates)[fit.free] ** 2) / sd**2
    if not less.any():
        return fit
    covariance = np.linalg.inv(np.linalg.inv(fit.covariance) - np.diag(less))
    x = fit.x.copy()
    x[fit.free] += covariance @ (less * x[fit.free])
    return replace(fit, x=np.clip(x, *coordinates.bounds), covariance=covariance)


def widening(fit: Fit, coordinates: Coordinates) -> Float[np.ndarray, " d"]:
    """By how much the scale of each prior is widened for a fit's sizes; 1 where it stays as it is."""
    free = np.isin(np.arange(len(fit.x)), fit.free) & coordinates.affine
    return np.where(free, np.maximum(np.abs(fit.x / coordinates.prior_sd), 1.0), 1.0)
