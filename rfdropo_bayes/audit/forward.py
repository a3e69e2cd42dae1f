"""Rollouts and their derivatives in batches of one size, so that two compilations serve a whole audit."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfdropo_bayes.audit.coordinates import Coordinates
from rfdropo_bayes.audit.deadline import Deadline
from rfdropo_bayes.audit.journal import digest
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.commands import Commands
from rfdropo_bayes.simulators.differences import DIFFERENCE, FORWARD
from rfdropo_bayes.simulators.protocol import Result, Simulator

# Lanes of one call: a compilation costs more than the padding of a call, so that there is one size. Processors take
# four lanes each.
WIDTH = max(8, 4 * (os.cpu_count() or 1))

Thetas = Float[np.ndarray, "lane physical"]
Points = Float[np.ndarray, "n d"]
Series = Float[np.ndarray, "... recording time channel"]


def _no_limit() -> None:
    """No check of the time."""


class Lanes:
    """A simulator behind two compiled functions of a fixed number of lanes.

    Args:
        simulator: with the base model's mechanisms and every candidate at its null value.
        marker_index: which of its markers are measured.
        width: lanes of one call; the last call of a batch is padded.
        slope_rollouts: what a derivative costs, that of the value included.
    """

    def __init__(
        self, simulator: Simulator, marker_index: np.ndarray, width: int = WIDTH, slope_rollouts: int = 3
    ) -> None:
        self.simulator = simulator
        self.marker_index = marker_index
        self.width = width
        self.slope_rollouts = slope_rollouts
        self.physical = tuple(spec.name for spec in simulator.parameters)

    def _observe(self, theta: jax.Array, commands: Commands) -> tuple[jax.Array, jax.Array, jax.Array]:
        values = dict(zip(self.physical, theta, strict=True))
        steps = jnp.asarray(commands.step.shape[0])
        observation = self.simulator.rollout(values, commands, steps)
        position = observation.position[:, self.marker_index]
        return position.reshape(position.shape[0], -1), observation.status, observation.tension

    @property
    def difference(self) -> float | None:
        """Relative step of its derivatives; None where they are exact."""
        engine: Any = getattr(self.simulator, "engine", None)
        backend = getattr(engine, "backend", None)
        if backend is None or backend.name != "numba":
            return None
        usual = FORWARD if backend.one_sided else DIFFERENCE[backend.precision]
        return backend.difference or usual

    def with_difference(self, step: float) -> Lanes:
        """The same with central differences over another step."""
        simulator: Any = self.simulator
        backend = simulator.engine.backend._replace(difference=step)
        return Lanes(simulator.with_backend(backend), self.marker_index, self.width)

    @cached_property
    def _rolled(self) -> Any:
        return jax.jit(jax.vmap(self._observe))

    @cached_property
    def _derived(self) -> Any:
        def one(theta: jax.Array, tangent: jax.Array, commands: Commands) -> jax.Array:
            return jax.jvp(lambda t: self._observe(t, commands)[0], (theta,), (tangent,))[1]

        return jax.jit(jax.vmap(one))

    def roll(
        self, theta: Thetas, commands: Commands, lane: np.ndarray, check: Callable[[], None] = _no_limit
    ) -> tuple[np.ndarray, np.ndarray]:
        """Marker coordinates of each set of parameters under the commands of its lane, and result codes.

        ``check`` is called before every batch, and may raise.
        """
        parts = self._chunks(self._rolled, commands, lane, check, theta)
        position, status = (np.concatenate([part[i] for part in parts])[: len(lane)] for i in range(2))
        return position, status

    def tension(self, theta: Thetas, commands: Commands, lane: np.ndarray) -> np.ndarray:
        """Cable tensions [N] of each set of parameters."""
        parts = self._chunks(self._rolled, commands, lane, _no_limit, theta)
        return np.concatenate([part[2] for part in parts])[: len(lane)]

    def differentiate(
        self,
        theta: Thetas,
        tangent: Thetas,
        commands: Commands,
        lane: np.ndarray,
        check: Callable[[], None] = _no_limit,
    ) -> np.ndarray:
        """Derivatives of the marker coordinates along tangents."""
        return np.concatenate(self._chunks(self._derived, commands, lane, check, theta, tangent))[: len(lane)]

    def _chunks(
        self, function: Any, commands: Commands, lane: np.ndarray, check: Callable[[], None], *arrays: np.ndarray
    ) -> list[Any]:
        parts = []
        for start in range(0, len(lane), self.width):
            check()
            index = np.minimum(np.arange(start, start + self.width), len(lane) - 1)
            chosen = Commands(*(np.asarray(part)[lane[index]] for part in commands))
            parts.append(jax.device_get(function(*(a[index] for a in arrays), chosen)))
        return parts


class RoutedLanes(Lanes):
    """Two simulators of one model: a fast one for all that it can do, another for rollouts with further candidates.

    Args:
        fast: lanes of the simulator without these candidates.
        slow: lanes of the simulator with all.
        null: physical values at which the further candidates do nothing.
    """

    def __init__(self, fast: Lanes, slow: Lanes, null: Mapping[str, float]) -> None:
        super().__init__(slow.simulator, slow.marker_index, slow.width, slow.slope_rollouts)
        self.fast, self.slow = fast, slow
        self._kept = np.array([self.physical.index(name) for name in fast.physical])
        self._further = np.setdiff1d(np.arange(len(self.physical)), self._kept)
        self.null = null
        self._null = np.array([null[self.physical[i]] for i in self._further])

    @property
    def difference(self) -> float | None:
        """See `Lanes.difference`."""
        return self.fast.difference

    def with_difference(self, step: float) -> Lanes:
        """See `Lanes.with_difference`."""
        return RoutedLanes(self.fast.with_difference(step), self.slow.with_difference(step), self.null)

    def _needs_slow(self, theta: np.ndarray) -> np.ndarray:
        return ~np.isclose(theta[:, self._further], self._null, rtol=1e-6, atol=1e-12).all(axis=1)

    def roll(
        self, theta: Thetas, commands: Commands, lane: np.ndarray, check: Callable[[], None] = _no_limit
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Lanes.roll`."""
        slow = self._needs_slow(theta)
        parts = [
            (~slow, self.fast, theta[:, self._kept]),
            (slow, self.slow, theta),
        ]
        found = [(mask, *lanes.roll(t[mask], commands, lane[mask], check)) for mask, lanes, t in parts if mask.any()]
        position = np.zeros((len(lane), *found[0][1].shape[1:]))
        status = np.zeros(len(lane), dtype=int)
        for mask, own, codes in found:
            position[mask], status[mask] = own, codes
        return position, status

    def tension(self, theta: Thetas, commands: Commands, lane: np.ndarray) -> np.ndarray:
        """See `Lanes.tension`."""
        if self._needs_slow(theta).any():
            return self.slow.tension(theta, commands, lane)
        return self.fast.tension(theta[:, self._kept], commands, lane)

    def differentiate(
        self,
        theta: Thetas,
        tangent: Thetas,
        commands: Commands,
        lane: np.ndarray,
        check: Callable[[], None] = _no_limit,
    ) -> np.ndarray:
        """See `Lanes.differentiate`."""
        slow = self._needs_slow(theta) | np.any(tangent[:, self._further] != 0.0, axis=1)
        found = []
        for mask, lanes, kept in ((~slow, self.fast, self._kept), (slow, self.slow, slice(None))):
            if mask.any():
                own = lanes.differentiate(theta[mask][:, kept], tangent[mask][:, kept], commands, lane[mask], check)
                found.append((mask, own))
        derivative = np.zeros((len(lane), *found[0][1].shape[1:]))
        for mask, own in found:
            derivative[mask] = own
        return derivative


class Forward:
    """Simulated marker coordinates of a set of recordings as functions of the audit's coordinates.

    Args:
        lanes: the simulator.
        coordinates: what a point means.
        commands: of the recordings, stacked.
        chosen: which of these are simulated, by name.
        rows: observations that are wanted of each; all by default.
        deadline: of the rollouts; none by default.
    """

    def __init__(
        self,
        lanes: Lanes,
        coordinates: Coordinates,
        commands: Commands,
        chosen: Mapping[str, int],
        rows: int | None = None,
        deadline: Deadline | None = None,
    ) -> None:
        self.deadline = deadline or Deadline()
        self.lanes = lanes
        self.coordinates = coordinates
        self.commands = _cut(Commands(*(np.asarray(part)[list(chosen.values())] for part in commands)), rows)
        self.slots = coordinates.slots(list(chosen))
        self.count = len(chosen)
        self.rollouts = 0

    @cached_property
    def identity(self) -> str:
        """Digest of the simulator, its parameters with their priors, and the commands."""
        own, simulator = self.coordinates, self.lanes.simulator
        named = (simulator.description, own.names, own.base, sorted(own.fixed.items()), sorted(own.nominal.items()))
        scale = own.values(np.stack([np.zeros(len(own.names)), np.ones(len(own.names))]))
        prior = (own.prior_mean, own.prior_sd, *own.bounds)
        return digest(
            repr(named),
            self.lanes.difference,
            self.lanes.marker_index,
            scale,
            self.slots,
            *prior,
            *map(np.asarray, self.commands),
        )

    def with_difference(self, step: float) -> Forward:
        """The same with derivatives over another step."""
        changed = copy.copy(self)
        changed.__dict__.pop("identity", None)
        changed.lanes = self.lanes.with_difference(step)
        return changed

    def positions(self, points: Points) -> tuple[Series, np.ndarray]:
        """Marker coordinates [m] of every recording, and True where all its rollouts ended well."""
        points = np.atleast_2d(points)
        theta, lane = self._lanes_of(points)
        position, status = self.lanes.roll(theta, self.commands, lane, self.deadline.check)
        self.rollouts += len(lane)
        fine = (status == Result.OK) & np.isfinite(position).all(axis=(1, 2))
        return position.reshape(len(points), self.count, *position.shape[1:]), fine.reshape(len(points), -1).all(axis=1)

    def position(self, point: Float[np.ndarray, " d"]) -> Series:
        """Marker coordinates at one point.

        Raises:
            InputError: a rollout there did not end well.
        """
        position, fine = self.positions(point[None])
        if not fine[0]:
            raise InputError("a rollout at the optimum did not end well", where="audit", remedy=Result.DIVERGED.remedy)
        return position[0]

    def tension(self, point: Float[np.ndarray, " d"]) -> Float[np.ndarray, "recording time cable"]:
        """Cable tensions at one point [N]."""
        theta, lane = self._lanes_of(point[None])
        return self.lanes.tension(theta, self.commands, lane)

    def derivatives(self, point: Float[np.ndarray, " d"], directions: Points) -> Series:
        """Derivative of the marker coordinates along each direction; one-sided where a mechanism is so at null."""
        return self.derivatives_at(np.repeat(point[None], len(directions), axis=0), directions)

    def derivatives_at(self, points: Points, directions: Points) -> Series:
        """The same with a point of its own for every direction."""
        if len(points) == 0:
            return np.zeros((0, self.count, self.commands.sample_step.shape[1], 3 * len(self.lanes.marker_index)))
        theta, lane = self._lanes_of(points)
        tangent = self.coordinates.physical_tangents(points, directions, self.slots).reshape(theta.shape)
        found = self.lanes.differentiate(theta, tangent, self.commands, lane, self.deadline.check)
        self.rollouts += self.lanes.slope_rollouts * len(lane)
        return np.nan_to_num(found).reshape(len(points), self.count, *found.shape[1:])

    def _lanes_of(self, points: Points) -> tuple[np.ndarray, np.ndarray]:
        theta = self.coordinates.physical_values(points, self.slots)
        return theta.reshape(-1, theta.shape[-1]), np.tile(np.arange(self.count), len(points))


def _cut(commands: Commands, rows: int | None) -> Commands:
    """The first observations only, and the steps that lead to them."""
    observed = commands.sample_step[:, :rows]
    last = int(observed.max()) + 1  # an observation may lie between two steps
    return Commands(commands.initial, commands.step[:, :last], observed, commands.sample_fraction[:, :rows])
