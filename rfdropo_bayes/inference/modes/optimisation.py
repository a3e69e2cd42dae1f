"""Posterior modes by Levenberg-Marquardt in the unconstrained space, and the Laplace approximation around them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

NOISE_GRID = 13  # values of a noise coordinate tried at the start of an optimisation
AXIS, LONGEST = 0.5, 0.05  # step along an axis of a posterior, in its deviations, and at most in any coordinate
NOISE_STEP = 1e-2  # of a noise coordinate, along which residuals only change their scale
DAMPINGS = 10.0 ** np.arange(-1.0, 5.0)  # over the damping before, tried in one batch
ROUNDS = 3  # of differences along axes that get better
FLAT_STEPS, FLAT, PROMISED = 3, 1e-2, 1.0
"""An optimisation also ends after so many steps in a row that gain less [nat] and promise less than a nat: on a curved
ridge, or where differences are as rough as the simulator, a quadratic model promises gains that no step keeps. On poses
of an arm of unknown sizes 25 further steps promised .2 nats each, and gained .04 in all."""
SAME = 0.05  # nats between two normal distributions that are taken for one


@runtime_checkable
class Optimisable(Protocol):
    """A log posterior with the derivatives that an optimisation needs."""

    @property
    def noise(self) -> Bool[np.ndarray, " d"]:
        """Coordinates of noise parameters, which are searched on a grid first."""
        ...

    @property
    def bounds(self) -> tuple[Any, Any]:
        """Lower and upper bounds of the coordinates, (d,) or one number: a step ends on a bound that it would cross."""
        ...

    @property
    def density(self) -> Any:
        """Log posterior of a batch (n, d), unnormalised."""
        ...

    def quadratic(self, u: Float[np.ndarray, " d"]) -> tuple[np.ndarray, np.ndarray]:
        """Gradient of the log posterior and a positive definite stand-in for minus its Hessian."""
        ...

    def information(self, u: Float[np.ndarray, " d"]) -> Float[np.ndarray, "d d"]:
        """Approximation of minus the Hessian of the log likelihood at a mode."""
        ...

    def along(self, axes: Float[np.ndarray, "d d"]) -> Optimisable | None:
        """The same log posterior with central differences along each column of ``axes``.

        None if derivatives are exact.
        """
        ...

    @property
    def prior_gradient(self) -> Callable[[np.ndarray], np.ndarray]:
        """Gradient of the log prior at one point."""
        ...

    @property
    def prior_hessian(self) -> Callable[[np.ndarray], np.ndarray]:
        """Hessian of the log prior at one point."""
        ...


class LevenbergState(NamedTuple):
    """State of an optimisation."""

    position: Float[np.ndarray, " d"]  # unconstrained point
    log_density: float  # log posterior there
    damping: float  # Levenberg-Marquardt damping, relative to the diagonal of the Hessian
    # whether the predicted gain of the last step was below the tolerance, or slightly above with a smaller actual gain
    converged: bool


class OptimisationStep(NamedTuple):
    """One step: the gain in log posterior, and the predicted gain of the quadratic model."""

    gain: float
    promised: float


class Laplace(NamedTuple):
    """Normal approximation in unconstrained coordinates.

    Attributes:
        mean: the mode.
        covariance: inverse of minus the Hessian.
        log_density: log posterior, unnormalised, at the mode.
        information: share of the likelihood in minus the Hessian; None if unknown.
        slope: gradient of the log likelihood at the mode, cancelled by the prior's gradient; None if unknown.
    """

    mean: Float[np.ndarray, " d"]
    covariance: Float[np.ndarray, "d d"]
    log_density: float
    information: Float[np.ndarray, "d d"] | None = None
    slope: Float[np.ndarray, " d"] | None = None

    @property
    def log_evidence(self) -> float:
        """Log of the integral of the unnormalised posterior, were it normal."""
        d = len(self.mean)
        return self.log_density + 0.5 * d * np.log(2.0 * np.pi) + 0.5 * float(np.linalg.slogdet(self.covariance)[1])


def init(target: Optimisable, u: Float[np.ndarray, " d"]) -> LevenbergState:
    """State at a starting point."""
    return LevenbergState(u, float(target.density(u[None])[0]), 1e-3, False)


def _solved(matrix: Float[np.ndarray, "d d"], right: Float[np.ndarray, " d"]) -> Float[np.ndarray, " d"]:
    """Solution of a linear system, the solution of least norm if it is not unique."""
    try:
        return np.linalg.solve(matrix, right)
    except np.linalg.LinAlgError:
        return np.linalg.lstsq(matrix, right)[0]


def step(target: Optimisable, state: LevenbergState, tolerance: float) -> tuple[LevenbergState, OptimisationStep]:
    """One Levenberg-Marquardt step; damping grows until the log posterior rises.

    Damping acts on the curvature's diagonal (Marquardt's scaling), so that units do not matter. All dampings of a step
    are tried in one batch of rollouts.
    """
    gradient, curvature = target.quadratic(state.position)
    low, high = target.bounds
    at_bound = ((state.position <= low) & (gradient < 0.0)) | ((state.position >= high) & (gradient > 0.0))
    if at_bound.any():
        gradient = np.where(at_bound, 0.0, gradient)
        curvature = np.where(at_bound[:, None] | at_bound, np.diag(np.diag(curvature)), curvature)
    diagonal = np.diag(np.maximum(np.diag(curvature), 1e-12))
    dampings = state.damping * DAMPINGS
    moves = np.stack([_solved(curvature + damping * diagonal, gradient) for damping in dampings])
    # No coordinate moves further than 2: a logistic or a logarithm is beyond any quadratic model there.
    moves *= np.minimum(1.0, 2.0 / np.maximum(np.abs(moves).max(axis=1, keepdims=True), 1e-300))
    newton = _solved(curvature + 1e-12 * diagonal, gradient)
    promised = 0.5 * float(gradient @ newton)
    if promised < tolerance:
        return state._replace(converged=True), OptimisationStep(0.0, promised)
    tried = np.clip(state.position + moves, low, high)
    densities = target.density(tried)
    best = int(np.argmax(densities))
    gain = float(densities[best] - state.log_density)
    position, density = (tried[best], float(densities[best])) if gain > 0.0 else state[:2]
    # The predicted gain of an engine in single precision may never be realised. If six decades of damping gain nothing,
    # the remaining differences are rounding, or the model is useless here: smaller steps, if any.
    if gain < tolerance:
        stuck = bool(dampings[-1] > 1e8 or promised < 100.0 * tolerance)
        moved = LevenbergState(position, density, state.damping * 1e5, stuck)
    else:
        moved = LevenbergState(position, density, float(np.clip(dampings[best], 1e-9, 1e9)), False)
    return moved, OptimisationStep(gain, promised)


def with_fitting_noise(target: Optimisable, u: Float[np.ndarray, " d"]) -> np.ndarray:
    """The point with its noise coordinates, one after the other, at the best of a wide grid.

    A start drawn from the prior, or the optimum of a shorter horizon, may have a noise that makes its residuals look
    impossible; every step then answers to the few rows that are hardest to fit.
    """
    steps = np.linspace(-6.0, 6.0, NOISE_GRID)
    for coordinate in np.flatnonzero(target.noise):
        points = np.tile(u, (len(steps), 1))
        points[:, coordinate] += steps
        densities = target.density(points)
        if np.isfinite(densities).any():
            u = points[int(np.nanargmax(np.where(np.isfinite(densities), densities, -np.inf)))]
    return u


def maximise(
    target: Optimisable, u: Float[np.ndarray, " d"], *, max_steps: int, tolerance: float
) -> tuple[LevenbergState, list[dict[str, Any]]]:
    """Optimise from one start, noise first, until the predicted gain of a step is below ``tolerance`` nats, or steps
    are `FLAT`.

    A start without a likelihood has no derivatives, and is returned unchanged.
    """
    state = init(target, with_fitting_noise(target, u) if max_steps else u)
    trace: list[dict[str, Any]] = []
    if not np.isfinite(state.log_density):
        return state, trace
    while not state.converged and len(trace) < max_steps:
        state, info = step(target, state, tolerance)
        trace.append({"log_density": state.log_density, "damping": state.damping, **info._asdict()})
        last = trace[-FLAT_STEPS:]
        if len(last) == FLAT_STEPS and all(each["gain"] < FLAT and each["promised"] < PROMISED for each in last):
            state = state._replace(converged=True)
    return state, trace


def optimisation_cost(d: int, noise: int) -> tuple[float, float]:
    """Rollouts for the start of an optimisation and for each of its steps, with ``d`` coordinates and ``noise`` noise
    coordinates: the grid of the noise; the value, a Jacobian by central differences, two more per noise, all dampings.
    """
    return float(NOISE_GRID * noise), 2.0 * (d + noise) + 1.0 + len(DAMPINGS)


def laplace(target: Optimisable, state: LevenbergState) -> Laplace:
    """Normal approximation at a mode; finite differences are taken along its own axes at the end."""
    approximation = normal_at(target, state)
    for _ in range(ROUNDS):
        nearer = target.along(_axes(approximation.covariance, target.noise))
        if nearer is None:
            break
        moved, _ = step(
            nearer, state._replace(position=approximation.mean, log_density=approximation.log_density), SAME**2
        )
        before, approximation = approximation, normal_at(nearer, moved)
        if divergence(before, approximation) < SAME:
            break
    return approximation


def normal_at(target: Optimisable, state: LevenbergState) -> Laplace:
    """Normal approximation from the derivatives of the optimisation."""
    u = state.position
    information = positive_part(target.information(u))
    values, vectors = np.linalg.eigh(information + positive_part(-target.prior_hessian(u)))
    values = np.maximum(values, 1e-12 * values[-1])
    covariance = (vectors / values) @ vectors.T
    return Laplace(u, covariance, state.log_density, information, -target.prior_gradient(u))


def _axes(covariance: Float[np.ndarray, "d d"], noise: Bool[np.ndarray, " d"]) -> Float[np.ndarray, "d d"]:
    """Steps to take differences over, one per column; noise coordinates keep their own axes."""
    axes, physical = NOISE_STEP * np.eye(len(covariance)), np.flatnonzero(~noise)
    if len(physical):
        values, vectors = np.linalg.eigh(covariance[np.ix_(physical, physical)])
        steps = AXIS * vectors * np.sqrt(np.maximum(values, 1e-12 * values[-1]))
        axes[np.ix_(physical, physical)] = steps * np.minimum(1.0, LONGEST / np.abs(steps).max(axis=0))
    return axes


def divergence(first: Laplace, second: Laplace) -> float:
    """Kullback-Leibler divergence of two normal distributions [nat], from the second to the first."""
    factor = np.linalg.cholesky(second.covariance)
    moved = np.linalg.solve(factor, second.mean - first.mean)
    ratio = np.linalg.solve(factor, np.linalg.cholesky(first.covariance))
    return float(0.5 * (np.sum(ratio**2) + moved @ moved - len(moved)) - np.log(np.abs(np.diag(ratio))).sum())


def positive_part(matrix: np.ndarray) -> np.ndarray:
    """The matrix without its negative eigenvalues."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T
