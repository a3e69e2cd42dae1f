"""Faults of a motion-capture recording: found and masked, never fitted.

Five kinds, each with its pattern in the numbers:

- *missing*: a position that is NaN (a marker was lost).
- *zero*: a position that is exactly 0, 0, 0, far from the marker before and after: some trackers write a lost marker
  this way.
- *held*: the tracker repeated its last pose. Real measurements carry noise in their last digits, so a position equal to
  its predecessor in all three coordinates is no new measurement. The first row of a held run counts as measured.
- *jump*: the tracker fitted the wrong rigid body for a row or a short run of rows, and then came back; two markers that
  swap for a row jump both. A jump is a step that differs from the neighbouring steps by more than ``TOLERANCE +
  MAX_ACCELERATION * dt**2``, or than ``UNUSUAL`` times as much as half of the steps do: noise makes all steps differ.
  The longest smooth path of each marker is kept: the largest set of rows in which every row can be reached from its
  predecessor. At most ``LONGEST_RUN`` rows are left out at a time, so a lasting change of level (a moved frame, an
  impact) is kept and counted among the *breaks*.
- *renamed*: the place of a marker under the name of another (`identities`).

At low sampling rates ``MAX_ACCELERATION * dt**2`` exceeds any motion. A jump is then a single row far from the two rows
before and the two rows after, which agree, while the commands stand (`_spikes`).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from rfdropo_bayes.data.identities import Change, changed_names
from rfdropo_bayes.data.sample_times import check_times, clock_notes, evenly_spaced
from rfdropo_bayes.errors import InputError

NOTES = "notes"  # key of a recording's settings: valid but suspicious facts

TOLERANCE = 1.5e-3  # [m]
MAX_ACCELERATION = 20.0  # [m/s2]: about 2 g, beyond the acceleration of the neighbouring rows
UNUSUAL = 5.0  # times the median difference; of normal noise one step in 10^12 differs by so much
LONGEST_RUN = 0.25  # [s]
MOST_ROWS = 250  # of a run: the longest run at 1 kHz; motion capture is not faster, and memory grows with it
FAR = 10e-3  # [m] from a zero to the marker before and after
FAR_STEPS = 3.0  # the same in steps of a fast row
_VELOCITY_ROWS = 5
_DRIFT_PER_ROW = 0.02  # share of the tolerance by which a smooth path may drift from the predicted one per row
_MARGIN = 2  # longest runs, on both sides of a step that is not smooth
_BLOCK = 20_000  # rows
_HELD = 0.05  # share of a command's range below which its usual change from row to row is noise
_STANDING = 6  # changes of the commands up to the row after a jump that are noise
_ONSET_ROWS = 3  # over this few rows a motion may start or stop at once
_FEW = 5.0  # quanta


class Faults(NamedTuple):
    """Faults of a recording.

    ``mask(time, marker)`` is True for usable positions. ``counts`` maps each kind to its number of positions per
    marker, and ``breaks`` to the number of lasting changes of level; kinds "zero" and "renamed" are present if they
    occur. ``notes`` list suspicious rows, each with a remedy for the user.
    """

    mask: Bool[np.ndarray, "time marker"]
    counts: dict[str, list[int]]
    notes: list[str]

    @property
    def settings(self) -> dict[str, Any]:
        """Counts and notes as facts about a recording, for `Trajectory.build`."""
        return {"faults": self.counts} | ({NOTES: self.notes} if self.notes else {})


def find_faults(
    time: Float[np.ndarray, " time"],
    position: Float[np.ndarray, "time marker 3"],
    *,
    command: Float[np.ndarray, "time channel"] | None = None,
    where: str = "recording",
    names: Sequence[str] = (),
) -> Faults:
    """Mask lost, held, jumping and renamed positions of a measured recording (not meant for simulated recordings).

    Args:
        time: times of the rows [s].
        position: marker positions [m]; NaN if a marker was lost.
        command: commands of the rows, if known.
        where: name of the recording in errors.
        names: marker names for the notes; numbers by default.

    Raises:
        InputError: fewer than two rows, another number of positions than times, or times that do not increase.
    """
    _check_rows(time, position, where)
    nan = np.isnan(position).any(axis=2)
    zero, doubtful = find_zeros(position)
    missing = nan | zero
    held = find_held(np.where(missing[..., None], 0.0, position)) & ~missing
    jumping = np.zeros_like(missing)
    breaks, clock = [], evenly_spaced(time)
    for marker in range(position.shape[1]):
        rows = np.flatnonzero(~(missing | held)[:, marker])
        wrong, level_changes = _off_path(clock[rows], position[rows, marker])
        if command is not None:
            wrong |= _spikes(position[rows, marker], command[rows])
        jumping[rows[wrong], marker] = True
        # a repeat of a wrong pose is as wrong as the pose; it is counted as held
        breaks.append(level_changes)
    renamed, changes = changed_names(position, ~(missing | held | jumping))
    renamed &= ~(missing | held | jumping)
    counts = {
        "missing": nan.sum(axis=0).tolist(),
        "held": held.sum(axis=0).tolist(),
        "jump": jumping.sum(axis=0).tolist(),
        "breaks": breaks,
    } | {kind: each.sum(axis=0).tolist() for kind, each in (("zero", zero), ("renamed", renamed)) if each.any()}
    names = names or [f"marker {number}" for number in range(1, position.shape[1] + 1)]
    mask = ~(missing | held | jumping | renamed)
    notes = clock_notes(time) + _zero_notes(zero, doubtful, names) + _name_notes(renamed, changes, names)
    return Faults(mask, counts, notes + _mostly_masked(mask | renamed, counts, names))


def _check_rows(time: np.ndarray, position: np.ndarray, where: str) -> None:
    check_times(time, where)
    if np.ndim(position) != 3 or position.shape[2] != 3 or position.shape[0] != len(time):
        raise InputError(f"positions have the shape {np.shape(position)} for {len(time)} times", where=where)
    if len(time) < 2:
        raise InputError(f"has {len(time)} observation rows", where=where, remedy="at least 2 are needed")


def find_zeros(
    position: Float[np.ndarray, "time marker 3"],
) -> tuple[Bool[np.ndarray, "time marker"], Bool[np.ndarray, "time marker"]]:
    """Masks of positions exactly at 0, 0, 0 whose marker was certainly lost, and possibly lost.

    A marker was lost if its positions before and after the zeros are farther away than a fast motion reaches in a row.
    A marker near zero was not lost. Distances between, at low sampling rates, and markers that are always at zero are
    in doubt.
    """
    zero = (position == 0.0).all(axis=2)
    lost, doubtful = np.zeros_like(zero), np.zeros_like(zero)
    for marker in np.flatnonzero(zero.any(axis=0)):
        seen = np.flatnonzero(np.isfinite(position[:, marker]).all(axis=1) & ~zero[:, marker])
        rows = np.flatnonzero(zero[:, marker])
        if not len(seen):
            doubtful[rows, marker] = True
            continue
        radius = np.linalg.norm(position[seen, marker], axis=1)
        following = np.searchsorted(seen, rows)
        before, after = radius[np.maximum(following - 1, 0)], radius[np.minimum(following, len(seen) - 1)]
        nearest = np.minimum(np.where(following == 0, after, before), np.where(following == len(seen), before, after))
        steps = np.linalg.norm(np.diff(position[seen, marker], axis=0), axis=1)[np.diff(seen) == 1]
        fast = float(np.quantile(steps, 0.99)) if len(steps) else 0.0
        lost[rows, marker] = nearest > max(FAR, FAR_STEPS * fast)
        doubtful[rows, marker] = (nearest > FAR) & ~lost[rows, marker]
    return lost, doubtful


def _zero_notes(zero: np.ndarray, doubtful: np.ndarray, names: Sequence[str]) -> list[str]:
    """Markers at exactly 0, 0, 0, with the first row of each."""
    notes = []
    for kind, words in (
        (zero, "taken for lost and left out; leave such cells empty to avoid this note"),
        (doubtful, "taken as it stands; if it was lost, leave the cells empty, or omit the marker"),
    ):
        for marker in np.flatnonzero(kind.any(axis=0)).tolist():
            rows = np.flatnonzero(kind[:, marker])
            notes.append(f"{names[marker]} is exactly at 0, 0, 0 in {len(rows)} rows, first in row {rows[0]}: {words}")
    return notes


def _mostly_masked(seen: np.ndarray, counts: dict[str, list[int]], names: Sequence[str]) -> list[str]:
    """Notes on markers with more masked than kept positions: the detected pattern is then hardly a fault."""
    notes, rows = [], len(seen)
    for marker in np.flatnonzero(2 * seen.sum(axis=0) < rows).tolist():
        marker_counts = {kind: each[marker] for kind, each in counts.items() if kind not in ("breaks", "renamed")}
        kinds = ", ".join(f"{count} {kind}" for kind, count in marker_counts.items() if count)
        notes.append(
            f"{int((~seen[:, marker]).sum())} of {rows} positions of {names[marker]} are masked ({kinds}): if most of "
            "them were measured, look at the unit of times, at the unit of positions and at the marker's columns"
        )
    return notes


def _name_notes(renamed: np.ndarray, changes: Sequence[Change], names: Sequence[str]) -> list[str]:
    """Rows in which markers change names for longer than a moment."""
    if not changes or not renamed.any():
        return []
    shown = "; ".join(
        f"row {change.row}: {' and '.join(names[m] for m in sorted(change.taken_by))}" for change in changes[:3]
    ) + ("; ..." if len(changes) > 3 else "")
    return [
        f"markers change names in {shown}: {int(renamed.sum())} positions under other names than in row 0 are left "
        "out; give the columns their right names from there on, or read pieces with rows"
    ]


def find_held(position: Float[np.ndarray, "time marker 3"]) -> Bool[np.ndarray, "time marker"]:
    """Mask of positions that repeat the previous row although the marker is not at rest.

    Not counted as held: markers that never move, coarsely rounded signals, and rows in which the whole body repeats if
    that is common (a noise-free recording at rest).
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
    """Whether coarse rounding makes a signal repeat: the changes are a few quanta."""
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


def _off_path(time: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, int]:
    """Rows off the longest smooth path of one marker, and the number of breaks in that path.

    A path with only smooth steps needs no search; the search covers the other steps only.
    """
    wrong, breaks = np.zeros(len(time), dtype=bool), 0
    if len(time) < 4 * _VELOCITY_ROWS:
        return wrong, breaks
    interval = float(np.median(np.diff(time)))
    reach = int(np.clip(round(LONGEST_RUN / interval), 2, MOST_ROWS))
    velocities = _end_velocities(time, position)
    noise = np.median(_Motion(time, position, *velocities, interval, 0.0).differences(1))
    allowed = max(TOLERANCE + MAX_ACCELERATION * interval**2, UNUSUAL * float(noise))
    motion = _Motion(time, position, *velocities, interval, allowed)
    rough = np.flatnonzero(~motion.smooth(1)) + 1
    for part in _around(rough, _MARGIN * reach, len(time)):
        wrong[part], broken = _longest_path(motion.part(part), reach)
        breaks += broken
    return wrong, breaks


def _spikes(
    position: Float[np.ndarray, "row 3"], command: Float[np.ndarray, "row channel"]
) -> Bool[np.ndarray, " row"]:
    """Rows of one marker that differ from both neighbours, while the two rows before and after agree, and commands that
    are held in most rows have not changed for some rows.
    """
    wrong = np.zeros(len(position), dtype=bool)
    step, sent = np.linalg.norm(np.diff(position, axis=0), axis=1), np.abs(np.diff(command, axis=0))
    if len(position) < _STANDING + 3 or not step.any() or not np.isfinite(command).all():
        return wrong
    usual = np.median(sent, axis=0)
    if np.any(UNUSUAL * usual > _HELD * np.ptp(command, axis=0)):
        return wrong
    allowed = max(TOLERANCE, UNUSUAL * float(np.median(step[step > 0.0])))
    rough, change = step > allowed, np.asarray(np.any(sent > UNUSUAL * usual, axis=1))
    standing = ~np.any(np.lib.stride_tricks.sliding_window_view(change, _STANDING), axis=1)
    for row in 1 + np.flatnonzero(rough[:-1] & rough[1:]):
        first, last = row - _STANDING + 1, row + 2
        if first < 0 or last >= len(position) or not standing[first]:
            continue
        around = [row - 2, row - 1, row + 1, row + 2]
        apart = np.linalg.norm(position[around[1:]] - position[around[:-1]], axis=1)
        wrong[row] = bool(np.all(apart <= allowed))
    return wrong


def _around(rows: np.ndarray, margin: int, length: int) -> list[slice]:
    """Slices of ``margin`` rows on both sides of some rows; touching slices are merged."""
    groups = np.split(rows, np.flatnonzero(np.diff(rows) > 2 * margin) + 1) if len(rows) else []
    return [slice(max(int(group[0]) - margin, 0), min(int(group[-1]) + margin, length)) for group in groups]


class _Motion(NamedTuple):
    """Rows of one marker, with the velocities before and after each row, and how much a step may differ from them."""

    time: np.ndarray
    position: np.ndarray
    arriving: np.ndarray
    leaving: np.ndarray
    interval: float
    allowed: float

    def part(self, rows: slice) -> _Motion:
        """Some rows of it."""
        return self._replace(**{key: getattr(self, key)[rows] for key in ("time", "position", "arriving", "leaving")})

    def smooth(self, apart: int) -> Bool[np.ndarray, " row"]:
        """Whether a body can move from each row to the row ``apart`` rows later.

        A step is plausible if it agrees with the mean of the velocities before and after. A short step may agree with
        one of the two, as at the onset of a motion.
        """
        first, last = slice(0, len(self.time) - apart), slice(apart, len(self.time))
        gap = (self.time[last] - self.time[first])[:, None]
        step = self.position[last] - self.position[first]
        before, after = self.arriving[first], self.leaving[last]
        allowed = self.allowed * (1.0 + _DRIFT_PER_ROW * (gap[:, 0] / self.interval - 1.0).clip(0.0))
        agrees = self.differences(apart) <= allowed
        if apart <= _ONSET_ROWS:
            for velocity in (before, after):
                agrees |= np.linalg.norm(step - gap * velocity, axis=1) <= allowed
        return agrees

    def differences(self, apart: int) -> Float[np.ndarray, " row"]:
        """Distance of each step over ``apart`` rows from the mean of the velocities before and after it [m]."""
        gap = (self.time[apart:] - self.time[:-apart])[:, None]
        mean = 0.5 * (self.arriving[:-apart] + self.leaving[apart:])
        return np.linalg.norm(self.position[apart:] - self.position[:-apart] - gap * mean, axis=1)


def _longest_path(motion: _Motion, reach: int) -> tuple[np.ndarray, int]:
    """Rows off the longest smooth path, and its breaks.

    Dynamic programming over the best path that ends in each row. A path is extended if the step is smooth. A break
    costs half the longest run, because a wrong run takes two breaks.
    """
    rows = len(motion.time)
    smooth = np.zeros((rows, reach), dtype=bool)  # from row r - 1 - b to row r
    for back in range(min(reach, rows - 1)):
        smooth[back + 1 :, back] = motion.smooth(back + 1)
    step_value = np.where(smooth, 1.0, 1.0 - 0.5 * reach)
    length = np.concatenate([np.full(reach, -np.inf), np.ones(rows)])
    last = np.zeros(rows, dtype=int)
    for row in range(1, rows):
        value = step_value[row] + length[row + reach - 1 :: -1][:reach]
        last[row] = np.argmax(value)
        length[row + reach] = max(value[last[row]], 1.0)
    kept = np.zeros(rows, dtype=bool)
    row, breaks = int(np.argmax(length)) - reach, 0
    while True:
        kept[row] = True
        if row == 0 or length[row + reach] == 1.0:
            return ~kept, breaks
        breaks += int(not smooth[row, last[row]])
        row -= int(last[row]) + 1


def _end_velocities(time: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median velocity of the few steps that arrive at each row, and of the few steps that leave it: a single bad step
    is ignored.
    """
    velocity = np.diff(position, axis=0) / np.diff(time)[:, None]
    edge = np.full((_VELOCITY_ROWS, 3), np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(np.concatenate([edge, velocity, edge]), _VELOCITY_ROWS, axis=0)
    median = np.empty(windows.shape[:2])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # the first row has no arriving step, the last no leaving one
        for first in range(0, len(windows), _BLOCK):  # each block of windows is copied
            median[first : first + _BLOCK] = np.nan_to_num(np.nanmedian(windows[first : first + _BLOCK], axis=2))
    rows = len(time)
    return median[:rows], median[_VELOCITY_ROWS : _VELOCITY_ROWS + rows]
