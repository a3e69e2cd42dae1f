"""A problem seen in logarithms of its positive parameters, where ridges are straight.

Data that determine a product or a ratio of parameters, such as stiffness over mass, leave a ridge as thin as the ratio
is known well. In the logarithms it is a straight line, which a covariance can describe and moves can follow; in
coordinates that bend towards the bounds of a prior it is a curve, on which a sampler stays about where it began. The
price is a wall at each bound: there is no density beyond it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from rfdropo_bayes.bayes.batches import padded
from rfdropo_bayes.bayes.problem import ResidualProblem, Values
from rfdropo_bayes.inference.modes.climb import Laplace

MOMENTS = 1000  # prior draws that tell which parameters are positive


class StraightProblem:
    """The same posterior in other coordinates: logarithms of what is positive, the problem's own for the rest.

    Args:
        problem: whose unconstrained coordinates belong to one parameter each.
        key: for the prior draws that tell which parameters are positive.
    """

    def __init__(self, problem: ResidualProblem, key: PRNGKeyArray) -> None:
        self.problem = problem
        self.names, self.units, self.bounds, self.n_rows = problem.names, problem.units, problem.bounds, problem.n_rows
        self.fingerprint = getattr(problem, "fingerprint", "")
        self.status_names = getattr(problem, "status_names", {})
        drawn = problem.sample_prior(key, MOMENTS)
        self.logarithmic = np.array([np.min(np.asarray(drawn[name])) > 0.0 for name in self.names])
        self._stand_in = {name: float(np.median(np.asarray(drawn[name]))) for name in self.names}

    def sample_prior(self, key: PRNGKeyArray, n: int) -> dict[str, Float[Any, " n"]]:
        """Independent prior draws."""
        return self.problem.sample_prior(key, n)

    def to_unconstrained(self, values: Values) -> Float[Any, "n d"]:
        """Logarithms where they are taken."""
        own = jnp.asarray(self.problem.to_unconstrained(values))
        value = jnp.stack([jnp.asarray(values[name]) for name in self.names], axis=-1)
        return jnp.where(self.logarithmic, jnp.log(jnp.where(self.logarithmic, value, 1.0)), own)

    def from_unconstrained(self, v: Float[Any, "n d"]) -> dict[str, Float[Any, " n"]]:
        """Inverse of `to_unconstrained`; values beyond a bound are returned as they are."""
        v = jnp.asarray(v)
        own = self.problem.from_unconstrained(jnp.where(self.logarithmic, 0.0, v))
        return {name: jnp.exp(v[:, j]) if self.logarithmic[j] else own[name] for j, name in enumerate(self.names)}

    def log_prior(self, v: Float[Any, "n d"]) -> Float[Any, " n"]:
        """Log density in these coordinates; not a number beyond a bound."""
        own, slope = self._own_and_slope(v)
        with np.errstate(divide="ignore"):
            return np.asarray(self.problem.log_prior(jnp.asarray(own))) + np.log(slope).sum(axis=1)

    def row_log_likelihood(self, values: Values, horizon: int) -> tuple[Float[Any, "n horizon"], Int[Any, " n"]]:
        """The problem's; minus infinity for values beyond a bound, which are not simulated."""
        inside = np.isfinite(np.asarray(self.problem.to_unconstrained(values))).all(axis=1)
        safe = {name: np.where(inside, np.asarray(values[name]), self._stand_in[name]) for name in self.names}
        rows, status = self.problem.row_log_likelihood(safe, horizon)
        return np.where(inside[:, None], np.asarray(rows), -np.inf), np.where(inside, np.asarray(status), 0)

    def mode(self, mode: Laplace) -> Laplace:
        """A normal approximation of the problem in these coordinates."""
        v = np.asarray(
            self.to_unconstrained(self.problem.from_unconstrained(jnp.asarray(mode.mean[None]))), dtype=float
        )
        slope = np.asarray(self._own_and_slope(v)[1], dtype=float)[0]
        information = None if mode.information is None else mode.information * np.outer(slope, slope)
        return Laplace(
            v[0],
            mode.covariance / np.outer(slope, slope),
            mode.log_density + float(np.log(slope).sum()),
            information,
            None if mode.slope is None else mode.slope * slope,
        )

    def _own_and_slope(self, v: Float[Any, "n d"]) -> tuple[Float[Any, "n d"], Float[Any, "n d"]]:
        """The problem's own coordinates, and the derivative of each by the one here."""
        return padded(self._compiled, v)

    @cached_property
    def _compiled(self) -> Callable:
        def own(v: Array) -> Array:
            return jnp.asarray(self.problem.to_unconstrained(self.from_unconstrained(v)))

        def both(v: Array) -> tuple[Array, Array]:
            value, slope = jax.jvp(own, (v,), (jnp.ones_like(v),))
            return value, jnp.abs(slope)

        return jax.jit(both)
