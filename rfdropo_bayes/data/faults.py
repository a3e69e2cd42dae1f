"""Faults of a motion-capture recording: found and masked, never fitted.

Three kinds, each by what it looks like in the numbers:

- *missing*: a position that is NaN (a marker was lost).
- *held*: the tracker repeated its last pose. Real measurements carry noise in their last digits, so a position equal to
  the one before it in all three coordinates is no new measurement. The first row of a held run counts as measured.
- *jump*: the tracker fitted the wrong rigid body for a row or a short run of rows, and then came back; two markers
  that swap for a row jump both. A jump is a step that differs from the neighbouring ones by more than
  ``tolerance + max_acceleration * dt**2``. What is kept of each marker is its longest smooth path: the largest set of
  rows in which every row can be reached from the one kept before it. Leaving out more rows than ``longest_run`` is
  never worth it, so a lasting change of level (a moved frame, an impact) is kept and counted among the *breaks*.

At low sampling rates ``max_acceleration * dt**2`` exceeds any motion: jumps cannot be told from it, nothing is masked.
"""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

TOLERANCE = 1.5e-3  # [m]
MAX_ACCELERATION = 20.0  # [m/s2]: about 2 g, in excess of what the neighbouring rows show
LONGEST_RUN = 0.25  # [s]
_VELOCITY_ROWS = 5
_DRIFT_PER_ROW = 0.02  # share of the tolerance by which a smooth path may drift from the predicted one per row
_ONSET_ROWS = 3  # over this few rows a motion may start or stop at once
_FEW = 5.0  # quanta


class Faults(NamedTuple):
    """What is wrong with a recording.

    ``mask(time, marker)`` is True where the position may be used. ``counts`` maps each kind to its number of
    positions per marker, and ``breaks`` to the number of lasting changes of level.
    """

    mask: Bool[np.ndarray, "time marker"]
    counts: dict[str, list[int]]


def find_faults(
    time: Float[np.ndarray, " time"],
    position: Float[np.ndarray, "time marker 3"],
    *,
    tolerance: float = TOLERANCE,
    max_acceleration: float = MAX_ACCELERATION,
    longest_run: float = LONGEST_RUN,
) -> Faults:
    """Mask missing, held and jumping positions of a measured recording (not meant for simulated ones).

    Args:
        time: times of the rows [s], increasing.
        position: marker positions [m]; NaN where a marker was lost.
        tolerance: distance that is no fault at any rate [m].
        max_acceleration: largest acceleration a marker can have [m/s2].
        longest_run: longest run of wrong positions that can be told from a lasting change [s].
    """
    missing = np.isnan(position).any(axis=2)
    held = find_held(np.where(missing[..., None], 0.0, position)) & ~missing
    jumping = np.zeros_like(missing)
    breaks = []
    for marker in range(position.shape[1]):
        rows = np.flatnonzero(~(missing | held)[:, marker])
        wrong, level_changes = _off_path(time[rows], position[rows, marker], tolerance, max_acceleration, longest_run)
        jumping[rows[wrong], marker] = True
        # a repeat of a wrong pose is as wrong as the pose; it is counted as held
        breaks.append(level_changes)
    counts = {
        "missing": missing.sum(axis=0).tolist(),
        "held": held.sum(axis=0).tolist(),
        "jump": jumping.sum(axis=0).tolist(),
        "breaks": breaks,
    }
    return Faults(~(missing | held | jumping), counts)


def find_held(position: Float[np.ndarray, "time marker 3"]) -> Bool[np.ndarray, "time marker"]:
    """True where a marker's position repeats the row before and that cannot be rest.

    Not held: markers that never move, signals so coarsely rounded that repeats are natural, and rows in which the whole
    body repeats when that is common (the rest of a noise-free recording).
    """
    step = np.abs(np.diff(position, axis=0))
    repeats = (step == 0.0).all(axis=2)
    still = repeats.all(axis=1)
    held = np.zeros(position.shape[:2], dtype=bool)
    for marker in range(position.shape[1]):
        changes = step[:, marker][step[:, marker] > 0.0]
        if changes.size == 0 or _rounded(changes) or repeats[:, marker].mean() > 0.5:
            continue
        held[1:, marker] = repeats[:, marker] & (~still | (still.mean() < 0.05))
    return held


def _rounded(changes: Float[np.ndarray, " n"]) -> bool:
    """Whether a signal is rounded so coarsely that it repeats by itself: its changes are a few times one quantum."""
    quanta = changes / changes.min()
    return bool(np.quantile(quanta, 0.01) < _FEW and np.all(np.abs(quanta - np.rint(quanta)) < 0.01))


def fill_missing(
    time: Float[np.ndarray, " time"], position: Float[np.ndarray, "time marker 3"]
) -> Float[np.ndarray, "time marker 3"]:
    """Positions with linear interpolation in place of NaN: placeholders under a False mask."""
    filled = np.array(position)
    for marker in range(filled.shape[1]):
        good = np.isfinite(filled[:, marker]).all(axis=1)
        if good.any() and not good.all():
            for axis in range(3):
                filled[~good, marker, axis] = np.interp(time[~good], time[good], filled[good, marker, axis])
    return filled


def _off_path(
    time: np.ndarray, position: np.ndarray, tolerance: float, max_acceleration: float, longest_run: float
) -> tuple[np.ndarray, int]:
    """Rows off the longest smooth path of one marker, and the number of breaks in that path.

    Dynamic programming over "the best path that ends in this row": it extends a path that ended shortly before if the
    step between them is smooth, or breaks with it at the price of half the longest run (a wrong run takes two breaks).
    """
    if len(time) < 4 * _VELOCITY_ROWS:
        return np.zeros(len(time), dtype=bool), 0
    interval = float(np.median(np.diff(time)))
    reach = max(round(longest_run / interval), 2)
    allowed = tolerance + max_acceleration * interval**2
    smooth = _smooth_steps(time, position, reach, interval, allowed)
    step_value = np.where(smooth, 1.0, 1.0 - 0.5 * reach)
    length = np.concatenate([np.full(reach, -np.inf), np.ones(len(time))])
    back = np.zeros(len(time), dtype=int)
    for row in range(1, len(time)):
        value = step_value[row] + length[row + reach - 1 :: -1][:reach]
        back[row] = np.argmax(value)
        length[row + reach] = max(value[back[row]], 1.0)
    kept = np.zeros(len(time), dtype=bool)
    row, breaks = int(np.argmax(length)) - reach, 0
    while True:
        kept[row] = True
        if row == 0 or length[row + reach] == 1.0:
            return ~kept, breaks
        breaks += int(not smooth[row, back[row]])
        row -= int(back[row]) + 1


def _smooth_steps(
    time: np.ndarray, position: np.ndarray, reach: int, interval: float, allowed: float
) -> Bool[np.ndarray, "row back"]:
    """Whether the motion from row ``r - 1 - b`` to row ``r`` is one a body can make, for b = 0 ... reach - 1.

    It is, if it agrees with the mean of the velocities before and after it; a short one may agree with either alone, as
    the onset of a motion does.
    """
    arriving, leaving = _end_velocities(time, position)
    smooth = np.zeros((len(time), reach), dtype=bool)
    for back in range(min(reach, len(time) - 1)):
        first, last = slice(0, len(time) - 1 - back), slice(back + 1, len(time))
        gap = (time[last] - time[first])[:, None]
        step = position[last] - position[first]
        before, after = arriving[first], leaving[last]
        predictions = (before, after, 0.5 * (before + after)) if back < _ONSET_ROWS else (0.5 * (before + after),)
        distance = np.min([np.linalg.norm(step - gap * velocity, axis=1) for velocity in predictions], axis=0)
        smooth[last, back] = distance <= allowed * (1.0 + _DRIFT_PER_ROW * (gap[:, 0] / interval - 1.0).clip(0.0))
    return smooth


def _end_velocities(time: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median velocity of the few steps that arrive at each row, and of those that leave it: one bad step is ignored."""
    with np.errstate(divide="ignore", invalid="ignore"):  # times that do not increase are refused later, by their row
        velocity = np.diff(position, axis=0) / np.diff(time)[:, None]
    edge = np.full((_VELOCITY_ROWS, 3), np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(np.concatenate([edge, velocity, edge]), _VELOCITY_ROWS, axis=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # the first row has no arriving step, the last no leaving one
        median = np.nan_to_num(np.nanmedian(windows, axis=2))
    rows = len(time)
    return median[:rows], median[_VELOCITY_ROWS : _VELOCITY_ROWS + rows]
