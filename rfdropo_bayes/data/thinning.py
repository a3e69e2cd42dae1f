"""Recordings with more rows than their motion needs: the rate that it needs, and copies with that rate."""

from __future__ import annotations

import numpy as np

from rfdropo_bayes.data.sample_times import sample_time
from rfdropo_bayes.data.trajectory import Trajectory

MANY = 20_000  # number of rows at or above which a thinned copy is examined in place of a recording
LOOKED_AT = 50_000  # rows that show which rate a motion needs
LIKE_NOISE, CLOSE = 1.6, 5e-3
"""Limits of the interpolation error between rows: a multiple of the error between every second row, and a share of the
spread of the markers.
"""
UNRESOLVED = 0.2  # share of the spread by which every second row is missed in a motion that needs every row
SLOWEST = 0.1  # longest time between rows [s] that is offered
FACTORS = tuple(digit * 10**power for power in range(4) for digit in (1, 2, 5))


def needed_interval(run: Trajectory) -> float:
    """The longest time between rows [s] at which a straight line from row to row describes the motion between them."""
    time, mask = run.time[:LOOKED_AT], run.position_mask[:LOOKED_AT]
    position, step = run.position[:LOOKED_AT], sample_time(run.time)
    seen = [(time[good], position[good, marker]) for marker, good in enumerate(mask.T) if good.sum() > 2]
    if not seen:
        return step
    deviation = float(np.sqrt(np.mean([place.var(axis=0).sum() for _, place in seen])))

    def error(every: int) -> float:
        """Root mean square distance from a straight line between every n-th row."""
        squares = []
        for own, place in seen:
            inside = slice(0, (len(own) - 1) // every * every + 1)
            lines = [np.interp(own[inside], own[::every], axis[::every]) for axis in place.T]
            squares.append(np.mean(np.sum((place[inside] - np.stack(lines, axis=1)) ** 2, axis=1)))
        return float(np.sqrt(np.mean(squares)))

    if error(2) > UNRESOLVED * deviation:
        return step
    allowed, longest = max(LIKE_NOISE * error(2), CLOSE * deviation), 2
    for every in FACTORS[2:]:
        if every * step > SLOWEST or every > len(time) // 4 or error(every) > allowed:
            break
        longest = every
    return longest * step


def looked_at(run: Trajectory) -> Trajectory:
    """A recording of many rows at the rate that its motion needs, without commands that change nothing; else itself."""
    if len(run.time) <= MANY:
        return run
    changes = np.concatenate([[True], (np.diff(run.command, axis=0) != 0.0).any(axis=1)])
    fewer = Trajectory(run.dataset.isel(command_time=changes))
    return fewer.resample(needed_interval(run))


def thinning_note(run: Trajectory) -> str | None:
    """Advice for a recording with more rows than its motion needs; None for others."""
    if len(run.time) <= MANY:
        return None
    needed, step = needed_interval(run), sample_time(run.time)
    if needed < 2.0 * step:
        return f"{run.name} has {len(run.time)} rows, and its motion needs them all: a fit of pieces (rows) is quicker"
    return (
        f"{run.name} has {len(run.time)} rows, one every {1e3 * step:.3g} ms, and its motion needs one every "
        f"{1e3 * needed:.3g} ms: resample = {needed:.3g} in [data] saves time and memory"
    )
