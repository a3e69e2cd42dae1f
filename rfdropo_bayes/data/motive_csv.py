"""Motive's export to CSV, format versions 1.2x.

The first line has facts in pairs, among them the unit of lengths. Rows of types, names, IDs, perhaps parents, and
quantities follow, then the row of axes and one row per frame. A column here is called by type, name, quantity and axis,
such as ``Rigid Body.tip.Position.X``, ``Marker.tip:Marker 001.Position.Y`` or ``Rigid Body.tip.Rotation.W``; if two
have the same name, their IDs follow it, and then numbers. Cells of a lost marker are empty. Errors and qualities are
skipped.

Motive stores no commands: they are in a separate file (`CsvColumns.command_time`). Its times begin with the take.
"""

from __future__ import annotations

import csv
import io
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from rfdropo_bayes.data.csv_table import MOTIVE, CsvTable, read_text
from rfdropo_bayes.errors import InputError

FORMAT = "motive-csv"
TIME = "Time (Seconds)"
LENGTH_UNITS = {"meters": "m", "centimeters": "cm", "millimeters": "mm"}
QUANTITIES = ("Position", "Rotation")
PASSED_OVER = "passed over"


class MotiveFile(NamedTuple):
    """A take."""

    table: CsvTable  # times [s], positions in the file's unit, and rotations
    length_unit: str | None  # "m", "cm" or "mm"; None if the header does not state it


def read_motive(path: Path) -> MotiveFile:
    """Read an export of Motive's.

    Raises:
        InputError: the file is not an export of Motive, has no row of axes or no positions, or is damaged (see
        `CsvTable`).
    """
    lines = read_text(path).replace("\r\n", "\n").replace("\r", "\n").split("\n")
    if not lines[0].startswith(MOTIVE):
        raise InputError(
            f"is not an export of Motive: its first line does not begin with {MOTIVE!r}",
            where=str(path),
            remedy="export it with header information, or use format = 'csv'",
        )
    axes = next((row for row, line in enumerate(lines) if line.startswith("Frame,")), None)
    if axes is None:
        remedy = "export it again, with header information"
        raise InputError("has no row of axes (Frame, Time (Seconds), X, Y, Z, ...)", where=str(path), remedy=remedy)
    names = _names([next(csv.reader([line])) for line in lines[1 : axes + 1] if line.strip()], path)
    if not any(name.endswith("Position.X") for name in names):
        remedy = "export rigid bodies or markers, with positions"
        raise InputError("has no positions", where=str(path), remedy=remedy)
    header = io.StringIO()
    csv.writer(header, lineterminator="").writerow(names)
    table = CsvTable.of_lines(path, [header.getvalue(), *lines[axes + 1 :]])
    table.frame = table.frame[[name for name in table.frame.columns if not name.startswith(PASSED_OVER)]]
    return MotiveFile(table, _length_unit(lines[0], path))


def _names(rows: list[list[str]], path: Path) -> list[str]:
    """Names of the columns; columns of anything but times, positions and rotations are only numbered."""
    *above, axes = [[cell.strip() for cell in row] for row in rows]
    if len(above) < 3:
        remedy = "export it again, with header information"
        raise InputError("lacks the rows of types, names and quantities above the axes", where=str(path), remedy=remedy)
    above = [row + [""] * (len(axes) - len(row)) for row in above]
    labelled = {row[1]: row for row in above if row[1]}
    kinds, called = labelled.get("Type", above[0]), labelled.get("Name", above[1])
    identities, quantities = labelled.get("ID", above[2] if len(above) > 3 else [""] * len(axes)), above[-1]
    taken, given = Counter(zip(kinds, called, quantities, axes, strict=False)), Counter[str]()
    names = []
    for column, axis in enumerate(axes):
        kind, name, quantity = kinds[column], called[column], quantities[column]
        if quantity in QUANTITIES and axis:
            twice = taken[kind, name, quantity, axis] > 1
            told = f"{kind}.{name}{f' {identities[column]}' if twice else ''}"
            given[f"{told} {quantity} {axis}"] += 1
            again = given[f"{told} {quantity} {axis}"]
            names.append(f"{told}{f' {again}' if again > 1 else ''}.{quantity}.{axis}")
        else:
            names.append(axis if axis == TIME else f"{PASSED_OVER} {column}")
    return names


def _length_unit(first: str, path: Path) -> str | None:
    facts = next(csv.reader([first]))
    told = dict(zip(facts[::2], facts[1::2], strict=False)).get("Length Units", "").strip()
    if told and told.lower() not in LENGTH_UNITS:
        raise InputError(f"lengths in {told!r}", where=str(path), remedy="export it in meters or millimeters")
    return LENGTH_UNITS.get(told.lower())
