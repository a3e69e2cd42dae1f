"""The posterior of a problem whose likelihood JAX can differentiate twice, as climbs see it: Newton's method."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from rfdropo_bayes.bayes.problem import Problem
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference.evaluations import Ledger, evaluate_prior, evaluate_rows

FLATTEST = 1e-10  # curvature that a step takes a direction to have at least, as a share of the steepest


class SmoothTarget(NamedTuple):
    """All rows of a problem, with the derivatives of its log posterior.

    Attributes:
        problem: with ``log_likelihood_at``.
        ledger: every evaluation is charged to it; a Hessian in d directions counts as d + 1.
        derivatives: gradient and Hessian of the log likelihood at one point, see `log_likelihood_derivatives`.
        prior_gradient, prior_hessian: of the log prior.
        noise: no coordinate is one: the Hessian knows about scales.
    """

    problem: Problem
    ledger: Ledger
    derivatives: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    prior_gradient: Callable[[np.ndarray], np.ndarray]
    prior_hessian: Callable[[np.ndarray], np.ndarray]
    noise: Bool[np.ndarray, " d"]

    def density(self, points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        """Log posterior, unnormalised; minus infinity where it is not a number."""
        rows = evaluate_rows(self.problem, points, self.problem.n_rows, self.ledger)
        return evaluate_prior(self.problem, points) + rows.sum(axis=1)

    def quadratic(self, u: Float[np.ndarray, " d"]) -> tuple[np.ndarray, np.ndarray]:
        """See `Climbable.quadratic`: where the density curves upwards, a step is as long as if it curved down."""
        gradient, hessian = self._at(u)
        values, vectors = np.linalg.eigh(hessian + self.prior_hessian(u))
        steep = np.maximum(np.abs(values), FLATTEST * np.abs(values).max())
        return gradient + self.prior_gradient(u), (vectors * steep) @ vectors.T

    def information(self, u: Float[np.ndarray, " d"]) -> Float[np.ndarray, "d d"]:
        """See `Climbable.information`."""
        return -self._at(u)[1]

    def along(self, axes: Float[np.ndarray, "d d"]) -> None:
        """See `Climbable.along`: derivatives are exact."""

    def _at(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives; a coordinate without one is taken to have no say."""
        self.ledger.charge(self.problem, len(u) + 1, self.problem.n_rows)
        gradient, hessian = (np.asarray(part, dtype=float) for part in self.derivatives(u))
        lost = ~(np.isfinite(gradient) & np.isfinite(hessian).all(axis=0))
        return np.where(lost, 0.0, gradient), np.where(lost[:, None] | lost, 0.0, hessian)


def log_likelihood_derivatives(problem: Problem) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Gradient and Hessian of the log likelihood of all rows at one unconstrained point, compiled once.

    Raises:
        InputError: a likelihood that JAX cannot differentiate twice, as one that integrates an equation with `odeint`.
    """
    density = problem.log_likelihood_at  # type: ignore[attr-defined]
    both = jax.jit(lambda u: (jax.grad(density)(u), jax.hessian(density)(u)))
    try:
        jax.eval_shape(both, np.zeros(len(problem.names)))
    except (TypeError, ValueError, NotImplementedError) as reason:
        raise InputError(
            f"JAX cannot differentiate this likelihood twice: {str(reason).splitlines()[0]}",
            where="[inference] method",
            remedy='use method = "smc"',
        ) from reason
    return both
