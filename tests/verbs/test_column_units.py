"""Units of columns: as names and lines of units tell them, else from sizes and motion, with the evidence."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from rfdropo_bayes.data.csv_table import CsvTable
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.verbs.column_units import command_time_unit, command_unit, time_unit, unit_in_names, unit_of_places

ROWS = 161
NOISE = np.random.default_rng(0).normal(size=(2 * ROWS, 3))


def held(every: int) -> np.ndarray:
    """Poses [mm] that a body goes to at once and holds for some rows."""
    return 10.0 * np.repeat(NOISE[: ROWS // every + 1], every, axis=0)[:ROWS] + 0.3 * NOISE[-ROWS:] + [0.0, 0.0, 120.0]


def swinging(seconds: float, hertz: float = 0.7) -> np.ndarray:
    time = seconds * np.arange(ROWS)
    return np.column_stack([20.0 * np.sin(2.0 * np.pi * hertz * time), 0.0 * time, 120.0 + 0.0 * time])


def table(time: np.ndarray, name: str = "t") -> CsvTable:
    return CsvTable.of_frame(pd.DataFrame({name: time}), "run", ())


@pytest.mark.parametrize(
    ("step", "places", "whole", "unit"),
    [
        (1.0, held(5), False, "s"),
        (1.0, held(5), True, "s"),
        (2.0, held(3), True, "s"),
        (5.0, held(3), True, "s"),
        (0.55, held(1), False, "s"),
        (0.02, swinging(0.02), False, "s"),
        (20.0, swinging(0.02), True, "ms"),
        (16.7, swinging(0.0167), False, "ms"),
        (2.0, swinging(0.002, 2.0), True, "ms"),
        (4000.0, swinging(0.004), True, "us"),
        (2e7, swinging(0.02), True, "ns"),
        (20.0, swinging(0.02, 0.0), True, "ms"),
    ],
)
def test_times_are_in_the_unit_in_which_a_soft_body_moves_so(step, places, whole, unit):
    time = 1000.0 * step + step * np.arange(ROWS)
    found = time_unit(table(time.round().astype("int64") if whole else time), "t", places)
    assert found.unit == unit
    assert f"of {ROWS} rows" in found.evidence


def test_stamps_since_1970_tell_their_unit_and_a_name_needs_no_evidence():
    found = time_unit(table(1_714_557_600_000 + 700 * np.arange(ROWS)), "t", held(1))
    assert found.unit == "ms"
    assert found.evidence == "112 s of 161 rows, 1.429 a second, counted from 1970"
    assert time_unit(table(np.arange(ROWS), "t [ms]"), "t [ms]", held(1)) == ("ms", {}, "")


def test_commands_last_as_long_as_the_recording():
    assert command_time_unit(table(np.arange(9)), "t", 8.0).unit == "s"
    assert command_time_unit(table(1000 * np.arange(9)), "t", 8.0).unit == "ms"


def named(*names: str, **units: str) -> CsvTable:
    found = CsvTable.of_frame(pd.DataFrame({name: np.arange(5.0) for name in names}), "run", ())
    found.units = units
    return found


def test_columns_may_be_in_several_units_of_one_kind():
    names = ("a_mm", "b_cm", "c_mm")
    assert unit_in_names(named(*names), names) == ("mm", {"b_cm": "cm"}, "")
    assert unit_in_names(named("a", "b", a="cm", b="cm"), ("a", "b")) == ("cm", {}, "")
    assert unit_in_names(named("a", "b"), ("a", "b")) is None
    assert unit_in_names(named("a_cm", "b"), ("a_cm", "b")).evidence == "a_cm tells it, and b tells none"
    with pytest.raises(InputError, match="a_mm in mm, b_deg in deg"):
        unit_in_names(named("a_mm", "b_deg"), ("a_mm", "b_deg"))


@pytest.mark.parametrize(
    ("names", "unit"),
    [
        (("valve1_pct", "valve2_pct"), "%"),
        (("u1 [%]", "u2 [%]"), "%"),
        (("duty_1", "duty_2"), "%"),
        (("u1_V", "u2_V"), "V"),
        (("voltage1", "voltage2"), "V"),
        (("p1 (kPa)", "p2 (kPa)"), "kPa"),
        (("valve1_bar", "valve2_bar"), "bar"),
        (("p_mbar", "q_mbar"), "mbar"),
        (("pressure_1", "pressure_2"), "bar"),
        (("F_NE", "F_SW"), "N"),
        (("tension1", "tension2"), "N"),
        (("Motor 1 [Grad]", "Motor 2 [Grad]"), "deg"),
        (("pull_1_in", "pull_2_in"), "in"),
        (("pull_1 (in)", "pull_2 (in)"), "in"),
        (("pull_in_1", "pull_in_2"), "mm"),
        (("c1", "c2"), "mm"),
    ],
)
def test_units_of_commands_by_their_names(names, unit):
    whole = named(*names)
    assert command_unit(whole, whole.frame, names).unit == unit


@pytest.mark.parametrize(("unit", "size"), [("m", 1.0), ("cm", 100.0), ("mm", 1000.0)])
def test_lengths_are_in_the_unit_in_which_markers_are_as_far_apart_as_on_the_robot(unit, size):
    heights = {"middle": 0.06, "tip": 0.12}
    start = size * np.array([[1.3, 0.2, 0.7], [1.31, 0.21, 0.755]])
    assert unit_of_places(start, heights).unit == unit
    assert unit_of_places(size * np.array([[0.0, 0.01, 0.119]]), {"tip": 0.12}).unit == unit
    assert unit_of_places(size * np.array([[0.4, 0.01, 0.119]]), {"tip": 0.12}) is None


@pytest.mark.parametrize(
    ("names", "values", "unit"),
    [
        (("enc_A", "enc_B"), [12, -40], "counts"),
        (("c1", "c2"), [12, 2047], "counts"),
        (("c1", "c2"), [12, -40], "mm"),
        (("c1", "c2"), [12.5, 2047.0], "mm"),
    ],
)
def test_large_whole_numbers_and_encoders_are_counts(names, values, unit):
    whole = CsvTable.of_frame(pd.DataFrame([dict.fromkeys(names, value) for value in values]), "run", ())
    assert command_unit(whole, whole.frame, names).unit == unit
