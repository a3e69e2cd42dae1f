"""The trunk's discrete actions: pull or release one of eight cables by a nominal 5 mm."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.errors import InputError

CABLES = 8
CABLE_NAMES = tuple(f"cable{index}" for index in range(CABLES))
DISPLACEMENT = 5e-3  # [m] per action, nominal
INITIAL = -1  # in the row of the initial state, before the first action
SETTINGS = {"displacement_per_action": DISPLACEMENT, "updates_per_action": 5, "displacement_per_update": 1e-3}


def cumulative_displacement(actions: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 8"]:
    """Commanded displacement [m] of each cable after each action, pull > 0, without any limit.

    Action a moves cable a % 8: pulled if a < 8, released otherwise; the initial action moves none. The model
    distributes the 5 mm over the action and applies the motors' limits.
    """
    change = np.zeros((len(actions), CABLES))
    moved = np.where(actions < CABLES, DISPLACEMENT, -DISPLACEMENT) * (actions != INITIAL)
    change[np.arange(len(actions)), actions % CABLES] = moved
    return change.cumsum(axis=0)


def read_actions(column: Float[np.ndarray, " rows"], where: str) -> Int[np.ndarray, " n"]:
    """Actions of an episode whose first row is the initial state; more such rows may follow before the first action.

    Raises:
        InputError: if the first row is not the initial state, or one after the first action is not an action 0 ... 15.
    """
    if column[0] != INITIAL:
        raise InputError(
            f"the first row has action {column[0]:g}, not {INITIAL} (the initial state)",
            where=f"{where}, row 0, column 'action'",
            remedy="the file must start with the initial state; use rows = [first, last] to leave rows out",
        )
    allowed: Sequence[int] = range(2 * CABLES)
    begun = False
    for row, action in enumerate(column[1:], start=1):
        begun = begun or action != INITIAL
        if begun and action not in allowed:
            raise InputError(
                f"{action:g} is not an action (0 to {2 * CABLES - 1})",
                where=f"{where}, row {row}, column 'action'",
                remedy="correct the cell",
            )
    return column[1:].astype(int)
