"""Units of columns: from names or a line of units, else guessed from sizes, with the evidence."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from rfdropo_bayes.data import named_columns
from rfdropo_bayes.data.csv_table import CsvTable
from rfdropo_bayes.data.named_columns import COMMAND_UNITS, METRES
from rfdropo_bayes.data.sample_times import PER_SECOND, row_interval
from rfdropo_bayes.errors import InputError

WORD = re.compile(r"[a-z0-9]+")
UNITS = (
    {unit: unit for unit in ("mm", "cm", "m", "deg", "rad")}
    | dict.fromkeys(
        ("count", "counts", "cnt", "cnts", "tick", "ticks", "pulse", "pulses", "steps", "qc"), named_columns.COUNTS
    )
    | {"inch": "in", "inches": "in", "grad": "deg"}
)
"""Words in the name of a column, and their unit; "Grad" is German for degrees."""
INCHES = re.compile(r"[_ .\[(]in[\])]?$")  # how a name ends whose unit is "in", which is also a word
FOREIGN = {
    "%": re.compile(r"%|(?<![a-z])(percent|percentage|pct|duty|pwm)(?![a-z])", re.IGNORECASE),
    "V": re.compile(r"volt|[_ .\[(]m?V[\])]?$|^m?V$"),
    "A": re.compile(r"(?<![a-z])amps?(?![a-z])|[_ .\[(]m?A[\])]?$|^m?A$"),
    **{
        unit: re.compile(rf"(?<![a-z]){unit}(?![a-z])", re.IGNORECASE)
        for unit in ("mbar", "bar", "psi", "kPa", "MPa", "Pa")
    },
    "N": re.compile(r"newton|[_ .\[(]N[\])]?$|^N$"),
}
"""Units of commands that are neither a length of cable nor an angle of a motor."""
FORCE = re.compile(r"force|kraft|tension|load|(?<![a-z])[fn]\d|(?<![a-z])f_", re.IGNORECASE)
ENCODER = re.compile(r"(?<![a-z])enc(oder)?(?![a-z])", re.IGNORECASE)
PRESSURE = re.compile(r"(?<![a-z])pressures?(?![a-z])", re.IGNORECASE)
SHORT_PRESSURE = re.compile(r"p_?\d+", re.IGNORECASE)  # or a pull: the motion must rule lengths out
PASCALS_ABOVE, KILOPASCALS_ABOVE = 2e3, 10.0  # largest pressures in chambers of soft robots in kPa, and in bar
ANGLES = ("rad", "deg", named_columns.COUNTS)
ANGLE = re.compile(r"motor|servo|joint|theta|angle|(?<![a-z])q_?\d", re.IGNORECASE)
TIME_UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("ms", "msec", "millis", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "usec", "micros", "microseconds", "µs", "μs"), "us"),
    **dict.fromkeys(("ns", "nsec", "nanos", "nanoseconds"), "ns"),
}
"""Words in the name of a column of times, and their unit."""
SINCE_1970 = (0.9e9, 4.2e9)  # seconds since 1970 in the years 1998 to 2103: stamps between them have a known unit
LONGEST_STEP = 100.0
"""Longest time between rows [s] with which such stamps are believed: a counter may run through the same numbers."""
USUAL_STEP, USUAL_RATE = 0.02, 0.5
"""Times between rows [s] and rates of motion [Hz] that recordings of soft robots have, to within decades."""
FASTEST_MOTION = 20.0  # rate of motion [Hz] that no soft robot has: the mean rate, by its speed over its spread
NOT_TOLD, NOT_WHOLE = 2.0, 4.0
"""How much speaks for seconds that no name tells another unit, and that stamps have decimals, in squared decades."""
RESTING = 3e-3  # share of the largest coordinate: markers that spread by less rest, and show the rate of noise
MILLIMETRES_ABOVE, DEGREES_ABOVE = 5.0, 20.0
"""Largest motion of a soft arm in metres, and largest turn of its drives in radians."""
COUNTS_ABOVE = 1e3  # largest of whole numbers that no cable moves in mm, nor a motor in deg
METRIC = ("m", "cm", "mm")  # units that are told by a size: inches and centimetres are within a factor of three
SERVO_PULSE = 400.0  # [us], the shortest pulse of a hobby servo; duty cycles are up to 100 % or 255
AS_PULSES = (
    "pulses of servos in us are --command-unit counts --counts-per-turn 4000, if 1000 us turn a servo by 90 degrees"
)
METRES_UP_TO = 0.2  # largest plausible pull of a cable of a soft arm [m]


BENT, UPRIGHT = 2.0, 1.1
"""By which factor two markers may be nearer than on the undeformed robot, and a single marker's distance may differ
from its height: its origin need not be the base."""


class Unit(NamedTuple):
    """A unit of columns."""

    unit: str  # unit of most of them
    others: Mapping[str, str] = {}  # columns in other units, which convert to it
    evidence: str = ""  # why it was guessed; empty if the names or a line of units have it


def unit_in_names(
    table: CsvTable, names: Sequence[str], known: Collection[str] = frozenset(UNITS.values())
) -> Unit | None:
    """The unit, one of ``known``, that columns carry in their names, as ``x1_mm``, or in a line of units below them.

    None if no column has a unit.

    Raises:
        InputError: units of several kinds, such as a length and an angle.
    """
    units = {name: unit for name in names if (unit := _of_column(table, name, known)) is not None}
    if not units:
        return None
    common = Counter(units.values()).most_common(1)[0][0]
    kinds = {_kind(unit): name for name, unit in units.items()}
    if len(kinds) > 1:
        one, other = list(kinds.values())[:2]
        raise InputError(
            f"columns of one kind are in several units: {one} in {units[one]}, {other} in {units[other]}",
            where=str(table.path),
            remedy="bring all to lengths of cable or to angles of motors, or write [data.columns] for some of them",
        )
    silent = [name for name in names if name not in units]
    evidence = f"{next(iter(units))} tells it, and {silent[0]} tells none" if silent else ""
    return Unit(common, {name: unit for name, unit in units.items() if unit != common}, evidence)


def _of_column(table: CsvTable, name: str, known: Collection[str]) -> str | None:
    for words in (table.units.get(name, ""), name):
        units = {UNITS[word] for word in WORD.findall(words.lower()) if UNITS.get(word) in known}
        units |= {"in"} if "in" in known and (words == "in" or INCHES.search(words)) else set()
        if units:
            return units.pop() if len(units) == 1 else None
    return None


def _kind(unit: str) -> str:
    return "rad" if unit == named_columns.COUNTS else COMMAND_UNITS[unit][0]


def foreign_unit(table: CsvTable, names: Sequence[str]) -> str | None:
    """The unit of commands that is neither a length nor an angle, if all of some columns have it."""
    for unit, words in FOREIGN.items():
        if names and all(words.search(table.units.get(name, "")) or words.search(name) for name in names):
            return unit
    return None


def length_unit(values: pd.DataFrame) -> Unit:
    """The unit of positions by their size."""
    largest = float(np.nanmax(np.abs(values.to_numpy())))
    return Unit("mm" if largest > MILLIMETRES_ABOVE else "m", evidence=f"positions reach {largest:.3g}")


def unit_of_places(start: Float[np.ndarray, "marker 3"], heights: Mapping[str, float]) -> Unit | None:
    """The unit in which distances between markers, or of a single marker from the base, match the robot.

    None if no unit agrees.

    Args:
        start: first seen position of each marker, in the unknown unit.
        heights: heights of the same markers on the robot [m], in their order.
    """
    names, height = list(heights), np.array(list(heights.values()))
    i, j = int(np.argmin(height)), int(np.argmax(height))
    single = i == j
    distance = float(np.linalg.norm(start[j] - (0.0 if single else start[i])))
    known = float(height[j] - (0.0 if single else height[i]))
    if not (np.isfinite(distance) and distance > 0.0 and known > 0.0):
        return None
    off = {unit: abs(np.log(distance * METRES[unit] / known)) for unit in METRES}
    unit = min(METRIC, key=off.__getitem__)
    most = np.log(BENT if not single else UPRIGHT)
    unit = unit if off[unit] <= most else "in"
    if off[unit] > most:
        return None
    words = f"{names[j]} is {distance:.3g} from " + ("the origin" if single else names[i])
    return Unit(unit, evidence=f"{words}, and {1e3 * known:.4g} mm on the robot")


def command_unit(table: CsvTable, values: pd.DataFrame, names: Sequence[str]) -> Unit:
    """The unit of commands by their names, or else by their size."""
    named = unit_in_names(table, names)
    if named is not None or not names:
        return named or Unit("mm")
    foreign = foreign_unit(table, names)
    largest = float(np.nanmax(np.abs(values[list(names)].to_numpy())))
    if foreign is not None:
        pulses = foreign == "%" and largest > SERVO_PULSE
        return Unit(foreign, evidence=f"{_span(names)} reach {largest:.3g}: {AS_PULSES}" if pulses else "")
    if all(ANGLE.search(name) for name in names):
        return angle_unit(values, names)
    if all(FORCE.search(name) for name in names):
        return Unit("N", evidence=f"{_span(names)} are called forces, and reach {largest:.3g}")
    if all(PRESSURE.search(name) for name in names):
        return Unit(pressure_unit(largest), evidence=f"{_span(names)} reach {largest:.3g}")
    evidence = f"{_span(names)} reach {largest:.3g}"
    if all(pd.api.types.is_integer_dtype(values[name]) for name in names):
        evidence += " in whole numbers, as counts do"
        if largest > COUNTS_ABOVE or all(ENCODER.search(name) for name in names):
            return Unit(named_columns.COUNTS, evidence=evidence)
    return Unit("mm" if largest > METRES_UP_TO else "m", evidence=evidence)


def pressure_unit(largest: float) -> str:
    """The unit of pressures by the largest of them."""
    return "Pa" if largest > PASCALS_ABOVE else "kPa" if largest > KILOPASCALS_ABOVE else "bar"


def angle_unit(values: pd.DataFrame, names: Sequence[str]) -> Unit:
    """The unit of angles by their size."""
    largest = float(np.nanmax(np.abs(values[list(names)].to_numpy())))
    return Unit("deg" if largest > DEGREES_ABOVE else "rad", evidence=f"{_span(names)} reach {largest:.3g}")


def _span(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}"


def time_units_in_names(table: CsvTable, name: str) -> set[str]:
    """Units of time by the words in a column's name, or by the line of units below it."""
    words = re.findall(r"[^\W_]+", f"{table.units.get(name, '')}".lower()) or re.findall(r"[^\W_]+", name.lower())
    return {TIME_UNITS[word] for word in words if word in TIME_UNITS}


def time_unit(table: CsvTable, time: str | None, places: np.ndarray | None = None) -> Unit:
    """The unit of times by a name or a line of units, or else by their size and the motion between rows.

    Args:
        table: table with these columns.
        time: column of times; None without times.
        places: positions of the markers in any unit, a row of coordinates for each time; None if unknown.
    """
    if time is None or len(table) < 2 or time in table.joined:
        return Unit("s")
    stamps = table.stamps(time, "s")
    units = time_units_in_names(table, time)
    if stamps.dated or len(units) == 1:
        return Unit("s" if stamps.dated else units.pop())
    interval, first = row_interval(stamps.since(stamps, str(table.path))), float(stamps.ticks[0])
    count = float(stamps.ticks[-1] - stamps.ticks[0])
    since = [
        unit
        for unit, ticks in PER_SECOND.items()
        if SINCE_1970[0] < first / ticks < SINCE_1970[1] and interval / ticks < LONGEST_STEP
    ]
    unit = since[0] if since else _likeliest(interval, bool((stamps.ticks % 1 != 0).any()), _rate(places))
    seconds = interval / PER_SECOND[unit]
    rate = f"{1.0 / seconds:.4g} a second" if seconds <= 1.0 else f"one every {seconds:.3g} s"
    words = f"{count / PER_SECOND[unit]:.3g} s of {len(table)} rows, {rate}"
    return Unit(unit, evidence=words + (", counted from 1970" if since else ""))


def command_time_unit(table: CsvTable, time: str | None, duration: float) -> Unit:
    """The unit of the commands' times: as given, or the unit in which their duration equals the recording's [s]."""
    guess = time_unit(table, time)
    if time is None or not guess.evidence or duration <= 0.0 or "1970" in guess.evidence:
        return guess
    stamps = table.stamps(time, "s")
    count = float(stamps.ticks[-1] - stamps.ticks[0])
    unit = min(PER_SECOND, key=lambda unit: abs(np.log10(max(count, 1e-9) / PER_SECOND[unit] / duration)))
    return Unit(unit, evidence=f"commands over {count / PER_SECOND[unit]:.3g} s, the recording over {duration:.3g} s")


def _rate(places: np.ndarray | None) -> float:
    """Mean rate of motion, in turns a row: speed over amplitude of the markers; zero at rest."""
    if places is None or len(places) < 3:
        return 0.0
    step, extent = np.sqrt(np.nanmean(np.diff(places, axis=0) ** 2)), np.sqrt(np.nanmean(np.nanvar(places, axis=0)))
    return float(step / (2.0 * np.pi * extent)) if extent > RESTING * np.nanmax(np.abs(places)) else 0.0


def _likeliest(interval: float, decimals: bool, rate: float) -> str:
    """The unit in which time between rows and rate of motion are most plausible for soft robots.

    A unit is excluded if the motion would be too fast for a soft robot. Rows between which markers move to and fro are
    poses at rest, seconds apart.
    """

    def unlikely(unit: str) -> tuple[bool, float]:
        seconds = interval / PER_SECOND[unit]
        motion = rate / seconds
        far = np.log10(seconds / USUAL_STEP) ** 2 + (np.log10(motion / USUAL_RATE) ** 2 if rate else 0.0)
        return motion > FASTEST_MOTION, far + (unit != "s") * (NOT_TOLD + NOT_WHOLE * decimals)

    return min(PER_SECOND, key=unlikely)
