"""Posterior mode by Levenberg-Marquardt in the unconstrained space, and the Laplace approximation around it.

Observation noise among the parameters. The residuals r are whitened, so the log likelihood is ``-r'r / 2 + c`` where c
holds the log determinants and depends on noise parameters alone. Noise parameters stay in the vector that is optimised
(they are not profiled out: their posterior and their correlation with the rest are wanted). They are found by testing
along which coordinates ``c`` changes. Along these the gradient is taken from the log likelihood itself, by central
differences; and since ``J'J`` holds only one half of the information about a scale (``m`` instead of ``2 m``), their
block of the Hessian at the optimum is taken by second differences of the log likelihood. Physical parameters keep the
Gauss-Newton block.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rfdropo_bayes.bayes.problem import Problem, ResidualProblem
from rfdropo_bayes.inference.evaluations import Ledger, evaluate_prior, evaluate_rows

DIFFERENCE = 1e-4  # step of central differences; unconstrained coordinates are of order one
NOISE_GRID = 13  # values of a noise coordinate tried at the start of a climb
BATCH_DIFFERENCE = 1e-3  # of rollouts in batches, which may be in single precision


class Target(NamedTuple):
    """A posterior at one horizon, as functions of one unconstrained point (batched where marked).

    Attributes:
        density: log posterior of a batch (n, d).
        likelihood: log likelihood of a batch (n, d).
        prior_gradient, prior_hessian: of the log prior.
        linearise: residuals (m,) and their Jacobian (m, d).
        noise: coordinates along which the log determinant changes.
    """

    density: Callable[[np.ndarray], np.ndarray]
    likelihood: Callable[[np.ndarray], np.ndarray]
    prior_gradient: Callable[[np.ndarray], np.ndarray]
    prior_hessian: Callable[[np.ndarray], np.ndarray]
    linearise: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    noise: Bool[np.ndarray, " d"]


class LevenbergState(NamedTuple):
    """Where an optimisation stands.

    Attributes:
        position: unconstrained point.
        log_density: log posterior there.
        damping: Levenberg-Marquardt's, relative to the diagonal of the Hessian.
        converged: the last step promised less than the tolerance, or little more and delivered less.
    """

    position: Float[np.ndarray, " d"]
    log_density: float
    damping: float
    converged: bool


class StepInfo(NamedTuple):
    """One step: the gain in log posterior, the gain the quadratic model promised, and the tries it took."""

    gain: float
    promised: float
    tries: int


class Laplace(NamedTuple):
    """Normal approximation in unconstrained coordinates.

    Attributes:
        mean: the mode.
        covariance: inverse of minus the Hessian.
        log_density: log posterior, unnormalised, at the mode.
    """

    mean: Float[np.ndarray, " d"]
    covariance: Float[np.ndarray, "d d"]
    log_density: float

    @property
    def log_evidence(self) -> float:
        """Log of the integral of the unnormalised posterior, were it normal."""
        d = len(self.mean)
        return self.log_density + 0.5 * d * np.log(2.0 * np.pi) + 0.5 * float(np.linalg.slogdet(self.covariance)[1])


def make_target(
    problem: ResidualProblem,
    horizon: int,
    ledger: Ledger,
    u: Float[np.ndarray, " d"],
    prior: tuple[Callable, Callable],
    jacobian: str = "auto",
    noise: Bool[np.ndarray, " d"] | None = None,
) -> Target:
    """Posterior of the first ``horizon`` rows.

    Args:
        problem: with residuals.
        horizon: rows to use.
        ledger: every rollout is charged to it; a Jacobian in d directions counts as d + 1.
        u: a point with a finite likelihood, around which noise coordinates are looked for.
        prior: `prior_derivatives`.
        jacobian: "forward" (JAX), "central" differences, or "auto": forward where residuals can be traced.
        noise: noise coordinates, if known.
    """

    def likelihood(points: np.ndarray) -> np.ndarray:
        return evaluate_rows(problem, points, horizon, ledger).sum(axis=1)

    def density(points: np.ndarray) -> np.ndarray:
        return evaluate_prior(problem, points) + likelihood(points)

    residuals_at, linearise = _make_linearise(problem, horizon, ledger, u, jacobian)
    physical = getattr(problem, "physical_names", problem.names)
    if noise is None and len(physical) < len(problem.names):
        noise = np.array([name not in physical for name in problem.names])
    if noise is None:
        ledger.charge(problem, 2 * len(u) + 1, horizon)
        noise = _noise_coordinates(
            lambda points: likelihood(points) + 0.5 * np.sum(residuals_at(points) ** 2, axis=1), u
        )
    return Target(density, likelihood, *prior, linearise, noise)


def prior_derivatives(problem: Problem) -> tuple[Callable, Callable]:
    """Gradient and Hessian of the log prior at one point; the same at every horizon, so compiled once."""

    def single(u: Array) -> Array:
        return jnp.asarray(problem.log_prior(u[None]))[0]

    own = getattr(problem, "prior_derivatives", None)
    gradient, hessian = own or (jax.jit(jax.grad(single)), jax.jit(jax.hessian(single)))
    return (lambda u: np.asarray(gradient(u))), (lambda u: np.asarray(hessian(u)))


def _make_linearise(
    problem: ResidualProblem, horizon: int, ledger: Ledger, u: np.ndarray, jacobian: str
) -> tuple[Callable, Callable]:
    """Residuals of a batch of points, not charged; residuals and Jacobian at one point, charged."""

    def residuals(u: Array) -> Any:
        values = problem.from_unconstrained(u[None])
        return problem.residuals({name: value[0] for name, value in values.items()}, horizon)

    if jacobian == "auto":
        jacobian = getattr(problem, "jacobian", "auto")
    in_batches = getattr(problem, "residual_batch", None) if jacobian == "central" else None
    width = BATCH_DIFFERENCE if in_batches else DIFFERENCE
    batched = None
    if in_batches is None and _works(lambda f, u: f(u), residuals, u):
        batched = jax.jit(jax.vmap(residuals))

    def at(points: np.ndarray) -> np.ndarray:
        if in_batches:
            return np.asarray(in_batches(problem.from_unconstrained(jnp.asarray(points)), horizon))
        if batched:
            return np.asarray(batched(jnp.asarray(points)))
        return np.stack([np.asarray(residuals(jnp.asarray(point))) for point in points])

    def differences(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ledger.charge(problem, 2 * len(u) + 1, horizon)
        steps = width * np.eye(len(u))
        values = at(np.concatenate([u[None], u + steps, u - steps]))
        upper, lower = values[1 : len(u) + 1], values[len(u) + 1 :]
        return values[0], (upper - lower).T / (2.0 * width)

    @jax.jit
    def both(u: Array) -> tuple[Array, Array]:
        return jax.vmap(lambda e: _directional(residuals, u, e), out_axes=(None, 1))(jnp.eye(len(u)))

    def forward(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ledger.charge(problem, len(u) + 1, horizon)
        value, columns = both(jnp.asarray(u))
        return np.asarray(value), np.asarray(columns)

    if jacobian == "auto":
        jacobian = "forward" if _works(_directional, residuals, u) else "central"
    return at, forward if jacobian == "forward" else differences


def _directional(residuals: Callable, u: Array, direction: Array | None = None) -> tuple[Array, Array]:
    """Residuals and their derivative along a direction."""
    return jax.jvp(residuals, (u,), (jnp.ones_like(u) if direction is None else direction,))


def _works(transform: Callable, residuals: Callable, u: np.ndarray) -> bool:
    """Whether JAX can trace something of the residuals; a host callback has no derivative, plain NumPy no trace."""
    try:
        jax.eval_shape(lambda u: transform(residuals, u), jnp.asarray(u))
    except (jax.errors.JAXTypeError, TypeError, ValueError, NotImplementedError):
        return False
    return True


def _noise_coordinates(determinant: Callable, u: np.ndarray, width: float = 0.05) -> np.ndarray:
    """Coordinates along which the log determinant ``c`` changes.

    It is the log likelihood plus ``r'r / 2`` of the SAME rollouts, whose errors cancel, single precision included.
    """
    steps = width * np.eye(len(u))
    values = determinant(np.concatenate([u[None], u + steps, u - steps]))
    changes = np.abs(values[1:] - values[0]).reshape(2, len(u))
    # A rollout that fails says nothing; its other side does.
    return np.max(np.where(np.isfinite(changes), changes, 0.0), axis=0) > 1e-2 + 1e-6 * abs(values[0])


def _slope(likelihood: Callable, u: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    steps = DIFFERENCE * np.eye(len(u))[chosen]
    values = likelihood(np.concatenate([u + steps, u - steps]))
    upper, lower = values[: len(steps)], values[len(steps) :]
    return (upper - lower) / (2.0 * DIFFERENCE)


def quadratic_model(target: Target, u: Float[np.ndarray, " d"]) -> tuple[np.ndarray, np.ndarray]:
    """Gradient of the log posterior and a positive definite stand-in for minus its Hessian."""
    residual, jacobian = target.linearise(u)
    # Where a neighbour's rollout is lost there is no derivative: that coordinate stays where it is for this step.
    jacobian = np.where(np.isfinite(jacobian).all(axis=0), jacobian, 0.0)
    gradient = -jacobian.T @ residual
    curvature = jacobian.T @ jacobian
    if target.noise.any():
        slope = _slope(target.likelihood, u, target.noise)
        gradient[target.noise] = np.where(np.isfinite(slope), slope, 0.0)
        # Twice, exact in expectation for a scale: J'J has m where the information is 2 m.
        curvature[np.ix_(target.noise, target.noise)] *= 2.0
    return gradient + target.prior_gradient(u), curvature + _positive_part(-target.prior_hessian(u))


def init(target: Target, u: Float[np.ndarray, " d"]) -> LevenbergState:
    """State at a starting point."""
    return LevenbergState(u, float(target.density(u[None])[0]), 1e-3, False)


def step(target: Target, state: LevenbergState, tolerance: float) -> tuple[LevenbergState, StepInfo]:
    """One Levenberg-Marquardt step; damping grows until the log posterior rises.

    Damping acts on the curvature's diagonal (Marquardt's scaling), so that units do not matter. All dampings of a step
    are tried in one batch of rollouts.
    """
    gradient, curvature = quadratic_model(target, state.position)
    diagonal = np.diag(np.maximum(np.diag(curvature), 1e-12))
    dampings = state.damping * 10.0 ** np.arange(-1.0, 5.0)
    moves = np.stack([np.linalg.solve(curvature + damping * diagonal, gradient) for damping in dampings])
    # No coordinate moves further than 2: a logistic or a logarithm is beyond any quadratic model there.
    moves *= np.minimum(1.0, 2.0 / np.maximum(np.abs(moves).max(axis=1, keepdims=True), 1e-300))
    newton = np.linalg.solve(curvature + 1e-12 * diagonal, gradient)
    promised = 0.5 * float(gradient @ newton)
    if promised < tolerance:
        return state._replace(converged=True), StepInfo(0.0, promised, 0)
    densities = target.density(state.position + moves)
    best = int(np.argmax(densities))
    gain = float(densities[best] - state.log_density)
    if gain <= 0.0:
        # The differences left are those of rounding, or the model is useless here: smaller steps next time.
        stuck = state.damping > 1e8 or promised < 100.0 * tolerance
        return state._replace(damping=state.damping * 1e5, converged=stuck), StepInfo(0.0, promised, len(dampings))
    # An engine in single precision has gradients that promise a little for ever; what it delivers tells.
    idle = gain < tolerance and promised < 100.0 * tolerance
    moved = LevenbergState(
        state.position + moves[best], float(densities[best]), float(np.clip(dampings[best], 1e-9, 1e9)), idle
    )
    return moved, StepInfo(gain, promised, len(dampings))


def with_fitting_noise(target: Target, u: Float[np.ndarray, " d"], width: float = 12.0) -> np.ndarray:
    """The point with its noise coordinates, one after the other, at the best of a wide grid.

    A start drawn from the prior, or the optimum of a shorter horizon, may have a noise that makes its residuals look
    impossible; every step then answers to the few rows that are hardest to fit.
    """
    steps = np.linspace(-0.5 * width, 0.5 * width, NOISE_GRID)
    for coordinate in np.flatnonzero(target.noise):
        points = np.tile(u, (len(steps), 1))
        points[:, coordinate] += steps
        densities = target.density(points)
        if np.isfinite(densities).any():
            u = points[int(np.nanargmax(np.where(np.isfinite(densities), densities, -np.inf)))]
    return u


def maximise(
    target: Target, u: Float[np.ndarray, " d"], *, max_steps: int, tolerance: float
) -> tuple[LevenbergState, list[dict[str, Any]]]:
    """Climb from one start, noise first, until a step promises less than ``tolerance`` nats."""
    state = init(target, with_fitting_noise(target, u))
    trace: list[dict[str, Any]] = []
    while not state.converged and len(trace) < max_steps:
        state, info = step(target, state, tolerance)
        trace.append({"log_density": state.log_density, "damping": state.damping, **info._asdict()})
    return state, trace


def laplace(target: Target, state: LevenbergState) -> Laplace:
    """Normal approximation at a mode, with second differences where noise parameters are concerned."""
    _, curvature = quadratic_model(target, state.position)
    if target.noise.any():
        exact = -_noise_hessian(target.likelihood, state.position, target.noise)
        index = np.flatnonzero(target.noise)
        prior = _positive_part(-target.prior_hessian(state.position))
        if np.isfinite(exact).all():
            curvature[np.ix_(index, index)] = exact + prior[np.ix_(index, index)]
    values, vectors = np.linalg.eigh(curvature)
    values = np.maximum(values, 1e-12 * values[-1])
    return Laplace(state.position, (vectors / values) @ vectors.T, state.log_density)


def _noise_hessian(likelihood: Callable, u: np.ndarray, noise: np.ndarray, width: float = 1e-2) -> np.ndarray:
    """Second differences of the log likelihood along the noise coordinates.

    The width is large for a difference because the log likelihood itself is: 1e5 nats leave 1e-11, over 1e-4.
    """
    steps = width * np.eye(len(u))[noise]
    k = len(steps)
    points = [u + si * a + sj * b for a in steps for b in steps for si in (1, -1) for sj in (1, -1)]
    values = likelihood(np.stack(points)).reshape(k, k, 2, 2)
    return (values[..., 0, 0] - values[..., 0, 1] - values[..., 1, 0] + values[..., 1, 1]) / (4.0 * width**2)


def _positive_part(matrix: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T
