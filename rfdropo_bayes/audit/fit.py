"""Posterior modes of the base model and its extensions within bounds, with Laplace's evidence."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.stats import norm

from rfdropo_bayes.audit.coordinates import Coordinates
from rfdropo_bayes.audit.forward import Fields, Forward
from rfdropo_bayes.audit.journal import Arrays, Journal, digest
from rfdropo_bayes.audit.measurements import Measurements
from rfdropo_bayes.bayes.channels import Seen
from rfdropo_bayes.bayes.noise.stacked import Stacked
from rfdropo_bayes.inference import LevenbergState, maximise, normal_at
from rfdropo_bayes.simulators.protocol import Observation

FIRST, ALL = 8, 40  # steps of a short climb, and most of one to its end
USUAL = 12  # steps of a climb, each with a Jacobian
TOLERANCE = 0.01  # nats that a step promises at the end of a climb
CLOSE = 1e-3  # of the squared misfit: climbs end where steps bring less than a thousandth of that
FAILED = 1e6  # whitened residual of a rollout that did not end well: no step is ever taken there


@dataclass(frozen=True)
class Fit:
    """A mode and the normal approximation around it.

    Attributes:
        x: coordinates of all parameters.
        free: which of them were fitted.
        residual: whitened, of all channels.
        jacobian: of the whitened prediction with respect to the free coordinates.
        covariance: of the free coordinates, prior included.
        log_evidence: Laplace's, up to the noise's normaliser, which all models under one noise share; the prior counts
            with its density and its curvature.
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

    @property
    def counted(self) -> float:
        """How many independent values the residuals amount to, where rows that last count as fewer."""
        return max(min(float(self.residual @ self.residual), len(self.residual)), np.e)

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
    """What is fitted: measurements under a noise, by a simulator; ``journal`` keeps what was computed.

    Where the noise is that of a model that is far off (see `inadequacy`), ``known`` is the same under the noise of the
    measurement.
    """

    forward: Forward
    measurements: Measurements
    noise: Stacked
    journal: Journal = field(default_factory=Journal)
    known: Target | None = None

    @property
    def measured(self) -> Target:
        """The same under the noise of the measurement."""
        return self if self.known is None else self.known

    def on(self, forward: Forward) -> Target:
        """The same with another simulator."""
        known = None if self.known is None else replace(self.known, forward=forward)
        return replace(self, forward=forward, known=known)

    @cached_property
    def identity(self) -> str:
        """Digest of everything that a residual depends on beside the parameters."""
        data = self.measurements
        readings = [np.asarray(channel.measured) for channel in data.channels]
        noise = [(part.scale, part.autocorrelation, part.correlation) for part in self.noise.parts]
        known = [np.zeros(0) if array is None else array for part in noise for array in part]
        return digest(self.forward.identity, *readings, data.count, *known, repr(data.weighed))

    def recall(self, what: str, inputs: Sequence[np.ndarray], compute: Callable[[], Arrays]) -> Arrays:
        """A computation with this target, looked up where the journal has it; its rollouts and seconds count either
        way."""
        before, looked_up = self.forward.rollouts, True

        def counted() -> Arrays:
            nonlocal looked_up
            began, found, looked_up = time.monotonic(), compute(), False
            seconds = np.asarray(time.monotonic() - began)
            return {**found, "rollouts": np.asarray(self.forward.rollouts - before), "seconds": seconds}

        found = dict(self.journal.recall(digest(self.identity, what, *inputs), counted))
        self.forward.rollouts = before + int(found.pop("rollouts"))
        seconds = float(found.pop("seconds", 0.0))
        if looked_up:
            self.forward.deadline.recall(seconds)
        return found

    def residual(self, points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n m"]:
        """Whitened residuals, measured less simulated, of a batch of points."""
        return self.evaluate(points)[0]

    def evaluate(
        self, points: Float[np.ndarray, "n d"], rows: int | None = None
    ) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, " n"], np.ndarray]:
        """Whitened residuals, the logarithms of the sizes that errors are relative to, and where rollouts ended well.

        Only the first ``rows`` rows of every recording, all by default, are simulated; later ones hold no meaning.
        Half the sum of squares and the sum of logarithms make minus the log likelihood, up to a constant.
        """
        shown, fine = self.forward.observe(points, rows)
        each = [self._errors({name: part[i] for name, part in shown.items()}) for i in range(len(fine))]
        white = self._whitened(np.stack([errors for errors, _ in each]), self.weighed(points)[0])
        return np.where(fine[:, None], white, FAILED), np.array([float(size) for _, size in each]), fine

    def errors(self, x: Float[np.ndarray, " d"]) -> Float[np.ndarray, "group time column"]:
        """Measured less simulated readings at one point, in the unit of the noise.

        Raises:
            InputError: a rollout there did not end well.
        """
        return np.asarray(self._errors(self.forward.observe_one(x))[0])

    def error_slopes(
        self, points: Float[np.ndarray, "k d"], directions: Float[np.ndarray, "k d"]
    ) -> tuple[Float[np.ndarray, "k group time column"], Float[np.ndarray, " k"]]:
        """Derivatives of the errors, and of the logarithms of sizes, along a direction at each point."""
        if len(points) == 0:
            return np.zeros((0, *self.measurements.count.shape)), np.zeros(0)
        along = self.forward.tangents(points, directions)
        if self._linear:  # what is shown enters errors as it is
            shown = {name: np.zeros(part.shape[1:]) for name, part in along.items()}
        slopes, at = [], np.zeros(0)
        for k, point in enumerate(points):
            tangent = {name: part[k] for name, part in along.items()}
            if not self._linear and not np.array_equal(at, point):
                shown, at = self.forward.observe_one(point), point
            here = {name: jnp.asarray(shown[name], dtype=float) for name in tangent}
            ahead = {name: jnp.asarray(part, dtype=float) for name, part in tangent.items()}
            slopes.append(jax.jvp(self._errors, (here,), (ahead,))[1])
        errors, sizes = zip(*slopes, strict=True)
        return np.stack([np.asarray(part) for part in errors]), np.array([float(part) for part in sizes])

    @property
    def _linear(self) -> bool:
        return all(channel.linear for channel in self.measurements.channels)

    def _errors(self, shown: Fields) -> tuple[Float[jax.Array, "group time column"], Float[jax.Array, ""]]:
        """Errors of all channels side by side at what one point shows, and the sum of logarithms of their sizes."""
        seen = _seen(shown)
        errors, sizes, channels = [], jnp.zeros(()), self.measurements.channels
        for channel, own in zip(channels, self.measurements.columns, strict=True):
            about = channel.expected(seen)
            errors.append(channel.deviation(channel.measured, about))
            size = channel.log_size(about, channel.measured)
            if size is not None:
                count = self.measurements.count[..., own]
                sizes += jnp.sum(jnp.where(count > 0, size, 0.0))
        return jnp.concatenate(errors, axis=-1), sizes

    def _whitened(self, errors: np.ndarray, weighed: np.ndarray) -> np.ndarray:
        return np.concatenate([self.measurements.whiten(errors, self.noise), weighed], axis=-1)

    def weighed(
        self, points: Float[np.ndarray, "n d"], directions: Float[np.ndarray, "n d"] | None = None
    ) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n k"]]:
        """Residuals of the weighed parts, and what they lose along a direction at each point."""
        parts, own = self.measurements.weighed, self.forward.coordinates
        if parts is None:
            return np.zeros((len(points), 0)), np.zeros((len(points), 0))
        sums = np.array([[name in entry.parameters for name in own.names] for entry in parts.entries], dtype=float)
        sd = np.array([entry.sd for entry in parts.entries])
        left = (parts.measured - own.values(points) @ sums.T) / sd
        along = np.zeros_like(points) if directions is None else own.slopes(points) * directions
        return left, along @ sums.T / sd

    def slopes(
        self, points: Float[np.ndarray, "k d"], directions: Float[np.ndarray, "k d"]
    ) -> tuple[Float[np.ndarray, "k m"], Float[np.ndarray, " k"]]:
        """Derivatives of the whitened prediction, and of the logarithms of sizes, along a direction at each point."""
        errors, sizes = self.error_slopes(points, directions)
        return self._whitened(-errors, self.weighed(points, directions)[1]), sizes

    def jacobian(self, x: Float[np.ndarray, " d"], free: Int[np.ndarray, " free"]) -> Float[np.ndarray, "m free"]:
        """Derivatives of the whitened prediction."""
        return self.slopes(np.repeat(x[None], len(free), axis=0), np.eye(len(x))[free])[0].T


def _seen(shown: Fields) -> Seen:
    parts = {name: shown.get(name) for name in Observation._fields}
    return Seen(Observation(**{**parts, "status": 0}), shown, shown["offset"])  # type: ignore[arg-type]


@dataclass
class _Climb:
    """The posterior over some coordinates, the others held, as `inference.maximise` climbs it."""

    target: Target
    start: Float[np.ndarray, " d"]
    free: Int[np.ndarray, " free"]

    def __post_init__(self) -> None:
        self.noise = np.zeros(len(self.free), dtype=bool)
        self.bounds = tuple(bound[self.free] for bound in self.target.forward.coordinates.bounds)
        self.linear: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None = None

    def place(self, u: Float[np.ndarray, "n free"]) -> Float[np.ndarray, "n d"]:
        """Points of all coordinates."""
        points = np.repeat(self.start[None], len(u), axis=0)
        points[:, self.free] = np.clip(u, *self.bounds)
        return points

    def density(self, u: Float[np.ndarray, "n free"]) -> Float[np.ndarray, " n"]:
        """Log posterior, up to the noise's normaliser."""
        points = self.place(u)
        white, sizes, fine = self.target.evaluate(points)
        prior = self.target.forward.coordinates.log_prior(points)[:, self.free].sum(axis=1)
        return np.where(fine, -0.5 * np.sum(white**2, axis=1) - sizes + prior, -np.inf)

    def linearise(self, u: Float[np.ndarray, " free"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals, the Jacobian of the prediction, and the slopes of the logarithms of sizes."""
        if self.linear is None or not np.array_equal(self.linear[0], u):
            x = self.place(u[None])
            directions = np.eye(x.shape[1])[self.free]
            slopes, sizes = self.target.slopes(np.repeat(x, len(self.free), axis=0), directions)
            self.linear = u.copy(), self.target.residual(x)[0], slopes.T, sizes
        return self.linear[1:]

    def quadratic(self, u: Float[np.ndarray, " free"]) -> tuple[np.ndarray, np.ndarray]:
        """See `modes.climb.Climbable`."""
        residual, jacobian, sizes = self.linearise(u)
        gradient = jacobian.T @ residual - sizes + self.prior_gradient(u)
        return gradient, jacobian.T @ jacobian + np.diag(np.maximum(-np.diag(self.prior_hessian(u)), 0.0))

    def information(self, u: Float[np.ndarray, " free"]) -> Float[np.ndarray, "free free"]:
        """See `modes.climb.Climbable`."""
        jacobian = self.linearise(u)[1]
        return jacobian.T @ jacobian

    def along(self, axes: Float[np.ndarray, "free free"]) -> None:
        """Its derivatives stay as they are."""

    def prior_gradient(self, u: Float[np.ndarray, " free"]) -> Float[np.ndarray, " free"]:
        """Of the log prior."""
        return self.target.forward.coordinates.prior_slopes(self.place(u[None])[0])[0][self.free]

    def prior_hessian(self, u: Float[np.ndarray, " free"]) -> Float[np.ndarray, "free free"]:
        """Of the log prior."""
        return np.diag(self.target.forward.coordinates.prior_slopes(self.place(u[None])[0])[1][self.free])


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
    climbed = _Climb(target, start, free)
    low, high = climbed.bounds
    inside = np.clip(start[free], low, high)
    state, _ = maximise(climbed, inside, max_steps=evaluations, tolerance=TOLERANCE)
    return _around(climbed, state)


def _around(climbed: _Climb, state: LevenbergState) -> Fit:
    """The normal approximation around a point that is taken for the mode."""
    low, high = climbed.bounds
    u, x = state.position, climbed.place(state.position[None])[0]
    found = normal_at(climbed, state)
    residual, jacobian, _ = climbed.linearise(u)
    spread = np.sqrt(np.diag(found.covariance))
    # Only part of a peak at a bound is inside.
    inside = np.log(np.maximum(norm.cdf((high - u) / spread) - norm.cdf((low - u) / spread), 1e-12))
    slope, _ = climbed.quadratic(u)
    slope = np.where(((u <= low) & (slope < 0)) | ((u >= high) & (slope > 0)), 0.0, slope)
    promise = 0.5 * float(slope @ found.covariance @ slope) if np.isfinite(state.log_density) else np.inf
    evidence = found.log_evidence + float(np.sum(inside))
    return Fit(x, climbed.free, residual, jacobian, found.covariance, evidence, promise)


def climb_rollouts(target: Target, parameters: int) -> int:
    """Rollouts that a climb of so many parameters may take."""
    forward = target.forward
    return forward.count * USUAL * (1 + forward.lanes.slope_rollouts * parameters)


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
    return points[int(np.argmax(heights(target, points, "shares")))]


def heights(target: Target, points: Float[np.ndarray, "n d"], what: str) -> Float[np.ndarray, " n"]:
    """Log posteriors of points, up to the noise's normaliser; kept in the journal by the name of ``what``."""

    def compute() -> Arrays:
        white, sizes, _ = target.evaluate(points)
        return {"height": -0.5 * np.sum(white**2, axis=1) - sizes}

    return target.recall(what, [points], compute)["height"] + target.forward.coordinates.log_prior(points).sum(axis=1)


def widened(fit: Fit, coordinates: Coordinates) -> Fit:
    """A fit as it would be under priors no narrower than the sizes found, to first order.

    The prior of a candidate's size says what is usual, and decides whether the candidate is believed. Once it is, a
    size of many prior deviations would be drawn back towards null by several posterior deviations. Sizes below one
    prior deviation stay as they are.
    """
    scale = 1.0 / coordinates.prior_sd[fit.free] ** 2
    less = (1.0 - 1.0 / widening(fit, coordinates)[fit.free] ** 2) * scale
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
