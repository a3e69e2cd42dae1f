"""What an inference method sees: a posterior given data, in named parameters. Simulators stay hidden behind it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Bool, Float, Int, PRNGKeyArray

# Arrays of JAX or of NumPy: a problem takes and returns either.
Values = Mapping[str, Float[Any, " n"]]


@runtime_checkable
class Problem(Protocol):
    """A posterior given data.

    A data *row* is one time step of every recording; a *horizon* ``h`` is the prefix of the first ``h`` rows (eq. 3 of
    RF-DROPO). Values are always named and in physical units; ``u`` is the unconstrained space that samplers move in.

    Attributes:
        names: scalar parameters, in sampling order.
        units: unit of each parameter, SI.
        bounds: hard bounds of each parameter; infinite where there is none.
        n_rows: rows of data; horizons run from 1 to ``n_rows``.

    A problem may also have

    - ``fingerprint: str``, a digest of its data and model: checkpoints of another problem are then refused;
    - ``prior_ends: dict[str, tuple[float, float]]``, where each parameter's prior ends: on its hard bounds or between
      them; without, the bounds are taken for them;
    - ``status_names: Mapping[int, str]``, words for its status codes, used when excluded rollouts are counted;
    - ``log_likelihood_at(u)`` of one unconstrained point, traceable by JAX, as NUTS and nested sampling want it.
    """

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def units(self) -> dict[str, str]: ...

    @property
    def bounds(self) -> dict[str, tuple[float, float]]: ...

    @property
    def n_rows(self) -> int: ...

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
        """Log density of each of the first ``horizon`` rows given those before it, for a batch of values.

        Returns:
            rows: minus infinity where the likelihood is zero, never NaN.
            status: 0, or the code of a rollout that did not end well. Such a rollout never gets weight; it is counted.
        """
        ...


@runtime_checkable
class ResidualProblem(Problem, Protocol):
    """A problem whose log likelihood is a sum of squares, as Gauss-Newton wants it.

    It may also have ``prior_derivatives``, compiled gradient and Hessian of the log prior; ``residual_batch(values,
    horizon)``, the residuals of many sets of values; and ``jacobian``, the way its Jacobians are to be taken ("auto",
    "forward" or "central").
    """

    def residuals(self, values: Mapping[str, Float[Any, ""]], horizon: int) -> Float[Any, " m"]:
        """Whitened residuals r of the first ``horizon`` rows for ONE set of values.

        ``-0.5 * sum(r**2) + c`` is the log likelihood, where ``c`` depends on noise parameters only. Traceable by JAX
        where the simulator is; otherwise Jacobians are taken by central differences.
        """
        ...


@runtime_checkable
class Hierarchy(Problem, Protocol):
    """A problem some of whose parameters are standard deviations of others, whose mean is zero.

    Attributes:
        scales: names of the standard deviations, with those of the parameters that each is of; may be empty.
        typical_scales: a value of each from the middle of its prior.
    """

    scales: Mapping[str, tuple[str, ...]]
    typical_scales: Mapping[str, float]

    def holding(self, values: Mapping[str, float]) -> ResidualProblem:
        """The same problem with some parameters known; what a known standard deviation is of has itself for its
        unconstrained coordinate."""
        ...

    def scale_log_prior(self, values: Float[Any, "n scale"]) -> Float[Any, " n"]:
        """Log density of the prior of the standard deviations."""
        ...


@runtime_checkable
class RolloutProblem(Problem, Protocol):
    """A problem that can be simulated without a noise model, as RF-DROPO wants it.

    Attributes:
        observed: measured features, laid out like `rollouts`.
        observed_mask: True where ``observed`` may be used.

    It may also have ``physical_names: tuple[str, ...]``, the parameters that a rollout depends on (all of ``names``
    where it is missing); the others, such as the noise scale, are passed at their prior median. Methods that learn from
    simulations use ``noisy_rollouts(key, values)``, rollouts of all rows with observation noise, and ``actions``
    (n_rows, a), the commands at the rows, where it has them. To the variances of rollouts RF-DROPO adds those of
    ``noise_deviation(values)``, the standard deviation (feature,) of each feature's noise at one set of values.
    """

    @property
    def observed(self) -> Float[Any, "n_rows feature"]: ...

    @property
    def observed_mask(self) -> Bool[Any, "n_rows feature"]: ...

    def rollouts(self, values: Values, horizon: int) -> tuple[Float[Any, "n horizon feature"], Int[Any, " n"]]:
        """Simulated features of the first ``horizon`` rows, without observation noise, and the status of each."""
        ...
