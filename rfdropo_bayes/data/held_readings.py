"""Readings that a slower loop repeats until it has a new one (a zero-order hold): which of them are new."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

HELD = 1.5  # samples: readings that last longer are held


def hold_time(time: Float[np.ndarray, " time"], reading: Float[np.ndarray, "time channel"]) -> float:
    """For how long a reading is repeated, the median over the recording [s]; 0 where there are too few changes."""
    changes = np.flatnonzero(_changed(reading))
    return float(np.median(np.diff(time[changes]))) if changes.size > 2 else 0.0


def new_readings(
    time: Float[np.ndarray, " time"], reading: Float[np.ndarray, "time channel"], hold: float
) -> Bool[np.ndarray, "time channel"]:
    """True where a reading was made since the row before.

    All are new unless they are held for longer than the sample time. Of held ones the new show themselves by a change
    of any channel, because all are read together; when the first row was read is not known. A new reading that equals
    the last in every channel goes unnoticed, which loses only what a drive at rest would have repeated.
    """
    if hold <= HELD * float(np.median(np.diff(time))):
        return np.ones(reading.shape, dtype=bool)
    return np.broadcast_to(_changed(reading)[:, None], reading.shape).copy()


def _changed(reading: Float[np.ndarray, "time channel"]) -> Bool[np.ndarray, " time"]:
    return np.concatenate([[False], (np.diff(reading, axis=0) != 0.0).any(axis=1)])
