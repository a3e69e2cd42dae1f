"""One vector for all parameters of an audit: of the base model, and of every candidate at its null value.

Base parameters are moved in the unconstrained space of their priors. A parameter of a candidate is measured from its
null value in units of its prior's deviation, because a null value may lie on a hard bound, at which an unconstrained
coordinate is infinite. A parameter without effect at null (a time constant) is also moved in the unconstrained space.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rfdropo_bayes.bayes.batches import padded
from rfdropo_bayes.bayes.priors import log_density
from rfdropo_bayes.bayes.scopes import Scopes

MEASURED_FROM_NULL = ("Normal", "TruncatedNormal", "HalfNormal")
PRIOR_DRAWS = 4000
# Prior deviations from its mean at which an unconstrained coordinate ends: a logistic is flat there.
FAR = 8.0
STEP = 1e-3  # of differences of log priors, in these coordinates

Moved = Callable[[Float[Any, "n moved"]], tuple[Float[Any, "n moved"], Float[Any, "n moved"]]]


@dataclass(frozen=True)
class Coordinates:
    """Parameters as one vector x."""

    space: Scopes  # every parameter, base first; each with its prior
    base: int  # number of base parameters
    # names of the simulator's parameters, in the order of rollouts; a sum of a shared value and a group's deviation is
    # clipped to their hard bounds
    physical: tuple[str, ...]
    # factor by which prior and unit of each coordinate are wider than its parameter's prior; empty for none
    widening: tuple[float, ...] = ()
    # draws of each parameter's prior, and ``moved``, values and derivatives of the parameters that move in
    # unconstrained coordinates, compiled. Copies share both: computing them takes as long as a refit's rollouts.
    draws: Mapping[str, np.ndarray] = field(default_factory=dict, repr=False, compare=False)
    moved: Moved | None = field(default=None, repr=False, compare=False)

    @property
    def nominal(self) -> dict[str, float]:
        """Value of each of the simulator's parameters that is not inferred."""
        return {name: self.space.fixed.get(name, self.space.specs[name].nominal) for name in self.physical}

    @property
    def names(self) -> tuple[str, ...]:
        """Names, in the order of the vector."""
        return self.space.names

    def with_further(self, added: Scopes) -> Coordinates:
        """The same with parameters after all others, which are measured from their null values."""
        fresh = added.sample(jax.random.key(len(self.names)), PRIOR_DRAWS)
        draws = self._draws | {name: np.asarray(values, dtype=float) for name, values in fresh.items()}
        extended = replace(self, space=self.space.with_further(added.parameters), draws=draws, moved=self._moved)
        assert extended.affine[len(self.names) :].all()
        return extended

    def widened(self, factors: Float[np.ndarray, " d"]) -> Coordinates:
        """The same with priors and units of candidates' sizes widened about null by ``factors``."""
        return replace(self, widening=tuple(factors.tolist()), draws=self._draws, moved=self._moved)

    @cached_property
    def affine(self) -> np.ndarray:
        """Mask of coordinates that are measured from their null value."""
        return np.array(
            [
                i >= self.base and p.table.get("distribution") in MEASURED_FROM_NULL
                for i, p in enumerate(self.space.parameters)
            ]
        )

    @cached_property
    def sizes(self) -> np.ndarray:
        """Mask of sizes: coordinates about null whose prior has its centre there, not places or times."""
        own = ((p.spec, float(p.table.get("loc", p.spec.nominal))) for p in self.space.parameters)
        central = np.array([centre == spec.nominal and not spec.grid for spec, centre in own])
        return self.affine & (central | (self.one_sided != 0))

    @cached_property
    def _draws(self) -> dict[str, np.ndarray]:
        if self.draws:
            return dict(self.draws)
        draws = self.space.sample(jax.random.key(0), PRIOR_DRAWS)
        return {name: np.asarray(values, dtype=float) for name, values in draws.items()}

    @cached_property
    def prior_deviations(self) -> dict[str, float]:
        """Standard deviation of each prior in physical units."""
        return {name: float(values.std()) for name, values in self._draws.items()}

    @cached_property
    def _null(self) -> np.ndarray:
        return np.array([p.spec.nominal for p in self.space.parameters], dtype=float)

    @cached_property
    def _scale(self) -> np.ndarray:
        """Scale of each prior: its own if it has a scale, so that a half-normal at null is a standard normal's half."""
        own = ((float(p.table.get("scale", 0.0)), self._draws[p.name]) for p in self.space.parameters)
        return np.array([scale or float(np.std(draws)) or 1.0 for scale, draws in own])

    @property
    def _unit(self) -> np.ndarray:
        """Unit of each coordinate that is measured from null."""
        return self._scale * np.array(self.widening or 1.0)

    @cached_property
    def prior_mean(self) -> Float[np.ndarray, " d"]:
        """Centre of the prior in these coordinates: the start of searches, unrelated to its density."""
        return np.array([0.0 if a else float(u.mean()) for a, u in zip(self.affine, self._free_draws, strict=True)])

    @cached_property
    def prior_sd(self) -> Float[np.ndarray, " d"]:
        """Deviation of the prior in these coordinates."""
        return np.array([1.0 if a else float(u.std()) for a, u in zip(self.affine, self._free_draws, strict=True)])

    @cached_property
    def _free_draws(self) -> list[np.ndarray]:
        return [np.asarray(p.transform.inv(self._draws[p.name])) for p in self.space.parameters]

    @cached_property
    def bounds(self) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
        """Lowest and highest value of each coordinate."""
        low, high = (np.array([getattr(p.spec, side) for p in self.space.parameters]) for side in ("low", "high"))
        lower = np.where(self.affine, (low - self._null) / self._unit, self.prior_mean - FAR * self.prior_sd)
        upper = np.where(self.affine, (high - self._null) / self._unit, self.prior_mean + FAR * self.prior_sd)
        return lower, upper

    @cached_property
    def one_sided(self) -> np.ndarray:
        """+1 or -1 if the null value lies on a bound and only that sign is allowed; else 0."""
        lower, upper = self.bounds
        return np.where(self.affine & (lower >= 0.0), 1, np.where(self.affine & (upper <= 0.0), -1, 0))

    def quantiles(self, index: int, levels: Sequence[float]) -> Float[np.ndarray, " level"]:
        """Quantiles of one parameter's prior, as coordinates."""
        return self.encode_one(index, np.quantile(self._draws[self.names[index]], levels))

    def encode_one(self, index: int, values: Any) -> np.ndarray:
        """Physical values of one parameter as coordinates."""
        if self.affine[index]:
            return (np.asarray(values, dtype=float) - self._null[index]) / self._unit[index]
        return np.asarray(self.space.parameters[index].transform.inv(np.asarray(values, dtype=float)))

    @cached_property
    def null(self) -> Float[np.ndarray, " d"]:
        """The base model at the centre of its prior, every candidate at its null value."""
        x = self.prior_mean.copy()
        for i in range(self.base, len(x)):
            low, high = np.quantile(self._draws[self.names[i]], [0.001, 0.999])
            x[i] = 0.0 if self.affine[i] else float(self.encode_one(i, np.clip(self._null[i], low, high)))
        return x

    def values(self, x: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        """Physical values."""
        return self._with_moved(self._null + self._unit * x, x, 0)

    def named(self, x: Float[np.ndarray, " d"]) -> dict[str, float]:
        """Physical values of one point by name."""
        return dict(zip(self.names, self.values(x[None])[0].tolist(), strict=True))

    def encode(self, values: Mapping[str, float]) -> Float[np.ndarray, " d"]:
        """Coordinates of physical values; missing values stay at `null`."""
        x = self.null.copy()
        for i, name in enumerate(self.names):
            if name in values:
                x[i] = float(self.encode_one(i, values[name]))
        return np.clip(x, *self.bounds)

    def slopes(self, x: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        """Derivative of each physical value with respect to its coordinate."""
        return self._with_moved(np.tile(self._unit, (len(x), 1)), x, 1)

    def log_prior(self, x: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        """Log density of each coordinate's prior in these coordinates."""
        usual = self._with_moved(self._null + self._scale * x, x, 0)  # in a wider prior as far from null as usual there
        slopes = self._with_moved(np.tile(self._scale, (len(x), 1)), x, 1)
        own = zip(self.space.parameters, usual.T, strict=True)
        density = [log_density(p.spec, p.table, value) for p, value in own]
        return np.stack(density, axis=1) + np.log(np.abs(slopes))

    @cached_property
    def _moved(self) -> Moved:
        """Values and derivatives of the parameters that move in unconstrained coordinates."""
        if self.moved is not None:
            return self.moved
        transforms = [p.transform for p, affine in zip(self.space.parameters, self.affine, strict=True) if not affine]

        def values(u: Float[Array, "n moved"]) -> Float[Array, "n moved"]:
            return jnp.stack([transform(column) for transform, column in zip(transforms, u.T, strict=True)], axis=1)

        return jax.jit(lambda u: jax.jvp(values, (u,), (jnp.ones_like(u),)))

    def _with_moved(self, values: Float[np.ndarray, "n d"], x: Float[np.ndarray, "n d"], which: int) -> np.ndarray:
        """``found`` with values (0) or slopes (1) of the parameters that are moved unconstrained in their places."""
        if not self.affine.all():
            values[:, ~self.affine] = padded(self._moved, x[:, ~self.affine])[which]
        return values

    def prior_slopes(self, x: Float[np.ndarray, " d"]) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
        """First and second derivatives of `log_prior` at one point; each depends on its own coordinate only."""
        behind, here, ahead = self.log_prior(x + STEP * np.array([[-1.0], [0.0], [1.0]]))
        return (ahead - behind) / (2.0 * STEP), (ahead - 2.0 * here + behind) / STEP**2

    def gains(self, x: Float[np.ndarray, "n d"]) -> dict[str, Float[np.ndarray, " n"]]:
        """Values of parameters that channels want and rollouts do not, inferred or fixed."""
        return self._beside(self.values(x)) | {
            name: np.full(len(x), value) for name, value in self.space.fixed.items() if name not in self.physical
        }

    def gain_tangents(
        self, x: Float[np.ndarray, "n d"], directions: Float[np.ndarray, "n d"]
    ) -> dict[str, Float[np.ndarray, " n"]]:
        """Derivatives of `gains` along directions."""
        zero = {name: np.zeros(len(x)) for name in self.space.fixed if name not in self.physical}
        return self._beside(self.slopes(x) * directions) | zero

    def _beside(self, columns: np.ndarray) -> dict[str, np.ndarray]:
        named = enumerate(self.space.parameters)
        return {p.name: columns[:, i] for i, p in named if p.physical not in self.physical}

    def slots(self, recordings: Sequence[str]) -> Int[np.ndarray, "recording d"]:
        """Index of each coordinate in a recording's physical parameters; -1 for coordinates of other recordings."""
        index = {name: i for i, name in enumerate(self.physical)}
        return np.array(
            [[index.get(p.physical, -1) if p.holds_for(r) else -1 for p in self.space.parameters] for r in recordings]
        )

    def physical_values(
        self, x: Float[np.ndarray, "n d"], slots: Int[np.ndarray, "recording d"]
    ) -> Float[np.ndarray, "n recording physical"]:
        """Inputs of the simulator for each recording."""
        start, specs = np.array(list(self.nominal.values())), [self.space.specs[name] for name in self.physical]
        inputs = self._scattered(np.tile(start, (len(x), len(slots), 1)), self.values(x), slots)
        return np.clip(inputs, *np.transpose([(spec.low, spec.high) for spec in specs]))

    def physical_tangents(
        self, x: Float[np.ndarray, "n d"], directions: Float[np.ndarray, "n d"], slots: Int[np.ndarray, "recording d"]
    ) -> Float[np.ndarray, "n recording physical"]:
        """Derivatives of `physical_values` along directions."""
        zero = np.zeros((len(x), len(slots), len(self.physical)))
        return self._scattered(zero, self.slopes(x) * directions, slots)

    def _scattered(self, theta: np.ndarray, values: np.ndarray, slots: np.ndarray) -> np.ndarray:
        added = np.array([bool(p.scope.added_to) for p in self.space.parameters])
        for recording, places in enumerate(slots):
            own = (places >= 0) & ~added
            theta[:, recording, places[own]] = values[:, own]
            for i in np.flatnonzero((places >= 0) & added):  # deviation of a group's value from the shared value
                theta[:, recording, places[i]] += values[:, i]
        return theta
