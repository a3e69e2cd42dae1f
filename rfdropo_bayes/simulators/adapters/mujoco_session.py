"""Sessions of a MuJoCo model: many lanes that go on from one control period to the next, each with own parameters."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.protocol import Observation, Result

if TYPE_CHECKING:
    from rfdropo_bayes.simulators.adapters.mujoco_model import MuJoCoRollouts

WHOLE = 1e-6
"""How far a control period may be from a whole number of time steps, in time steps."""


class MuJoCoSession:
    """Lanes of one model that are commanded one control period at a time.

    Motion is that of whole rollouts, to the tolerance of MuJoCo's solver where it has constraints: each period begins
    its first solve anew.

    Args:
        rollouts: of the model.
        lanes: how many.
        period: control period [s], a whole number of time steps.

    Raises:
        InputError: a period that is none.
    """

    def __init__(self, rollouts: MuJoCoRollouts, lanes: int, period: float) -> None:
        step = float(rollouts.model.opt.timestep)
        self.rollouts, self.lanes, self.period, self.steps = rollouts, lanes, float(period), round(period / step)
        if self.steps < 1 or abs(self.steps - period / step) > WHOLE:
            raise InputError(
                f"a control period of {period:g} s is no whole number of time steps",
                remedy=f"give a multiple of {step:g} s",
            )
        self._models = [copy.copy(rollouts.model) for _ in range(lanes)]
        self._state = np.tile(rollouts.first[0], (lanes, 1))
        self._periods = np.zeros(lanes, dtype=int)
        self._failed = np.ones(lanes, dtype=bool)

    @property
    def time(self) -> Float[np.ndarray, " lane"]:
        """Since every lane was started [s]."""
        return self.period * self._periods

    def reset(
        self,
        rows: Int[np.ndarray, " row"],
        parameters: Mapping[str, Float[np.ndarray, " row"] | float],
        *,
        command: Float[np.ndarray, "row channel"] | None = None,
    ) -> Observation:
        """Start some lanes anew; the others stay where they are.

        Args:
            rows: lanes.
            parameters: values by name, one per row or one for all of them; those left out are nominal.
            command: in force before the start; zero by default.

        Returns:
            The first observation of these rows, without an axis of time.

        Raises:
            InputError: no such lane or parameter.
        """
        rows = np.atleast_1d(np.asarray(rows, dtype=np.intp))
        if rows.size == 0 or rows.min() < 0 or rows.max() >= self.lanes:
            raise InputError(f"rows {rows.tolist()} of {self.lanes} lanes", where="reset", remedy="name known lanes")
        unknown = sorted(set(parameters) - set(self.rollouts.edits))
        if unknown:
            raise InputError(f"unknown parameter {unknown[0]!r}", where="reset", remedy="see the model's parameters")
        values = {name: np.broadcast_to(np.asarray(given, float), rows.shape) for name, given in parameters.items()}
        for model, row in zip(self.rollouts.models(values, len(rows)), rows, strict=True):
            self._models[row] = copy.copy(model)
        first = np.zeros((len(rows), len(self.rollouts.channels))) if command is None else np.asarray(command, float)
        state, found = self.rollouts.begun([self._models[row] for row in rows], self._ctrl(first))
        self._state[rows], self._failed[rows], self._periods[rows] = state, ~found, 0
        return self._advanced(rows, first, 0)

    def act(self, commands: Float[np.ndarray, "lane channel"]) -> Observation:
        """Let all lanes run for one control period, under commands that hold for it.

        Returns:
            What is seen at its end, without an axis of time; the status of a lane that diverged stays so until it is
            started anew.
        """
        self._periods += 1
        return self._advanced(np.arange(self.lanes), np.asarray(commands, float), self.steps)

    def save(self) -> dict[str, np.ndarray]:
        """State of all lanes, one row a lane; their parameters stay with the session."""
        return {"state": self._state.copy(), "periods": self._periods.copy(), "failed": self._failed.copy()}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from what `save` gave."""
        self._state, self._periods = np.array(state["state"]), np.array(state["periods"])
        self._failed = np.array(state["failed"])

    def _ctrl(self, commands: Float[np.ndarray, "row channel"]) -> Float[np.ndarray, "row ctrl"]:
        ctrl = np.tile(self.rollouts.first[1], (len(commands), 1))
        ctrl[:, list(self.rollouts.channels.values())] = commands
        return ctrl

    def _advanced(self, rows: np.ndarray, commands: np.ndarray, steps: int) -> Observation:
        """Run some lanes for so many steps, and one more that shows the state before it."""
        ctrl = np.repeat(self._ctrl(commands)[:, None], steps + 1, axis=1)
        begun = self._state[rows, 0]
        states, seen = self.rollouts.rolled([self._models[row] for row in rows], self._state[rows], ctrl)
        if steps:
            self._state[rows] = states[:, -2]
        late = states[:, -1, 0] - begun - (steps + 1) * self.rollouts.model.opt.timestep
        arrived = (np.abs(late) < 0.5 * self.rollouts.model.opt.timestep) & np.isfinite(states[:, -1]).all(axis=1)
        self._failed[rows] |= ~arrived
        position, tension = self.rollouts.shown(seen[:, -1:])
        status = np.where(self._failed[rows], int(Result.DIVERGED), int(Result.OK))
        parts: Any = position[:, 0], tension[:, 0], None, status
        return Observation(*parts)
