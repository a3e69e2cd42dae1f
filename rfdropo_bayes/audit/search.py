"""The base model's optimum, looked for as `calibrate` looks for it: climbs from screened draws over growing horizons.

Under a long recording the likelihood has many small summits, on which climbs of the whole end. `BaseProblem` shows the
base model's posterior to `inference.find_modes`, whose climbs begin at short prefixes; `better_nearby` then asks
rollouts, not derivatives, whether the summit that was found is one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from rfdropo_bayes.audit.fit import CLOSE, Fit, Target, heights
from rfdropo_bayes.bayes.problem import ProblemDefaults
from rfdropo_bayes.bayes.space import ParameterSpace
from rfdropo_bayes.inference import LaplaceConfig, climb_cost, find_modes
from rfdropo_bayes.simulators.differences import usable_difference

USUAL = 3  # steps of each of these climbs: of a linear model one or two, of the demonstration's arm five
CLIMBED = 0.1  # nats that a step of these climbs promises at their end; the audit's own climb goes on from there
POLLED = (0.3, 0.03, 0.003)  # prior deviations to each side of a summit that are tried
ALONG = (4.0, 2.0, 1.0, 0.3)  # deviations of the posterior along its principal axes, likewise
WITHIN = 0.5 * max(ALONG) ** 2  # nats that a step of slopes promises which is no longer than those tried


@dataclass(frozen=True)
class BaseProblem(ProblemDefaults):
    """The base model's posterior as inference methods see it; see `bayes.problem.ResidualProblem`.

    A row is one row of every group of repeats, whitened given those before it. The noise is known.
    """

    target: Target
    jacobian: str = "central"

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Base parameters."""
        own = self.target.forward.coordinates
        return own.names[: own.base]

    @property
    def units(self) -> dict[str, str]:
        """Of the parameters."""
        return {p.name: p.spec.unit for p in self._parameters}

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """Hard bounds."""
        return {p.name: (p.spec.low, p.spec.high) for p in self._parameters}

    @property
    def n_rows(self) -> int:
        """Rows of the longest recording."""
        return int(self.target.measurements.count.shape[1])

    @property
    def _parameters(self) -> Any:
        own = self.target.forward.coordinates
        return own.space.parameters[: own.base]

    def sample_prior(self, key: PRNGKeyArray, n: int) -> dict[str, Float[Any, " n"]]:
        """Independent prior draws."""
        drawn = ParameterSpace(self._parameters).sample(key, n)
        return {name: np.asarray(column, dtype=float) for name, column in drawn.items()}

    def to_unconstrained(self, values: Mapping[str, Any]) -> Float[Any, "n d"]:
        """Coordinates of values."""
        own = self.target.forward.coordinates
        return np.stack([own.encode_one(i, np.asarray(values[name])) for i, name in enumerate(self.names)], axis=1)

    def from_unconstrained(self, u: Float[Any, "n d"]) -> dict[str, Float[Any, " n"]]:
        """Values of coordinates."""
        values = self.target.forward.coordinates.values(self._points(u))
        return {name: values[:, i] for i, name in enumerate(self.names)}

    def log_prior(self, u: Float[Any, "n d"]) -> Float[Any, " n"]:
        """Log prior density."""
        own = self.target.forward.coordinates
        return own.log_prior(self._points(u))[:, : own.base].sum(axis=1)

    @cached_property
    def prior_derivatives(self) -> tuple[Any, Any]:
        """Gradient and Hessian of the log prior."""
        own = self.target.forward.coordinates

        def at(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            slope, curvature = own.prior_slopes(self._points(np.asarray(u)[None])[0])
            return slope[: own.base], np.diag(curvature[: own.base])

        return (lambda u: at(u)[0]), (lambda u: at(u)[1])

    def row_log_likelihood(
        self, values: Mapping[str, Any], horizon: int
    ) -> tuple[Float[Any, "n horizon"], Int[Any, " n"]]:
        """Of each row given those before it, up to the noise's normaliser; status 1 for a rollout that was lost."""
        white, weighed, fine = self._rows(values, horizon)
        rows = -0.5 * np.sum(white**2, axis=(1, 3))
        rows[:, 0] -= 0.5 * np.sum(weighed**2, axis=1)
        return np.where(fine[:, None], rows, -np.inf), np.where(fine, 0, 1)

    def residual_batch(self, values: Mapping[str, Any], horizon: int) -> Float[Any, "n m"]:
        """Whitened residuals of a prefix."""
        white, weighed, fine = self._rows(values, horizon)
        return np.where(fine[:, None], np.concatenate([white.reshape(len(white), -1), weighed], axis=1), np.inf)

    def residuals(self, values: Mapping[str, Any], horizon: int) -> Float[Any, " m"]:
        """The same of one set of values."""
        return self.residual_batch({name: np.atleast_1d(value) for name, value in values.items()}, horizon)[0]

    def _points(self, u: Any) -> np.ndarray:
        own = self.target.forward.coordinates
        points = np.repeat(own.null[None], len(u), axis=0)
        points[:, : own.base] = np.asarray(u)
        return np.clip(points, *own.bounds)

    def _rows(self, values: Mapping[str, Any], horizon: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Whitened residuals of a prefix, those of weighed parts, and where rollouts ended well.

        What the sizes of relative errors add to the likelihood is left to the climb that goes on from here.
        """
        white, _, fine = self.target.evaluate(self._points(self.to_unconstrained(values)), horizon)
        white = np.where(fine[:, None], white, 0.0)
        series = self.target.measurements.series(white)
        return series[:, :, :horizon], white[:, self.target.measurements.count.size :], fine


def search(target: Target, key: PRNGKeyArray) -> Float[np.ndarray, " d"]:
    """Where the best of `calibrate`'s climbs ends.

    Raises:
        NoLikelihoodError: all prior draws are lost.
    """

    def compute() -> dict[str, np.ndarray]:
        problem = BaseProblem(target)
        # Its normal approximation is not used: the coarse differences of short climbs suffice.
        mode = find_modes(problem, LaplaceConfig(tolerance=CLIMBED), key).modes[0]
        return {"x": problem._points(mode.mean[None])[0]}

    return target.recall("search", [np.asarray(jax.random.key_data(key))], compute)["x"]


def search_rollouts(target: Target) -> int:
    """Rollouts that `search` usually takes: draws that are screened, at each horizon, and climbs, of which the better
    half goes on to the next."""
    config, own = LaplaceConfig(), target.forward.coordinates
    beginning, step = climb_cost(own.base, 0)
    climbs = sum(max(config.starts >> level, 1) for level in range(config.blocks))
    return target.forward.count * int(config.blocks * config.screen + climbs * (beginning + USUAL * step))


def poll_rollouts(target: Target) -> int:
    """Rollouts that `better_nearby` takes."""
    return target.forward.count * (1 + 2 * (len(POLLED) + len(ALONG)) * target.forward.coordinates.base)


def with_usable_differences(target: Target, x: Float[np.ndarray, " d"]) -> Target:
    """The target with derivatives over steps on whose scale its motion is smooth around a point.

    Slopes over the steps of a ladder, in prior deviations, are compared, of all base parameters at once; rollouts say
    which steps agree.
    """
    usual, coordinates = target.forward.lanes.difference, target.forward.coordinates
    if usual is None:
        return target
    directions = np.diag(coordinates.prior_sd)[: coordinates.base]

    def slope(step: float) -> np.ndarray:
        points = np.clip(np.concatenate([x + step * directions, x - step * directions]), *coordinates.bounds)
        found = target.recall("ladder", [points], lambda: {"residual": target.residual(points)})["residual"]
        ahead, behind = np.split(found, 2)
        return (ahead - behind) / (2.0 * step)

    step = usable_difference(slope)
    return target if step <= usual else replace(target, forward=target.forward.with_difference(step))


def better_nearby(target: Target, fit: Fit) -> Float[np.ndarray, " d"] | None:
    """A point beside a fit that is clearly better; None where rollouts confirm that it is a summit.

    Derivatives cannot tell: of a motion that is rough on the scale of their steps they are noise, and promise nothing.
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
