"""Detection of wrapped or restarted counters and angles, by jumps that no marker follows.

A wrapped counter has short steps, and steps of nearly a turn against the motion before and after. A real jump of the
command looks the same, so the markers decide: their motion is regressed on the commands with and without the jumps. A
jump is doubtful if the regression is better without it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

SHORT, LONG = 0.35, 0.6
"""Steps of a counter that wraps are shorter or longer than these shares of a turn, and none lies between."""
FEWEST = 5  # short steps that are needed to distinguish a turn from a command that jumps
SEVERAL = 2  # jumps that it takes to believe in a turn of no known counter
EXCEPTIONAL = 3.0  # multiple of the 95 % quantile of step sizes above which a step may be a restart
BETTER, MUCH_BETTER = 0.9, 0.5
"""Ratio of the errors without and with the jumps of a turn, and of a restart, below which markers did not follow."""
FILLED = 0.8  # least share of a known turn over which values extend that wrap between rows far apart
DELAYS = (0.0, 0.05, 0.1, 0.2, 0.4)  # [s] of the markers after the commands
ROWS = 4000  # that a regression looks at, at most
POWERS = tuple(2.0**k for k in range(8, 33))  # turns of counters in whole numbers


class Wraps(NamedTuple):
    """Jumps of one column."""

    rows: tuple[int, ...]  # after the jumps
    turn: float  # turn of the counter, in the unit of the column
    known: bool  # whether this is the turn of a known counter; else it is estimated from the jumps
    clear: bool = True  # whether no step is of a length between the jumps and the motion beside them


class Column(NamedTuple):
    """One column of a file."""

    name: str  # name in the file
    values: Float[np.ndarray, " rows"]  # one value per row; NaN if missing
    turns: Sequence[float]  # possible turns of counters in this unit


class Motion(NamedTuple):
    """Motion of the markers: times of the rows of the columns [s], times of the positions [s], and positions."""

    sent: Float[np.ndarray, " rows"]
    time: Float[np.ndarray, " time"]
    position: Float[np.ndarray, "time coordinate"]


def unwrapped(values: Float[np.ndarray, " rows"], turn: float) -> Float[np.ndarray, " rows"]:
    """Unwrapped values of a counter that restarts at every ``turn``; missing values stay missing."""
    continued, known = np.array(values, dtype=float), np.isfinite(values)
    continued[known] = np.unwrap(continued[known], period=turn)
    return continued


def read_on(
    values: Float[np.ndarray, "rows column"], names: Sequence[str], turns: Mapping[str, float]
) -> Float[np.ndarray, "rows column"]:
    """Columns, unwrapped if ``turns`` has their turn."""
    columns = [unwrapped(own, turns[name]) if name in turns else own for name, own in zip(names, values.T, strict=True)]
    return np.stack(columns, axis=1)


def turns_of(unit: str, counts_per_turn: float | None, values: np.ndarray) -> list[float]:
    """Turns of counters and angles that a unit allows, and whole numbers in any unit."""
    angles = {"deg": [360.0], "rad": [2.0 * np.pi]}.get(unit, [])
    given = [] if counts_per_turn is None or unit != "counts" else [counts_per_turn]
    known = values[np.isfinite(values)]
    whole = len(known) > 0 and bool(np.all(known == np.round(known)))
    return [*angles, *given, *(POWERS if whole else ())]


def find_wraps(values: Float[np.ndarray, " rows"], turns: Sequence[float]) -> Wraps | None:
    """Jumps of about one turn relative to the motion before and after; None without jumps, or if steps of all lengths
    occur in values that do not fill a known turn.

    Args:
        values: values of one column; missing values are skipped.
        turns: turns of known counters.
    """
    rows = np.flatnonzero(np.isfinite(values))
    step = np.diff(values[rows])
    size = np.abs(step)
    longest = float(size.max(initial=0.0))
    jump, short = size > 0.5 * longest, size <= 0.5 * longest
    usual = float(size[short].max(initial=0.0))
    if np.count_nonzero(size[short]) < FEWEST:
        return None
    turn = float(np.median([size[k] + _towards(step, int(k), short) for k in np.flatnonzero(jump)]))
    extent = float(np.ptp(values[rows]))
    near = [each for each in turns if abs(each - turn) <= max(usual, 0.01 * turn) and extent <= each]
    turn = min(near, key=lambda each: abs(each - turn)) if near else float(f"{turn:.3g}")
    continued = np.abs(size[jump] - turn).max() <= 1.5 * usual
    within = extent <= 1.01 * turn
    if not (continued and within) or usual > SHORT * turn or size[jump].min() < LONG * turn:
        return _folded(values, rows, turns)
    if not near and np.count_nonzero(jump) < SEVERAL:
        return None
    return Wraps(tuple(int(row) for row in rows[1:][jump]), turn, bool(near))


def _folded(values: np.ndarray, rows: np.ndarray, turns: Sequence[float]) -> Wraps | None:
    """Jumps by over half a known turn that the values fill, if the steps between these are too long to tell."""
    extent, jump = float(np.ptp(values[rows])), np.abs(np.diff(values[rows]))
    filled = [turn for turn in turns if FILLED * turn <= extent <= turn and np.any(jump > 0.5 * turn)]
    if not filled:
        return None
    return Wraps(tuple(int(row) for row in rows[1:][jump > 0.5 * filled[0]]), filled[0], known=True, clear=False)


def _towards(step: np.ndarray, k: int, short: np.ndarray) -> float:
    """Motion per row around a jump, against the jump's direction; 0 if it has the same direction."""
    beside = [step[j] for j in (k - 1, k + 1) if 0 <= j < len(step) and short[j]]
    return max(0.0, -float(np.sign(step[k])) * float(np.mean(beside))) if beside else 0.0


def wraps_of(columns: Sequence[Column], motion: Motion) -> dict[str, Wraps]:
    """Columns with jumps of one turn that the markers do not follow."""
    by_name = {column.name: find_wraps(column.values, column.turns) for column in columns}
    wraps = {name: each for name, each in by_name.items() if each is not None}
    together = len(wraps) > 1 and len({row for each in wraps.values() for row in each.rows}) == 1
    if not wraps or together:  # counters that jump together, and once, were started anew
        return {}
    raw = np.stack([column.values for column in columns], axis=1)
    whole, numbers = raw.copy(), {column.name: k for k, column in enumerate(columns)}
    for name, each in wraps.items():
        whole[:, numbers[name]] = unwrapped(raw[:, numbers[name]], each.turn)
    best = regression_error(whole, motion)
    for name, k in numbers.items():  # a column that the markers follow as it is
        again = whole.copy()
        again[:, k] = raw[:, k]
        if name in wraps and (error := regression_error(again, motion)) < BETTER * best:
            whole, best = again, error
            del wraps[name]
    # Columns are compared together: of three cables, two determine where the third is.
    clear = all(each.clear for each in wraps.values())
    return wraps if best < (BETTER if clear else MUCH_BETTER) * regression_error(raw, motion) else {}


class Restart(NamedTuple):
    """A row in which columns jump and no marker follows, and the size of each jump by column."""

    row: int
    jumps: Mapping[str, tuple[float, float]]


def find_restart(columns: Sequence[Column], motion: Motion) -> Restart | None:
    """The row of the longest jump that the markers do not follow; None if they follow, or nothing jumps."""
    values = np.stack([column.values for column in columns], axis=1)
    step = np.diff(values, axis=0)
    usual = np.array([_usual(own) for own in np.abs(step).T])
    excess = np.where(usual > 0.0, np.abs(step) / np.where(usual > 0.0, usual, 1.0), 0.0)
    if excess.size == 0 or not np.nanmax(excess) > EXCEPTIONAL:
        return None
    row = int(np.nanargmax(np.nanmax(excess, axis=1)))
    moved = excess[row] > EXCEPTIONAL
    level = values.copy()
    level[row + 1 :, moved] -= step[row, moved]
    if not regression_error(level, motion) < MUCH_BETTER * regression_error(values, motion):
        return None
    names = [column.name for column in columns]
    return Restart(
        row + 1, {names[k]: (float(values[row, k]), float(values[row + 1, k])) for k in np.flatnonzero(moved)}
    )


def _usual(size: np.ndarray) -> float:
    """The 95 % quantile of the sizes of nonzero steps; 0 if there are too few."""
    moving = size[np.isfinite(size) & (size > 0.0)]
    return float(np.quantile(moving, 0.95)) if len(moving) >= 4 * FEWEST else 0.0


def regression_error(values: Float[np.ndarray, "rows channel"], motion: Motion) -> float:
    """Root mean square error of the markers as a linear function of the values in force, at the best delay.

    Infinite if there are fewer rows than the regression has unknowns.
    """
    position = np.asarray(motion.position, dtype=float)
    stride = max(1, len(position) // ROWS)
    time, position = motion.time[::stride], position[::stride]
    filled = np.where(np.isfinite(values), values, 0.0)
    scale = np.maximum(np.ptp(filled, axis=0), 1e-300)
    known = np.isfinite(values).all(axis=1)
    errors = [np.inf]
    for delay in DELAYS:
        row = np.maximum(np.searchsorted(motion.sent, time - delay + 1e-9, side="right") - 1, 0)
        kept = np.isfinite(position).all(axis=1) & known[row]
        if kept.sum() <= 2 * (values.shape[1] + 1):
            continue
        design = np.column_stack([np.ones(kept.sum()), filled[row[kept]] / scale])
        weights = np.linalg.lstsq(design, position[kept], rcond=1e-9)[0]
        errors.append(float(np.sqrt(np.mean((position[kept] - design @ weights) ** 2))))
    return min(errors)


def counter_notes(columns: Sequence[Column], motion: Motion, unit: str) -> list[str]:
    """Notes on doubtful columns in one unit, each with the line to type."""
    if not len(motion.position) or not columns:
        return []
    wraps = wraps_of(columns, motion)
    if wraps:
        first, each = min(wraps.items(), key=lambda item: item[1].rows[0])
        values = next(column.values for column in columns if column.name == first)
        row, about = each.rows[0], "" if each.known else "about "
        before = values[:row][np.isfinite(values[:row])][-1]
        line = ", ".join(f"{quoted_key(name)} = {own.turn:.10g}" for name, own in wraps.items())
        count = sum(len(own.rows) for own in wraps.values())
        return [
            f"{', '.join(wraps)} jump by a turn of a counter ({about}{each.turn:.6g} {unit}) while the markers move "
            f"on: {count} jumps, the first of {first} from {before:.6g} to {values[row]:.6g} in row {row}; "
            f"unwrap = {{{line}}} in [data.columns] reads on across the turn"
        ]
    restart = find_restart(columns, motion)
    if restart is None:
        return []
    jumps = ", ".join(f"{old:.6g} to {new:.6g}" for old, new in restart.jumps.values())
    return [
        f"{', '.join(restart.jumps)} jump in row {restart.row} ({jumps} {unit}) and the markers do not follow, as "
        "after a restart that sets a counter anew; read the rows on one side with rows = [first, last]; or correct "
        "columns"
    ]


def quoted_key(name: str) -> str:
    """The name of a column as a key of TOML."""
    plain = name and all(letter.isascii() and (letter.isalnum() or letter in "_-") for letter in name)
    escaped = name.replace("\\", "\\\\").replace('"', '\\"')
    return name if plain else f'"{escaped}"'
