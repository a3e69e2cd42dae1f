"""Tables of text as other laboratories have them: separators, no names, a line of units, rows without time."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes.data import CsvColumns
from rfdropo_bayes.data.csv_layout import dialect_of, units_above, without_names
from rfdropo_bayes.data.csv_table import CsvTable
from rfdropo_bayes.data.mapped_formats import read_mapped
from rfdropo_bayes.errors import InputError

NAMES = ["t", "u", "x", "y", "z"]
ROWS = [[0.0, 1.5, 100.5, 0.25, 0.0], [0.5, 2.0, 100.0, 1.0, 2.5], [1.0, 2.0, 100.0, 2.0, 5.25]]
COLUMNS = {"time": "t", "commands": ["u"], "command_unit": "mm", "positions": [["x", "y", "z"]], "position_unit": "mm"}


def text(separator: str = ",", decimal: str = ".", head: str | None = None) -> str:
    lines = [separator.join(str(value).replace(".", decimal) for value in row) for row in ROWS]
    return "\n".join([separator.join(NAMES) if head is None else head, *lines]).lstrip("\n") + "\n"


def read(path, written: str, **changes):
    path.write_text(written)
    return read_mapped("csv", path, CsvColumns.model_validate(COLUMNS | changes))


def check(found) -> None:
    np.testing.assert_allclose(found.time, [0.0, 0.5, 1.0])
    np.testing.assert_allclose(found.position[:, 0], 1e-3 * np.array(ROWS)[:, 2:])
    np.testing.assert_allclose(found.command[:, 0], [1.5e-3, 2e-3, 2e-3])


@pytest.mark.parametrize("decimal", [".", ","])
@pytest.mark.parametrize("separator", [",", ";", "\t", "|", " ", ", ", " | "])
@pytest.mark.parametrize("named", [True, False])
def test_every_separator_is_seen_with_names_and_without(tmp_path, separator, decimal, named):
    if separator.strip() == decimal == ",":
        pytest.skip("nothing tells them apart")
    written = text(separator, decimal, None if named else "")
    check(read(tmp_path / "run.csv", written, **({} if named else {"names": NAMES})))


def test_a_file_without_names_shows_its_first_rows_and_asks_for_names(tmp_path):
    with pytest.raises(InputError, match=r"not the names of its 5 columns: row 0: 0\.0,1\.5.*names = \[\.\.\.\]"):
        read(tmp_path / "run.csv", text(head=""))
    with pytest.raises(InputError, match="has 5 columns, and names has 4"):
        read(tmp_path / "run.csv", text(head=""), names=NAMES[1:])
    with pytest.raises(InputError, match="the first line holds values, not the names of its 5 columns: row 0: 0"):
        read(tmp_path / "run.csv", text(head="# logger 3\n# noon"))


@pytest.mark.parametrize(
    ("first", "unnamed"),
    [
        ("t,1,2,3", False),  # channels called by their numbers
        ("0,1,2,3", False),  # pandas writes so what has no names
        ("0.0,1.5,2,3", True),
        ("2024-05-01T10:00:00,1.5,2,3", True),
        ("0.0,pull,1.5,2", True),
        ("t,label,x,y", False),
        ("0,0,0,0", True),
    ],
)
def test_names_are_told_from_values(first, unnamed):
    below = ["0.5,pull,2.5,2", "1.0,rest,2.5,2"] if "pull" in first or "label" in first else ["1,2.5,2,3", "2,2.5,2,3"]
    assert without_names([first, *below], ",") == unnamed


@pytest.mark.parametrize("line", ["s,mm,mm,mm,mm", "[s],[mm],[mm],[mm],[mm]", "s,,mm,mm,mm", '"s","mm","mm","mm","mm"'])
def test_a_line_of_units_is_no_row(tmp_path, line):
    path = tmp_path / "run.csv"
    check(read(path, text().replace("\n", f"\n{line}\n", 1)))
    assert CsvTable(path, (), machine_written=False).units["x"] == "mm"


@pytest.mark.parametrize("row", ["0.0,1.5,100,0,0", "a,b,c,d,e", ",,,,", "nan,nan,nan,nan,nan"])
def test_a_row_of_values_or_words_is_no_line_of_units(row):
    assert units_above([row, "0.5,2.0,100,1,2"], ",") is None


def test_names_of_several_words_stand_between_tabs():
    assert dialect_of(["step\tload 1\ttip x", "0\t0.5\t6.44", "1\t0.7\t6.5"]).separator == "\t"


def test_decimal_commas_that_come_late_are_seen():
    assert dialect_of(["a;b", *["1;2"] * 100, "1,5;2"]) == (";", ",")


def test_rows_without_time_are_a_second_apart_and_doubtful(tmp_path):
    found = read(tmp_path / "run.csv", text(), time="rows")
    np.testing.assert_array_equal(found.time, [0.0, 1.0, 2.0])
    assert any("rows have no times" in note for note in found.notes)


def test_columns_have_units_of_their_own(tmp_path):
    found = read(tmp_path / "run.csv", text(), units={"u": "cm", "z": "cm"})
    np.testing.assert_allclose(found.command[:, 0], [1.5e-2, 2e-2, 2e-2])
    np.testing.assert_allclose(found.position[:, 0], np.array(ROWS)[:, 2:] * [1e-3, 1e-3, 1e-2], atol=1e-12)
    with pytest.raises(InputError, match="no column of commands or positions"):
        read_mapped("csv", tmp_path / "run.csv", parsed(units={"t": "ms"}))
    with pytest.raises(InputError, match="gives 'u' in 'rad', which cannot be brought to 'mm'"):
        read_mapped("csv", tmp_path / "run.csv", parsed(units={"u": "rad"}))


def parsed(**changes) -> CsvColumns:
    from rfdropo_bayes.tables import parse_table

    return parse_table(CsvColumns, COLUMNS | changes, where="[data.columns]")


def test_axes_of_a_left_handed_file_are_taken(tmp_path):
    found = read(tmp_path / "run.csv", text(), axes=["x", "-y", "z"])
    np.testing.assert_allclose(found.position[:, 0], 1e-3 * np.array(ROWS)[:, 2:] * [1.0, -1.0, 1.0])
    with pytest.raises(InputError, match="quaternions have no mirror image"):
        parsed(axes=["x", "-y", "z"], object_pose=list("abcdefg"))


VICON = """Trajectories
50
,,arm:mid,,,arm:tip,,,
Frame,Sub Frame,X,Y,Z,X,Y,Z,motor1
,,mm,mm,mm,mm,mm,mm,deg
1,0,50.5,-310,795,49.5,-310,669.5,0
2,0,50,-309,794,,,,1.5
3,0,50,-309,794,49.5,-309,670,2
"""
DEVICES = "Devices\n1000\n,,Force plate,,\nFrame,Sub Frame,Fx,Fy,Fz\n,,N,N,N\n1,0,1,2,3\n1,1,1,2,3\n\n"


@pytest.mark.parametrize(
    "written",
    [
        VICON,
        DEVICES + VICON + "\n" + DEVICES.replace("Devices", "Joints"),
        VICON.replace(",arm:tip,,,", ",arm:tip"),  # names end at the last one
        VICON.replace("arm:tip,,,", "arm:tip,arm:tip,arm:tip,"),
        VICON.replace("Trajectories\n50\n", "TRAJECTORIES,,,,,,,,\n50,Hz,,,,,,,\n"),  # as a spreadsheet fills lines up
        VICON.replace(",", ";"),
    ],
)
def test_the_trajectories_of_vicon_have_names_of_markers_a_rate_and_units(tmp_path, written):
    path = tmp_path / "trial.csv"
    path.write_text(written)
    table = CsvTable(path, (), machine_written=False)
    names = ["mid_X", "mid_Y", "mid_Z", "tip_X", "tip_Y", "tip_Z"]
    assert list(table.frame.columns) == ["Frame", "Sub Frame", *names, "motor1"]
    assert table.units == dict.fromkeys(names, "mm") | {"motor1": "deg"}
    assert table.rate == 50.0
    assert table.left_out == (("Devices", "Joints") if "Devices" in written else ())
    np.testing.assert_array_equal(
        table.numbers(names[3:], allow_missing=True)[[0, 2]], [[49.5, -310, 669.5], [49.5, -309, 670]]
    )
    assert np.isnan(table.numbers(names[3:], allow_missing=True)[1]).all()


def test_subjects_stay_in_the_names_of_markers_if_they_tell_them_apart(tmp_path):
    path = tmp_path / "trial.csv"
    path.write_text(VICON.replace("arm:mid", "plate:tip"))
    assert list(CsvTable(path, (), machine_written=False).frame.columns)[4:6] == ["plate:tip_Z", "arm:tip_X"]


def test_axes_without_markers_above_them_are_refused(tmp_path):
    path = tmp_path / "trial.csv"
    path.write_text(VICON.split("arm:tip,,,\n")[1])
    with pytest.raises(InputError, match=r"'X' appears twice; rename one of them.*line of the markers' names"):
        CsvTable(path, (), machine_written=False)


def test_a_cut_row_of_trajectories_is_refused(tmp_path):
    path = tmp_path / "trial.csv"
    path.write_text(VICON.replace("2,0,50,-309,794,,,,1.5", "2,0,50") + "\n" + DEVICES)
    with pytest.raises(InputError, match="has 3 values, but the header names 9"):
        CsvTable(path, (), machine_written=False)


@pytest.mark.parametrize(("sample_time", "doubtful"), [(0.02, False), (0.01, True)])
def test_a_sample_time_other_than_the_stated_rate_is_doubtful(tmp_path, sample_time, doubtful):
    axes = {"positions": [["mid_X", "mid_Y", "mid_Z"]], "commands": ["motor1"], "command_unit": "deg"}
    found = read(tmp_path / "run.csv", VICON, time=None, sample_time=sample_time, **axes)
    np.testing.assert_allclose(found.time, sample_time * np.arange(3))
    assert any("the file says 50 Hz, and sample_time" in note for note in found.notes) == doubtful


@pytest.mark.parametrize("names", ["header.stamp.sec,header.stamp.nanosec", "secs,nsecs"])
def test_seconds_and_nanoseconds_are_one_column_of_times(tmp_path, names):
    path = tmp_path / "run.csv"
    stamps = ("1741700600,999999999", "1741700601,000000001", "1741700601,000000002")
    rows = [f"{stamp},{','.join(map(str, row[1:]))}" for stamp, row in zip(stamps, ROWS, strict=True)]
    path.write_text("\n".join([f"{names},u,x,y,z", *rows]) + "\n")
    name = names.replace(",", " + ")
    found = read_mapped("csv", path, parsed(time=name))
    np.testing.assert_array_equal(found.time, [0.0, 2e-9, 3e-9])
    path.write_text(path.read_text().replace("000000002", "1000000000"))
    with pytest.raises(InputError, match=r"row 2.*1741700601 and 1000000000 are no whole seconds"):
        CsvTable(path, (), machine_written=False).stamps(name, "s")


def test_a_repeated_line_of_names_is_left_out_and_counted(tmp_path):
    lines = text().splitlines()
    found = read(tmp_path / "run.csv", "\n".join([*lines[:2], lines[0], *lines[2:]]) + "\n")
    check(found)
    assert sum("the line of names stands 1 time more below" in note for note in found.notes) == 1
    check(whole := read(tmp_path / "run.csv", text()))
    assert not any("line of names" in note for note in whole.notes)
