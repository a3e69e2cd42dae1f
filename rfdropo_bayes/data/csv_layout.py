"""Layout of a table's text: its separator and decimal sign, and whether names and units stand above it."""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

from rfdropo_bayes.errors import InputError

SEPARATORS = (",", ";", "\t", "|", " ")
"""In the order in which they are preferred; a space stands for any number of spaces and tabs."""
SAMPLED = 40  # rows that are tried with each separator
MOST_SHOWN = 120  # letters of a row that an error shows
COMMENTS = ("#", "%", "//")  # how lines begin that are not part of a table
_MARKED = re.compile(r"\s*#+\s*(?=[\w\"])")  # a comment sign in front of the names of columns, as NumPy writes it
_NUMBER = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)(e[+-]?\d+)?|[+-]?(nan|inf|infinity)|na|null|none", re.IGNORECASE)
_COMMA = re.compile(r"[+-]?\d*,\d+(e[+-]?\d+)?", re.IGNORECASE)
_DATE = re.compile(r"\d{4}-\d\d-\d\d([T ].*)?|\d+:\d\d(:\d\d)?([.,]\d+)?")
_UNITS = re.compile(
    r"s|sec|seconds?|ms|milliseconds?|[uµμ]s|microseconds?|ns|h|min|hz|m|cm|mm|[uµμ]m|metres?|meters?|"
    r"deg|degrees?|°|rad|radians?|counts?|ticks?|steps?|pulses?|n|kn|newtons?|n ?m|v|mv|volts?|a|ma|amps?|"
    r"%|percent|pct|pa|kpa|mpa|bar|mbar|psi|g|kg|k|°c|degc|c|-|1|(mm|cm|m|rad|deg|°)/s(\^?2)?",
    re.IGNORECASE,
)
_AXIS = re.compile(r"[xyz]'*", re.IGNORECASE)  # a name of a column that is an axis; ' of velocities, as Vicon writes
TRAJECTORIES = "trajectories"  # title of the block of Vicon's export that holds the markers
_TITLE = re.compile(r"([a-z][a-z ]*)[\s,;]*", re.IGNORECASE)  # spreadsheets fill lines up with separators
_RATE = re.compile(r"(\d+\.?\d*)[\s,;]*(hz)?[\s,;]*", re.IGNORECASE)


class Block(NamedTuple):
    """The lines of the markers in an export of Vicon's; all lines of another file."""

    lines: list[str]
    rate: float | None = None  # rows a second, as the line below the title has it
    others: tuple[str, ...] = ()  # titles of the other blocks


class Dialect(NamedTuple):
    """Separator and decimal sign of a CSV file."""

    separator: str
    decimal: str


def cells_of(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    if '"' not in line:
        return line.split(separator)
    return next(csv.reader([line], delimiter=separator, skipinitialspace=True))


def dialect_of(lines: Sequence[str]) -> Dialect:
    """Separator and decimal sign of a table whose first line may hold names.

    The chosen separator yields the most numeric cells in the first rows. Decimals follow a comma if any cell has a
    comma in a number; separating commas are then quoted.
    """
    separator = max(SEPARATORS, key=lambda sign: _fit(lines, sign))
    rows = lines[1:] or lines
    if separator == "," and not any('"' in line for line in rows):
        return Dialect(separator, ".")
    told = (cell for line in rows if "," in line for cell in cells_of(line, separator))
    return Dialect(separator, "," if any(_COMMA.fullmatch(cell.strip()) for cell in told) else ".")


def marker_block(lines: list[str]) -> Block:
    """The block of trajectories in an export of Vicon's, without its title and rate: two lines begin each block."""
    titles = {
        row: title[1].strip()
        for row in range(len(lines) - 1)
        if (title := _TITLE.fullmatch(lines[row])) and _RATE.fullmatch(lines[row + 1])
    }
    start = next((row for row, title in titles.items() if title.lower() == TRAJECTORIES), None)
    if start is None:
        return Block(lines)
    end = next((row for row in titles if row > start), len(lines))
    rows = lines[start + 2 : end]
    while rows and not rows[-1].strip(" ,;\t"):
        rows.pop()
    rate = float(_RATE.sub(r"\1", lines[start + 1]))
    return Block(rows, rate or None, tuple(t for row, t in titles.items() if row != start))


def table_lines(lines: Sequence[str]) -> list[str]:
    """The lines of a table from its names on, or from its rows on if no line names them.

    Programs write other lines above a table: comments, and lines of other widths. They are left out if no row of
    values is among them. A comment sign in front of the names is removed. If the names are axes (X, Y, Z, X, Y, Z), the
    line of markers above them is joined with them.
    """
    separator = dialect_of(["", *lines[-SAMPLED:]]).separator
    widths = Counter(len(cells_of(line, separator)) for line in lines[-SAMPLED:])
    width = widths.most_common(1)[0][0]
    bare = (_MARKED.sub("", line, count=1) for line in lines)
    start = next(row for row, line in enumerate(bare) if len(cells_of(line, separator)) == width)
    while lines[start].lstrip().startswith(COMMENTS) and _is_header(lines[start + 1 : start + 2], separator, width):
        start += 1
    start += _names_axes(lines[start + 1 : start + 2], separator, width)
    above = [line for line in lines[:start] if not line.lstrip().startswith(COMMENTS)]
    first = _MARKED.sub("", lines[start], count=1)
    if start and _names_axes([first], separator, width):
        first = _with_markers(lines[start - 1], first, separator)
    if any(_holds_values(line, separator) for line in above) or (above and not _is_header([first], separator, width)):
        return list(lines)
    return [first, *lines[start + 1 :]]


def _names_axes(line: Sequence[str], separator: str, width: int) -> bool:
    """Whether a line, if there is one, is a header with columns that are called x, y and z."""
    return _is_header(line, separator, width) and set("xyz") <= {
        cell.strip().lower() for cell in cells_of(line[0], separator)
    }


def _with_markers(above: str, axes: str, separator: str) -> str:
    """A line of names, in which a marker's name precedes each of its axes, such as tip_X.

    Markers' names stand above x, or above each of their axes; a line with words elsewhere names no markers. Subjects
    (arm:tip) are left out if the markers' names differ without them.
    """
    names, over = ([cell.strip() for cell in cells_of(line, separator)] for line in (axes, above))
    markers, marker = [], ""
    for name, word in zip_longest(names, over[: len(names)], fillvalue=""):
        axis = _AXIS.fullmatch(name)
        if word and (len(over) == 1 or axis is None or (name[0] not in "xX" and word != marker)):
            return axes
        marker = (word or marker) if axis else ""
        markers.append(marker)
    bare = {marker: marker.rpartition(":")[2] for marker in markers}
    bare = bare if len(set(bare.values())) == len(bare) else {marker: marker for marker in markers}
    written = io.StringIO()
    joined = [f"{bare[marker]}_{name}" if marker else name for marker, name in zip(markers, names, strict=True)]
    csv.writer(written, delimiter=separator, lineterminator="").writerow(joined)
    return written.getvalue()


def _is_header(line: Sequence[str], separator: str, width: int) -> bool:
    """Whether a line, if there is one, has a cell for each column and no values."""
    cells = [cell.strip() for cell in cells_of(line[0], separator)] if line else []
    return len(cells) == width > 1 and not any(is_value(cell) and cell for cell in cells)


def _holds_values(line: str, separator: str) -> bool:
    """Whether a line has several cells, and more values than words."""
    cells = [cell for cell in cells_of(line, separator) if cell.strip()]
    return len(cells) > 1 and 2 * sum(is_value(cell) for cell in cells) > len(cells)


def _fit(lines: Sequence[str], separator: str) -> tuple[bool, float, int, bool, int]:
    """Score of a separator: whether there is more than one column, the share and number of numeric cells, whether each
    column has a name, and the number of names.
    """
    names = len(cells_of(lines[0], separator))
    rows = [cells_of(line, separator) for line in lines[1 : SAMPLED + 1] or lines if line.strip()]
    cells = [cell for row in rows for cell in row]
    values = sum(is_value(cell) for cell in cells)
    if separator == " " and not values:  # words of any text
        return False, 0.0, 0, False, 0
    named = bool(rows) and names == len(rows[0])
    return max(names, *map(len, rows), 0) > 1, values / max(len(cells), 1), values, named, names


def is_value(cell: str) -> bool:
    """Whether a cell holds a number, a date or nothing."""
    cell = cell.strip().strip('"').strip()
    return not cell or bool(_NUMBER.fullmatch(cell) or _DATE.fullmatch(cell))


def without_names(lines: Sequence[str], separator: str) -> bool:
    """Whether the first line of a table holds values in place of names.

    It may hold words in columns that are words below. A line of 0, 1, 2, ... numbers the columns, and so names them.
    """
    first = [cell.strip().strip('"') for cell in cells_of(lines[0], separator)]
    if first == [str(number) for number in range(len(first))] and len(lines) > 1:
        return False
    numbers = sum(bool(_NUMBER.fullmatch(cell) or _DATE.fullmatch(cell)) for cell in first)
    if 2 * numbers < len(first) or not numbers:
        return False
    below = [cells_of(line, separator) for line in lines[1 : SAMPLED + 1] if line.strip()]
    return all(
        is_value(cell) or any(column < len(row) and not is_value(row[column]) for row in below)
        for column, cell in enumerate(first)
    )


def units_above(rows: Sequence[str], separator: str) -> list[str] | None:
    """The units in the line below the names, one for each column; None if it is a row of values."""
    if len(rows) < 2:
        return None
    cells = [cell.strip().strip('"').strip("[]() ") for cell in cells_of(rows[0], separator)]
    told = [cell for cell in cells if cell]
    known = sum(bool(_UNITS.fullmatch(cell)) for cell in told)
    words = [cell for cell in told if not is_value(cell)]
    below = cells_of(rows[1], separator)
    numbered = len(below) == len(cells) and 2 * sum(is_value(cell) for cell in below) >= len(cells)
    return cells if numbered and words and 2 * known >= len(told) and 2 * len(words) > len(told) else None


def header_of(path: Path, lines: Sequence[str], separator: str, names: Sequence[str] | None) -> list[str]:
    """The names of the columns: the first line, or ``names`` if the first line holds values.

    Raises:
        InputError: a first line of values and no names for them, or a different number of names.
    """
    first = [cell.strip() for cell in cells_of(lines[0], separator)]
    if not without_names(lines, separator):
        return first
    if names is None:
        raise InputError(
            f"the first line holds values, not the names of its {len(first)} columns: {first_rows(lines[:2])}",
            where=str(path),
            remedy=f"write a line of {len(first)} names above it, or give names = [...] in [data.columns] (init: "
            '--names "t,c1,c2,tip_x,tip_y,tip_z")',
        )
    if len(names) != len(first):
        raise InputError(
            f"has {len(first)} columns, and names has {len(names)}; {first_rows(lines[:2])}",
            where=str(path),
            remedy="give one name for each column",
        )
    return list(names)


def first_rows(lines: Sequence[str]) -> str:
    """The first rows of a table, as an error shows them."""
    rows = (line.replace("\t", " ").strip() for line in lines)
    return "; ".join(f"row {k}: {row[:MOST_SHOWN]}{'...' * (len(row) > MOST_SHOWN)}" for k, row in enumerate(rows))
