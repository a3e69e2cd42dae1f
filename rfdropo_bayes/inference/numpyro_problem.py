"""A plain numpyro model and its data, as a problem for the samplers of this package."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray
from numpyro import handlers
from numpyro.distributions import biject_to, constraints
from numpyro.infer import Predictive
from numpyro.infer.util import compute_log_probs, constrain_fn, potential_energy, unconstrain_fn

from rfdropo_bayes.errors import InputError

Batch = Mapping[str, Float[Array, " n"]]


class NumpyroProblem:
    """Posterior of a numpyro model given the data it was called with.

    Parameters are the components of the model's latent sites: site ``tau`` is ``tau``, the second component of a vector
    ``theta`` is ``theta[1]``, of a matrix ``corr[0,1]``. Rows are the elements along the first axis of the observed
    sites, site after site; an observed scalar (or a ``numpyro.factor``) is one row. The likelihood is that of the
    observed sites, the prior all the rest.

    Args:
        model: the model.
        args, kwargs: what it is called with, data included.
        row_sites: observed sites in the order in which their rows come; None for the model's own order.

    Raises:
        InputError: nothing is observed, nothing is latent, a latent site is discrete or has an improper prior.
    """

    def __init__(
        self,
        model: Callable[..., Any],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
        row_sites: Sequence[str] | None = None,
    ) -> None:
        self.model, self.args, self.kwargs = model, tuple(args), dict(kwargs or {})
        trace = self._trace()
        sites = {name: site for name, site in trace.items() if site["type"] == "sample"}
        observed = [name for name, site in sites.items() if site["is_observed"]]
        latent = {name: site for name, site in sites.items() if not site["is_observed"]}
        self.row_sites = tuple(observed if row_sites is None else row_sites)
        self._check(latent, observed)
        self._shapes = {name: tuple(np.shape(site["value"])) for name, site in latent.items()}
        self._free_shapes = {
            name: tuple(biject_to(site["fn"].support).inverse_shape(self._shapes[name]))
            for name, site in latent.items()
        }
        self.names = tuple(name for site, shape in self._shapes.items() for name in _components(site, shape))
        self.units = dict.fromkeys(self.names, "1")
        self.bounds = {
            name: bound
            for site, shape in self._shapes.items()
            for name, bound in zip(_components(site, shape), _bounds(latent[site]["fn"].support, shape), strict=True)
        }
        self.n_rows = sum(_row_count(sites[name]) for name in self.row_sites)
        self.fingerprint = self._fingerprint(sites)

    def _trace(self) -> dict[str, Any]:
        seeded = handlers.seed(self.model, jax.random.key(0))
        try:
            return handlers.trace(seeded).get_trace(*self.args, **self.kwargs)
        except NotImplementedError as error:
            raise InputError(
                "the model has a prior that cannot be sampled",
                where="numpyro model",
                remedy="give every parameter a proper prior",
            ) from error

    def _check(self, latent: Mapping[str, Any], observed: list[str]) -> None:
        if not latent:
            raise InputError("the model has no parameters", where="numpyro model")
        if not observed:
            raise InputError("the model observes nothing", where="numpyro model", remedy="pass the data as obs=")
        for name in self.row_sites:
            if name not in observed:
                raise InputError(f"site {name!r} is not observed", where="row_sites", remedy=f"one of {observed}")
        missing = [name for name in observed if name not in self.row_sites]
        if missing:
            raise InputError(f"observed sites {missing} are missing", where="row_sites", remedy="list them all")
        for name, site in latent.items():
            if site["fn"].support.is_discrete:
                raise InputError(f"site {name!r} is discrete", where="numpyro model", remedy="sum it out")

    def _fingerprint(self, sites: Mapping[str, Any]) -> str:
        digest = hashlib.sha256()
        for name in self.row_sites:
            digest.update(name.encode())
            digest.update(np.ascontiguousarray(np.asarray(sites[name]["value"])).tobytes())
        return digest.hexdigest()

    def sample_prior(self, key: PRNGKeyArray, n: int) -> dict[str, Float[Array, " n"]]:
        """Prior draws by running the model forward."""
        drawn = Predictive(self.model, num_samples=n, return_sites=list(self._shapes))(key, *self.args, **self.kwargs)
        return self._split(drawn)

    def to_unconstrained(self, values: Batch) -> Float[Array, "n d"]:
        """Sites mapped by numpyro's bijections, flattened, in the model's order."""
        return self._unconstrain(self._join(values))

    def from_unconstrained(self, u: Float[Array, "n d"]) -> dict[str, Float[Array, " n"]]:
        """Inverse of `to_unconstrained`."""
        return self._split(self._constrain(jnp.asarray(u)))

    def log_prior(self, u: Float[Array, "n d"]) -> Float[Array, " n"]:
        """Log density of the latent sites with the Jacobian of the bijections."""
        return self._log_prior(jnp.asarray(u))

    def row_log_likelihood(
        self, values: Batch, horizon: int
    ) -> tuple[Float[np.ndarray, "n horizon"], Int[np.ndarray, " n"]]:
        """Log probability of the first ``horizon`` rows; all rows are computed, a plain model knows no shorter way."""
        rows = np.asarray(self._rows(self._join(values)))[:, :horizon]
        return np.where(np.isnan(rows), -np.inf, rows), np.where(np.isnan(rows).any(axis=1), 1, 0)

    def log_likelihood_at(self, u: Float[Array, " d"]) -> Float[Array, ""]:
        """Log likelihood of all rows at one unconstrained point; traceable and differentiable."""
        sites = constrain_fn(self.model, self.args, self.kwargs, self._ravelled(u))
        return self._single_rows({name: sites[name] for name in self._shapes}).sum()

    status_names: Mapping[int, str] = {1: "not_a_number"}

    @cached_property
    def _constrain(self) -> Callable:
        def single(u: Array) -> dict[str, Array]:
            sites = constrain_fn(self.model, self.args, self.kwargs, self._ravelled(u))
            return {name: sites[name] for name in self._shapes}

        return jax.jit(jax.vmap(single))

    @cached_property
    def _unconstrain(self) -> Callable:
        def single(sites: dict[str, Array]) -> Array:
            free = unconstrain_fn(self.model, self.args, self.kwargs, sites)
            return jnp.concatenate([jnp.ravel(free[name]) for name in self._shapes])

        return jax.jit(jax.vmap(single))

    @cached_property
    def _log_prior(self) -> Callable:
        hidden = handlers.block(self.model, hide=list(self.row_sites))

        def single(u: Array) -> Array:
            return -potential_energy(hidden, self.args, self.kwargs, self._ravelled(u))

        return jax.jit(jax.vmap(single))

    def _single_rows(self, sites: dict[str, Array]) -> Float[Array, " rows"]:
        seeded = handlers.seed(self.model, jax.random.key(0))
        parts, _ = compute_log_probs(seeded, self.args, self.kwargs, sites, sum_log_prob=False)
        return jnp.concatenate([_sum_rows(parts[name]) for name in self.row_sites])

    @cached_property
    def _rows(self) -> Callable:
        return jax.jit(jax.vmap(self._single_rows))

    def _ravelled(self, u: Float[Array, " d"]) -> dict[str, Array]:
        parts, start = {}, 0
        for name, shape in self._free_shapes.items():
            size = int(np.prod(shape))
            parts[name] = u[start : start + size].reshape(shape)
            start += size
        return parts

    def _split(self, sites: Mapping[str, Array]) -> dict[str, Array]:
        flat: dict[str, Array] = {}
        for site, shape in self._shapes.items():
            columns = jnp.asarray(sites[site]).reshape(-1, int(np.prod(shape)))
            flat |= {name: columns[:, j] for j, name in enumerate(_components(site, shape))}
        return flat

    def _join(self, values: Batch) -> dict[str, Array]:
        sites = {}
        for site, shape in self._shapes.items():
            columns = [jnp.asarray(values[name]) for name in _components(site, shape)]
            sites[site] = jnp.stack(columns, axis=-1).reshape(-1, *shape)
        return sites


def problem_from_numpyro(
    model: Callable[..., Any],
    args: Sequence[Any] = (),
    kwargs: Mapping[str, Any] | None = None,
    row_sites: Sequence[str] | None = None,
) -> NumpyroProblem:
    """The posterior of a numpyro model, ready for ``methods.run(problem, "smc", {...}, key)``; see `NumpyroProblem`."""
    return NumpyroProblem(model, args, kwargs, row_sites)


def _components(site: str, shape: tuple[int, ...]) -> list[str]:
    if not shape:
        return [site]
    return [f"{site}[{','.join(map(str, index))}]" for index in np.ndindex(*shape)]


def _bounds(support: Any, shape: tuple[int, ...]) -> list[tuple[float, float]]:
    """Bounds of each component, where the support is a plain interval; infinite otherwise."""
    while isinstance(support, constraints.independent):
        support = support.base_constraint
    low = np.broadcast_to(np.asarray(getattr(support, "lower_bound", -np.inf), dtype=float), shape)
    high = np.broadcast_to(np.asarray(getattr(support, "upper_bound", np.inf), dtype=float), shape)
    return list(zip(low.ravel().tolist(), high.ravel().tolist(), strict=True))


def _row_count(site: Mapping[str, Any]) -> int:
    shape = jnp.shape(site["fn"].log_prob(site["value"]))
    return shape[0] if shape else 1


def _sum_rows(log_prob: Array) -> Float[Array, " rows"]:
    return log_prob.reshape(log_prob.shape[0], -1).sum(axis=1) if log_prob.ndim else log_prob[None]
