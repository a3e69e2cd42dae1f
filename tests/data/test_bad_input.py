"""Bad files and tables: one line that says what is wrong, where, and what to do."""

from __future__ import annotations

import gzip

import numpy as np
import pytest

from rfdropo_bayes.data import (
    CsvColumns,
    DataSpec,
    Trajectory,
    load_recordings,
    read_asl_csv,
    read_optitrack_csv,
    read_sofa_csv,
)
from rfdropo_bayes.data.csv_table import CsvTable
from rfdropo_bayes.data.mapped_formats import read_mapped
from rfdropo_bayes.errors import InputError


def fails(message: str):
    return pytest.raises(InputError, match=message)


def test_empty_files(tmp_path):
    path = tmp_path / "empty.csv"
    path.write_text("")
    with fails(r"empty\.csv: the file is empty"):
        read_sofa_csv(path)
    path.write_text("action,x0\n")
    with fails("a header but no rows"):
        read_sofa_csv(path)
    with fails("no such file"):
        read_sofa_csv(tmp_path / "absent.csv")
    path.write_bytes(b"\xff\xfe\x00\x80")
    with fails("not a text file"):
        read_sofa_csv(path)
    for text in ('{"t": [0, 1]}', '[{"t": 0},\n {"t": 1}]\n', "\n[[0, 1], [1, 2]]"):
        path.write_text(text)
        with fails("is JSON, not a table of columns; give a CSV file"):
            read_sofa_csv(path)


def test_a_file_cut_anywhere_in_its_last_row_is_noticed(sofa_table, write, tmp_path):
    path = write(sofa_table(), tmp_path / "episode.csv")
    text = path.read_text()
    last_row = text.rstrip("\n").rfind("\n") + 1
    for cut in range(last_row + 1, len(text), 7):
        path.write_text(text[:cut])
        with fails("row 4: .*the file is cut short"):
            read_sofa_csv(path)
    path.write_text(text[:last_row])
    with fails("row 3: the episode does not end"):
        read_sofa_csv(path)


def test_a_cut_archive_is_noticed(asl_tables, write, tmp_path):
    observations, commands = asl_tables()
    path = write(observations, tmp_path / "o.csv.gz")
    path.write_bytes(path.read_bytes()[:-200])
    with fails("gzip archive is cut short"):
        read_asl_csv(path, write(commands, tmp_path / "c.csv"))
    path.write_bytes(gzip.compress(b"ID,x1\n0,1\n"))
    with fails("column 'y1' is missing"):
        read_asl_csv(path, None)


def test_ragged_rows_in_the_middle(sofa_table, write, tmp_path):
    path = write(sofa_table(), tmp_path / "episode.csv")
    lines = path.read_text().splitlines()
    lines[2] += ",1.0"
    path.write_text("\n".join(lines) + "\n")
    with fails("row 1: has 66 values, but the header names 65; repair the row"):
        read_sofa_csv(path)


def test_missing_and_renamed_columns(optitrack_table, write, tmp_path):
    table = optitrack_table()
    with fails("column 'timestamp' is missing; did you mean 'time_stamp'"):
        read_optitrack_csv(write(table.rename(columns={"timestamp": "time_stamp"}), tmp_path / "a.csv"))
    with fails("column 'z3' is missing"):
        read_optitrack_csv(write(table.drop(columns="z3"), tmp_path / "b.csv"))
    (tmp_path / "own.csv").write_text("t,x,y,z,pull\n0,1,2,3,4\n1,1,2,3,4\n")
    columns = CsvColumns.model_validate(COLUMNS | {"commands": ["pul"]})
    with fails(r"column 'pul' is missing; did you mean 'pull'\?; correct its name in \[data.columns\]"):
        read_mapped("csv", tmp_path / "own.csv", columns)
    (tmp_path / "c.csv").write_text("a,a\n1,2\n")
    with fails("column 'a' appears twice"):
        CsvTable(tmp_path / "c.csv", ["a"])


def test_nan_and_text_are_placed(optitrack_table, write, tmp_path):
    table = optitrack_table()
    table.loc[4, "y2"] = np.nan
    path = write(table, tmp_path / "run.csv")
    with fails(r"run\.csv, row 4, column 'y2': NaN or empty cell \(1 of them"):
        read_optitrack_csv(path)
    masked = read_optitrack_csv(path, mask_missing=True)
    assert not masked.position_mask[4, 1]
    np.testing.assert_allclose(masked.position[4, 1], masked.position[[3, 5], 1].mean(axis=0), atol=2e-5)
    path.write_text(path.read_text().replace("100.5,", "half past,"))
    with fails("row 5, column 'timestamp': 'half past' is not a number"):
        read_optitrack_csv(path)


def test_a_nan_command_is_never_masked(optitrack_table, write, tmp_path):
    table = optitrack_table().astype({"action": float})
    table.loc[4, "action"] = np.nan
    with fails("row 4, column 'action'"):
        read_optitrack_csv(write(table, tmp_path / "run.csv"), mask_missing=True)


@pytest.mark.parametrize(
    ("row", "value", "message"),
    [(0, 3, "not -1"), (2, 16, "16 is not"), (3, 2.5, "2.5 is not"), (3, -1, "row 3, column 'action': -1 is not")],
)
def test_actions_that_do_not_exist(sofa_table, write, tmp_path, row, value, message):
    table = sofa_table().astype({"action": float})
    table.loc[row, "action"] = value
    with fails(message):
        read_sofa_csv(write(table, tmp_path / "episode.csv"))


def test_metres_given_as_millimetres_and_the_reverse(sofa_table, asl_tables, write, tmp_path):
    table = sofa_table()
    points = [column for column in table if column[0] in "xyz"]
    table[points] *= 1e-3
    with fails("metres given as millimetres"):
        read_sofa_csv(write(table, tmp_path / "episode.csv"))
    observations, commands = asl_tables()
    observations[[column for column in observations if column != "ID"]] *= 1e3
    with fails("millimetres given as metres"):
        read_asl_csv(write(observations, tmp_path / "o.csv"), write(commands, tmp_path / "c.csv"))


def test_recordings_and_commands_that_do_not_fit(asl_tables, write, tmp_path):
    observations, commands = asl_tables()
    path = write(observations, tmp_path / "o.csv")
    with fails("60 observations do not fit 49 commands: there must be one observation more"):
        read_asl_csv(path, write(commands.iloc[:49], tmp_path / "c.csv"))
    observations["ID"] //= 20
    path = write(observations, tmp_path / "o.csv")
    with fails(r"poses with ID 0 to 2 \(3\) do not fit 5 commands"):
        read_asl_csv(path, write(commands.iloc[:5], tmp_path / "c.csv"))
    with fails("do not fit no commands"):
        read_asl_csv(path, None)


def test_rows_missing_in_the_middle(asl_tables, optitrack_table, write, tmp_path):
    observations, commands = asl_tables()
    with fails("row 7, column 'ID': ID 8 instead of 7"):
        read_asl_csv(write(observations.drop(index=7), tmp_path / "o.csv"), write(commands, tmp_path / "c.csv"))
    with fails("row 6, column 'timestamp': 0.2 s pass before this row"):
        read_optitrack_csv(write(optitrack_table().drop(index=6), tmp_path / "run.csv"))


COLUMNS = {
    "sample_time": 0.1,
    "commands": ["u"],
    "command_unit": "mm",
    "positions": [["x", "y", "z"]],
    "position_unit": "mm",
}


def test_a_plain_csv_needs_the_columns_its_mapping_names(tmp_path):
    (tmp_path / "own.csv").write_text("x,y,z,pull\n100,0,0,1\n100,1,0,2\n")
    with fails("column 'u' is missing; nothing else there looks like it: x, y, z, pull"):
        read_mapped("csv", tmp_path / "own.csv", CsvColumns.model_validate(COLUMNS))
    with fails(r"column 'X' is missing \(and 'Y'\); did you mean 'x'\?"):
        read_mapped("csv", tmp_path / "own.csv", CsvColumns.model_validate(COLUMNS | {"positions": [["X", "Y", "z"]]}))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fits": []}, r"\[data\]: unknown key 'fits'; did you mean 'fit'\?"),
        ({"format": "sofa_csv"}, "'sofa_csv': Input should be 'sofa-csv', 'optitrack-csv', .* or 'netcdf'"),
        ({"fit": []}, "at least 1 item"),
        ({"resample": -0.1}, "greater than 0"),
        ({"fit": [{"observation": "a.csv"}]}, "unknown key 'fit.0.observation'; did you mean 'observations'"),
        ({"fit": [{"observations": "a", "row": [0, 1]}]}, "unknown key 'fit.0.row'; did you mean 'rows'"),
        ({"fit": "a.csv"}, "fit = 'a.csv': Input should be a valid list"),
        ({"format": "csv"}, r"needs a \[data.columns\] table"),
        ({"format": "csv", "columns": COLUMNS | {"tme": "t"}}, "unknown key 'columns.tme'; did you mean 'time'"),
        (
            {"format": "csv", "columns": COLUMNS | {"position_unit": "metre"}},
            "position_unit = 'metre': Input should be 'm', 'cm', 'mm' or 'in'",
        ),
        ({"format": "csv", "columns": COLUMNS | {"axes": ["x", "z", "-z"]}}, "x, y and z once each"),
        ({"format": "csv", "columns": COLUMNS | {"time": "t"}}, "either time"),
        ({"format": "csv", "columns": COLUMNS | {"markers": ["a", "b"]}}, "markers has 2 entries instead of 1"),
    ],
)
def test_tables_with_a_mistake(change, message):
    with fails(message) as caught:
        DataSpec.parse({"format": "sofa-csv", "fit": ["a.csv"]} | change)
    assert "\n" not in str(caught.value)


def test_a_missing_key_is_named():
    with fails(r"\[data\]: the key 'fit' is missing"):
        DataSpec.parse({"format": "netcdf"})


def plain(path, text: str, encoding: str = "utf-8", **changes):
    path.write_bytes(text.encode(encoding))
    return read_mapped("csv", path, CsvColumns.model_validate(COLUMNS | changes))


ROWS = "x,y,z,u\n100.5,0,0,1.5\n100,1,0,2\n100,2,0,2\n"


@pytest.mark.parametrize(
    "text",
    [
        ROWS,
        ROWS.replace(",", ";"),
        ROWS.replace(",", "\t"),
        ROWS.replace(",", ";").replace(".", ","),
        ROWS.replace(",", "\t").replace(".", ","),
        ROWS.replace(",", " ; "),
        "sep=;\n" + ROWS.replace(",", ";").replace(".", ","),
        ROWS.replace("100.5", '"100,5"').replace("1.5", '"1,5"'),
        ROWS.replace(",", " "),
        "# " + ROWS.replace(",", " "),
        "  " + ROWS.replace(",", "   ").replace("\n", "\n  ").rstrip(" "),
        ROWS.replace(",", " ").replace(".", ","),
        ROWS.replace("\n", "\r\n"),
        ROWS.replace("\n", "\r"),
        ROWS.removesuffix("\n"),
        '"x","y","z","u"\n"100.5","0","0","1.5"\n100,1,0,2\n100,2,0,2\n',
    ],
)
def test_separators_and_decimal_signs(tmp_path, text):
    found = plain(tmp_path / "own.csv", text)
    np.testing.assert_allclose(found.position[0, 0], [0.1005, 0.0, 0.0])
    np.testing.assert_allclose(found.command[0], 1.5e-3)
    assert found.position.shape == (3, 1, 3)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
def test_encodings(tmp_path, encoding):
    found = plain(tmp_path / "own.csv", ROWS.replace("u\n", "Länge µm\n"), encoding, commands=["Länge µm"])
    assert found.cable_names == ("Länge µm",)


def test_decimal_commas_between_commas_are_explained(tmp_path):
    with fails("has 8 values, but the header names 4.*separate values by semicolons"):
        plain(tmp_path / "own.csv", "x,y,z,u\n100,5,0,0,0,0,1,5\n100,5,0,0,0,0,1,5\n")
    with fails(r"row 1, column 'x': '1\.005,5' is not a number"):
        plain(tmp_path / "own.csv", "x;y;z;u\n100,5;0;0;1,5\n1.005,5;0;0;1,5\n100;0;0;1\n")


@pytest.mark.parametrize(
    "above",
    [
        "# logger 3.1\n# begun at noon\n",
        "logger 3.1\n\nbegun;at noon\n",
        "# rate, 100, Hz, nominal\n",  # as many cells as columns
        "# ",  # in front of the names
    ],
)
def test_lines_above_the_names_of_the_columns_are_left_out(tmp_path, above):
    """Loggers say there when they began."""
    found, bare = plain(tmp_path / "own.csv", above + ROWS), plain(tmp_path / "bare.csv", ROWS)
    np.testing.assert_array_equal(found.position, bare.position)
    assert found.cable_names == bare.cable_names


def test_rows_of_another_width_are_refused(tmp_path):
    with fails("row 0: has 5 values, but the header names 4"):
        plain(tmp_path / "own.csv", "x,y,z,u\n" + ROWS.removeprefix("x,y,z,u\n").replace("\n", ",\n"))
    longer = "".join(f"{row},0\n" for row in ROWS.splitlines()[1:])
    with fails("row 3: has 5 values, but the header names 4"):  # a second table below the first
        plain(tmp_path / "own.csv", ROWS + "x,y,z,u,v\n" + longer)


def test_a_clock_that_is_written_in_no_known_way_is_not_one_cell_to_correct(tmp_path):
    names, *rows = ROWS.splitlines()
    text = "\n".join([f"t,{names}", *(f"3/31/2024 10:59:{59 - k} AM,{row}" for k, row in enumerate(rows))]) + "\n"
    with fails("row 0, column 't': '3/31/2024 10:59:59 AM' is not a number.*or give sample_time in place of time"):
        plain(tmp_path / "own.csv", text, time="t", sample_time=None)


def test_columns_without_names_are_not_read(tmp_path):
    """Spreadsheets add commas for cells that once were touched."""
    names, *rows = ROWS.splitlines()
    found = plain(tmp_path / "own.csv", "\n".join([names + ",,", *(row + ",," for row in rows)]) + "\n")
    assert found.position.shape == (3, 1, 3)


def test_a_folder_is_no_recording(tmp_path):
    (tmp_path / "monday").mkdir()
    spec = DataSpec.parse({"format": "csv", "fit": ["monday"], "columns": COLUMNS})
    with fails(r'monday: is a folder, not a file; name its files, e.g. "monday/\*.csv"'):
        load_recordings(spec, tmp_path)
    with fails("is a folder, but neither a ROS 2 bag nor a LeRobotDataset"):
        read_mapped("csv", tmp_path / "monday", CsvColumns.model_validate(COLUMNS))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"imu": ["ax", "ay", "az"]}, "unknown key 'imu'; a marker is a position"),
        (
            {"positions": [["x", "y", "z", "qx", "qy", "qz", "qw"]]},
            "has 7 columns, not x, y and z; a marker is a position",
        ),
        ({"positions": [["x", "y"]]}, "the marker x, y has 2 columns, not x, y and z; name its three columns"),
        ({"tensions": ["f1", "f2"]}, "tensions has 2 entries instead of 1, one for each channel in commands"),
        ({"motor_angles": ["f1", "f2"]}, "motor_angles has 2 entries instead of 1"),
    ],
)
def test_columns_that_are_no_positions_say_what_to_do(change, message):
    with fails(message):
        DataSpec.parse({"format": "csv", "fit": ["a.csv"], "columns": COLUMNS | change})


def test_a_table_without_positions_says_what_to_add():
    columns = {key: value for key, value in COLUMNS.items() if key != "positions"}
    with fails("no positions of markers; add positions = "):
        DataSpec.parse({"format": "csv", "fit": ["a.csv"], "columns": columns})


def test_missing_readings_are_left_out_and_counted(tmp_path):
    """One missing tension, angle or pose refuses nothing; marker positions and commands are another matter."""
    pose = ["ox", "oy", "oz", "qx", "qy", "qz", "qw"]
    text = "x,y,z,u,f,a," + ",".join(pose) + "\n"
    text += "".join(f"{100 + row},0,0,{row},{row + 5},{row / 9},{row},0,0,0,0,0,1\n" for row in range(6))
    lines = text.splitlines()
    lines[3] = "102,0,0,2,,nan,,,,,,,"
    found = plain(tmp_path / "own.csv", "\n".join(lines), tensions=["f"], motor_angles=["a"], object_pose=pose)
    assert found.tension_mask[:, 0].tolist() == [True, True, False, True, True, True]
    assert not found.motor_angle_mask[2, 0]
    np.testing.assert_array_equal(np.isnan(found.object_pose).all(axis=1), [False, False, True, False, False, False])
    assert found.left_out.endswith("1 missing motor angles, 1 missing poses of the object, 1 missing tensions")
    coarse = found.resample(0.2)
    assert coarse.tension_mask[:, 0].tolist() == [True, False, True]
    assert np.isnan(coarse.object_pose).any(axis=1).tolist() == [False, True, False]
    found.save(tmp_path / "own.nc")
    again = Trajectory.load(tmp_path / "own.nc")
    np.testing.assert_array_equal(again.tension_mask, found.tension_mask)
    lines[3] = lines[3].replace("102", "")
    with fails("row 2, column 'x': NaN or empty cell"):
        plain(tmp_path / "own.csv", "\n".join(lines), tensions=["f"], motor_angles=["a"], object_pose=pose)
