"""Lanes of a MuJoCo model that continue from their state, each with its own parameters."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from rfdropo_bayes.fem.rollouts import Motion
from rfdropo_bayes.simulators.body_lanes import LaneStart

if TYPE_CHECKING:
    from rfdropo_bayes.simulators.adapters.mujoco_model import MuJoCoRollouts


class MuJoCoLanes:
    """Bodies of a session: see `simulators.body_lanes.BodyLanes`. The material of a lane is its parameters by name.

    Motion equals that in whole rollouts, to the tolerance of MuJoCo's solver if there are constraints, because each
    period restarts the solver.

    Args:
        rollouts: rollouts of the model.
        count: number of lanes.
    """

    def __init__(self, rollouts: MuJoCoRollouts, count: int) -> None:
        self.rollouts = rollouts
        self._models = [copy.copy(rollouts.model) for _ in range(count)]
        self._state = np.tile(rollouts.first[0], (count, 1))
        self._failed = np.ones(count, dtype=bool)
        self._values = np.full((count, len(rollouts.edits)), np.nan)

    def reset(self, rows: Int[np.ndarray, " row"], given: LaneStart) -> Motion:
        self._take_values(rows, np.stack([np.asarray(given.material[name], float) for name in self.rollouts.edits], 1))
        first = np.asarray(given.start, float)
        state, valid = self.rollouts.begun([self._models[row] for row in rows], self._ctrl(first[:, None])[:, 0])
        self._state[rows], self._failed[rows] = state, ~valid
        return self._moved(rows, np.zeros((len(rows), 0, first.shape[1])), first)

    def advance(self, displacement: Float[np.ndarray, "lane step channel"]) -> Motion:
        return self._moved(np.arange(len(self._models)), displacement, displacement[:, -1])

    def save(self) -> Float[np.ndarray, "lane values"]:
        return np.concatenate([self._state, self._failed[:, None], self._values], axis=1)

    def restore(self, rows: Int[np.ndarray, " row"], state: Float[np.ndarray, "row values"]) -> None:
        size = self._state.shape[1]
        self._state[rows], self._failed[rows] = state[:, :size], state[:, size] > 0.0
        self._take_values(rows, state[:, size + 1 :])

    def _take_values(self, rows: np.ndarray, values: Float[np.ndarray, "row parameter"]) -> None:
        """Let the models of lanes have these values, in the order of the model's parameters."""
        self._values[rows] = values
        columns = dict(zip(self.rollouts.edits, values.T, strict=True))
        for model, row in zip(self.rollouts.models(columns, len(rows)), rows, strict=True):
            self._models[row] = copy.copy(model)

    def _ctrl(self, commands: Float[np.ndarray, "row step channel"]) -> Float[np.ndarray, "row step ctrl"]:
        ctrl = np.tile(self.rollouts.first[1], (*commands.shape[:2], 1))
        ctrl[..., list(self.rollouts.channels.values())] = commands
        return ctrl

    def _moved(
        self, rows: np.ndarray, commands: Float[np.ndarray, "row step channel"], last: Float[np.ndarray, "row channel"]
    ) -> Motion:
        """Take a step for each command, and one more under ``last`` that shows the state before it."""
        steps, clock = commands.shape[1], self.rollouts.model.opt.timestep
        ctrl = self._ctrl(np.concatenate([commands, last[:, None]], axis=1))
        begun = self._state[rows, 0]
        states, seen = self.rollouts.rolled([self._models[row] for row in rows], self._state[rows], ctrl)
        if steps:
            self._state[rows] = states[:, -2]
        late = states[:, -1, 0] - begun - (steps + 1) * clock
        self._failed[rows] |= ~((np.abs(late) < 0.5 * clock) & np.isfinite(states[:, -1]).all(axis=1))
        position, tension = self.rollouts.shown(seen)  # the first row: tensions of a new command before any motion
        diverged: Bool[np.ndarray, " row"] = self._failed[rows].copy()
        sound = ~diverged[:, None]
        return Motion(
            np.where(sound[..., None], position[:, -1], 0.0),
            np.where(sound, tension[:, -1], 0.0),
            diverged,
            np.zeros(len(rows)),
            np.ones(len(rows), dtype=bool),
            peak=np.where(sound, tension.max(axis=1), 0.0),
        )
