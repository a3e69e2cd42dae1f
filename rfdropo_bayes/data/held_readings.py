"""Readings of sensors: missing readings, and readings that a slower loop repeats (a zero-order hold)."""

from __future__ import annotations

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from rfdropo_bayes.data.sample_times import evenly_spaced, sample_time

HELD = 1.5  # samples: readings that last longer are held


def present_readings(reading: np.ndarray | None) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Readings with NaN replaced by the last (or else the next) reading, and a mask of measured readings.

    The mask is None if nothing is missing.
    """
    values = None if reading is None else np.array(reading, dtype=float)
    if values is None or values.ndim != 2 or np.isfinite(values).all():
        return reading, None
    present = np.isfinite(values)
    filled = pd.DataFrame(np.where(present, values, np.nan)).ffill().bfill().fillna(0.0)
    return filled.to_numpy(), present


def hold_time(time: Float[np.ndarray, " time"], reading: Float[np.ndarray, "time channel"]) -> float:
    """Median time for which a reading is repeated [s]; 0 if there are too few changes."""
    changes = np.flatnonzero(_changed(np.asarray(present_readings(reading)[0])))
    return float(np.median(np.diff(evenly_spaced(time)[changes]))) if changes.size > 2 else 0.0


def new_readings(
    time: Float[np.ndarray, " time"], reading: Float[np.ndarray, "time channel"], hold: float
) -> Bool[np.ndarray, "time channel"]:
    """Mask of readings that were made since the previous row.

    All readings are new unless they last for longer than the sample time. A change of any channel marks a new held
    reading, because all channels are read together. The first row counts as held. A new reading that equals the last in
    every channel goes unnoticed, which loses only repeated readings of a drive at rest.
    """
    if hold <= HELD * sample_time(time):
        return np.ones(reading.shape, dtype=bool)
    return np.broadcast_to(_changed(reading)[:, None], reading.shape).copy()


def _changed(reading: Float[np.ndarray, "time channel"]) -> Bool[np.ndarray, " time"]:
    return np.concatenate([[False], (np.diff(reading, axis=0) != 0.0).any(axis=1)])
