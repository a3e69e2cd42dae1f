"""Interface of a posterior for inference methods: a posterior given data, in named parameters. Simulators stay hidden
behind it.

| a protocol | for |
|---|---|
| `Problem` | every method |
| `ResidualProblem` | Gauss-Newton optimisation |
| `WarmStart` | optimisations from an earlier posterior |
| `Hierarchy` | optimisations with standard deviations among the parameters |
| `RolloutProblem` | RF-DROPO |

All members of a protocol are required. `ProblemDefaults` and `RolloutDefaults` have the members with usual defaults.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.posteriors import DrawsByOwner

# Arrays of JAX or of NumPy: a problem takes and returns both.
Values = Mapping[str, Float[Any, " n"]]


@runtime_checkable
class Problem(Protocol):
    """A posterior given data.

    A data *row* is one time step of every recording; a *horizon* ``h`` is the prefix of the first ``h`` rows (eq. 3 of
    RF-DROPO). Values are always named and in physical units; ``u`` is the unconstrained space that samplers move in.

    Attributes:
        names: scalar parameters, in sampling order.
        units: unit of each parameter, SI.
        bounds: hard bounds of each parameter; infinite without a bound.
        prior_ends: ends of each parameter's prior, at its hard bounds or inside them.
        n_rows: rows of data; horizons run from 1 to ``n_rows``.
        fingerprint: a digest of its data and model; checkpoints with another fingerprint are refused.
        status_names: words for its status codes, used when excluded rollouts are counted.
    """

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def units(self) -> Mapping[str, str]: ...

    @property
    def bounds(self) -> Mapping[str, tuple[float, float]]: ...

    @property
    def prior_ends(self) -> Mapping[str, tuple[float, float]]: ...

    @property
    def n_rows(self) -> int: ...

    @property
    def fingerprint(self) -> str: ...

    @property
    def status_names(self) -> Mapping[int, str]: ...

    def sample_prior(self, key: PRNGKeyArray, n: int) -> dict[str, Float[Any, " n"]]:
        """Independent prior draws."""
        ...

    def to_unconstrained(self, values: Values) -> Float[Any, "n d"]:
        """Values as points of the unconstrained space."""
        ...

    def from_unconstrained(self, u: Float[Any, "n d"]) -> dict[str, Float[Any, " n"]]:
        """Inverse of `to_unconstrained`."""
        ...

    def log_prior(self, u: Float[Any, "n d"]) -> Float[Any, " n"]:
        """Normalised log prior density in the UNCONSTRAINED space, that is with the Jacobian of the transform."""
        ...

    def row_log_likelihood(self, values: Values, horizon: int) -> tuple[Float[Any, "n horizon"], Int[Any, " n"]]:
        """Log density of each of the first ``horizon`` rows given the earlier rows, for a batch of values.

        Returns:
            rows: minus infinity for a zero likelihood, never NaN. status: 0, or the code of a failed rollout. Such a
            rollout never gets weight; it is counted.
        """
        ...


Derivatives = tuple[Callable[[Any], Any], Callable[[Any], Any]]
"""Gradient (d,) and Hessian (d, d) of a density, as functions of one unconstrained point (d,)."""


@runtime_checkable
class ResidualProblem(Problem, Protocol):
    """A problem whose log likelihood is a sum of squares, for Gauss-Newton.

    Attributes:
        physical_names: parameters that the simulation depends on; the others are noise. All of ``names`` if unknown:
        noise parameters are then identified numerically.
        prior_derivatives: derivatives of the log prior.
    """

    @property
    def physical_names(self) -> tuple[str, ...]: ...

    @property
    def prior_derivatives(self) -> Derivatives: ...

    def residuals(self, values: Values, horizon: int) -> Float[Any, "n m"]:
        """Whitened residuals r of the first ``horizon`` rows for each set of values.

        ``-0.5 * sum(r**2) + c`` is the log likelihood, with ``c`` a function of noise parameters only. Jacobians are
        central differences.
        """
        ...


@runtime_checkable
class WarmStart(Problem, Protocol):
    """A problem with starting points beside its prior.

    Attributes:
        earlier: draws of an earlier posterior, by parameter and owner; empty without an earlier posterior.
    """

    @property
    def earlier(self) -> DrawsByOwner: ...

    def sample_starts(self, key: PRNGKeyArray, n: int) -> dict[str, Float[Any, " n"]]:
        """Starts of optimisations."""
        ...


@runtime_checkable
class Hierarchy(Problem, Protocol):
    """A problem with standard deviations of other, zero-mean parameters among its parameters.

    Attributes:
        scales: names of the standard deviations, each with the names of its parameters; may be empty.
        typical_scales: a central value of each under its prior.
    """

    @property
    def scales(self) -> Mapping[str, tuple[str, ...]]: ...

    @property
    def typical_scales(self) -> Mapping[str, float]: ...

    def holding(self, values: Mapping[str, float]) -> ResidualProblem:
        """The same problem with some parameters fixed. A parameter with a fixed standard deviation equals its
        unconstrained coordinate.
        """
        ...

    def scale_log_prior(self, values: Float[Any, "n scale"]) -> Float[Any, " n"]:
        """Log density of the prior of the standard deviations."""
        ...


@runtime_checkable
class RolloutProblem(Problem, Protocol):
    """A problem that can be simulated without a noise model, for RF-DROPO.

    Attributes:
        physical_names: parameters that a rollout depends on; the others, such as the noise scale, are passed at their
            prior median.
        observed: measured features, laid out like `rollouts`.
        observed_mask: True for usable entries of ``observed``.
    """

    @property
    def physical_names(self) -> tuple[str, ...]: ...

    @property
    def observed(self) -> Float[Any, "n_rows feature"]: ...

    @property
    def observed_mask(self) -> Bool[Any, "n_rows feature"]: ...

    def rollouts(self, values: Values, horizon: int) -> tuple[Float[Any, "n horizon feature"], Int[Any, " n"]]:
        """Simulated features of the first ``horizon`` rows, without observation noise, and the status of each."""
        ...

    def noise_deviation(self, values: Mapping[str, float]) -> Float[Any, " feature"]:
        """Standard deviation of each feature's observation noise, at one set of values."""
        ...


class ProblemDefaults:
    """Default members of a problem: a prior that ends at the bounds, and no fingerprint.

    Its derivatives of the prior are JAX's.
    """

    # ``self`` is no `Problem` to a run-time check of types: asking for all its members would ask for these in turn.

    fingerprint: str = ""
    status_names: Mapping[int, str] = MappingProxyType({})

    @cached_property
    def prior_ends(self: Any) -> Mapping[str, tuple[float, float]]:
        """The hard bounds."""
        return self.bounds

    @cached_property
    def physical_names(self: Any) -> tuple[str, ...]:
        """All."""
        return self.names

    @cached_property
    def prior_derivatives(self: Any) -> Derivatives:
        """Gradient and Hessian of the log prior at one unconstrained point, compiled."""

        def single(u: Array) -> Array:
            return jnp.asarray(self.log_prior(u[None]))[0]

        return jax.jit(jax.grad(single)), jax.jit(jax.hessian(single))


class RolloutDefaults(ProblemDefaults):
    """The same of a problem with rollouts: no noise."""

    def noise_deviation(self: Any, values: Mapping[str, float]) -> Float[np.ndarray, " feature"]:
        """Zero."""
        return np.zeros(np.shape(self.observed)[1])


def with_rollouts(problem: Problem) -> RolloutProblem:
    """A problem for a method that learns from rollouts.

    Raises:
        InputError: the problem has no such members.
    """
    if not isinstance(problem, RolloutProblem):
        raise InputError("this problem has no rollouts", where="[inference] method", remedy='use method = "smc"')
    return problem


CAPABILITIES: dict[str, type] = {
    "residuals": ResidualProblem,
    "sample_starts": WarmStart,
    "scales": Hierarchy,
    "rollouts": RolloutProblem,
}
"""Optional protocols of a problem, by the member that marks each."""


def check_problem(problem: object) -> None:
    """Check the members of a problem before a method runs.

    Raises:
        InputError: the problem lacks a member of `Problem`, or of a protocol that the problem implements in part.
    """
    there = {*dir(problem)}
    wanted = [("", Problem), *((member, kind) for member, kind in CAPABILITIES.items() if member in there)]
    for member, kind in wanted:
        missing = sorted(_members(kind) - there)
        if missing:
            having = f"has {member!r} but lacks" if member else "lacks"
            raise InputError(
                f"{type(problem).__name__} {having} {', '.join(missing)}",
                where="problem",
                remedy=f"define the members of {kind.__name__}; derive from {ProblemDefaults.__name__} or "
                f"{RolloutDefaults.__name__} for the usual defaults",
            )


def _members(kind: type) -> set[str]:
    """Public members of a protocol and of its base protocols."""
    return {name for each in kind.__mro__[:-1] for name in vars(each) if not name.startswith("_")}
