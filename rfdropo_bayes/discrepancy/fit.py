"""Posterior modes of the base model and its extensions within bounds, with Laplace's evidence.

The likelihood of a long recording has many small local optima, at which optimisations of the whole stop. The base
model's optimum is searched as in `calibrate`: `inference.find_modes` starts at selected draws, and at short prefixes.
`better_nearby` then checks the optimum by rollouts instead of derivatives.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray
from scipy.stats import norm

from rfdropo_bayes.bayes.channels import Seen
from rfdropo_bayes.bayes.inferred_parameter import InferredParameter
from rfdropo_bayes.bayes.lanes import Fields
from rfdropo_bayes.bayes.noise.autoregression import MISFIT
from rfdropo_bayes.bayes.noise.stacked import Stacked
from rfdropo_bayes.bayes.problem import ProblemDefaults
from rfdropo_bayes.bayes.scopes import Scopes
from rfdropo_bayes.discrepancy.coordinates import Coordinates
from rfdropo_bayes.discrepancy.forward import Forward
from rfdropo_bayes.discrepancy.journal import Arrays, Journal, digest
from rfdropo_bayes.discrepancy.measurements import Measurements
from rfdropo_bayes.discrepancy.score import VISIBLE
from rfdropo_bayes.discrepancy.usable_difference import usable_difference
from rfdropo_bayes.inference.modes.mode_search import LaplaceConfig, find_modes
from rfdropo_bayes.inference.modes.optimisation import maximise, normal_at, optimisation_cost
from rfdropo_bayes.inference.modes.targets import Target as Climbed
from rfdropo_bayes.simulators.protocol import Observation

ALL = 40  # most steps of a full optimisation
USUAL = 8  # steps of an optimisation, each with a Jacobian
TOLERANCE = 0.01  # predicted gain of a step [nat] at the end of an optimisation
CLOSE = 1e-3  # of the squared misfit: optimisations end at steps with less than a thousandth of it
SEARCHED = 3  # steps of an optimisation in a search: a linear model needs one or two, the demonstration's arm five
# predicted gain [nat] at the end of a search's optimisations; the audit's own optimisation continues from there
OPTIMISED = 0.1
POLLED = (0.3, 0.03, 0.003)  # trial deviations of the prior to each side of an optimum
ALONG = (4.0, 2.0, 1.0, 0.3)  # trial deviations of the posterior along its principal axes
WITHIN = 0.5 * max(ALONG) ** 2  # predicted gain [nat] of a step no longer than the trial steps
AGAIN = 3  # times that a fit is continued from a better point beside it, before it counts as not converged
FAILED = 1e6  # whitened residual of a rollout that failed: no step is ever taken there


@dataclass(frozen=True)
class Fit:
    """A mode and the normal approximation around it."""

    x: Float[np.ndarray, " d"]  # coordinates of all parameters
    free: Int[np.ndarray, " free"]  # indices of fitted coordinates
    residual: Float[np.ndarray, " n"]  # whitened residuals of all channels
    jacobian: Float[np.ndarray, "n free"]  # derivative of the whitened prediction with respect to the free coordinates
    covariance: Float[np.ndarray, "free free"]  # covariance of the free coordinates, prior included
    # Laplace's, up to the noise's normaliser, which all models under the same noise share; the prior counts with its
    # density and its curvature
    log_evidence: float
    promise: float  # predicted gain of a further Gauss-Newton step [nat]; see `converged`

    @property
    def converged(self) -> bool:
        """Whether the predicted gain of a step is below a nat, or below the accuracy of a large misfit."""
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
class FitTarget:
    """Target of a fit: measurements, noise and simulator; ``journal`` stores results.

    If the noise belongs to a misspecified model (see `inadequacy`), ``known`` is the same target under the measurement
    noise.
    """

    forward: Forward
    measurements: Measurements
    noise: Stacked
    journal: Journal = field(default_factory=Journal)
    known: FitTarget | None = None

    @property
    def measured(self) -> FitTarget:
        """The target under the noise of the measurement."""
        return self if self.known is None else self.known

    def on(self, forward: Forward) -> FitTarget:
        """The target with another simulator."""
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
        """A computation with this target, from the journal if stored; its rollouts and seconds count in both cases."""
        before, looked_up = self.forward.rollouts, True
        self.forward.forget()

        def counted() -> Arrays:
            nonlocal looked_up
            began, result, looked_up = time.monotonic(), compute(), False
            seconds = np.asarray(time.monotonic() - began)
            return {**result, "rollouts": np.asarray(self.forward.rollouts - before), "seconds": seconds}

        result = dict(self.journal.recall(digest(self.identity, what, *inputs), counted))
        self.forward.rollouts = before + int(result.pop("rollouts"))
        self.forward.forget()
        seconds = float(result.pop("seconds", 0.0))
        if looked_up:
            self.forward.deadline.recall(seconds)
        return result

    def residual(self, points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n m"]:
        """Whitened residuals, measured less simulated, of a batch of points."""
        return self.evaluate(points)[0]

    def evaluate(
        self, points: Float[np.ndarray, "n d"], rows: int | None = None
    ) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, " n"], np.ndarray]:
        """Whitened residuals, the log standard deviations that whiten them, and the mask of successful rollouts.

        Only the first ``rows`` rows of every recording, all by default, are simulated; later rows are meaningless. Half
        the sum of squares and the sum of logarithms make minus the log likelihood, up to a constant.
        """
        shown, fine = self.forward.observe(points, rows)
        each = [self._errors({name: part[i] for name, part in shown.items()}) for i in range(len(fine))]
        white = self._whitened(np.stack([errors for errors, _ in each]), self.weighed(points)[0])
        return np.where(fine[:, None], white, FAILED), np.array([float(size) for _, size in each]), fine

    def log_likelihood(self, points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        """Log likelihood of a batch of points, up to the noise's normaliser; minus infinity after a failed rollout."""
        white, sizes, fine = self.evaluate(points)
        return np.where(fine, -0.5 * np.sum(white**2, axis=1) - sizes, -np.inf)

    def errors(self, x: Float[np.ndarray, " d"]) -> Float[np.ndarray, "group time column"]:
        """Measured less simulated readings at one point, in the unit of the noise.

        Raises:
            InputError: a rollout at the point failed.
        """
        return np.asarray(self._errors(self.forward.observe_one(x))[0])

    def shown_errors(self, shown: Fields, several: Sequence[str] = ()) -> Float[np.ndarray, "*many group time column"]:
        """Measured less simulated readings, from the observations at one point; fields in ``several`` have several
        values, each in turn.
        """
        if not several:
            return np.asarray(self._errors(shown)[0])
        axes = {name: 0 if name in several else None for name in shown}
        return np.asarray(jax.vmap(lambda own: self._errors(own)[0], in_axes=(axes,))(shown))

    def error_slopes(
        self, points: Float[np.ndarray, "k d"], directions: Float[np.ndarray, "k d"]
    ) -> tuple[Float[np.ndarray, "k group time column"], Float[np.ndarray, " k"]]:
        """Derivatives of the errors, and of the logarithms of sizes, along a direction at each point."""
        if len(points) == 0:
            return np.zeros((0, *self.measurements.count.shape)), np.zeros(0)
        along = self.forward.tangents(points, directions)
        if self._linear:  # observations enter errors unchanged
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
        """Errors of all channels side by side for the observations at one point, and the sum of logarithms of their
        sizes.
        """
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
        """Residuals of the weighed parts, and their decrease along a direction at each point."""
        parts, own = self.measurements.weighed, self.forward.coordinates
        if parts is None:
            return np.zeros((len(points), 0)), np.zeros((len(points), 0))
        sums = np.array([[name in entry.parameters for name in own.names] for entry in parts.entries], dtype=float)
        sd = np.array([entry.sd for entry in parts.entries])
        residual = (parts.measured - own.values(points) @ sums.T) / sd
        along = np.zeros_like(points) if directions is None else own.slopes(points) * directions
        return residual, along @ sums.T / sd

    def slopes(
        self, points: Float[np.ndarray, "k d"], directions: Float[np.ndarray, "k d"]
    ) -> tuple[Float[np.ndarray, "k m"], Float[np.ndarray, " k"]]:
        """Derivatives of the whitened prediction, and of the logarithms of sizes, along a direction at each point."""
        errors, sizes = self.error_slopes(points, directions)
        return self._whitened(-errors, self.weighed(points, directions)[1]), sizes

    def visible_slopes(
        self, points: Float[np.ndarray, "k d"], directions: Float[np.ndarray, "k d"]
    ) -> Float[np.ndarray, "k m"]:
        """Slopes of the whitened prediction over changes that just show (`VISIBLE`), to both sides within the bounds;
        plain slopes if a change by the whole direction does not show, or a rollout fails.

        Cables that fall slack make kinks. Over micrometres, effects of single cables have cosines of .1 to .9 with
        those that show (smooth arm, three data sets); to one side, the shift of a clock has .75, as commands change at
        the times of rows.
        """
        slopes = self.slopes(points, directions)[0]
        size = np.linalg.norm(slopes, axis=1)
        seen = size > VISIBLE
        if not seen.any():
            return slopes
        change = VISIBLE * directions[seen] / size[seen, None]
        ends = [np.clip(points[seen] + sign * change, *self.forward.coordinates.bounds) for sign in (1.0, -1.0)]
        both = self.residual(np.concatenate(ends))
        ahead, behind = np.split(both, 2)
        share = np.sum((ends[0] - ends[1]) * directions[seen], axis=1) / np.sum(directions[seen] ** 2, axis=1)
        fine = np.all(np.abs(both) < FAILED, axis=1).reshape(2, -1).all(axis=0) & (share > 0.0)
        slopes[np.flatnonzero(seen)[fine]] = (behind - ahead)[fine] / share[fine, None]
        return slopes

    def jacobian(self, x: Float[np.ndarray, " d"], free: Int[np.ndarray, " free"]) -> Float[np.ndarray, "m free"]:
        """Derivatives of the whitened prediction."""
        return self.slopes(np.repeat(x[None], len(free), axis=0), np.eye(len(x))[free])[0].T


def _seen(shown: Fields) -> Seen:
    parts = {name: shown.get(name) for name in Observation._fields}
    return Seen(Observation(**{**parts, "status": 0}), shown, shown["offset"])  # type: ignore[arg-type]


@dataclass(frozen=True)
class Posterior(ProblemDefaults):
    """The posterior over some coordinates, with the others fixed, as a problem of `bayes.problem`.

    A row is one row of every group of repeats, whitened given the earlier rows. The noise is known.
    """

    target: FitTarget  # target of the fit
    start: Float[np.ndarray, " d"]  # all coordinates
    free: Int[np.ndarray, " free"]  # indices of free coordinates

    @property
    def _coordinates(self) -> Coordinates:
        return self.target.forward.coordinates

    @cached_property
    def _parameters(self) -> tuple[InferredParameter, ...]:
        return tuple(self._coordinates.space.parameters[i] for i in self.free)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Free parameters."""
        return tuple(p.name for p in self._parameters)

    @property
    def units(self) -> dict[str, str]:
        """Units of the parameters."""
        return {p.name: p.spec.unit for p in self._parameters}

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """Hard bounds."""
        return {p.name: (p.spec.low, p.spec.high) for p in self._parameters}

    @cached_property
    def prior_ends(self) -> dict[str, tuple[float, float]]:
        """Ends of each prior, at the hard bounds or inside them."""
        return {p.name: p.ends for p in self._parameters}

    @property
    def n_rows(self) -> int:
        """Rows of the longest recording."""
        return int(self.target.measurements.count.shape[1])

    def place(self, u: Float[Any, "n free"]) -> Float[np.ndarray, "n d"]:
        """Points of all coordinates, within their bounds."""
        points = np.repeat(self.start[None], len(u), axis=0)
        points[:, self.free] = np.asarray(u)
        return np.clip(points, *self._coordinates.bounds)

    def sample_prior(self, key: PRNGKeyArray, n: int) -> dict[str, Float[Any, " n"]]:
        """Independent prior draws."""
        drawn = Scopes(self._parameters).sample(key, n)
        return {name: np.asarray(column, dtype=float) for name, column in drawn.items()}

    def to_unconstrained(self, values: Mapping[str, Any]) -> Float[Any, "n free"]:
        """Coordinates of values."""
        own = zip(self.free, self.names, strict=True)
        return np.stack([self._coordinates.encode_one(i, np.asarray(values[name])) for i, name in own], axis=1)

    def from_unconstrained(self, u: Float[Any, "n free"]) -> dict[str, Float[Any, " n"]]:
        """Values of coordinates."""
        values = self._coordinates.values(self.place(u))
        return {name: values[:, i] for i, name in zip(self.free, self.names, strict=True)}

    def log_prior(self, u: Float[Any, "n free"]) -> Float[Any, " n"]:
        """Log prior density of the free coordinates."""
        return self._coordinates.log_prior(self.place(u))[:, self.free].sum(axis=1)

    @property
    def prior_derivatives(self) -> tuple[Any, Any]:
        """Gradient and Hessian of the log prior."""

        def at(u: np.ndarray, order: int) -> np.ndarray:
            return self._coordinates.prior_slopes(self.place(np.asarray(u)[None])[0])[order][self.free]

        return (lambda u: at(u, 0)), (lambda u: np.diag(at(u, 1)))

    def row_log_likelihood(
        self, values: Mapping[str, Any], horizon: int
    ) -> tuple[Float[Any, "n horizon"], Int[Any, " n"]]:
        """Log density of each row given the earlier rows, up to the noise's normaliser; status 1 for a failed
        rollout.
        """
        white, weighed, fine = self._rows(values, horizon)
        rows = -0.5 * np.sum(white**2, axis=(1, 3))
        rows[:, 0] -= 0.5 * np.sum(weighed**2, axis=1)
        return np.where(fine[:, None], rows, -np.inf), np.where(fine, 0, 1)

    def residuals(self, values: Mapping[str, Any], horizon: int) -> Float[Any, "n m"]:
        """Whitened residuals of a prefix."""
        white, weighed, fine = self._rows(values, horizon)
        return np.where(fine[:, None], np.concatenate([white.reshape(len(white), -1), weighed], axis=1), np.inf)

    def _rows(self, values: Mapping[str, Any], horizon: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Whitened residuals of a prefix, of weighed parts, and the mask of successful rollouts.

        The contribution of relative errors' sizes to the likelihood is left to the optimisation of the whole.
        """
        white, _, fine = self.target.evaluate(self.place(self.to_unconstrained(values)), horizon)
        white = np.where(fine[:, None], white, 0.0)
        series = self.target.measurements.series(white)
        return series[:, :, :horizon], white[:, self.target.measurements.count.size :], fine

    def whole(self) -> Climbed:
        """All rows, for an optimisation: with derivatives of the simulator and of the sizes of errors."""
        known: dict[bytes, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}

        def at(u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            if u.tobytes() not in known:
                known.clear()
                x = self.place(u[None])
                directions = np.eye(x.shape[1])[self.free]
                slopes, sizes = self.target.slopes(np.repeat(x, len(self.free), axis=0), directions)
                known[u.tobytes()] = self.target.residual(x)[0], -slopes.T, -sizes
            return known[u.tobytes()]

        def likelihood(u: np.ndarray) -> np.ndarray:
            return self.target.log_likelihood(self.place(u))

        low, high = self._coordinates.bounds
        return Climbed(
            lambda u: likelihood(u) + self.log_prior(u),
            likelihood,
            *self.prior_derivatives,
            lambda u: at(u)[:2],
            lambda u: self.target.residual(self.place(u)),
            np.zeros(len(self.free), dtype=bool),
            beside=lambda u: at(u)[2],
            bounds=(low[self.free], high[self.free]),
        )


def optimise(
    target: FitTarget, start: Float[np.ndarray, " d"], free: Int[np.ndarray, " free"], *, evaluations: int = ALL
) -> Fit:
    """Posterior mode over the free coordinates from one start, the others held."""

    def compute() -> Arrays:
        posterior = Posterior(target, start, free)
        optimised = posterior.whole()
        low, high = optimised.bounds
        state, _ = maximise(optimised, np.clip(start[free], low, high), max_steps=evaluations, tolerance=TOLERANCE)
        u, approximation = state.position, normal_at(optimised, state)
        residual, jacobian = optimised.linearise(u)
        deviation = np.sqrt(np.diag(approximation.covariance))
        # Only part of a peak at a bound is inside.
        inside = np.log(np.maximum(norm.cdf((high - u) / deviation) - norm.cdf((low - u) / deviation), 1e-12))
        slope, _ = optimised.quadratic(u)
        slope = np.where(((u <= low) & (slope < 0)) | ((u >= high) & (slope > 0)), 0.0, slope)
        promise = 0.5 * float(slope @ approximation.covariance @ slope) if np.isfinite(state.log_density) else np.inf
        evidence = approximation.log_evidence + float(np.sum(inside))
        # Integrated over the size of a misspecified model's residuals; no change at the assumed size.
        series = target.measurements.series(residual)
        change = 0.0
        for part, own in zip(target.noise.parts, target.measurements.columns, strict=True):
            if part.source == MISFIT:
                share = max(float(np.sum(series[..., own] ** 2)) / part.freedom, np.finfo(float).tiny)
                change += 0.5 * part.freedom * (share - 1.0 - np.log(share))
        evidence += change
        return {
            "x": posterior.place(u[None])[0],
            "free": np.asarray(free),
            "residual": np.asarray(residual),
            "jacobian": np.asarray(-jacobian),
            "covariance": np.asarray(approximation.covariance),
            "log_evidence": np.asarray(evidence),
            "promise": np.asarray(promise),
        }

    stored = target.recall("optimise", [start, free, np.array(evaluations)], compute)
    numbers = {name: float(stored[name]) for name in ("log_evidence", "promise")}
    return Fit(**{**stored, **numbers})  # type: ignore[arg-type]


def optimisation_rollouts(target: FitTarget, parameters: int) -> int:
    """Expected rollouts of an optimisation of ``parameters`` parameters."""
    forward, (_, values) = target.forward, optimisation_cost(0, 0)
    return forward.count * USUAL * (int(values) + forward.lanes.slope_rollouts * parameters)


def best_between(
    target: FitTarget,
    here: Float[np.ndarray, " d"],
    there: Float[np.ndarray, " d"],
    constant: Sequence[int],
    shares: Float[np.ndarray, " share"],
) -> Float[np.ndarray, " d"]:
    """The best point, at some shares of the way, between one and a linear extrapolation from it, which a large misfit
    carries too far. Coordinates that are held, places and times, mean the same however large an effect is."""
    coordinates = target.forward.coordinates
    points = here + shares[:, None] * (there - here)
    points[:, list(constant)] = there[list(constant)]
    points = np.clip(points, *coordinates.bounds)
    return points[int(np.argmax(heights(target, points, "shares")))]


def heights(target: FitTarget, points: Float[np.ndarray, "n d"], what: str) -> Float[np.ndarray, " n"]:
    """Log posteriors of points, up to the noise's normaliser; stored in the journal under the name ``what``."""

    stored = target.recall(what, [points], lambda: {"height": target.log_likelihood(points)})
    return stored["height"] + target.forward.coordinates.log_prior(points).sum(axis=1)


def widened(target: FitTarget, fit: Fit) -> Fit:
    """A fit under priors at least as wide as the fitted sizes: its point, covariance and promise.

    The prior of a candidate's size describes usual sizes, and decides on the candidate. After its adoption the prior
    would bias a large size towards null by several posterior deviations. Sizes below one prior deviation are unchanged.
    A first-order step is not sufficient: if motion determines only a ratio, such as drag over modulus, the wider prior
    moves both far along a curve.

    Args:
        target: target of the fit.
        fit: a mode of the posterior.
    """
    own = target.forward.coordinates
    factors = widening(fit, own)
    if (factors == 1.0).all():
        return fit
    wide = target.on(target.forward.with_coordinates(own.widened(factors)))
    refitted, unit = optimise(wide, fit.x / factors, fit.free), factors[fit.free]
    target.forward.rollouts = wide.forward.rollouts
    x = np.clip(factors * refitted.x, *own.bounds)  # which the product misses by its last bit
    return replace(fit, x=x, covariance=refitted.covariance * np.outer(unit, unit), promise=refitted.promise)


def widening(fit: Fit, coordinates: Coordinates) -> Float[np.ndarray, " d"]:
    """Factor by which the scale of each prior is widened for a fit's sizes; 1 for no change."""
    free = np.isin(np.arange(len(fit.x)), fit.free) & coordinates.affine
    return np.where(free, np.maximum(np.abs(fit.x / coordinates.prior_sd), 1.0), 1.0)


def base_optimum(target: FitTarget, key: PRNGKeyArray) -> Float[np.ndarray, " d"]:
    """End of the best optimisation of `calibrate`.

    Raises:
        NoLikelihoodError: all prior draws fail.
    """

    def compute() -> dict[str, np.ndarray]:
        own = target.forward.coordinates
        posterior = Posterior(target, own.null, np.arange(own.base))
        # Its normal approximation is not used: the coarse differences of short optimisations suffice.
        mode = find_modes(posterior, _searching(target), key).modes[0]
        return {"x": posterior.place(mode.mean[None])[0]}

    return target.recall("search", [np.asarray(jax.random.key_data(key))], compute)["x"]


def _searching(target: FitTarget) -> LaplaceConfig:
    """Search settings of `calibrate`; rows of a body at rest are independent, and have one horizon."""
    rests = getattr(target.forward.lanes.simulator, "at_rest", False)
    return LaplaceConfig(tolerance=OPTIMISED, blocks=1) if rests else LaplaceConfig(tolerance=OPTIMISED)


def optimum_rollouts(target: FitTarget) -> int:
    """Rollouts that `base_optimum` usually takes: evaluated draws at each horizon, and optimisations, of which the
    better half continues.
    """
    config, own = _searching(target), target.forward.coordinates
    beginning, step = optimisation_cost(own.base, 0)
    optimisations = sum(max(config.starts >> level, 1) for level in range(config.blocks))
    return target.forward.count * int(
        config.blocks * config.prior_draws + optimisations * (beginning + SEARCHED * step)
    )


def poll_rollouts(target: FitTarget) -> int:
    """Rollouts that `better_nearby` takes."""
    return target.forward.count * (1 + 2 * (len(POLLED) + len(ALONG)) * target.forward.coordinates.base)


def with_usable_differences(target: FitTarget, x: Float[np.ndarray, " d"]) -> FitTarget:
    """The target with derivatives over steps on whose scale its motion is smooth around a point.

    Slopes over the steps of a ladder, in prior deviations, are compared, of all base parameters at once; rollouts say
    which steps agree.
    """
    usual, coordinates = target.forward.lanes.difference, target.forward.coordinates
    directions = np.diag(coordinates.prior_sd)[: coordinates.base]

    def slope(step: float) -> np.ndarray:
        points = np.clip(np.concatenate([x + step * directions, x - step * directions]), *coordinates.bounds)
        residuals = target.recall("ladder", [points], lambda: {"residual": target.residual(points)})["residual"]
        ahead, behind = np.split(residuals, 2)
        return (ahead - behind) / (2.0 * step)

    step = usable_difference(slope)
    return target if step <= usual else replace(target, forward=target.forward.with_difference(step))


def polled(target: FitTarget, fit: Fit, name: str, report: Callable[[str], None]) -> Iterator[Fit]:
    """A fit, continued from better points beside it; rollouts confirm the last, or it has not converged."""
    for _ in range(AGAIN):
        yield fit
        better = better_nearby(target, fit)
        if better is None:  # for a motion with kinks, as with slack cables, slopes predict gains that do not exist
            yield replace(fit, promise=0.0) if fit.promise < WITHIN else fit
            return
        report(f"{name}: sum of squares {fit.residual @ fit.residual:.0f}, and better beside it")
        fit = optimise(target, better, fit.free)
    yield fit if better_nearby(target, fit) is None else replace(fit, promise=np.inf)


def better_nearby(target: FitTarget, fit: Fit) -> Float[np.ndarray, " d"] | None:
    """A point beside a fit that is clearly better; None if rollouts confirm the optimum.

    Derivatives cannot show this: for a motion that is rough on the scale of their steps they are noise.
    """
    coordinates = target.forward.coordinates
    own = coordinates.prior_sd[fit.free]
    values, vectors = np.linalg.eigh(fit.covariance / np.outer(own, own))
    axes = (vectors * np.sqrt(np.maximum(values, 0.0))).T * own
    moves = [step * np.diag(own) for step in POLLED] + [step * axes for step in ALONG]
    moved = np.concatenate([sign * move for move in moves for sign in (-1.0, 1.0)])
    points = np.repeat(fit.x[None], 1 + len(moved), axis=0)
    points[1:, fit.free] += moved
    tried = np.clip(points, *coordinates.bounds)
    height = heights(target, tried, "poll")
    best = int(np.argmax(height))
    return tried[best] if height[best] > height[0] + 1.0 + CLOSE * float(fit.residual @ fit.residual) else None
