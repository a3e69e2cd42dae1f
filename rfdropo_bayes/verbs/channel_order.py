"""Which order of the command columns explains a motion best, from what every channel does by itself."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

GAIN = 1e-3
"""Agreement that another order must gain to be preferred."""
RIDGE = 1e-3
"""Of the regression, as a share of the mean square of a channel: opposed cables move together."""


class Driven(NamedTuple):
    """Markers in one recording about their mean, and the commands in force at the same times about theirs."""

    command: Float[np.ndarray, "row channel"]
    motion: Float[np.ndarray, "row coordinate"]


class Order(NamedTuple):
    """An order of the columns: channel k of the robot takes column ``columns[k]``; and how well it agrees, to 1."""

    columns: tuple[int, ...]
    agreement: float


def best_order(runs: Sequence[Driven], response: Float[np.ndarray, "channel coordinate"]) -> Order:
    """The order of the columns under which the channels' responses agree best with the motion, at any common size.

    An assignment problem proposes orders; exchanges of two columns improve them. Columns that never move stay.

    Args:
        runs: recordings.
        response: what a unit of each channel moves the markers by.
    """
    seen = np.sum([run.command.T @ run.motion for run in runs], axis=0)
    within = np.sum([run.command.T @ run.command for run in runs], axis=0)
    size = float(np.sqrt(np.sum([np.sum(run.motion**2) for run in runs])))
    shares = Shares(seen @ response.T, within, response @ response.T, size)
    channels = len(response)
    ridge = RIDGE * np.trace(within) / channels * np.eye(channels) + 1e-300 * np.eye(channels)
    whitened = np.linalg.solve(within + ridge, shares.together)
    found = Order(tuple(range(channels)), shares.agreement(range(channels)))
    for matrix in (whitened, shares.together):
        column, channel = linear_sum_assignment(matrix, maximize=True)
        proposed = _improved(shares, tuple(int(k) for k in column[np.argsort(channel)]))
        found = proposed if proposed.agreement > found.agreement + GAIN else found
    return _settled(shares, _improved(shares, found.columns))


class Shares(NamedTuple):
    """All that an agreement takes, of columns (rows of the first two) and channels."""

    together: Float[np.ndarray, "column channel"]
    within: Float[np.ndarray, "column column"]
    alike: Float[np.ndarray, "channel channel"]
    size: float

    def agreement(self, columns: Sequence[int]) -> float:
        """Correlation of the motion with the one that this order predicts."""
        order = list(columns)
        square = float(np.sum(self.within[np.ix_(order, order)] * self.alike))
        scale = self.size * np.sqrt(max(square, 0.0))
        return float(np.sum(self.together[order, np.arange(len(order))]) / scale) if scale > 0.0 else 0.0


def _improved(shares: Shares, columns: tuple[int, ...]) -> Order:
    """An order that no exchange of two columns improves."""
    best = Order(columns, shares.agreement(columns))
    while True:
        others = [_exchanged(best.columns, i, j) for i, j in combinations(range(len(columns)), 2)]
        other = max(((shares.agreement(each), each) for each in others), default=(0.0, columns))
        if other[0] <= best.agreement + GAIN:
            return best
        best = Order(other[1], other[0])


def _settled(shares: Shares, found: Order) -> Order:
    """The order with every column in its own place whose place makes no difference, such as one that never moves."""
    for k in range(len(found.columns)):
        other = _exchanged(found.columns, k, found.columns.index(k))
        agreement = shares.agreement(other)
        found = Order(other, agreement) if agreement > found.agreement - GAIN else found
    return found


def _exchanged(columns: tuple[int, ...], i: int, j: int) -> tuple[int, ...]:
    changed = list(columns)
    changed[i], changed[j] = columns[j], columns[i]
    return tuple(changed)
