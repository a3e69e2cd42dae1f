"""Rollouts and their derivatives in batches of one size, so that few compilations suffice for an audit."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.batches import in_chunks
from rfdropo_bayes.bayes.channels.object_pose import OFFSETS, Placing
from rfdropo_bayes.discrepancy.coordinates import Coordinates
from rfdropo_bayes.discrepancy.deadline import Deadline
from rfdropo_bayes.discrepancy.journal import digest
from rfdropo_bayes.errors import InputError, NoLikelihoodError
from rfdropo_bayes.runtime import available_processors
from rfdropo_bayes.simulators.callbacks import distinct
from rfdropo_bayes.simulators.commands import Commands
from rfdropo_bayes.simulators.protocol import Result, Simulator

# Lanes of one call: a compilation costs more than the padding of a call, so that there is one size. Calls with few
# different lanes are the most frequent.
WIDTH = 8 * max(available_processors(), 2)
KEPT = 64  # points, at most, of which the last observations are kept
# Step of a derivative of a compiled engine in prior deviations, one-sided; a larger step is taken to both sides. The
# rounding of 1e-13 m then errs by 1e-9 m a deviation, the last iteration of an equilibrium by 1e-6 m.
STEP = 1e-4
COARSE = 0.03  # the same for an engine in single precision, whose rounding is 1e-5 m

Thetas = Float[np.ndarray, "lane physical"]
Points = Float[np.ndarray, "n d"]
Fields = dict[str, np.ndarray]
"""Parts of an `Observation` by name, with a leading axis over lanes, or over points and recordings."""


def _no_limit() -> None:
    """No check of the time."""


class Lanes:
    """A simulator behind compiled functions of a fixed number of lanes.

    Args:
        simulator: simulator with the base model's mechanisms and every candidate at its null value.
        marker_index: indices of its measured markers.
        width: lanes per call, with the last call of a batch padded.
        fields: parts of an observation that are data; if the pose of an object is included, its start is an input.
        costly: parameters of which rollouts take longer than others.

    Attributes:
        difference: step of derivatives in prior deviations, see `STEP`; None if derivatives are exact.
    """

    def __init__(
        self,
        simulator: Simulator,
        marker_index: np.ndarray,
        width: int = WIDTH,
        fields: Sequence[str] = ("position",),
        costly: Sequence[str] = (),
    ) -> None:
        self.simulator = simulator
        self.marker_index = marker_index
        backend = getattr(getattr(simulator, "engine", None), "backend", None)
        self.width = width
        self.fields = tuple(fields)
        self.costly = tuple(costly)
        self._size: tuple[int, int] | None = None
        self.difference: float | None = None
        if backend is not None and backend.name == "numba":
            self.difference = STEP if backend.precision == "float64" else COARSE
        self.physical = tuple(spec.name for spec in simulator.parameters)

    def _observe(
        self, theta: jax.Array, start: jax.Array, commands: Commands, steps: jax.Array
    ) -> tuple[dict[str, jax.Array], jax.Array]:
        values: Any = dict(zip(self.physical, theta, strict=True))
        if "object_pose" in self.fields:
            assert isinstance(self.simulator, Placing)
            values = self.simulator.with_object_at(values, start)
        observation = self.simulator.rollout(values, commands, steps)
        found = observation._replace(position=observation.position[:, self.marker_index])._asdict()
        lacking = [name for name in self.fields if found[name] is None]
        if lacking:
            raise InputError(
                f"the simulator does not tell its {lacking[0].replace('_', ' ')}",
                where=f"[model] {lacking[0]}",
                remedy="leave it out, or let its rollout return it",
            )
        status = found.pop("status")
        return {name: part for name, part in found.items() if part is not None}, status

    @property
    def slope_rollouts(self) -> int:
        """Rollouts per derivative, beside those of the value."""
        if self.difference is None:
            return 3
        return 1 if self.difference <= STEP else 2

    @property
    def later(self) -> float:
        """Time to compile what only rollouts with candidates need, in times that the first program takes."""
        return 0.0

    def with_difference(self, step: float) -> Self:
        """The same with differences over another step."""
        changed = copy.copy(self)
        changed.difference = step
        return changed

    @cached_property
    def _rolled(self) -> Any:
        return jax.jit(jax.vmap(self._observe, in_axes=(0, 0, 0, None)))

    @cached_property
    def _derived(self) -> Any:
        def one(theta: jax.Array, tangent: jax.Array, start: jax.Array, commands: Commands) -> dict[str, jax.Array]:
            def data(theta: jax.Array) -> dict[str, jax.Array]:
                found, _ = self._observe(theta, start, commands, jnp.asarray(commands.step.shape[0]))
                return {name: found[name] for name in self.fields}

            return jax.jvp(data, (theta,), (tangent,))[1]

        return jax.jit(jax.vmap(one))

    def roll(
        self,
        theta: Thetas,
        start: np.ndarray,
        commands: Commands,
        check: Callable[[], None] = _no_limit,
        steps: int | None = None,
    ) -> tuple[Fields, np.ndarray]:
        """Observations of each parameter set under the commands of its lane, and result codes.

        ``start`` (lane, 7) are initial poses of an object. ``check`` is called before every batch, and may raise. After
        ``steps`` time steps, all by default, rows are meaningless.
        """
        limit, rows = jnp.asarray(commands.step.shape[1] if steps is None else steps), commands.sample_step.shape[1]
        lanes = (theta, start, self._as_long(commands))
        found, status = in_chunks(lambda own: self._rolled(*own, limit), lanes, (self.width,), before=check)
        return {name: part[:, :rows] for name, part in found.items()}, status

    def _as_long(self, commands: Commands) -> Commands:
        """Commands with steps and rows that are not computed, as many as in the first call: of shorter recordings, the
        program is not compiled again.
        """
        given = commands.step.shape[1], commands.sample_step.shape[1]
        self._size = self._size or given
        steps, rows = (most - own for most, own in zip(self._size, given, strict=True))
        if commands.signals is not None or min(steps, rows) < 0 or steps == rows == 0:
            return commands
        return commands._replace(
            step=np.pad(commands.step, [(0, 0), (0, steps), (0, 0)], mode="edge"),
            sample_step=np.pad(commands.sample_step, [(0, 0), (0, rows)], constant_values=self._size[0]),
            sample_fraction=np.pad(commands.sample_fraction, [(0, 0), (0, rows)]),
        )

    def differentiate(
        self,
        theta: Thetas,
        tangent: Thetas,
        start: np.ndarray,
        commands: Commands,
        check: Callable[[], None] = _no_limit,
    ) -> Fields:
        """Derivatives along tangents of the parts of an observation that are data."""
        lanes = (theta, tangent, start, commands)
        return in_chunks(lambda own: self._derived(*own), lanes, (self.width,), before=check)


class RoutedLanes(Lanes):
    """Two compiled simulators of one model: a fast one for all that it can do, another for rollouts with further
    candidates.

    Args:
        fast: lanes of the simulator without these candidates.
        slow: lanes of the simulator with all.
        null: physical values at which the further candidates do nothing.
    """

    def __init__(self, fast: Lanes, slow: Lanes, null: Mapping[str, float]) -> None:
        super().__init__(slow.simulator, slow.marker_index, slow.width, slow.fields, slow.costly)
        self.fast, self.slow = fast, slow
        self._kept = np.array([self.physical.index(name) for name in fast.physical])
        self._further = np.setdiff1d(np.arange(len(self.physical)), self._kept)
        self._null = np.array([null[self.physical[i]] for i in self._further])

    @property
    def later(self) -> float:
        """See `Lanes.later`: a program takes time as its mechanisms do, counted by their parameters."""
        return len(self.slow.physical) / len(self.fast.physical) * (1.0 + self.slow.later)

    def _needs_slow(self, theta: np.ndarray) -> np.ndarray:
        return ~np.isclose(theta[:, self._further], self._null, rtol=1e-6, atol=1e-12).all(axis=1)

    def roll(
        self,
        theta: Thetas,
        start: np.ndarray,
        commands: Commands,
        check: Callable[[], None] = _no_limit,
        steps: int | None = None,
    ) -> tuple[Fields, np.ndarray]:
        """See `Lanes.roll`."""
        slow = self._needs_slow(theta)
        routes: list[tuple[np.ndarray, Lanes, Any]] = [(~slow, self.fast, self._kept), (slow, self.slow, slice(None))]
        order, found = np.concatenate([np.flatnonzero(mask) for mask, _, _ in routes]), []
        for mask, lanes, kept in routes:
            if mask.any():
                chosen = np.flatnonzero(mask)
                found.append(lanes.roll(theta[chosen][:, kept], start[chosen], commands.of(chosen), check, steps))
        return jax.tree.map(lambda *parts: np.concatenate(parts)[np.argsort(order)], *found)


class Forward:
    """Predicted observations of a set of recordings, as a function of the audit's coordinates.

    Args:
        lanes: the simulator.
        coordinates: map from points to parameters.
        commands: stacked commands of the recordings.
        chosen: names of the simulated recordings.
        rows: number of observations of each; all by default.
        deadline: deadline of the rollouts; none by default.
        start: initial poses (recording, 7) of an object, if its poses are data.
    """

    def __init__(
        self,
        lanes: Lanes,
        coordinates: Coordinates,
        commands: Commands,
        chosen: Mapping[str, int],
        rows: int | None = None,
        deadline: Deadline | None = None,
        start: Float[np.ndarray, "recording 7"] | None = None,
    ) -> None:
        self.deadline = deadline or Deadline()
        self.lanes = lanes
        self.coordinates = coordinates
        self.commands = _cut(commands.of(list(chosen.values())), rows)
        self.recordings = tuple(chosen)
        self.slots = coordinates.slots(self.recordings)
        self.count = len(chosen)
        self.start = np.zeros((self.count, 7)) if start is None else start
        self.rollouts = 0
        self.pace = 0.0  # seconds of the last whole rollout, among different rollouts that fill a call
        self.compiling = 0.0  # seconds that rollouts took to compile
        self.forget()

    def forget(self) -> None:
        """Compute again what was observed last: rollouts then do not depend on what was looked up before."""
        self._recent: tuple[dict[bytes, int], Fields, np.ndarray] = ({}, {}, np.zeros(0))

    @cached_property
    def identity(self) -> str:
        """Digest of the simulator, its parameters with their priors, and the commands."""
        own, simulator = self.coordinates, self.lanes.simulator
        held = sorted(own.space.fixed.items()), sorted(own.nominal.items())
        named = (simulator.description, own.names, own.base, *held)
        scale = own.values(np.stack([np.zeros(len(own.names)), np.ones(len(own.names))]))
        prior = (own.prior_mean, own.prior_sd, *own.bounds)
        return digest(
            repr(named),
            self.lanes.difference,
            self.lanes.marker_index,
            scale,
            self.slots,
            self.start,
            self.lanes.fields,
            *prior,
            *map(np.asarray, self.commands[:4]),
        )

    def with_difference(self, step: float) -> Forward:
        """The same with derivatives over another step."""
        return self._with(lanes=self.lanes.with_difference(step))

    def with_coordinates(self, coordinates: Coordinates) -> Forward:
        """The same in other coordinates of the same parameters."""
        return self._with(coordinates=coordinates)

    def _with(self, **parts: Any) -> Forward:
        changed = copy.copy(self)
        changed.__dict__.pop("identity", None)
        changed.__dict__.update(parts)
        changed.forget()
        return changed

    def observe(self, points: Points, rows: int | None = None) -> tuple[Fields, np.ndarray]:
        """Observations of every recording at each point (point, recording, ...), and whether all rollouts succeeded.

        Only the first ``rows`` rows, all by default, are simulated; later rows are meaningless.

        The fields also have ``offset`` [m], the shift of measured against simulated positions, and parameters of
        channels that rollouts do not use.
        """
        points = np.atleast_2d(points)
        places, seen, fine = self._recent
        if all(point.tobytes() in places for point in points):  # an optimisation asks for a value after its slopes
            index = [places[point.tobytes()] for point in points]
            return {name: part[index] for name, part in seen.items()}, fine[index]
        theta = self.coordinates.physical_values(points, self.slots)
        flat, start, commands = self._per_lane(theta, points)
        beside = np.repeat(self._beside(points), self.count, axis=0)
        once, again = distinct([np.tile(np.arange(self.count), len(theta)), flat, beside])
        began = time.monotonic()
        every = self.commands.step.shape[1]
        steps = None if rows is None else min(int(self.commands.sample_step[:, :rows].max()) + 1, every)
        found, status = self.lanes.roll(flat[once], start[once], commands.of(once), self.deadline.check, steps)
        # A call that is not full is filled with copies, which cost one engine nothing and the other as much as ever.
        if steps is None and len(status) >= self.lanes.width:
            self.pace = (time.monotonic() - began) / (-(-len(status) // self.lanes.width) * self.lanes.width)
        self.rollouts += len(status)
        status, found = status[again], {name: part[again] for name, part in found.items()}
        found = self._as_seen(found, theta, points)
        fine = status == Result.OK
        for name in self.lanes.fields:
            fine &= np.isfinite(found[name][:, :rows]).reshape(len(fine), -1).all(axis=1)
        shown = {name: part.reshape(len(points), self.count, *part.shape[1:]) for name, part in found.items()}
        shown |= {"offset": self._offset(theta), **self.coordinates.gains(points)}
        fine = fine.reshape(len(points), -1).all(axis=1)
        if rows is None and len(points) <= KEPT:
            self._recent = {point.tobytes(): i for i, point in enumerate(points)}, shown, fine
        return shown, fine

    def observe_one(self, point: Float[np.ndarray, " d"]) -> Fields:
        """Observations of every recording at one point.

        Raises:
            NoLikelihoodError: a rollout failed.
        """
        found, fine = self.observe(point[None])
        if not fine[0]:
            words = "a rollout at the optimum failed"
            raise NoLikelihoodError(words, where="audit", remedy=Result.DIVERGED.remedy)
        return {name: part[0] for name, part in found.items()}

    def tangents(self, points: Points, directions: Points) -> Fields:
        """Derivatives of `observe` for data fields along a direction at each point; one-sided for one-sided mechanisms
        at null.
        """
        tangent = self.coordinates.physical_tangents(points, directions, self.slots)
        step = self._difference
        found = self._exact(points, tangent) if step is None else self._differences(points, directions, step)
        return found | {"offset": self._offset(tangent), **self.coordinates.gain_tangents(points, directions)}

    @property
    def _difference(self) -> float | None:
        """See `Lanes.difference`."""
        return self.lanes.difference

    def _exact(self, points: Points, tangent: np.ndarray) -> Fields:
        """Derivatives by JAX."""
        flat, start, commands = self._per_lane(self.coordinates.physical_values(points, self.slots), points)
        along = tangent.reshape(flat.shape)
        # Recordings that a direction does not affect, such as another group's, are unchanged.
        moved = np.flatnonzero(along.any(axis=1))
        moved = moved if len(moved) else np.arange(1)
        found = self.lanes.differentiate(
            flat[moved], along[moved], start[moved], commands.of(moved), self.deadline.check
        )
        self.rollouts += self.lanes.slope_rollouts * len(moved)
        shown = {}
        for name, part in found.items():
            every = np.zeros((len(flat), *part.shape[1:]))
            every[moved] = np.nan_to_num(part)
            shown[name] = every.reshape(len(points), self.count, *part.shape[1:])
        return shown

    def _differences(self, points: Points, directions: Points, step: float) -> Fields:
        """Differences over a step in prior deviations: to one side if it is small, and at bounds; zero if a rollout
        fails.
        """
        low, high = self.coordinates.bounds
        size = step / np.maximum(np.abs(directions / self.coordinates.prior_sd).max(axis=1), np.finfo(float).tiny)
        move = size[:, None] * directions
        ahead, behind = (((x >= low) & (x <= high)).all(axis=1) for x in (points + move, points - move))
        behind &= ~ahead | (step > STEP)
        ends = np.concatenate([points - behind[:, None] * move, points + ahead[:, None] * move])
        seen, fine = self.observe(ends)
        usable = fine.reshape(2, -1).all(axis=0) & (ahead | behind)
        share = np.where(usable, 1.0 / (np.maximum(ahead.astype(float) + behind, 1.0) * size), 0.0)
        shown = {}
        for name in self.lanes.fields:
            before, after = np.split(seen[name], 2)
            shown[name] = np.nan_to_num(after - before) * share.reshape(-1, *[1] * (before.ndim - 1))
        return shown

    def _offset(self, theta: np.ndarray) -> np.ndarray:
        found = np.zeros((*theta.shape[:2], 3))
        for axis, name in enumerate(OFFSETS):
            if name in self.lanes.physical:
                found[..., axis] = theta[..., self.lanes.physical.index(name)]
        return found

    def _beside(self, points: Points) -> Float[np.ndarray, "n k"]:
        """Further inputs of a rollout beside the simulator's parameters."""
        return np.zeros((len(points), 0))

    def _as_seen(self, found: Fields, theta: np.ndarray, points: Points) -> Fields:
        """Measured fields from the observations of rollouts, one row per lane."""
        return found

    def _per_lane(self, theta: np.ndarray, points: Points) -> tuple[np.ndarray, np.ndarray, Commands]:
        """Parameters (point, recording, physical), starts and commands of each lane."""
        lane = np.tile(np.arange(self.count), len(theta))
        return theta.reshape(-1, theta.shape[-1]), self.start[lane], self.commands.of(lane)


def _cut(commands: Commands, rows: int | None) -> Commands:
    """The first observations only, and the steps that lead to them."""
    observed = commands.sample_step[:, :rows]
    last = int(observed.max()) + 1  # an observation may lie between two steps
    return Commands(commands.initial, commands.step[:, :last], observed, commands.sample_fraction[:, :rows])
