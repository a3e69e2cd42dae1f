"""Clocks of recordings: stamps of any kind as seconds from the first stamp, and checks of them.

Stamps are numbers in a unit, or dates and durations as NumPy, pandas, PyArrow or ISO 8601 write them. Integer stamps
are subtracted as integers: nanoseconds since 1970 have more digits than a float holds.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from rfdropo_bayes.errors import InputError

TimeUnit = Literal["s", "ms", "us", "ns"]
PER_SECOND: dict[str, float] = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_NANOSECONDS = 1e9
_DECIMAL_COMMA = r"(?<=:\d\d),(?=\d)"  # of seconds, as loggers of Python write them

SHORT = 0.1  # share of the local interval below which a row came in one delivery with the row before
BUNCHED = 0.1  # share of such rows above which stamps are of arrival
LONGEST_WINDOW, SHORTEST_WINDOW = 100, 8  # rows that a local interval is a mean of: several deliveries
JUMP = 10.0  # intervals: a longer interval is a jump of the clock, or lost rows
COARSE = 0.1  # share of repeated stamps at or above which the clock is coarser than the rows
ONE_RATE = 1.1  # times between rows that differ by less are of the same rate: clocks jitter
GRAIN = 0.02  # of the usual interval: coarser stamps of single precision are reported
ON_GRID = 0.2  # of the grain: largest distance of rounded stamps from single precision
SLOWEST, FASTEST = 1.0, 2e-4  # [s] between rows: range of recordings of a moving robot
ANEW = 10.0  # gaps by which a clock that is set back has begun anew; by less, rows changed places
SET_BACK = 0.01  # largest share of rows out of order after a clock that was set back; else rows are not sorted


class Stamps(NamedTuple):
    """Times in the file's unit: ``ticks``, integers if possible, with ``per_second`` ticks per second."""

    ticks: np.ndarray
    per_second: float
    dated: bool

    def since(self, origin: Stamps, where: str) -> Float[np.ndarray, " rows"]:
        """Seconds from the first stamp of ``origin``; InputError if dates meet numbers."""
        if self.dated != origin.dated:
            raise InputError(
                "some times are dates, others are numbers", where=where, remedy="give all on one clock, in one form"
            )
        if self.ticks.dtype.kind == origin.ticks.dtype.kind == "i":
            finest = max(self.per_second, origin.per_second)
            own, other = (round(finest / stamps.per_second) for stamps in (self, origin))
            return (self.ticks * own - origin.ticks[0] * other) / finest
        if self.per_second == origin.per_second:
            return (self.ticks - origin.ticks[0]) / self.per_second
        return self.ticks / self.per_second - origin.ticks[0] / origin.per_second


def read_stamps(values: Any, unit: str = "s", *, where: str, column: str = "time") -> Stamps:
    """Stamps, one for each row.

    Args:
        values: numbers in ``unit``, dates, durations or text of these; dates and durations have no unit.
        unit: a key of `PER_SECOND`.
        where: the recording; column: name of its times.

    Raises:
        InputError: no stamps, a missing stamp, or a stamp that is neither a number nor a date.
    """
    if np.ndim(values) != 1 or len(values) == 0:
        raise InputError(f"{column} has the shape {np.shape(values)}", where=where, remedy="give one time per row")
    cells = values.reset_index(drop=True) if isinstance(values, pd.Series) else pd.Series(_plain(values))
    if cells.isna().any():
        raise InputError(
            f"NaN or empty cell ({int(cells.isna().sum())} of them in all)",
            where=f"{where}, row {int(cells.isna().argmax())}, column {column!r}",
            remedy="repair the recording, or number its rows with sample_time in place of a column of times",
        )
    if dated(cells):
        return _in_nanoseconds(cells)
    if not pd.api.types.is_numeric_dtype(cells.dtype):
        return _of_text(cells, unit, where, column)
    if pd.api.types.is_integer_dtype(cells.dtype) and cells.max() <= np.iinfo(np.int64).max:
        return Stamps(cells.to_numpy(dtype=np.int64), PER_SECOND[unit], False)
    return Stamps(cells.to_numpy(dtype=np.float64), PER_SECOND[unit], False)


def _plain(values: Any) -> Any:
    return values if isinstance(values, pd.Index | list | tuple | np.ma.MaskedArray) else np.asarray(values)


def dated(cells: pd.Series) -> bool:
    """Whether a column is of dates or durations, of NumPy, pandas or PyArrow."""
    return getattr(cells.dtype, "kind", "") in ("M", "m")


def numbers_of(cells: pd.Series) -> pd.Series:
    """Numbers of a column, integers as such; NaN for cells that are missing or not numeric."""
    if not pd.api.types.is_numeric_dtype(cells.dtype):
        cells = cells.astype(object)  # text of PyArrow has a NaN that counts as present
    numbers = pd.to_numeric(cells, errors="coerce")
    whole = pd.api.types.is_integer_dtype(numbers.dtype) and not numbers.isna().any()
    return numbers if whole else pd.Series(numbers.to_numpy(dtype=float, na_value=np.nan), index=numbers.index)


def _in_nanoseconds(cells: pd.Series) -> Stamps:
    """Dates and durations; a date of another time zone is the same instant."""
    if cells.dtype.kind == "m":
        return Stamps(pd.TimedeltaIndex(cells.astype(object)).as_unit("ns").asi8, _NANOSECONDS, True)
    dates = pd.DatetimeIndex(pd.to_datetime(cells.astype(object), utc=True))
    return Stamps(dates.as_unit("ns").asi8, _NANOSECONDS, True)


def _of_text(cells: pd.Series, unit: str, where: str, column: str) -> Stamps:
    numbers = numbers_of(cells)
    if numbers.notna().all():
        return read_stamps(numbers, unit, where=where, column=column)
    written = cells.map(lambda cell: cell if not isinstance(cell, str) else cell.strip()).astype(object)
    written = written.replace(_DECIMAL_COMMA, ".", regex=True)
    dates = pd.to_datetime(written, utc=True, format="ISO8601", errors="coerce")
    if dates.notna().all():
        return _in_nanoseconds(dates)
    durations = pd.to_timedelta(written.map(lambda cell: str(cell) if ":" in str(cell) else None), errors="coerce")
    if durations.notna().all():
        return _in_nanoseconds(durations)
    best = max((numbers, dates, durations), key=lambda each: each.notna().sum())
    row = int(best.isna().argmax())
    raise InputError(
        f"{str(cells.iat[row])!r} is not a number, nor a date as ISO 8601 has it",
        where=f"{where}, row {row}, column {column!r}",
        remedy="correct the cell"
        if best.notna().any()
        else "write all times as numbers or like 2024-05-01T12:00:00.25, or give sample_time in place of time",
    )


def check_times(time: Float[np.ndarray, " rows"], where: str, key: str = "time") -> None:
    """Raise an InputError that names the first row whose time is not finite, or not later than its predecessor.

    Args:
        time: times of the rows [s].
        where: the recording; key: name of its times.
    """
    if np.ndim(time) != 1:
        raise InputError(f"{key} has the shape {np.shape(time)}", where=where, remedy="give one time per row")
    if not np.all(np.isfinite(time)):
        row = int(np.argmax(~np.isfinite(time)))
        raise InputError(f"{key} is not a number", where=f"{where}, row {row}", remedy="repair the time column")
    gaps = np.diff(time)
    stuck = np.flatnonzero(gaps <= 0.0)
    if not stuck.size:
        return
    remedy, back = "sort the rows or remove duplicates", gaps < 0.0
    if not back.any() and stuck.size > COARSE * len(gaps):
        between = _of_groups(time, gaps)
        given = f" = {between:.4g}" if between > 0.0 else ""
        remedy = f"the stamps are coarser than the rows: give sample_time{given} (seconds from row to row); or {remedy}"
    elif 0 < back.sum() <= max(1.0, SET_BACK * len(gaps)):
        row = int(np.argmax(back)) + 1
        mixed = -gaps[row - 1] > ANEW * float(np.median(np.abs(gaps)))
        remedy = (
            f"the clock was set back by {-gaps[row - 1]:.4g} s before row {row}: split the file there, or "
            "give sample_time if rows are evenly spaced; "
            + ("sorting the rows would mix the recordings before and after" if mixed else f"else {remedy}")
        )
    raise InputError(
        f"{key} does not increase ({stuck.size} times)", where=f"{where}, row {int(stuck[0]) + 1}", remedy=remedy
    )


def repeated_rows(time: Float[np.ndarray, " rows"]) -> np.ndarray:
    """Rows with the stamp of the row before, if they are few and the clock never goes back."""
    gaps = np.diff(time)
    repeated = np.flatnonzero(gaps == 0.0) + 1
    few = np.all(gaps >= 0.0) and len(repeated) <= COARSE * len(gaps)
    return repeated if few else repeated[:0]


def spread_repeats(time: Float[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
    """Times with `repeated_rows` evenly between the rows around them."""
    repeated = repeated_rows(time)
    if not len(repeated):
        return time
    own = np.setdiff1d(np.arange(len(time)), repeated)
    behind = float(np.median(np.diff(time[own]))) * (len(time) - own[-1])  # for a stamp that the last rows repeat
    return np.interp(np.arange(len(time)), np.append(own, len(time)), np.append(time[own], time[-1] + behind))


def _of_groups(time: np.ndarray, gaps: np.ndarray) -> float:
    """Time from row to row [s] of rows that share stamps, from the first rows of the first and last group."""
    starts = np.flatnonzero(gaps > 0.0) + 1
    return float(time[starts[-1]] - time[0]) / float(starts[-1]) if len(starts) else 0.0


def row_interval(time: Float[np.ndarray, " rows"]) -> float:
    """Time from row to row [s], the median of means over many rows: deliveries, single gaps and clocks that begin anew
    do not change it."""
    window = _window(time)
    gaps = time[window:] - time[:-window]
    return float(np.median(gaps[gaps > 0.0] if np.any(gaps > 0.0) else gaps)) / window


def _window(time: np.ndarray) -> int:
    return int(min(np.clip(len(time) // 8, SHORTEST_WINDOW, LONGEST_WINDOW), len(time) - 1))


def short_intervals(time: Float[np.ndarray, " rows"]) -> np.ndarray:
    """Rows that arrived together with the row before, if there are enough to show that stamps are times of arrival."""
    usual, window = row_interval(time), _window(time)
    gaps = np.minimum(np.diff(time), window * usual)  # one gap of hours makes no others short
    means = np.convolve(gaps, np.ones(window) / window, "valid")
    around = np.pad(means, (window // 2, len(gaps) - len(means) - window // 2), "edge")
    short = np.flatnonzero(gaps < SHORT * around) + 1
    return short if len(short) >= BUNCHED * len(gaps) else short[:0]


def evenly_spaced(time: Float[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
    """Times for derivatives [s]: evenly spaced if stamps are times of arrival, else the stamps."""
    short = short_intervals(time)
    return time if not len(short) else time[0] + _between(time, short) * np.arange(len(time))


def sample_time(*times: Float[np.ndarray, " rows"]) -> float:
    """Median time from row to row [s] of one or more recordings, evenly spaced if stamps are of arrival."""
    return float(np.median(np.concatenate([np.diff(evenly_spaced(time)) for time in times])))


def _between(time: np.ndarray, short: np.ndarray) -> float:
    """Time from row to row [s] between the first delivery and the last, lost time left out."""
    starts = np.setdiff1d(np.arange(1, len(time)), short)
    if len(starts) < 2:
        return row_interval(time)
    gaps = np.diff(time)
    longest = JUMP * float(np.median(gaps[starts - 1]))
    within = gaps[starts[0] : starts[-1]]
    return float(within[within <= longest].mean())


def rounded_notes(stamps: Stamps, time: Float[np.ndarray, " rows"]) -> list[str]:
    """Stamps in single precision that are too coarse to space rows evenly; ``time`` in seconds."""
    if stamps.ticks.dtype.kind != "f" or len(time) < SHORTEST_WINDOW:
        return []
    single = stamps.ticks.astype(np.float32)
    grain = float(np.spacing(np.abs(single).max()))
    gaps = np.diff(time) * stamps.per_second
    usual = float(np.median(gaps))
    on_grid = np.abs(stamps.ticks - single.astype(float)).max() < ON_GRID * grain  # text rounds them once more
    if not on_grid or grain < GRAIN * usual or np.ptp(gaps) < 0.5 * grain:
        return []
    return [
        f"times have single precision: they go in steps of {1e3 * grain / stamps.per_second:.3g} ms, and rows come "
        f"every {1e3 * usual / stamps.per_second:.4g} ms; for rows that were measured evenly give sample_time = "
        f"{float(time[-1]) / (len(time) - 1):.4g} in place of time, or record double precision"
    ]


def clock_notes(time: Float[np.ndarray, " rows"]) -> list[str]:
    """Notes on valid but suspicious times [s], by row, each with a remedy."""
    gaps, usual, notes = np.diff(time), row_interval(time), []
    short = short_intervals(time)
    if len(short):
        notes.append(
            f"{len(short)} of {len(time)} rows, first row {short[0]}, have stamps that follow the row "
            f"before at once, although rows come every {1e3 * usual:.4g} ms: stamps of arrival, not of "
            "measurement; for rows that were measured evenly give sample_time = "
            f"{_between(time, short):.4g} in place of time"
        )
    if not SLOWEST >= usual >= FASTEST:
        notes.append(
            f"rows are {usual:.4g} s apart, from row 0 on: if this is wrong, correct time_unit under "
            f"[data.columns] ({', '.join(PER_SECOND)})"
        )
    long = float(np.quantile(np.delete(gaps, short - 1), 0.95))  # between deliveries, if there are any
    jumps = np.flatnonzero(gaps > JUMP * max(usual, long)) + 1
    for row in jumps[:1]:
        more = f", and {len(jumps) - 1} times more" if len(jumps) > 1 else ""
        notes.append(
            f"the clock jumps by {gaps[row - 1]:.4g} s before row {row}, although rows come every "
            f"{1e3 * usual:.4g} ms{more}: it is taken for time that passed; if the clock was set or rows "
            f"are missing, read two pieces, rows = [0, {row - 1}] and rows = [{row}, {len(time) - 1}]"
        )
    return notes
