"""Files that hold several recordings: a clock that begins anew, or a column that names a row's session or trial."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from rfdropo_bayes.data.csv_table import CsvTable
from rfdropo_bayes.data.sample_times import ANEW
from rfdropo_bayes.files import output_folder
from rfdropo_bayes.verbs.column_names import Guess, names_of

SESSION = re.compile(r"(?<![a-z])(sessions?|days?|dates?|arms?|robots?|specimens?)(?![a-z])", re.IGNORECASE)
TRIAL = re.compile(r"(?<![a-z])(trials?|episodes?|runs?|experiments?)(?![a-z])", re.IGNORECASE)
MOST = 40  # recordings in a file: more changes are no recordings
FEWEST = 10  # rows of a recording


def split_files(folder: Path, recordings: Sequence[Path], guess: Guess) -> dict[Path, str]:
    """The recordings, with each file of several recordings split into files below a folder; and why, in words, for the
    first part of a file that was split, else empty.

    Parts of a file that names sessions are called after the number of their session, so that groups can be made.
    """
    found: dict[Path, str] = {}
    for path in recordings:
        table = CsvTable(path, (), names=guess.names, machine_written=False)
        used = [guess.time, *guess.commands, *names_of(guess.positions), *guess.tensions, *guess.motor_angles]
        session, trial = (_numbers(table.frame, used, names) for names in (SESSION, TRIAL))
        changes = [np.diff(session) != 0, np.diff(trial) != 0, _begins_anew(_clock(table, guess))]
        starts = np.append(0, np.flatnonzero(np.any(changes, axis=0)) + 1)
        ends = np.append(starts[1:], len(table))
        if not 1 < len(starts) <= MOST or np.min(ends - starts) < FEWEST:
            found[path] = ""
            continue
        names = [f"_session_{session[start] + 1}" if session.any() else "" for start in starts]
        below = output_folder(folder / "recordings")
        for number, (name, start, end) in enumerate(zip(names, starts, ends, strict=True)):
            count = sum(other == name for other in names[: number + 1])
            part = below / f"{path.name.partition('.')[0]}{name}_{count}.csv"
            _write(part, table, table.frame.iloc[start:end], named=guess.names is None)
            rows = ", ".join(str(row) for row in starts[1:])
            words = f"{path.name} holds {len(starts)} recordings, split before rows {rows}"
            found[part] = "" if number else "; ".join([words, *table.notes])
    return found


def _clock(table: CsvTable, guess: Guess) -> np.ndarray:
    """Times of the rows, in any unit; zeros without times."""
    if guess.time is None or guess.time not in table:
        return np.zeros(len(table))
    return np.asarray(table.stamps(guess.time, guess.time_unit).ticks, dtype=float)


def _begins_anew(clock: np.ndarray) -> np.ndarray:
    """Whether the clock is set back far after each row."""
    gaps = np.diff(clock)
    usual = float(np.median(np.abs(gaps))) if len(gaps) else 0.0
    return gaps < -ANEW * usual if usual > 0.0 else np.zeros(len(gaps), dtype=bool)


def _numbers(frame: pd.DataFrame, used: Sequence[str | None], names: re.Pattern[str]) -> np.ndarray:
    """Number of the session or trial of each row, by the columns with such ``names``, in the order of the rows."""
    beside = [name for name in frame.columns if name not in used and names.search(str(name))]
    named = [name for name in beside if frame[name].nunique() <= MOST]
    if not named:
        return np.zeros(len(frame), dtype=int)
    return pd.factorize(frame[named].astype(str).agg(" ".join, axis=1))[0]


def _write(path: Path, table: CsvTable, rows: pd.DataFrame, *, named: bool) -> None:
    lines = [
        ";".join(rows.columns),
        *([";".join(table.units.get(name, "") for name in rows.columns)] if table.units else []),
    ]
    text = rows.to_csv(sep=";", index=False, header=False)
    path.write_text("".join(f"{line}\n" for line in (lines if named else [])) + text, encoding="utf-8")
