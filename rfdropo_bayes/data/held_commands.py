"""Commands that are readings of a sensor, such as a load cell, while poses are held: one value for each pose.

The noise of such readings would act on a simulated robot as commands: reversals of a few millinewtons pass for play. It
is seen if the readings change little in most rows, much between poses, and nowhere drift while a pose is held.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

UNUSUAL = 10.0  # times the median change from row to row: 6.7 standard deviations of the change
FEWEST_POSES, FEWEST_ROWS = 3, 4
MOST = 0.5  # share of the rows that poses without a drift have, beside rows between poses


def averaged_while_held(
    command: Float[np.ndarray, "row channel"], unit: str
) -> tuple[Float[np.ndarray, "row channel"], list[str]]:
    """Commands with their mean over each held pose, and a note on it; the same commands without noise or held poses.

    Args:
        command: commands of the rows.
        unit: their unit, for the note.
    """
    change = np.abs(np.diff(command, axis=0))
    noise = np.median(change, axis=0) if len(change) else np.zeros(command.shape[1])
    if not np.isfinite(command).all() or not noise.any():
        return command, []
    poses = np.split(np.arange(len(command)), 1 + np.flatnonzero((change > UNUSUAL * noise).any(axis=1)))
    held = [rows for rows in poses if len(rows) >= FEWEST_ROWS and not _drifts(command[rows], noise)]
    if len(held) < FEWEST_POSES or sum(map(len, held)) < MOST * len(command):
        return command, []
    mean = command.copy()
    for rows in held:
        mean[rows] = command[rows].mean(axis=0)
    spread = float(np.sqrt(np.mean((command - mean) ** 2)))
    words = f"commands are readings with a noise of {spread:.2g} {unit}: each of {len(held)} held poses has their mean"
    return mean, [words]


def _drifts(command: Float[np.ndarray, "row channel"], noise: Float[np.ndarray, " channel"]) -> bool:
    """Whether the halves of a pose differ by more than the noise of their means."""
    half = len(command) // 2
    apart = np.abs(command[:half].mean(axis=0) - command[-half:].mean(axis=0))
    return bool(np.any(apart > UNUSUAL * noise / np.sqrt(half)))
