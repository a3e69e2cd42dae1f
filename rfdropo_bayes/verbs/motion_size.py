"""Whether markers move as far as the nominal model does under the same commands, and which unit would explain it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from rfdropo_bayes.data.named_columns import COMMAND_UNITS, CsvColumns
from rfdropo_bayes.verbs.motion_direction import Paths

OFF = 3.0
"""Ratio of two motions above which a unit is doubted. A nominal model is within a factor of two if commands impose
lengths or angles, and the nearest units are a factor of ten apart. The ratio is 0.5 to 1.6 for four real robots.
"""
FAR_OFF = 30.0
"""The same for commands that are forces: how far they bend a body depends on its stiffness, which is not known."""
EXPLAINED = 2.0  # A unit explains a motion that is within this factor of the measured motion
IMPOSED = ("m", "rad")  # units of commands that impose cable lengths


class Size(NamedTuple):
    """Root mean square motion of the markers about their mean [m]."""

    measured: float
    nominal: float

    @property
    def ratio(self) -> float:
        """Measured over nominal; 1 if neither moves."""
        if self.nominal == 0.0:
            return 1.0 if self.measured == 0.0 else float("inf")
        return self.measured / self.nominal

    def within(self, factor: float) -> bool:
        """Whether both motions have the same size."""
        return 1.0 / factor <= self.ratio <= factor


def size_of(recordings: Iterable[Paths]) -> Size:
    """Size of the markers' motion in recordings, and under the nominal model at the same rows."""
    squares, count = np.zeros(2), 0
    for paths in recordings:
        for k in range(paths.mask.shape[1]):
            seen = paths.mask[:, k]
            if seen.any():
                both = (paths.measured[seen, k], paths.nominal[seen, k])
                squares += [np.sum((each - each.mean(axis=0)) ** 2) for each in both]
                count += int(seen.sum())
    measured, nominal = np.sqrt(squares / max(count, 1))
    return Size(float(measured), float(nominal))


def limit_of(command_unit: str) -> float:
    """The ratio at or above which the size of a motion is doubted, by the unit of a recording's commands."""
    return OFF if command_unit in IMPOSED else FAR_OFF


class Unit(NamedTuple):
    """Another unit of the commands, and its ratio to the unit that was read."""

    name: str
    factor: float


def other_units(columns: CsvColumns | None, command_unit: str) -> list[Unit]:
    """Units that commands may have been in: named units first, then powers of ten; none for forces."""
    if command_unit not in IMPOSED:
        return []
    own = None if columns is None else COMMAND_UNITS.get(columns.command_unit)
    named = (
        [] if own is None else [Unit(n, size / own[1]) for n, (kind, size) in COMMAND_UNITS.items() if kind == own[0]]
    )
    powers = [Unit("", 10.0**power) for power in (-3, -2, -1, 1, 2, 3)]
    known = [unit.factor for unit in named]
    return [
        *(unit for unit in named if unit.factor != 1.0),
        *(unit for unit in powers if not np.isclose(known, unit.factor).any()),
    ]


def likely_units(units: Sequence[Unit], size: Size | None) -> list[Unit]:
    """Units by the agreement of sizes, best first.

    Without a size, because the simulation failed under commands that may be too large: smaller units.
    """
    if size is None:
        return sorted((unit for unit in units if unit.factor < 1.0), key=lambda unit: -unit.factor)
    ratio = float(np.clip(size.ratio, 1e-9, 1e9))
    towards = [unit for unit in units if (unit.factor > 1.0) == (ratio > 1.0)]
    return sorted(towards, key=lambda unit: abs(np.log(unit.factor / ratio)))


def size_sentence(size: Size, columns: CsvColumns | None, explained: tuple[Unit, Size] | None) -> str:
    """A size that is doubted, in words, with the unit that explains it and the motion under that unit."""
    times = f"{size.ratio:.2g} times" if size.ratio >= 1.0 else f"1/{1.0 / size.ratio:.2g}"
    said = (
        f"the markers move by {1e3 * size.measured:.3g} mm (root mean square about their mean) and the nominal model "
        f"under the same commands by {1e3 * size.nominal:.3g} mm: {times} as far"
    )
    return f"{said}; {unit_words(columns, explained)}"


def unit_words(columns: CsvColumns | None, explained: tuple[Unit, Size] | None) -> str:
    """Remedy: the line to write."""
    known = columns is not None and columns.command_unit in COMMAND_UNITS
    if explained is None:
        more = "" if known else ", counts_per_turn"
        return f"look at command_unit{more} and position_unit, and at spool_radius and gain of the robot file"
    unit, then = explained
    moved = f"would make it {1e3 * then.nominal:.3g} mm"
    if unit.name:
        return f'command_unit = "{unit.name}" in [data.columns] {moved}'
    return (
        f"commands {unit.factor:g} times as large {moved}: look at their unit, and at the gain of the robot's channels"
    )
