"""Delay of markers behind the commands of their rows, from residuals of quadratic maps of the commands, without a
model.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.data.named_columns import CsvColumns
from rfdropo_bayes.data.sample_times import sample_time

DELAYS = (0.0, 0.1, 0.2, 0.4)  # tried delays of the motion behind its commands [s]
MOST_ROWS = 2000  # rows of a recording that are used
JUST_BEFORE = 1e-6  # [s] before a row: a command that is sent in it does not act yet
RIDGE = 1e-6  # ridge penalty of the maps, as a share of the mean square of their features
CLEARLY = 0.9  # ratio of the root mean square residuals of two maps below which the better map is reported

APART = 0.3  # the same ratio of two neighbours' commands below which each row is a pose of its own
UNSETTLED = 2.0
"""Ratio of the residuals in rows after a change of the commands and in others beyond which bodies move: 1.1 at rest,
5.8 if a twentieth of the way is left in the next row (20 pulls of 12 rows, noise of .02 mm)."""


class LagError(NamedTuple):
    """Residual of the markers' motion after a quadratic map of the commands."""

    rows: int  # rows by which the commands precede the markers; 0 is the same row
    error: float  # root mean square residual [m]


def errors_by_row(runs: Sequence[Trajectory], lags: Sequence[int] = (-1, 0, 1, 2)) -> list[LagError]:
    """Residuals if each row shows the effect of the command some rows before, for each lag."""
    return [LagError(lag, _map_error([(own, _shifted(sent, lag)) for own, sent in _series(runs)])) for lag in lags]


def apart(run: Trajectory) -> str | None:
    """Why each row is a pose of its own, in words: it shows one command, and nothing of the command before or after.

    None for rows of a continuous motion. If commands are held for several rows, a map of them fits most rows of any
    body: then rows that follow a change must fit as well as the others.
    """
    one, other = sorted(errors_by_row([run], (0, 1)), key=lambda each: each.error)
    if one.error >= APART * other.error:
        return None
    ((positions, sent),) = _series([run])
    own = _shifted(sent, one.rows)
    residuals, _ = _map_residuals([(positions, own)])
    whole, changed = np.isfinite(residuals).all(axis=1), np.append(True, np.diff(own, axis=0).any(axis=1))
    after, held = whole & changed, whole & ~changed
    if held.any() and np.mean(residuals[after] ** 2) > UNSETTLED**2 * np.mean(residuals[held] ** 2):
        return None
    return f"a map of one row's command leaves {1e3 * one.error:.3g} mm, of its neighbour's {1e3 * other.error:.3g} mm"


def best_delay(runs: Sequence[Trajectory]) -> float:
    """Delay [s] of the markers behind the commands at which a quadratic map fits best."""
    step = sample_time(*(run.time for run in runs))
    delays = sorted({*DELAYS, step})
    errors = [
        _map_error([(_positions(run)[:MOST_ROWS], run.command_at(run.time - d)[:MOST_ROWS]) for run in runs])
        for d in delays
    ]
    return delays[int(np.argmin(errors))]


def _series(runs: Sequence[Trajectory]) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(_positions(run)[:MOST_ROWS], run.command_at(run.time)[:MOST_ROWS]) for run in runs]


def _positions(run: Trajectory) -> Float[np.ndarray, "row coordinate"]:
    seen = np.where(run.position_mask[..., None], run.position, np.nan)
    return seen.reshape(len(run.time), -1)


def _shifted(command: Float[np.ndarray, "row channel"], lag: int) -> Float[np.ndarray, "row channel"]:
    """Commands of another row, NaN beyond the ends."""
    moved = np.full(command.shape, np.nan)
    rows = np.arange(len(command)) - lag
    inside = (rows >= 0) & (rows < len(command))
    moved[inside] = command[rows[inside]]
    return moved


def _map_error(series: Sequence[tuple[np.ndarray, np.ndarray]]) -> float:
    """Root mean square residual of a single map for all recordings; infinite without data."""
    residuals, free = _map_residuals(series)
    return float(np.sqrt(np.nansum(residuals**2) / free)) if free else np.inf


def _map_residuals(series: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[Float[np.ndarray, "row coordinate"], int]:
    """Residuals of a single map for all recordings, with a separate mean per recording, and their degrees of freedom.

    Rows that are not whole are NaN. Without data there are no degrees of freedom.
    """
    features, motion, used = [], [], []
    for position, command in series:
        whole = np.isfinite(position).all(axis=1) & np.isfinite(command).all(axis=1)
        whole &= whole.sum() > 1
        shape = _quadratic(command[whole])
        features.append(shape - (shape.mean(axis=0) if whole.any() else 0.0))
        motion.append(position[whole] - (position[whole].mean(axis=0) if whole.any() else 0.0))
        used.append(whole)
    known, moved, rows = np.concatenate(features), np.concatenate(motion), np.concatenate(used)
    residuals = np.full((len(rows), moved.shape[1]), np.nan)
    if not rows.any():
        return residuals, 0
    gram = known.T @ known
    ridge = RIDGE * np.trace(gram) / len(gram) + 1e-300
    residuals[rows] = moved - known @ np.linalg.solve(gram + ridge * np.eye(len(gram)), known.T @ moved)
    return residuals, max(len(moved) - int(np.linalg.matrix_rank(known)), 1)


def _quadratic(command: Float[np.ndarray, "row channel"]) -> Float[np.ndarray, "row feature"]:
    """Scaled commands, their positive parts, and the products of all pairs."""
    size = np.sqrt(np.sum(command**2, axis=0) / max(len(command), 1))
    scaled = command / np.where(size > 0.0, size, 1.0)
    one, other = np.triu_indices(scaled.shape[1])
    return np.concatenate([scaled, np.maximum(scaled, 0.0), scaled[:, one] * scaled[:, other]], axis=1)


class LagWords(NamedTuple):
    """The row of the command that a pose shows, in words; and a doubt if the simulation uses another row."""

    words: str
    doubt: str | None


CLOCKS = "look at the clocks of commands and positions"
REMEDIES = {
    0: "commands_with_poses = true in [data.columns]: commands were measured with the pose, or poses are at rest",
    1: "commands_with_poses = false in [data.columns]",
}
NAMES = {-1: "the next row", 0: "its own row", 1: "the row before", 2: "two rows before"}


def lag_words(runs: Sequence[Trajectory], columns: CsvColumns | None) -> LagWords:
    """Find the row of the command that poses at rest show."""
    errors = {each.rows: each.error for each in errors_by_row(runs)}
    best = min(errors, key=lambda rows: errors[rows])
    own = all(np.array_equal(run.command_at(run.time - JUST_BEFORE), run.command_at(run.time)) for run in runs)
    taken, shared = 0 if own else 1, columns is not None and columns.command_time is None
    listed = ", ".join(f"{NAMES[rows]} {1e3 * error:.3g}" for rows, error in errors.items())
    words = (
        f"a pose follows the command of {NAMES[best]} best; the simulation takes that of {NAMES[taken]} (a quadratic "
        f"map of the command leaves, in mm: {listed})"
    )
    if errors[best] >= CLEARLY * errors[taken]:
        return LagWords(words, None)
    shares = f"{1e3 * errors[best]:.3g} mm are left, by {NAMES[taken]} {1e3 * errors[taken]:.3g} mm"
    remedy = REMEDIES.get(best, CLOCKS) if shared else CLOCKS
    return LagWords(words, f"a pose follows the command of {NAMES[best]} ({shares}): {remedy}")
