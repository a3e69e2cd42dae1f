"""Command sequences that no recording gives: random walks of single channels within limits."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.experiment import CommandsTable


def random_walk(
    table: CommandsTable, channels: int, rng: np.random.Generator
) -> tuple[Float[np.ndarray, " command"], Float[np.ndarray, "command channel"]]:
    """Every ``interval`` one channel, chosen at random, moves by ``step`` up or down, reflected at the limits.

    This is how the paper's data were collected: each action pulls or releases one cable.

    Returns:
        times [s] and cumulative commands [the robot's command unit].

    Raises:
        InputError: a step larger than the range.
    """
    if table.high - table.low < table.step:
        raise InputError(
            f"a step of {table.step:g} does not fit between {table.low:g} and {table.high:g}",
            where="[commands]",
            remedy="widen the limits or shorten the step",
        )
    count = int(np.floor(table.duration / table.interval + 1e-9))
    level = np.clip(np.zeros(channels), table.low, table.high)
    value = np.empty((count, channels))
    for row in range(count):
        channel = rng.integers(channels)
        move = table.step * rng.choice([-1.0, 1.0])
        if not table.low <= level[channel] + move <= table.high:
            move = -move
        level[channel] += move
        value[row] = level
    return table.interval * np.arange(count), value
