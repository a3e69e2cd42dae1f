"""A plain numpyro model and its data, as a problem for the samplers of this package."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
from jaxtyping import Array, Float, Int, PRNGKeyArray
from numpyro import handlers
from numpyro.distributions import (
    Cauchy,
    Delta,
    Distribution,
    ExpandedDistribution,
    ImproperUniform,
    Independent,
    Laplace,
    Logistic,
    MaskedDistribution,
    Normal,
    StudentT,
    TransformedDistribution,
    biject_to,
    constraints,
)
from numpyro.infer import init_to_uniform
from numpyro.infer.util import compute_log_probs, constrain_fn, potential_energy, unconstrain_fn
from numpyro.primitives import Messenger

from rfdropo_bayes.bayes.problem import ProblemDefaults
from rfdropo_bayes.errors import InputError

CENTRING_DRAWS = 64  # at which the data's information is looked at
VARIES = 1e-9  # relative: what moves less with the draws is a constant
MOST_KNOWN = 1e50  # information that is more than this is a singularity
DEEPEST = 8  # levels of a hierarchy
ROUND_TRIP = 1e-6  # relative error of a round trip
TRIALS = 64  # draws of a prior, of which some must be finite
LOCATED = (Normal, StudentT, Cauchy, Laplace, Logistic)  # priors on the whole line with a location and a scale

Batch = Mapping[str, Float[Array, " n"]]


class _JaxData(Messenger):
    """A model whose data are JAX arrays: numpyro compares NumPy's with NumPy, also to bounds that JAX is tracing."""

    def process_message(self, msg: dict[str, Any]) -> None:
        if msg["type"] == "sample" and msg["is_observed"]:
            msg["value"] = jnp.asarray(msg["value"])


class NumpyroProblem(ProblemDefaults):
    """Posterior of a numpyro model given the data it was called with.

    Parameters are the components of the model's latent sites: site ``tau`` is ``tau``, the second component of a vector
    ``theta`` is ``theta[1]``, of a matrix ``corr[0,1]``; `sites` puts draws together again. Rows are the elements along
    the first axis of the observed sites, site after site; an observed scalar (or a ``numpyro.factor``) is one row. The
    likelihood is that of the observed sites, the prior all the rest.

    Args:
        model: the model.
        args, kwargs: what it is called with, data included.
        row_sites: observed sites in the order in which their rows come; None for the model's own order.

    Raises:
        InputError: nothing is observed, nothing is latent; a latent site is discrete or its prior improper; data are
            not numbers; the model takes random subsamples of its data, or has ``numpyro.param`` sites.
    """

    def __init__(
        self,
        model: Callable[..., Any],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
        row_sites: Sequence[str] | None = None,
    ) -> None:
        self.model, self.args, self.kwargs = _JaxData(model), tuple(args), dict(kwargs or {})
        trace = self._trace(0)
        _check_kinds(trace)
        sites = {name: site for name, site in trace.items() if site["type"] == "sample"}
        observed = [name for name, site in sites.items() if site["is_observed"]]
        latent = {name: site for name, site in sites.items() if not site["is_observed"]}
        self.row_sites = tuple(observed if row_sites is None else row_sites)
        self._check_observed(observed)
        _check_latent(latent)
        _check_data({name: sites[name] for name in observed})
        self._shapes = {name: tuple(np.shape(site["value"])) for name, site in latent.items()}
        self._free_shapes = {
            name: tuple(biject_to(site["fn"].support).inverse_shape(self._shapes[name]))
            for name, site in latent.items()
        }
        self.names = tuple(name for site, shape in self._shapes.items() for name in _components(site, shape))
        self.units = dict.fromkeys(self.names, "1")
        self.bounds = self._bounds(latent)
        self.n_rows = sum(_row_count(sites[name]) for name in self.row_sites)
        self.fingerprint = self._fingerprint(sites)

    def _trace(self, seed: int) -> dict[str, Any]:
        """Sites at values that need no prior draws, which an improper prior does not have, as yet unchecked."""
        started = handlers.substitute(handlers.seed(self.model, jax.random.key(seed)), substitute_fn=init_to_uniform)
        with numpyro.validation_enabled(False):
            return handlers.trace(started).get_trace(*self.args, **self.kwargs)

    def _check_observed(self, observed: list[str]) -> None:
        if not observed:
            raise InputError("the model observes nothing", where="numpyro model", remedy="pass the data as obs=")
        for name in self.row_sites:
            if name not in observed:
                raise InputError(f"site {name!r} is not observed", where="row_sites", remedy=f"one of {observed}")
        missing = [name for name in observed if name not in self.row_sites]
        if missing:
            raise InputError(f"observed sites {missing} are missing", where="row_sites", remedy="list them all")

    def _bounds(self, latent: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
        """Bounds of every parameter; none where they move with other parameters."""
        moved, found = self._trace(1), {}
        for site, shape in self._shapes.items():
            ends = [_interval(sites[site]["fn"].support, shape) for sites in (latent, moved)]
            for name, first, second in zip(_components(site, shape), *ends, strict=True):
                found[name] = first if first == second else (-np.inf, np.inf)
        return found

    def _fingerprint(self, sites: Mapping[str, Any]) -> str:
        digest = hashlib.sha256()
        named = [(name, sites[name]["value"]) for name in self.row_sites]
        for name, value in (*named, *enumerate(jax.tree.leaves((self.args, self.kwargs)))):
            array = np.ascontiguousarray(np.asarray(value))
            if array.dtype != object:  # an object has no bytes that say what it is
                digest.update(f"{name} {array.shape} {array.dtype}".encode())
                digest.update(array.tobytes())
        return digest.hexdigest()

    def sample_prior(self, key: PRNGKeyArray, n: int) -> dict[str, Float[Array, " n"]]:
        """Prior draws by running the model forward."""
        return self._split(self._draw(jax.random.split(key, n)))

    def sample_starts(self, key: PRNGKeyArray, n: int) -> dict[str, Float[Array, " n"]]:
        """Where climbs may start: at prior draws, and as many from where numpyro starts its chains, uniformly within 2
        of zero in every unconstrained coordinate: draws of a prior that says nothing are far from everything."""
        prior = self.sample_prior(key, n - n // 2)
        near = jax.random.uniform(jax.random.fold_in(key, 1), (n // 2, len(self.names)), minval=-2.0, maxval=2.0)
        return {name: jnp.concatenate([prior[name], value]) for name, value in self.from_unconstrained(near).items()}

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

    def path_density(self, u: Float[Array, " d"], shares: Float[Array, " n_rows"]) -> Float[Array, ""]:
        """Log prior plus the log density of every row times its share, at one unconstrained point; traceable."""
        sites = constrain_fn(self.model, self.args, self.kwargs, self._ravelled(u))
        rows = self._single_rows({name: sites[name] for name in self._shapes})
        return self.log_prior(u[None])[0] + jnp.sum(jnp.where(shares > 0.0, shares * rows, 0.0))

    def location_scale(self, u: Float[Array, " d"]) -> tuple[Float[Array, " d"], Float[Array, " d"]]:
        """Location and scale of each coordinate's prior given the others, at one unconstrained point; traceable.

        0 and 1 where the prior is not one of these two and a shape, on the whole line.
        """
        sites = constrain_fn(self.model, self.args, self.kwargs, self._ravelled(u))
        given = handlers.substitute(handlers.seed(self.model, jax.random.key(0)), data=sites)
        trace = handlers.trace(given).get_trace(*self.args, **self.kwargs)
        found = [_location_scale(trace[name]["fn"], shape) for name, shape in self._free_shapes.items()]
        return jnp.concatenate([part[0] for part in found]), jnp.concatenate([part[1] for part in found])

    def sites(self, draws: Mapping[str, Float[np.ndarray, "*batch"]]) -> dict[str, Float[np.ndarray, "*batch *shape"]]:
        """Draws of components as draws of the model's own sites, in their shapes, with those of ``deterministic``
        sites computed from them: ``problem.sites(result.draws)["theta"]`` is (chain, draw, *shape of theta)."""
        batch = np.shape(next(iter(draws.values())))
        flat = self._join({name: jnp.ravel(jnp.asarray(draws[name])) for name in self.names})
        return {name: np.asarray(value).reshape(*batch, *value.shape[1:]) for name, value in self._follow(flat).items()}

    status_names: Mapping[int, str] = MappingProxyType({1: "not_a_number"})
    earlier: Mapping[str, Float[Any, " n"]] = MappingProxyType({})

    @cached_property
    def _draw(self) -> Callable:
        def single(key: PRNGKeyArray) -> dict[str, Array]:
            trace = handlers.trace(handlers.seed(self.model, key)).get_trace(*self.args, **self.kwargs)
            return {name: trace[name]["value"] for name in self._shapes}

        return jax.jit(jax.vmap(single))

    @cached_property
    def _follow(self) -> Callable:
        def single(sites: dict[str, Array]) -> dict[str, Array]:
            given = handlers.substitute(handlers.seed(self.model, jax.random.key(0)), data=sites)
            trace = handlers.trace(given).get_trace(*self.args, **self.kwargs)
            wanted = [name for name, site in trace.items() if name in sites or site["type"] == "deterministic"]
            return {name: jnp.asarray(trace[name]["value"]) for name in wanted}

        return jax.jit(jax.vmap(single))

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


def _check_kinds(trace: Mapping[str, Any]) -> None:
    """Refuse what has no posterior: parameters that are optimised, and data that change from call to call."""
    for name, site in trace.items():
        if site["type"] == "param":
            raise InputError(
                f"{name!r} is a numpyro.param, which has no prior", where="numpyro model", remedy="use numpyro.sample"
            )
        if site["type"] == "plate" and site["args"][1] not in (None, site["args"][0]):
            raise InputError(
                f"plate {name!r} takes random subsamples of the data", where="numpyro model", remedy="use all of them"
            )


def _check_latent(latent: Mapping[str, Any]) -> None:
    if not latent:
        raise InputError("the model has no parameters", where="numpyro model")
    for name, site in latent.items():
        if site["fn"].support.is_discrete:
            raise InputError(f"site {name!r} is discrete", where="numpyro model", remedy="sum it out")
        if _fixed(site["fn"]):
            raise InputError(
                f"site {name!r} is no parameter: its prior allows a single value",
                where="numpyro model",
                remedy="numpyro.deterministic instead of numpyro.sample",
            )
        try:
            proper = not _without_density(site["fn"]) and _draws_finite(site["fn"])
        except NotImplementedError:  # a distribution of the user's own, with a density only
            proper = False
        if not proper:
            raise InputError(
                f"the prior of site {name!r} is improper: it cannot be sampled, and there is no evidence",
                where="numpyro model",
                remedy="give it a proper prior, if a wide one such as Normal(0, 1000)",
            )


def _without_density(fn: Distribution | None) -> bool:
    """Whether a prior, or what it is made from, is flat or masked out."""
    while fn is not None and not isinstance(fn, ImproperUniform | MaskedDistribution):
        fn = getattr(fn, "base_dist", None)
    return fn is not None


def _draws_finite(fn: Distribution) -> bool:
    """Whether a prior can be sampled; of a proper one some draws may be too large for a number, as 1 / Gamma(0.001)."""
    return bool(np.isfinite(fn.sample(jax.random.key(0), (TRIALS,))).any(axis=0).all())


def _fixed(fn: Distribution) -> bool:
    while isinstance(fn, Independent | ExpandedDistribution):
        fn = fn.base_dist
    return isinstance(fn, Delta)


def _check_data(observed: Mapping[str, Any]) -> None:
    for name, site in observed.items():
        missing = ~np.isfinite(np.asarray(site["value"], dtype=float))
        missing = missing.any(axis=tuple(range(missing.ndim)[missing.ndim - site["fn"].event_dim :]))
        count = int(np.sum(missing & np.asarray(_unmasked(site["fn"]))))
        if count:
            raise InputError(
                f"{count} values of the observed site {name!r} are not finite numbers",
                where="numpyro model",
                remedy="leave them out, or hide them with numpyro.handlers.mask",
            )


def _unmasked(fn: Distribution) -> Any:
    return fn._mask if isinstance(fn, MaskedDistribution) else True


def _ends(support: Any) -> tuple[Any, Any]:
    """Bounds of a support that is a plain interval; infinite otherwise."""
    while isinstance(support, constraints.independent):
        support = support.base_constraint
    if isinstance(support, type(constraints.circular)):  # its ends are one point
        return -np.inf, np.inf
    return getattr(support, "lower_bound", -np.inf), getattr(support, "upper_bound", np.inf)


def _interval(support: Any, shape: tuple[int, ...]) -> list[tuple[float, float]]:
    """Bounds of each component of a site."""
    low, high = (np.broadcast_to(np.asarray(end, dtype=float), shape).ravel().tolist() for end in _ends(support))
    return list(zip(low, high, strict=True))


def _location_scale(fn: Distribution, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Of each component of a site; 0 and 1 unless it has them and no bounds."""
    while isinstance(fn, Independent | ExpandedDistribution) or _bijected(fn):
        fn = fn.base_dist
    if type(fn) not in LOCATED:
        return jnp.zeros(int(np.prod(shape))), jnp.ones(int(np.prod(shape)))
    return jnp.ravel(jnp.broadcast_to(fn.loc, shape)), jnp.ravel(jnp.broadcast_to(fn.scale, shape))


def _bijected(fn: Distribution) -> bool:
    """Whether a prior is another seen through its own support's bijection, as LogNormal is a Normal of logarithms."""
    return isinstance(fn, TransformedDistribution) and fn.transforms == [biject_to(fn.support)]


def _row_count(site: Mapping[str, Any]) -> int:
    shape = jax.eval_shape(site["fn"].log_prob, site["value"]).shape
    return shape[0] if shape else 1


def _sum_rows(log_prob: Array) -> Float[Array, " rows"]:
    return log_prob.reshape(log_prob.shape[0], -1).sum(axis=1) if log_prob.ndim else log_prob[None]


class CentredProblem(ProblemDefaults):
    """A plain model in coordinates between centred and non-centred: ``v = (u - l) / s^(1 - c) + c l``.

    Effects with a common, unknown spread make a funnel: where the spread is small, so are the effects, and no step
    suits both ends. In deviations from the common location l, in units of the spread s, there is no funnel as long as
    the data say little of an effect; where they say much, the effect itself is the better coordinate. Of a normal
    likelihood with information h, the effect is best mixed in with the share ``c = h / (h + 1 / s^2)``.
    Papaspiliopoulos, Roberts and Skold (2003), Non-centered parameterisations for hierarchical models and data
    augmentation.

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

    def to_unconstrained(self, values: Batch) -> Float[Any, "n d"]:
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
    u = u[:: max(1, len(u) // CENTRING_DRAWS)][:CENTRING_DRAWS]
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
        if np.all(np.abs(back - u) <= ROUND_TRIP * (1.0 + np.abs(u))):
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
