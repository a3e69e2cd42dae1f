"""Reading a numeric CSV file strictly: a recording that was cut short must not pass for a shorter recording."""

from __future__ import annotations

import codecs
import difflib
import gzip
import io
import re
import zlib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float

from rfdropo_bayes.data.csv_layout import (
    cells_of,
    dialect_of,
    header_of,
    marker_block,
    table_lines,
    units_above,
    without_names,
)
from rfdropo_bayes.data.sample_times import PER_SECOND, Stamps, dated, numbers_of, read_stamps
from rfdropo_bayes.errors import InputError

HEAD = 100_000  # letters of a file that hold its first rows
JSON = ("{", "[{", "[[")  # how JSON begins
_SECONDS, _NANOSECONDS = (
    re.compile(rf"(.*?){word}", re.IGNORECASE) for word in ("s(?:ecs?|econds)", "n(?:ano)?s(?:ecs?|econds)")
)
GIVE_CSV = "give a CSV file, plain or gzipped"
MOTIVE = "Format Version"  # how the first line of an export of Motive's begins


def closest(name: str, known: Sequence[str]) -> str:
    """Hint that names the known entry nearest to ``name``, upper or lower case, or lists all if none is near."""
    folded = {entry.casefold(): entry for entry in known}
    near = difflib.get_close_matches(name.casefold(), list(folded), n=1, cutoff=0.5)
    if near:
        return f"did you mean {folded[near[0]]!r}?"
    shown = ", ".join(known[:12]) + (", ..." if len(known) > 12 else "")
    return f"nothing else there looks like it: {shown}"


def read_text(path: Path) -> str:
    """Text of a plain or gzipped file.

    Raises:
        InputError: the file is missing, unreadable, a damaged gzip archive, not text, or JSON.
    """
    if path.is_dir():
        raise InputError("is a folder, not a file", where=str(path), remedy=f'name its files, e.g. "{path.name}/*.csv"')
    try:
        raw = path.read_bytes()
    except FileNotFoundError:
        raise InputError("no such file", where=str(path), remedy="correct the path") from None
    except OSError as error:
        raise InputError(
            f"cannot be read ({error.strerror})", where=str(path), remedy="check its permissions"
        ) from None
    try:
        if raw[:2] == b"\x1f\x8b":
            raw = gzip.decompress(raw)
    except (EOFError, OSError, zlib.error):
        raise InputError("the gzip archive is cut short or damaged", where=str(path), remedy="fetch it again") from None
    text = _decoded(raw)
    if any(ord(sign) < 32 and sign not in "\t\n\r\f" for sign in text[:4096]):
        raise InputError("is not a text file", where=str(path), remedy=GIVE_CSV)
    if text.lstrip().startswith(JSON):
        raise InputError("is JSON, not a table of columns", where=str(path), remedy=GIVE_CSV)
    return text


def _decoded(raw: bytes) -> str:
    """Text in UTF-8 or, with its byte order mark, UTF-16; other text is read as Latin-1, as older loggers write it."""
    marked = raw[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    with suppress(UnicodeDecodeError):
        text = raw.decode("utf-16" if marked else "utf-8-sig")
        if "\n" in text or not marked:
            return text
    return raw.decode("latin-1")


def unnamed_rows(path: Path) -> list[list[str]] | None:
    """The cells of the first rows of a CSV that has no names of columns; None if it has names.

    Raises:
        InputError: see `read_text`.
    """
    lines = read_text(path)[:HEAD].splitlines()
    if len(lines) < 2:
        return None
    lines = table_lines(lines[:-1])  # the last line of the head may be cut
    separator = dialect_of(lines).separator
    if not without_names(lines, separator):
        return None
    return [[cell.strip() for cell in cells_of(line, separator)] for line in lines[:3]]


class CsvTable:
    """A rectangular table of numbers with named columns.

    Values may be separated by commas, semicolons, tabs, bars or spaces, and decimals may follow a comma (`dialect_of`).
    Lines that a program wrote above the names are left out (`table_lines`).
    A second line of units is no row: ``units`` maps the names of columns to their units.
    The trajectories of an export of Vicon's are read: ``rate`` is their rows a second, ``left_out`` the titles of the
    other blocks (`marker_block`). Repeated lines of names are left out; ``notes`` tell their number.

    Args:
        path: the file, plain or gzipped.
        required: columns that must be there.
        names: names of the columns, if the first line holds values.
        machine_written: files of the format are written by a program that ends every line with a newline, so a last
        line without a newline is incomplete. Otherwise a table [data.columns] names the columns.

    Raises:
        InputError: empty file, header without rows, ragged or cut rows, a missing, renamed or repeated column.
    """

    missing_remedy = "correct its name in [data.columns]"
    """Remedy for a missing column."""
    rate: float | None = None
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def __init__(
        self, path: Path, required: Sequence[str], *, names: Sequence[str] | None = None, machine_written: bool = True
    ) -> None:
        self.path = path
        if machine_written:
            self.missing_remedy = "rename the column, or use format = 'csv' with a [data.columns] mapping"
        text = read_text(path)
        ended = text.endswith("\n")
        lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
        del text  # of a long recording as large as the lines
        if lines[0].lower().startswith("sep="):  # spreadsheets write so which separator follows
            lines.pop(0)
        if lines and lines[0].startswith(MOTIVE):
            raise InputError(
                "is Motive's own export, whose header has several lines", where=str(path), remedy='use "motive-csv"'
            )
        self._parse(lines, names)
        if machine_written and not ended:
            raise InputError(
                "the last line has no newline: the file is incomplete",
                where=f"{path}, row {len(self) - 1}",
                remedy="fetch it again, or drop that row, or end it with a newline if it is whole",
            )
        self.require(required)

    def _parse(self, lines: list[str], names: Sequence[str] | None = None) -> None:
        """Read a header and rows; empty lines at the end are ignored."""
        while lines and not lines[-1].strip():
            lines.pop()
        if not lines:
            raise InputError("the file is empty", where=str(self.path), remedy="give a CSV with a header and rows")
        if len(lines) == 1:
            raise InputError("has a header but no rows", where=str(self.path), remedy="record or export it again")
        lines, self.rate, self.left_out = marker_block(lines)
        if len(lines) < 2:
            raise InputError("has no trajectories", where=str(self.path), remedy="export it again, with its markers")
        lines = table_lines(lines)
        dialect = dialect_of(lines)
        self.decimal = dialect.decimal
        header = header_of(self.path, lines, dialect.separator, names)
        rows = lines if without_names(lines, dialect.separator) else [line for line in lines[1:] if line != lines[0]]
        repeated = len(lines) - 1 - len(rows)
        if repeated > 0:
            times = "1 time" if repeated == 1 else f"{repeated} times"
            self.notes = (f"the line of names stands {times} more below: left out, and not counted as rows",)
        units = units_above(rows, dialect.separator) or []
        self.units = {name: unit for name, unit in zip(header, units, strict=bool(units)) if unit}
        rows = rows[1:] if units else rows
        _check_names(self.path, header)
        _check_rectangular(self.path, rows, dialect.separator, len(header))
        self.frame = pd.read_csv(
            io.BytesIO("\n".join(rows).encode()),
            sep=r"\s+" if dialect.separator == " " else dialect.separator,
            decimal=dialect.decimal,
            header=None,
            skipinitialspace=True,
            low_memory=False,
            index_col=False,
        )
        self.frame.columns = [name or f"Unnamed: {column}" for column, name in enumerate(header)]

    @classmethod
    def of_lines(cls, path: Path, lines: list[str]) -> CsvTable:
        """A table whose first line, the header, was made by the reader of a format.

        Raises:
            InputError: see the class.
        """
        table = cls.__new__(cls)
        table.path = path
        table._parse(lines)
        return table

    @classmethod
    def of_frame(cls, frame: pd.DataFrame, name: str, required: Sequence[str]) -> CsvTable:
        """A table in memory; ``name`` replaces its path.

        A named index is also a column; an unnamed index of dates is the column "index".

        Raises:
            InputError: no rows, a column that appears twice, or is missing.
        """
        if frame.index.name is not None or isinstance(frame.index, pd.DatetimeIndex | pd.TimedeltaIndex):
            called = frame.index.name if frame.index.name is not None else "index"
            frame = frame.reset_index(drop=called in frame.columns)
        table = cls.__new__(cls)
        table.path, table.decimal, table.units = Path(name), ".", {}
        table.frame = frame.rename(columns=str).reset_index(drop=True)
        _check_names(table.path, list(table.frame.columns))
        if len(frame) == 0:
            raise InputError("has no rows", where=name)
        table.require(required)
        return table

    @property
    def joined(self) -> dict[str, tuple[str, str]]:
        """Times in two columns, seconds and nanoseconds, as ROS writes them: the name for both, such as
        "header.stamp.sec + header.stamp.nanosec", and the names of the two. They need no unit.
        """
        names = [str(name) for name in self.frame.columns]
        fractions = {match[1]: name for name in names if (match := _NANOSECONDS.fullmatch(name))}
        wholes = {name: match[1] for name in names if (match := _SECONDS.fullmatch(name))}
        pairs = [(name, fractions[stem]) for name, stem in wholes.items() if stem in fractions]
        return {f"{name} + {rest}": (name, rest) for name, rest in pairs}

    def __len__(self) -> int:
        return len(self.frame)

    def __contains__(self, name: str) -> bool:
        return name in self.frame.columns or name in self.joined

    def require(self, names: Sequence[str]) -> None:
        """Raise an InputError if some ``names`` are not columns; it lists them and the nearest column to the first."""
        columns = list(self.frame.columns)
        missing = [name for name in names if name not in columns]
        if not missing:
            return
        spare = [column for column in columns if column not in names] or columns
        words = f"column {missing[0]!r} is missing"
        if len(missing) > 1:
            words += f" (and {', '.join(map(repr, missing[1:]))})"
        raise InputError(f"{words}; {closest(missing[0], spare)}", where=str(self.path), remedy=self.missing_remedy)

    def numbers(self, names: Sequence[str], *, allow_missing: bool = False) -> Float[np.ndarray, "rows columns"]:
        """Columns as float64; rows are counted from 0 after the header in every message.

        Raises:
            InputError: a cell that is not a number; an empty, NaN or infinite cell unless ``allow_missing``
                (then it comes back as NaN).
        """
        self.require(names)
        cells = self.frame[list(names)]
        values = np.array(cells.apply(self._number).to_numpy(dtype=np.float64, na_value=np.nan))
        text = np.isnan(values) & cells.notna().to_numpy()
        if text.any():
            row, column = np.argwhere(text)[0]
            raise InputError(
                f"{str(cells.iat[row, column])!r} is not a number",
                where=f"{self.path}, row {row}, column {names[column]!r}",
                remedy="correct the cell",
            )
        values[np.isinf(values)] = np.nan
        if not allow_missing and np.isnan(values).any():
            row, column = np.argwhere(np.isnan(values))[0]
            raise InputError(
                f"NaN or empty cell ({int(np.isnan(values).sum())} of them in all)",
                where=f"{self.path}, row {row}, column {names[column]!r}",
                remedy="repair the recording; lost markers alone may be masked with missing = 'mask' in [data]",
            )
        return values

    def stamps(self, name: str, unit: str) -> Stamps:
        """A column of times in a ``unit``, or of dates; see `read_stamps`.

        Raises:
            InputError: a cell that is empty, or neither a number nor a date.
        """
        if name not in self.frame.columns and name in self.joined:
            return self._joined_stamps(name)
        self.require([name])
        numbers, cells = self._number(self.frame[name]), self.frame[name]
        told = numbers.notna() | cells.isna()
        return read_stamps(numbers if told.all() else cells, unit, where=str(self.path), column=name)

    def _joined_stamps(self, name: str) -> Stamps:
        """Integer nanoseconds: a float of the seconds since 1970 would be coarse."""
        seconds, rest = self.numbers(self.joined[name]).T
        odd = (seconds % 1.0 != 0.0) | (rest % 1.0 != 0.0) | (rest < 0.0) | (rest >= PER_SECOND["ns"])
        if odd.any():
            row = int(np.argmax(odd))
            raise InputError(
                f"{seconds[row]:.15g} and {rest[row]:.15g} are no whole seconds and nanoseconds of a second",
                where=f"{self.path}, row {row}, columns {name}",
                remedy="correct the cells, or name one column of times",
            )
        return Stamps(seconds.astype(np.int64) * 10**9 + rest.astype(np.int64), PER_SECOND["ns"], False)

    def numeric(self, rows: int) -> pd.DataFrame:
        """The columns that hold nothing but numbers and empty cells in the first rows, as numbers."""
        cells = self.frame.head(rows)
        values = cells.apply(self._number)
        told = values.notna().any() & (values.notna() | cells.isna()).all()
        return values.loc[:, told]

    def _number(self, cells: pd.Series) -> pd.Series:
        """Cells of a column as numbers; pandas leaves a column with any text unchanged. Dates are not numbers."""
        if dated(cells):
            return pd.Series(np.nan, index=cells.index)
        if self.decimal == "," and not pd.api.types.is_numeric_dtype(cells):
            cells = cells.map(
                lambda cell: str(cell).replace(",", ".") if "." not in str(cell) else "", na_action="ignore"
            )
        return numbers_of(cells)

    def points(self, names: Sequence[str], *, allow_missing: bool = False) -> Float[np.ndarray, "rows points 3"]:
        """Columns x, y, z of several points, in the order of ``names``."""
        return self.numbers(names, allow_missing=allow_missing).reshape(len(self), -1, 3)

    def pose(
        self, names: Sequence[str], unit: float, *, allow_missing: bool = False
    ) -> Float[np.ndarray, "rows 7"] | None:
        """Position and quaternion from columns whose length ``unit`` is in metres; None without columns."""
        if not any(name in self for name in names):
            return None
        values = self.numbers(names, allow_missing=allow_missing)
        values[:, :3] *= unit
        return values


def _check_names(path: Path, names: Sequence[str]) -> None:
    repeated = sorted({name for name in names if name and names.count(name) > 1})  # spreadsheets add nameless columns
    if repeated:
        remedy = "rename one of them"
        if repeated[0].lower() in ("x", "y", "z"):
            remedy += ", such as tip_x and mid_x, or keep the line of the markers' names above them"
        raise InputError(f"column {repeated[0]!r} appears twice", where=str(path), remedy=remedy)


def _check_rectangular(path: Path, rows: Sequence[str], separator: str, fields: int) -> None:
    for row, line in enumerate(rows):
        if separator != " " and '"' not in line and line.count(separator) == fields - 1:
            continue
        count = len(cells_of(line, separator))
        if count != fields:
            last = row == len(rows) - 1
            raise InputError(
                f"has {count} values, but the header names {fields}" + (": the file is cut short" if last else ""),
                where=f"{path}, row {row}",
                remedy="separate values by semicolons if decimals follow a comma"
                if count == 2 * fields
                else ("fetch the file again or drop the row" if last else "repair the row"),
            )
