"""Coordinates of a hierarchy between centred and non-centred, chosen by what the data say of each of its members.

Effects with a common, unknown spread make a funnel: where the spread is small, so are the effects, and no step suits
both ends. In deviations from the common location, in units of the spread, there is no funnel as long as the data say
little of an effect; where they say much, the effect itself is the better coordinate. Of a normal likelihood with
information h and a spread s, the effect is best mixed in with the share ``h / (h + 1 / s^2)``.
Papaspiliopoulos, Roberts and Skold (2003), Non-centered parameterisations for hierarchical models and data
augmentation.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rfdropo_bayes.bayes.problem import Values
from rfdropo_bayes.inference.plain.problem import NumpyroProblem

DRAWS = 64  # at which the data's information is looked at
VARIES = 1e-9  # relative: what moves less with the draws is a constant
MOST_KNOWN = 1e50  # information that is more than this is a singularity
DEEPEST = 8  # levels of a hierarchy
CLOSE = 1e-6  # relative error of a round trip


class CentredProblem:
    """A plain model in other coordinates: ``v = (u - l) / s^(1 - c) + c l`` with location l, spread s and share c.

    Args:
        problem: the model.
        share: of centring, per coordinate; 1 leaves a coordinate as it is.
        depth: levels of the hierarchy.
    """

    def __init__(self, problem: NumpyroProblem, share: Float[np.ndarray, " d"], depth: int) -> None:
        self.problem, self.share, self.depth = problem, jnp.asarray(share), depth
        self.names, self.units, self.bounds, self.n_rows = problem.names, problem.units, problem.bounds, problem.n_rows
        self.fingerprint = f"{problem.fingerprint} {np.asarray(share).tobytes().hex()}"
        self.status_names = problem.status_names
        self.sample_prior, self.row_log_likelihood = problem.sample_prior, problem.row_log_likelihood
        self._own_batch = jax.jit(jax.vmap(self._own))
        self._there_batch = jax.jit(jax.vmap(self._there))
        self._stretch_batch = jax.jit(jax.vmap(self._stretch))

    def to_unconstrained(self, values: Values) -> Float[Any, "n d"]:
        """Coordinates of values."""
        return self._there_batch(jnp.asarray(self.problem.to_unconstrained(values)))

    def from_unconstrained(self, v: Float[Any, "n d"]) -> dict[str, Float[Any, " n"]]:
        """Inverse of `to_unconstrained`."""
        return self.problem.from_unconstrained(self._own_batch(jnp.asarray(v)))

    def log_prior(self, v: Float[Any, "n d"]) -> Float[Any, " n"]:
        """Log density in these coordinates."""
        u = self._own_batch(jnp.asarray(v))
        return self.problem.log_prior(u) + self._stretch_batch(u)

    def path_density(self, v: Float[Array, " d"], shares: Float[Array, " n_rows"]) -> Float[Array, ""]:
        """Log prior plus the log density of every row times its share, at one point; traceable."""
        u = self._own(v)
        return self.problem.path_density(u, shares) + self._stretch(u)

    def _own(self, v: Float[Array, " d"]) -> Float[Array, " d"]:
        """The model's own coordinates: level by level, each by the location and spread of those above it."""
        u = v
        for _ in range(self.depth):
            location, scale = self.problem.location_scale(u)
            u = jnp.where(self.share < 1.0, location + scale ** (1.0 - self.share) * (v - self.share * location), v)
        return u

    def _there(self, u: Float[Array, " d"]) -> Float[Array, " d"]:
        location, scale = self.problem.location_scale(u)
        moved = (u - location) / scale ** (1.0 - self.share) + self.share * location
        return jnp.where(self.share < 1.0, moved, u)

    def _stretch(self, u: Float[Array, " d"]) -> Float[Array, ""]:
        """Log determinant of the own coordinates by these."""
        _, scale = self.problem.location_scale(u)
        return jnp.sum(jnp.where(self.share < 1.0, (1.0 - self.share) * jnp.log(scale), 0.0))


def centred(problem: NumpyroProblem, u: Float[np.ndarray, "n d"]) -> NumpyroProblem | CentredProblem:
    """The model in the coordinates that suit draws of its posterior; itself where it has no hierarchy.

    Args:
        problem: the model.
        u: unconstrained draws of its posterior, however rough.
    """
    u = u[:: max(1, len(u) // DRAWS)][:DRAWS]
    location, scale = (np.asarray(part) for part in jax.jit(jax.vmap(problem.location_scale))(jnp.asarray(u)))
    moves = (np.ptp(location, axis=0) > VARIES * np.abs(location).max(axis=0)) | (
        np.ptp(scale, axis=0) > VARIES * scale.max(axis=0)
    )
    if not moves.any():
        return problem
    members = np.flatnonzero(moves)
    known = np.clip(np.nan_to_num(_information(problem, u, members)), 0.0, MOST_KNOWN) * scale[:, members] ** 2
    share = np.ones(u.shape[1])
    share[members] = np.mean(known / (1.0 + known), axis=0)
    for depth in range(1, DEEPEST + 1):
        found = CentredProblem(problem, share, depth)
        back = found._own_batch(found._there_batch(jnp.asarray(u)))
        if np.all(np.abs(back - u) <= CLOSE * (1.0 + np.abs(u))):
            return found
    return problem  # each member depends on the one before it: a series in time, and no hierarchy


def _information(
    problem: NumpyroProblem, u: Float[np.ndarray, "n d"], members: Int[np.ndarray, " k"]
) -> Float[np.ndarray, "n k"]:
    """Minus the second derivative of the log likelihood by each of some coordinates."""
    slope = jax.grad(problem.log_likelihood_at)

    def second(point: Array, index: Array) -> Array:
        along = jnp.zeros_like(point).at[index].set(1.0)
        return jax.jvp(slope, (point,), (along,))[1][index]

    by_member = jax.vmap(jax.vmap(second, in_axes=(None, 0)), in_axes=(0, None))
    return -np.asarray(jax.jit(by_member)(jnp.asarray(u), jnp.asarray(members)))
