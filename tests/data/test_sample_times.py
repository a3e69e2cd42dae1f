"""Times of recordings: whatever they are written as, and what is wrong with them."""

from __future__ import annotations

import re

import numpy as np
import pandas as pd
import pytest

from rfdropo_bayes.data import CsvColumns, Trajectory, find_faults
from rfdropo_bayes.data.held_readings import hold_time
from rfdropo_bayes.data.mapped_formats import read_mapped
from rfdropo_bayes.data.sample_times import (
    check_times,
    clock_notes,
    read_stamps,
    repeated_rows,
    rounded_notes,
    sample_time,
    spread_repeats,
)
from rfdropo_bayes.errors import InputError

STEP = 0.01  # [s]
TIME = STEP * np.arange(60)
SINCE_1970 = 1_530_018_381_010_286_378  # [ns]
COLUMNS = {"commands": ["u"], "command_unit": "mm", "positions": [["x", "y", "z"]], "position_unit": "mm"}


def seconds(values, unit: str = "s") -> np.ndarray:
    stamps = read_stamps(values, unit, where="run")
    return stamps.since(stamps, "run")


def table(stamps) -> pd.DataFrame:
    motion = {"u": np.sin(TIME), "x": 10.0 * np.sin(3.0 * TIME), "y": 0.5 * TIME, "z": 200.0 - TIME}
    return pd.DataFrame({"t": stamps, **motion})


DATES = pd.Timestamp("2024-03-31 01:59:59.9") + pd.to_timedelta(TIME, unit="s")
STAMPS = {
    "datetime64": DATES,
    "datetime64 in ms": DATES.astype("datetime64[ms]"),
    "a time zone whose clock is put forward": DATES.tz_localize("UTC").tz_convert("Europe/Berlin"),
    "timedelta64": pd.to_timedelta(TIME, unit="s"),
    "datetime": list(DATES.to_pydatetime()),
    "datetime in a time zone": list(DATES.tz_localize("UTC").to_pydatetime()),
    "ISO 8601": [date.isoformat() for date in DATES],
    "ISO 8601 with an offset": [date.isoformat() + "+02:00" for date in DATES],
    "as loggers of Python write it": [date.strftime("%Y-%m-%d %H:%M:%S,%f")[:-3] for date in DATES],
    "time of the day": [date.strftime("%H:%M:%S.%f") for date in DATES.shift(-1, "h")],
    "text": [f"{value:.2f}" for value in 1e3 + TIME],
}


@pytest.mark.parametrize("kind", STAMPS)
@pytest.mark.parametrize("types", ["as given", "nullable", "pyarrow", "index", "file"])
def test_dates_and_durations_are_seconds_from_the_first_row(kind, types, tmp_path):
    frame = table(STAMPS[kind])
    if types == "pyarrow":
        pytest.importorskip("pyarrow")
        frame = frame.convert_dtypes(dtype_backend="pyarrow")
    if types == "nullable":
        frame = frame.convert_dtypes()
    columns = {"time": "t", **COLUMNS}
    if types == "file":
        frame.to_csv(tmp_path / "run.csv", index=False)
        found = read_mapped("csv", tmp_path / "run.csv", CsvColumns(**columns))
    else:
        found = Trajectory.from_pandas(frame.set_index("t") if types == "index" else frame, columns)
    np.testing.assert_allclose(found.time, TIME, atol=1e-9)


def test_an_index_of_dates_without_a_name_is_a_column_of_that_name():
    frame = table(0.0).drop(columns="t").set_index(DATES)
    np.testing.assert_allclose(Trajectory.from_pandas(frame, {"time": "index", **COLUMNS}).time, TIME, atol=1e-9)


def test_whole_numbers_keep_every_digit_in_arrays_and_files(tmp_path):
    """A float holds times since 1970 to 256 ns."""
    ticks = SINCE_1970 + 7 * np.arange(60)
    np.testing.assert_array_equal(np.rint(1e9 * seconds(ticks, "ns")), 7 * np.arange(60))
    table(ticks).to_csv(tmp_path / "run.csv", index=False)
    found = read_mapped("csv", tmp_path / "run.csv", CsvColumns(time="t", time_unit="ns", **COLUMNS))
    np.testing.assert_array_equal(np.rint(1e9 * found.time), 7 * np.arange(60))


@pytest.mark.parametrize(("unit", "count"), [("s", 1), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
@pytest.mark.parametrize("types", [float, "int64", "uint32", "Int64"])
def test_every_unit_is_converted(unit, count, types):
    ticks = pd.Series(np.arange(4) * (count if types is float else max(count, 1)) * 0.5 * 2).astype(types)
    np.testing.assert_allclose(seconds(ticks, unit), np.arange(4), rtol=1e-12)


def test_commands_are_on_the_clock_of_the_observations():
    clock = SINCE_1970 + np.arange(0, 600, 10) * 1_000_000
    motion = table(0.0)
    given = {
        "position": motion[["x", "y", "z"]].to_numpy()[:, None],
        "command": motion[["u"]],
        "markers": ["tip"],
        "channels": ["u"],
        "position_unit": "mm",
        "command_unit": "mm",
    }
    found = Trajectory.from_arrays(time=clock, command_time=clock + 2_000_000, time_unit="ns", **given)
    np.testing.assert_allclose(found.command_time, TIME + 0.002, atol=1e-12)
    dates = clock.astype("datetime64[ns]")
    found = Trajectory.from_arrays(time=dates, command_time=dates + np.timedelta64(2, "ms"), **given)
    np.testing.assert_allclose(found.command_time, TIME + 0.002, atol=1e-12)
    with pytest.raises(InputError, match="some times are dates, others are numbers"):
        Trajectory.from_arrays(time=dates, command_time=TIME, **given)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (["0.0", "soon", "0.2"], "row 1, column 'time': 'soon' is not a number, nor a date"),
        (["2024-01-01", "2024-01-02", "later"], "row 2, column 'time': 'later' is not a number, nor a date"),
        ([0.0, np.nan], "row 1, column 'time': NaN or empty cell"),
        (np.array(["2024-01-01", "NaT"], "datetime64[ms]"), "row 1, column 'time': NaN or empty cell"),
        (np.zeros((3, 1)), r"shape \(3, 1\)"),
        ([], r"shape \(0,\)"),
    ],
)
def test_what_is_no_time_is_said_by_its_row(values, said):
    with pytest.raises(InputError, match=said):
        read_stamps(values, where="run")


def grouped(share: int) -> np.ndarray:
    return np.floor(np.arange(400) / share) * share * STEP


@pytest.mark.parametrize(
    ("time", "said"),
    [
        (grouped(5), r"row 1: time does not increase \(320 times\); .* give sample_time = 0\.01 .* remove duplicates"),
        (np.full(400, 1.73234e9), r"row 1: time does not increase \(399 times\); .* give sample_time \("),
        (np.r_[TIME, TIME[-1]], r"row 60: time does not increase \(1 times\); sort the rows or remove duplicates"),
        (
            np.r_[TIME, TIME - 0.2],
            r"row 60: .*; the clock was set back by 0\.79 s before row 60: split the file .* would mix",
        ),
        (TIME[::-1], r"row 1: time does not increase \(59 times\); sort the rows"),
        (np.r_[TIME, np.inf], "row 60: time is not a number"),
    ],
)
def test_times_that_do_not_increase_are_refused_before_anything_needs_them(time, said):
    with pytest.raises(InputError, match=said):
        check_times(time, "run")
    place = np.cumsum(np.random.default_rng(0).normal(0.0, 1e-3, (len(time), 2, 3)), axis=0) + 0.1
    with pytest.raises(InputError, match=said):
        find_faults(time, place)
    if np.isfinite(time).all():
        given = {"markers": ["a", "b"], "channels": ["u"], "command": np.zeros((len(time), 1))}
        with pytest.raises(InputError, match=said):
            Trajectory.from_arrays(time=time, position=place, **given)


@pytest.mark.parametrize("rows", [0, 1])
def test_too_few_rows_are_said(rows):
    with pytest.raises(InputError, match=f"has {rows} observation rows; at least 2"):
        find_faults(np.zeros(rows), np.zeros((rows, 1, 3)))


def delivered(sizes: np.ndarray, apart: float = 3e-6) -> np.ndarray:
    """Stamps of rows that are measured every 10 ms and handed over in groups of these sizes."""
    measured, first, stamps = STEP * np.arange(sizes.sum()), 0, []
    for size in sizes:
        stamps.append(measured[first + size - 1] + apart * np.arange(size))
        first += size
    return np.concatenate(stamps)


def swinging(rows: int) -> np.ndarray:
    time = STEP * np.arange(rows)
    place = np.stack([0.05 * np.sin(8.0 * time), 0.0 * time, 0.2 + 0.0 * time], axis=-1)[:, None]
    return place + np.random.default_rng(1).normal(0.0, 5e-5, place.shape)


@pytest.mark.parametrize(
    "sizes",
    [np.full(70, 6), np.full(20, 20), np.full(200, 2), np.random.default_rng(2).integers(1, 12, 80)],
    ids=["six", "twenty", "two", "any"],
)
def test_stamps_of_arrival_are_noted_and_mask_nothing(sizes):
    time = delivered(sizes)
    place = swinging(len(time))
    faults = find_faults(time, place)
    assert faults.mask.all()
    (note,) = faults.notes
    row = int(np.argmax(np.diff(time) < 1e-3)) + 1
    assert f"first row {row}, " in note
    assert "stamps of arrival" in note
    given = float(note.partition("sample_time = ")[2].split()[0])
    assert given == pytest.approx(STEP, rel=0.05)
    angle = np.random.default_rng(4).normal(size=(len(time) // 4 + 1, 1)).repeat(4, axis=0)[: len(time)]
    found = Trajectory.from_arrays(
        time=time, position=place, command=angle, command_unit="rad", motor_angle=angle, markers=["m"], channels=["u"]
    )
    assert found.dataset.attrs["sample_time"] == pytest.approx(STEP, rel=0.05)
    assert hold_time(time, angle) == pytest.approx(4 * STEP, rel=0.05)
    place[200, 0, 1] += 0.03  # a jump is still found, on an even clock
    assert np.flatnonzero(~find_faults(time, place).mask[:, 0]).tolist() == [200]


def test_the_sample_time_of_recordings_is_that_of_their_rows_whatever_their_stamps():
    """Half of these stamps follow the one before at once: the median interval is none."""
    late = delivered(np.full(70, 6))
    assert np.median(np.diff(late)) < 0.1 * STEP
    assert sample_time(late) == pytest.approx(STEP, rel=0.05)
    assert sample_time(TIME, late) == pytest.approx(STEP, rel=0.05)


def test_jitter_two_rates_and_a_gap_are_no_stamps_of_arrival():
    rng = np.random.default_rng(3)
    even = STEP * np.arange(400)
    for time in (
        even,
        even + rng.uniform(-0.4, 0.4, 400) * STEP,
        np.r_[0.2 * np.arange(200), 40.0 + even],
        np.r_[even, 3600.0 + even],
    ):
        assert not any("arrival" in note for note in clock_notes(time))


def test_a_clock_that_jumps_is_noted_with_its_row():
    time = np.r_[TIME, TIME + 3600.0]
    (note,) = clock_notes(time)
    assert note.startswith("the clock jumps by 3599 s before row 60, although rows come every 10 ms")
    assert "rows = [0, 59] and rows = [60, 119]" in note
    assert clock_notes(TIME) == []


@pytest.mark.parametrize("factor", [1e3, 1e6, 1e-3])
def test_rows_far_slower_or_faster_than_a_robot_ask_for_the_unit(factor):
    (note,) = clock_notes(factor * TIME)
    assert "correct time_unit" in note


def test_a_fine_clock_takes_no_more_memory_than_a_coarse_one():
    """Rows a nanosecond apart: a quarter of a second of them would be 250 million columns."""
    time, place = 1e-9 * np.arange(400), swinging(400)
    assert find_faults(time, place).mask.shape == (400, 1)


@pytest.mark.parametrize("kind", ["array", "file"])
def test_stamps_of_single_precision_are_noted_once_they_are_coarse(kind, tmp_path):
    """After 20 hours single precision goes in steps of 7.8 ms."""
    for hours, step, noted in ((0.0, 0.02, False), (20.0, 0.02, True), (20.0, 1.0, False)):
        single = (3600.0 * hours + step * np.arange(200)).astype(np.float32)
        if kind == "file":
            pd.DataFrame({"t": single.astype(float)}).to_csv(tmp_path / "run.csv", index=False)
            single = pd.read_csv(tmp_path / "run.csv")["t"].to_numpy()
        stamps = read_stamps(single, where="run")
        notes = rounded_notes(stamps, stamps.since(stamps, "run"))
        assert [note.partition(":")[0] for note in notes] == ["times have single precision"] * noted
        if noted:
            assert "in steps of 7.81 ms, and rows come every" in notes[0]
            assert re.search(r"sample_time = 0\.0(2|199\d) in", notes[0])


def test_stamps_of_double_precision_jitter_unsaid():
    stamps = read_stamps(72000.0 + 0.02 * np.arange(200) + np.random.default_rng(0).normal(0.0, 1e-3, 200), where="run")
    assert rounded_notes(stamps, stamps.since(stamps, "run")) == []


def test_a_few_repeated_stamps_lie_between_their_neighbours():
    time = np.arange(60.0)
    stale = time.copy()
    stale[[7, 30, 31, 59]] = stale[[6, 29, 29, 58]]
    np.testing.assert_array_equal(repeated_rows(stale), [7, 30, 31, 59])
    np.testing.assert_allclose(spread_repeats(stale), time)
    for refused in (time[::-1], grouped(5), np.r_[time, 3.0]):
        np.testing.assert_array_equal(spread_repeats(refused), refused)
