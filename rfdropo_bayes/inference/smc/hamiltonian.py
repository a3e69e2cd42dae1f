"""Moves along the gradient of a posterior on its way, for particles in many dimensions.

A proposal that knows only the population's covariance is refused the more often the more parameters there are; one that
follows the density's slope is not. All particles move at once, each in coordinates whitened by the half of the
population that it is not in.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rfdropo_bayes.bayes.problem import Problem
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference.smc.moves import Reference

WORTHWHILE = 15  # parameters from which on "auto" follows gradients; with fewer, moves by the covariance cost less
TRAVEL = 1.5  # length of a trajectory in deviations: about a quarter of an orbit, which forgets the start
MOST_LEAPS = 24
FASTEST = 1e6  # momentum in deviations of what is still a trajectory
JITTER = 0.2  # of step lengths, so that no direction's orbit is met at its period


@runtime_checkable
class SlopedProblem(Problem, Protocol):
    """A problem whose posterior on the way to it JAX can differentiate."""

    def path_density(self, u: Float[Array, " d"], shares: Float[Array, " n_rows"]) -> Float[Array, ""]:
        """Log prior plus the log density of every row times its share, at one unconstrained point; traceable."""
        ...


def chosen_kernel(kernel: str, problem: Problem, rollouts: float | None) -> str:
    """What "auto" means for a problem: gradients where there are some, many parameters, and no budget of rollouts."""
    if kernel != "auto":
        return kernel
    sloped = isinstance(problem, SlopedProblem) and len(problem.names) >= WORTHWHILE and rollouts is None
    return "hamiltonian" if sloped else "crank_nicolson"


def flow_of(problem: Problem) -> Flow:
    """Trajectories of a problem.

    Raises:
        InputError: JAX cannot differentiate its posterior.
    """
    if not isinstance(problem, SlopedProblem):
        raise InputError(
            'kernel = "hamiltonian" follows gradients, which this problem does not have',
            where="[inference] kernel",
            remedy='kernel = "auto"',
        )
    return Flow(problem)


class Flow:
    """Trajectories of a problem's particles under one target of its path.

    Args:
        problem: its derivatives are compiled once per number of particles.
    """

    def __init__(self, problem: SlopedProblem) -> None:
        self.n_rows = problem.n_rows
        slope = jax.vmap(jax.grad(problem.path_density), in_axes=(0, None))

        def leap(
            u: Array, momentum: Array, shares: Array, factors: Array, second: Array, steps: Array, leaps: Array
        ) -> tuple[Array, Array]:
            def whitened(gradient: Array) -> Array:
                return jnp.where(second, gradient @ factors[1], gradient @ factors[0])

            def coloured(momentum: Array) -> Array:
                return jnp.where(second, momentum @ factors[1].T, momentum @ factors[0].T)

            def once(_: Any, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
                u, momentum, push = state
                momentum = momentum + 0.5 * steps * push
                u = u + steps * coloured(momentum)
                push = whitened(slope(u, shares))
                return u, momentum + 0.5 * steps * push, push

            u, momentum, _ = jax.lax.fori_loop(0, leaps, once, (u, momentum, whitened(slope(u, shares))))
            return u, momentum

        self._leap = jax.jit(leap)

    def __call__(
        self,
        generator: np.random.Generator,
        position: Float[np.ndarray, "n d"],
        progress: float,
        references: tuple[Reference, Reference],
        second: Bool[np.ndarray, " n"],
        scale: float,
        charge: Callable[[int], None],
    ) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, " n"]]:
        """Propose for all particles.

        Args:
            generator: of momenta.
            position: unconstrained particles.
            progress: rows of the path that are in, the last perhaps by a share.
            references: of the two halves; their covariances are the inverse mass.
            second: particles of the second half.
            scale: step length in deviations.
            charge: is told how many gradients were taken.

        Returns:
            where the particles arrive, and the log of the momenta's part of the acceptance ratio.
        """
        leaps = leaps_of(scale)
        charge((leaps + 1) * len(position))
        momentum = generator.standard_normal(position.shape)
        steps = scale * (1.0 + JITTER * generator.uniform(-1.0, 1.0, (len(position), 1)))
        shares = np.clip(progress - np.arange(self.n_rows), 0.0, 1.0)
        factors = np.stack([reference.cholesky for reference in references])
        arrived, left = (
            np.asarray(part)
            for part in self._leap(position, momentum, shares, factors, second[:, None], steps, jnp.asarray(leaps))
        )
        # A step too long for the slope flies off: such a trajectory is refused, whatever its numbers.
        good = np.isfinite(arrived).all(axis=1) & (np.abs(left) < FASTEST).all(axis=1)
        ratio = 0.5 * np.sum(momentum**2, axis=1) - 0.5 * np.sum(np.where(good[:, None], left, 0.0) ** 2, axis=1)
        return np.where(good[:, None], arrived, position), np.where(good, ratio, -np.inf)


def leaps_of(scale: float) -> int:
    """Steps of a trajectory."""
    return int(np.clip(np.ceil(TRAVEL / scale), 1, MOST_LEAPS))
