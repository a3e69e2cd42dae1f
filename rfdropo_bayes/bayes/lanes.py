"""A simulator behind compiled programs: rollouts lane by lane, in batches of few sizes."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.batches import in_chunks
from rfdropo_bayes.bayes.channels.object_pose import Placing
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.runtime import available_processors
from rfdropo_bayes.simulators.commands import Commands
from rfdropo_bayes.simulators.protocol import Simulator

# Lanes of one call of an audit: a compilation costs more than the padding of a call, so that there is one size. Calls
# with few different lanes are the most frequent.
WIDTH = 8 * max(available_processors(), 2)
# Step of a derivative to one side, in prior deviations; a larger step is taken to both sides. A delay of .07 s is known
# to 4e-5 s, and a fit with steps of 1e-2 (a millisecond) ends 1.5e-4 s beside it. Rounding of 1e-13 m errs by 1e-9 m a
# deviation, the last iteration of an equilibrium by 1e-6 m.
STEP = 1e-4
COARSE = 0.03  # the same for an engine in single precision, whose rounding is 1e-5 m

Thetas = Float[np.ndarray, "lane physical"]
Fields = dict[str, np.ndarray]
"""Parts of an `Observation` by name, with a leading axis over lanes, or over points and recordings."""


def _no_limit() -> None:
    """No check of the time."""


class Lanes:
    """A simulator behind compiled functions of lanes, each with its own parameters and commands.

    Args:
        simulator: the simulator, mechanisms included.
        marker_index: indices of its measured markers.
        width: lanes per call, with the last call of a batch padded.
        fields: parts of an observation that are data; if the pose of an object is included, its start is an input.
        costly: parameters whose rollouts are slow.
        physical: parameters that lanes are given; all of the simulator's by default. The others are nominal.

    Attributes:
        difference: step of derivatives in prior deviations, see `STEP`.
    """

    def __init__(
        self,
        simulator: Simulator,
        marker_index: np.ndarray,
        fields: Sequence[str] = ("position",),
        costly: Sequence[str] = (),
        physical: Sequence[str] | None = None,
    ) -> None:
        self.simulator = simulator
        self.marker_index = marker_index
        self.width = WIDTH
        self.fields = tuple(fields)
        self.costly = tuple(costly)
        self._size: tuple[int, int] | None = None
        self.difference = COARSE if simulator.description.get("precision") == "float32" else STEP
        self.physical = tuple(spec.name for spec in simulator.parameters) if physical is None else tuple(physical)

    def _observe(
        self, theta: jax.Array, start: jax.Array, commands: Commands, steps: jax.Array
    ) -> tuple[dict[str, jax.Array], jax.Array]:
        values: Any = dict(zip(self.physical, theta, strict=True))
        if "object_pose" in self.fields:
            assert isinstance(self.simulator, Placing)
            values = self.simulator.with_object_at(values, start)
        observation = self.simulator.rollout(values, commands, steps)
        parts = observation._replace(position=observation.position[:, self.marker_index])._asdict()
        lacking = [name for name in self.fields if parts[name] is None]
        if lacking:
            raise InputError(
                f"the simulator does not return its {lacking[0].replace('_', ' ')}",
                where=f"[model] {lacking[0]}",
                remedy="leave it out, or let its rollout return it",
            )
        status = parts.pop("status")
        return {name: part for name, part in parts.items() if part is not None}, status

    @property
    def slope_rollouts(self) -> int:
        """Rollouts per derivative, beside those of the value."""
        return 1 if self.difference <= STEP else 2

    @property
    def later(self) -> float:
        """Time to compile what only rollouts with candidates need, in times that the first program takes."""
        return 0.0

    def with_difference(self, step: float) -> Self:
        """The lanes with another step of differences."""
        changed = copy.copy(self)
        changed.difference = step
        return changed

    @cached_property
    def _rolled(self) -> Any:
        return jax.jit(jax.vmap(self._observe, in_axes=(0, 0, 0, None)))

    def roll(
        self,
        theta: Thetas,
        start: np.ndarray | None,
        commands: Commands,
        check: Callable[[], None] = _no_limit,
        steps: int | None = None,
        width: int | None = None,
    ) -> tuple[Fields, np.ndarray]:
        """Observations of each parameter set under the commands of its lane, and result codes.

        ``start`` (lane, 7) are initial poses of an object. ``check`` is called before every batch, and may raise. After
        ``steps`` time steps, all by default, rows are meaningless. ``width`` are the lanes of a call, if others.
        """
        limit, rows = jnp.asarray(commands.step.shape[1] if steps is None else steps), commands.sample_step.shape[1]
        lanes = (theta, start, self._as_long(commands))
        parts, status = in_chunks(lambda own: self._rolled(*own, limit), lanes, (width or self.width,), before=check)
        return {name: part[:, :rows] for name, part in parts.items()}, status

    def _as_long(self, commands: Commands) -> Commands:
        """Commands with steps and rows that are not computed, as many as in the first call: of shorter recordings, the
        program is not compiled again.
        """
        given = commands.step.shape[1], commands.sample_step.shape[1]
        self._size = self._size or given
        steps, rows = (most - own for most, own in zip(self._size, given, strict=True))
        if commands.signals is not None or min(steps, rows) < 0 or steps == rows == 0:
            return commands
        longer: dict[str, Any] = {
            "step": np.pad(commands.step, [(0, 0), (0, steps), (0, 0)], mode="edge"),
            "sample_step": np.pad(commands.sample_step, [(0, 0), (0, rows)], constant_values=self._size[0]),
            "sample_fraction": np.pad(commands.sample_fraction, [(0, 0), (0, rows)]),
        }
        return commands._replace(**longer)


def lanes_of(simulator: Simulator, marker_index: np.ndarray, physical: tuple[str, ...]) -> Lanes:
    """Lanes of a simulator, given some of its parameters: all models of the simulator share one program, for example
    with other priors or recordings.
    """
    for lanes in _RECENT:
        own = lanes.simulator is simulator and lanes.physical == physical
        if own and np.array_equal(lanes.marker_index, marker_index):
            return lanes
    _RECENT.append(Lanes(simulator, marker_index, physical=physical))
    return _RECENT[-1]


_RECENT: deque[Lanes] = deque(maxlen=8)


class RoutedLanes(Lanes):
    """Two compiled simulators of one model: a fast simulator, and another for rollouts with candidates that the fast
    simulator lacks.

    Args:
        fast: lanes of the simulator without these candidates.
        slow: lanes of the simulator with all.
        null: physical values at which the further candidates do nothing.
    """

    def __init__(self, fast: Lanes, slow: Lanes, null: Mapping[str, float]) -> None:
        super().__init__(slow.simulator, slow.marker_index, slow.fields, slow.costly)
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
        start: np.ndarray | None,
        commands: Commands,
        check: Callable[[], None] = _no_limit,
        steps: int | None = None,
        width: int | None = None,
    ) -> tuple[Fields, np.ndarray]:
        slow = self._needs_slow(theta)
        routes: list[tuple[np.ndarray, Lanes, Any]] = [(~slow, self.fast, self._kept), (slow, self.slow, slice(None))]
        order, results = np.concatenate([np.flatnonzero(mask) for mask, _, _ in routes]), []
        for mask, lanes, kept in routes:
            if mask.any():
                chosen = np.flatnonzero(mask)
                own = None if start is None else start[chosen]
                results.append(lanes.roll(theta[chosen][:, kept], own, commands.of(chosen), check, steps, width))
        return jax.tree.map(lambda *parts: np.concatenate(parts)[np.argsort(order)], *results)
