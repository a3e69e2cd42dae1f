"""The posterior of a problem with residuals for optimisation: Gauss-Newton in the unconstrained space.

Observation noise among the parameters. The residuals r are whitened, so the log likelihood is ``-r'r / 2 + c``; c holds
the log determinants and depends on noise parameters alone. Noise parameters stay in the vector that is optimised (they
are not profiled out: their posterior and their correlation with the rest are wanted). They are found by testing along
which coordinates ``c`` changes. Along these the gradient is taken from the log likelihood itself, by central
differences; and since ``J'J`` holds only one half of the information about a scale (``m`` instead of ``2 m``), their
block of the Hessian at the optimum is taken by second differences of the log likelihood. Physical parameters keep the
Gauss-Newton block.

Differences of rollouts in single precision carry rounding, whose square adds to ``J'J`` equally in all directions.
Along a ridge, which the data hardly inform, rounding can dominate, and the ridge then appears too short. Once the
posterior is roughly known, differences are therefore taken along its own axes, over a large part of its deviations.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from rfdropo_bayes.bayes.problem import ResidualProblem
from rfdropo_bayes.inference.evaluations import Ledger, evaluate_prior, evaluate_rows
from rfdropo_bayes.inference.modes.optimisation import positive_part

# Step of central differences, in the prior's deviations of each unconstrained coordinate, which may be metres; rollouts
# may be in single precision.
DIFFERENCE = 1e-3
PRIOR_DRAWS = 200  # for these deviations
NOISE_DIFFERENCE = 1e-4  # of noise coordinates, which are logarithms

UNBOUNDED = (-np.inf, np.inf)


class Target(NamedTuple):
    """A posterior at one horizon, as functions of one unconstrained point (batched if marked)."""

    density: Callable[[np.ndarray], np.ndarray]  # log posterior of a batch (n, d)
    likelihood: Callable[[np.ndarray], np.ndarray]  # log likelihood of a batch (n, d)
    # prior_gradient, prior_hessian: derivatives of the log prior
    prior_gradient: Callable[[np.ndarray], np.ndarray]
    prior_hessian: Callable[[np.ndarray], np.ndarray]
    linearise: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]  # residuals (m,) and their Jacobian (m, d)
    residuals: Callable[[np.ndarray], np.ndarray]  # residuals (n, m) of a batch (n, d); zero for missing data
    noise: Bool[np.ndarray, " d"]  # coordinates along which the log determinant changes
    # residuals (m,), and their central differences (m, d) along the columns of a matrix (d, d); None if derivatives are
    # not recomputed
    differences: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]] | None = None
    # gradient of the terms of the log likelihood beside half the sum of squares, whose curvature is neglected; None if
    # these terms depend on noise coordinates only
    beside: Callable[[np.ndarray], np.ndarray] | None = None
    bounds: tuple[Any, Any] = UNBOUNDED  # lowest and highest value of each coordinate

    def along(self, axes: Float[np.ndarray, "d d"]) -> Target | None:
        differences = self.differences
        if differences is None:
            return None

        def linearise(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            residual, changes = differences(u, axes)
            lost = ~np.isfinite(changes).all(axis=0)
            if lost.any():  # steps along coordinates are shorter
                changes[:, lost] = (_known(self.linearise(u)[1]) @ axes)[:, lost]
            return residual, np.linalg.solve(axes.T, changes.T).T

        return self._replace(linearise=linearise)

    def quadratic(self, u: Float[np.ndarray, " d"]) -> tuple[np.ndarray, np.ndarray]:
        residual, jacobian = self.linearise(u)
        jacobian = _known(jacobian)
        gradient = -jacobian.T @ residual
        if self.beside is not None:
            gradient += self.beside(u)
        curvature = jacobian.T @ jacobian
        if self.noise.any():
            slope = _slope(self.likelihood, u, self.noise)
            gradient[self.noise] = np.where(np.isfinite(slope), slope, 0.0)
            # Twice, exact in expectation for a scale: J'J has m, the information is 2 m.
            curvature[np.ix_(self.noise, self.noise)] *= 2.0
        return gradient + self.prior_gradient(u), curvature + positive_part(-self.prior_hessian(u))

    def information(self, u: Float[np.ndarray, " d"]) -> Float[np.ndarray, "d d"]:
        """See `Optimisable.information`: Gauss-Newton, with second differences for noise parameters."""
        curvature = self.quadratic(u)[1] - positive_part(-self.prior_hessian(u))
        if self.noise.any():
            exact = -_noise_hessian(self.likelihood, u, self.noise)
            index = np.flatnonzero(self.noise)
            if np.isfinite(exact).all():
                curvature[np.ix_(index, index)] = exact
        return curvature


def make_target(
    problem: ResidualProblem,
    horizon: int,
    ledger: Ledger,
    u: Float[np.ndarray, " d"],
    prior: tuple[Callable, Callable],
    noise: Bool[np.ndarray, " d"] | None = None,
) -> Target:
    """Posterior of the first ``horizon`` rows.

    Args:
        problem: problem with residuals.
        horizon: rows to use.
        ledger: charged with every rollout; a Jacobian in d directions takes 2 d + 1.
        u: a point with a finite likelihood, at which noise coordinates are identified.
        prior: `prior_derivatives`.
        noise: noise coordinates, if known.
    """

    def likelihood(points: np.ndarray) -> np.ndarray:
        return evaluate_rows(problem, points, horizon, ledger).sum(axis=1)

    def density(points: np.ndarray) -> np.ndarray:
        return evaluate_prior(problem, points) + likelihood(points)

    residuals_at, linearise, differences = _make_linearise(problem, horizon, ledger)
    if noise is None and len(problem.physical_names) < len(problem.names):
        noise = np.array([name not in problem.physical_names for name in problem.names])
    if noise is None:
        ledger.charge(problem, 2 * len(u) + 1, horizon)
        noise = _noise_coordinates(
            lambda points: likelihood(points) + 0.5 * np.sum(residuals_at(points) ** 2, axis=1), u
        )

    def residuals(points: np.ndarray) -> np.ndarray:
        ledger.charge(problem, len(points), horizon)
        return residuals_at(points)

    return Target(density, likelihood, *prior, linearise, residuals, noise, differences)


def prior_derivatives(problem: ResidualProblem) -> tuple[Callable, Callable]:
    """Gradient and Hessian of the log prior at one point, as arrays of NumPy; the same at every horizon."""
    gradient, hessian = problem.prior_derivatives
    return (lambda u: np.asarray(gradient(u))), (lambda u: np.asarray(hessian(u)))


def _make_linearise(problem: ResidualProblem, horizon: int, ledger: Ledger) -> tuple[Callable, Callable, Callable]:
    """Three functions: residuals of a batch of points, without a charge to the budget; residuals and Jacobian at one
    point, with a charge, by central differences; and `Target.differences`."""
    drawn = problem.to_unconstrained(problem.sample_prior(jax.random.key(0), PRIOR_DRAWS))
    width = DIFFERENCE * np.asarray(drawn).std(axis=0)

    def at(points: np.ndarray) -> np.ndarray:
        return np.asarray(problem.residuals(problem.from_unconstrained(jnp.asarray(points)), horizon))

    def differences(u: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ledger.charge(problem, 2 * len(u) + 1, horizon)
        values = at(np.concatenate([u[None], u + axes.T, u - axes.T]))
        upper, lower = values[1 : len(u) + 1], values[len(u) + 1 :]
        return values[0], 0.5 * (upper - lower).T

    def central(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        residual, changes = differences(u, np.diag(width))
        return residual, changes / width

    return at, central, differences


def _noise_coordinates(determinant: Callable, u: np.ndarray) -> np.ndarray:
    """Coordinates along which the log determinant ``c`` changes.

    It is the log likelihood plus ``r'r / 2`` of the SAME rollouts, whose errors cancel, single precision included.
    """
    steps = 0.05 * np.eye(len(u))
    values = determinant(np.concatenate([u[None], u + steps, u - steps]))
    changes = np.abs(values[1:] - values[0]).reshape(2, len(u))
    # The other side of a failed rollout still gives a difference.
    return np.max(np.where(np.isfinite(changes), changes, 0.0), axis=0) > 1e-2 + 1e-6 * abs(values[0])


def _known(jacobian: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "m d"]:
    """A failed rollout of a neighbour leaves no derivative: that coordinate is then fixed for a step."""
    return np.where(np.isfinite(jacobian).all(axis=0), jacobian, 0.0)


def _slope(likelihood: Callable, u: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    steps = NOISE_DIFFERENCE * np.eye(len(u))[chosen]
    values = likelihood(np.concatenate([u + steps, u - steps]))
    upper, lower = values[: len(steps)], values[len(steps) :]
    return (upper - lower) / (2.0 * NOISE_DIFFERENCE)


def _noise_hessian(likelihood: Callable, u: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Second differences of the log likelihood along the noise coordinates.

    The width is large for a difference because the log likelihood itself is: 1e5 nats leave 1e-11, over 1e-4.
    """
    width = 1e-2
    steps = width * np.eye(len(u))[noise]
    k = len(steps)
    points = [u + si * a + sj * b for a in steps for b in steps for si in (1, -1) for sj in (1, -1)]
    values = likelihood(np.stack(points)).reshape(k, k, 2, 2)
    return (values[..., 0, 0] - values[..., 0, 1] - values[..., 1, 0] + values[..., 1, 1]) / (4.0 * width**2)
