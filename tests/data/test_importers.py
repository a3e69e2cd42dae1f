"""Importers, on synthetic files and against rows of the real ones checked by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rfdropo_bayes.data import CsvColumns, read_asl_csv, read_optitrack_csv, read_sofa_csv
from rfdropo_bayes.data.actions import cumulative_displacement
from rfdropo_bayes.data.mapped_formats import read_mapped
from rfdropo_bayes.errors import InputError


def test_sofa_commands_accumulate_and_are_in_force_from_the_row_before(sofa_table, write, tmp_path):
    table = sofa_table()
    table["action"] = [-1, 2, 2, 10, 15]
    recording = read_sofa_csv(write(table, tmp_path / "episode.csv"))
    np.testing.assert_allclose(recording.time, [0.0, 0.05, 0.10, 0.15, 0.20])
    np.testing.assert_allclose(recording.command_time, recording.time[:-1])
    np.testing.assert_allclose(recording.command[:, 2], [5e-3, 10e-3, 5e-3, 5e-3])
    np.testing.assert_allclose(recording.command[:, 7], [0.0, 0.0, 0.0, -5e-3])
    assert not recording.initial_command.any()
    assert recording.synthetic
    assert recording.position_mask.all()
    np.testing.assert_allclose(recording.position[3, 20], [0.0, -3e-3, 0.18])


def test_sofa_file_by_hand(datasets):
    recording = read_sofa_csv(datasets / "sofa_trunk" / "push_1.csv")
    assert recording.position.shape == (101, 21, 3)
    assert recording.marker_names[::10] == ("p00", "p10", "p20")
    np.testing.assert_allclose(recording.position[1, 20], [0.0075e-3, -12.129e-3, 183.35725e-3], atol=1e-12)
    np.testing.assert_allclose(recording.object_pose[1, :3], [0.0, -74.681e-3, 0.1], atol=1e-12)
    # its first actions are 15 15 13 13 7 3 3: cable 7 released twice, cable 5 twice, then 7 pulled and 3 twice
    np.testing.assert_allclose(recording.command[3], 1e-3 * np.array([0, 0, 0, 0, 0, -10, 0, -10]))
    np.testing.assert_allclose(recording.command[6], 1e-3 * np.array([0, 0, 0, 10, 0, -10, 0, -5]))
    assert recording.settings["goal"] == [0.1, -0.1, 0.05]


def test_optitrack_timing_and_units(optitrack_table, write, tmp_path):
    recording = read_optitrack_csv(write(optitrack_table(), tmp_path / "run.csv"))
    np.testing.assert_allclose(recording.command_time, 0.1 * np.arange(11), atol=1e-9)
    np.testing.assert_allclose(recording.command[:4, 1], [5e-3, 0.0, 5e-3, 0.0], atol=1e-15)
    assert recording.position_mask.all()
    assert recording.object_pose is None
    np.testing.assert_allclose(recording.position[0, 3], [0.0, -0.03, 0.16], atol=1e-4)


def test_a_marker_lost_in_the_first_rows_does_not_move_the_first_action(optitrack_table, write, tmp_path):
    table = optitrack_table()
    places = [name for name in table if name[0] in "xyz"]
    table.loc[1, places] = table.loc[0, places]
    for lost in ([], ["x4", "y4", "z4"]):
        table.loc[:1, lost] = np.nan
        recording = read_optitrack_csv(write(table, tmp_path / "run.csv"), mask_missing=True)
        np.testing.assert_allclose(recording.command_time[:2], [0.1 - 1 / 120, 0.1], atol=1e-9)


def test_optitrack_file_by_hand(datasets):
    name = "AKLWI_collected_data_20250130-145317.csv"
    recording = read_optitrack_csv(datasets / "sim2real_trunk" / name)
    assert recording.position.shape == (101, 4, 3)
    assert recording.command.shape == (100, 8)
    np.testing.assert_allclose(
        recording.position[2, 3], [6.033880170e-3, -66.258259117e-3, 162.961840629e-3], atol=1e-11
    )
    np.testing.assert_allclose(recording.time[:3], [0.0, 0.212689, 0.312689], atol=1e-6)
    # 5, 12, 12, 12: cable 5 pulled once, cable 4 released three times; 83 actions 14 at the end release cable 6
    np.testing.assert_allclose(recording.command[3], 1e-3 * np.array([0, 0, 0, 0, -15, 5, 0, 0]))
    assert recording.command[-1, 6] == pytest.approx(-83 * 5e-3)
    # rows 0 and 1 repeat one frame: action 0 left just before row 1, action 1 at row 1; row 1 is no new measurement
    np.testing.assert_allclose(recording.command_time[:3], recording.time[[1, 1, 2]] - [1 / 120, 0, 0], atol=1e-9)
    assert not recording.position_mask[1].any()
    assert recording.position_mask.sum() == 400
    np.testing.assert_allclose(np.linalg.norm(recording.object_pose[:, 3:], axis=1), 1.0, atol=1e-6)
    assert recording.object_pose[0, 6] == pytest.approx(0.99992925)  # the file has the opposite sign: the same rotation


def test_asl_frame_units_and_timing(asl_tables, write, tmp_path):
    observations, commands = asl_tables()
    observations[["x1", "y1", "z1"]] = [0.11, -0.105, 0.13]
    recording = read_asl_csv(write(observations, tmp_path / "o.csv"), write(commands, tmp_path / "c.csv.gz"))
    np.testing.assert_allclose(recording.position[7, 0], [0.11, 0.13, 0.105])
    np.testing.assert_allclose(recording.command[5], [np.pi / 6, 0, 0, 0, 0, 0])
    np.testing.assert_allclose(recording.time, 0.01 * np.arange(60))
    np.testing.assert_allclose(recording.command_time, recording.time[:-1])
    np.testing.assert_allclose(recording.initial_command, recording.command[0])
    assert recording.command_unit == "rad"


def test_asl_file_by_hand(datasets):
    folder = datasets / "asl_trunk"
    recording = read_asl_csv(
        folder / "observations_controlled_1_100g.csv.gz", folder / "control_inputs_controlled_1.csv.gz"
    )
    assert recording.position.shape == (15001, 3, 3)
    assert recording.command.shape == (15000, 6)
    np.testing.assert_allclose(recording.position[0, 2], [0.10035146, 0.1065277, 0.31325835], atol=1e-8)
    np.testing.assert_allclose(recording.command[1, :2], np.deg2rad([-1.9690438733303424, 5.095397942463393]))
    np.testing.assert_allclose(recording.motor_angle[1, 2], np.deg2rad(-2.9804534912109375))
    assert recording.settings["payload_mass"] == pytest.approx(0.1)
    assert recording.settings["motor_angle_hold"] == pytest.approx(0.05)
    assert recording.time[-1] == pytest.approx(150.0)


def test_asl_settled_poses(datasets):
    folder = datasets / "asl_trunk"
    recording = read_asl_csv(
        folder / "observations_adiabatic_global_4.csv.gz", folder / "control_inputs_adiabatic_global_4.csv.gz"
    )
    assert recording.position.shape == (30, 3, 3)
    assert recording.command.shape == (29, 6)
    np.testing.assert_allclose(np.rad2deg(recording.initial_command[0]), 18.99296397981523)
    np.testing.assert_allclose(np.rad2deg(recording.command[0, 1]), -63.57886031528356)
    assert recording.motor_angle is None
    # command k is in force when pose k is taken, and commands come at the blocks' first rows: 177 rows, then 354
    held = recording.command_at(recording.time)
    np.testing.assert_array_equal(held[1:], recording.command)
    np.testing.assert_allclose(recording.time[1], 3.54)
    np.testing.assert_allclose(recording.command_time[:2], [0.01, 3.55])
    # the same command, sent twice in a row, leaves the trunk where it was (rows 17 and 18)
    np.testing.assert_array_equal(held[17], held[18])
    assert np.linalg.norm(recording.position[17] - recording.position[18], axis=1).max() < 0.5e-3


def test_asl_at_zero_command(datasets):
    recording = read_asl_csv(datasets / "asl_trunk" / "observations_zeros_0g.csv.gz", None)
    assert recording.command.shape == (3000, 6)
    assert not recording.command.any()
    assert np.std(recording.position, axis=0).max() < 0.1e-3


@pytest.fixture
def plain(tmp_path) -> Path:
    rows = 40
    noise = np.random.default_rng(2).normal(0.0, 0.01, (rows, 3))
    lines = ["t,x,y,z,motor,load"]
    for row in range(rows):
        x, y, z = np.array([100.0 + row, -200.0, 30.0]) + noise[row]
        lines.append(f"{1000 + 20 * row},{x:.9f},{y:.9f},{z:.9f},{row},{row / 10}")
    path = tmp_path / "own.csv"
    path.write_text("\n".join(lines))
    return path


MAPPING = {
    "time": "t",
    "time_unit": "ms",
    "commands": ["motor"],
    "command_unit": "deg",
    "positions": [["x", "y", "z"]],
    "position_unit": "mm",
    "axes": ["x", "z", "-y"],
    "tensions": ["load"],
    "robot": "own",
}


def test_plain_csv_converts_through_its_mapping(plain):
    recording = read_mapped("csv", plain, CsvColumns.model_validate(MAPPING))
    np.testing.assert_allclose(recording.time, 0.02 * np.arange(40), atol=1e-9)
    np.testing.assert_allclose(recording.position[10, 0], [0.11, 0.03, 0.2], atol=1e-4)
    np.testing.assert_allclose(recording.command_at(recording.time)[:, 0], np.deg2rad(np.arange(40)))
    np.testing.assert_allclose(recording.tension[5], [0.5])
    assert recording.robot == "own"
    assert recording.cable_names == ("motor",)


def test_positions_are_counted_from_a_marker_of_a_base_that_was_moved(plain):
    """A camera that is moved from row to row changes nothing beside the marker of the base."""
    still = read_mapped("csv", plain, CsvColumns.model_validate(MAPPING)).position
    header, *lines = plain.read_text().splitlines()
    away = np.random.default_rng(0).normal(scale=100.0, size=(len(lines), 3))
    moved = [f"{header},base_x,base_y,base_z"]
    for line, base in zip(lines, away, strict=True):
        time, *rest = line.split(",")
        place = [float(value) + b for value, b in zip(rest[:3], base, strict=True)]
        moved.append(",".join([time, *(f"{value:.9f}" for value in place), *rest[3:], *(f"{b:.9f}" for b in base)]))
    plain.write_text("\n".join(moved))
    beside = CsvColumns.model_validate(MAPPING | {"base_marker": ["base_x", "base_y", "base_z"]})
    np.testing.assert_allclose(read_mapped("csv", plain, beside).position, still, atol=1e-10)


def test_the_origin_of_the_base_is_taken_off_in_the_frame_and_unit_of_the_file(plain):
    """The base is 100, 20 and -30 mm along the file's axes, which the base frame calls x, -z and y."""
    read = read_mapped("csv", plain, CsvColumns.model_validate(MAPPING))
    moved = read_mapped("csv", plain, CsvColumns.model_validate(MAPPING | {"origin": [100.0, 20.0, -30.0]}))
    shift = np.broadcast_to([0.1, -0.03, -0.02], read.position.shape)
    np.testing.assert_allclose(read.position - moved.position, shift, atol=1e-12)


def test_counts_are_angles_by_the_counts_of_one_turn(plain):
    """Commands and measured angles alike; the largest command that is believed is in counts, too."""
    counted = MAPPING | {"command_unit": "counts", "counts_per_turn": 360.0}
    counted |= {"motor_angles": ["motor"], "motor_angle_unit": "counts"}
    read = read_mapped("csv", plain, CsvColumns.model_validate(counted))
    assert read.command_unit == "rad"
    np.testing.assert_allclose(read.command_at(read.time)[:, 0], np.deg2rad(np.arange(40)))
    np.testing.assert_allclose(read.motor_angle[:, 0], np.deg2rad(np.arange(40)))
    winch = counted | {"counts_per_turn": 4.0}
    with pytest.raises(InputError, match="largest_command"):
        read_mapped("csv", plain, CsvColumns.model_validate(winch))
    far = read_mapped("csv", plain, CsvColumns.model_validate(winch | {"largest_command": 40.0}))
    np.testing.assert_allclose(far.command.max(), 0.5 * np.pi * 39)


@pytest.mark.parametrize("change", [{"command_unit": "counts"}, {"counts_per_turn": 360.0}])
def test_counts_and_the_counts_of_a_turn_belong_together(change):
    with pytest.raises(ValueError, match="counts_per_turn belongs to the unit"):
        CsvColumns.model_validate(MAPPING | change)


def test_plain_csv_takes_commands_from_a_file_of_their_own(plain, tmp_path):
    (tmp_path / "commands.csv").write_text("motor\n" + "\n".join(["7"] * 39))
    recording = read_mapped("csv", plain, CsvColumns.model_validate(MAPPING), tmp_path / "commands.csv")
    np.testing.assert_allclose(recording.command, np.deg2rad(7.0))
    (tmp_path / "commands.csv").write_text("motor\n" + "\n".join(["7"] * 38))
    with pytest.raises(InputError, match="40 observations do not fit 38 commands"):
        read_mapped("csv", plain, CsvColumns.model_validate(MAPPING), tmp_path / "commands.csv")


def test_a_command_holds_in_the_empty_cells_below_it_and_they_are_counted(plain, tmp_path):
    columns, sent = CsvColumns.model_validate(MAPPING), tmp_path / "sent.csv"
    sent.write_text("motor;note\n7,0;x\n;x\n;x\n9,5;x\n" + ";x\n" * 35)
    recording = read_mapped("csv", plain, columns, sent)
    np.testing.assert_allclose(np.rad2deg(recording.command[:, 0]), [7.0] * 3 + [9.5] * 36)
    assert "37 of 39 cells of commands are empty, the first in row 1 of motor" in recording.notes[0]
    sent.write_text("motor;note\n" + ";x\n" * 2 + "9,5;x\n" + ";x\n" * 36)
    with pytest.raises(
        InputError, match="row 0, column 'motor': the first command is in row 2; write the command that"
    ):
        read_mapped("csv", plain, columns, sent)
    sent.write_text("motor;note\n" + ";x\n" * 39)
    with pytest.raises(InputError, match="row 0, column 'motor': holds no command"):
        read_mapped("csv", plain, columns, sent)
    sent.write_text("motor;note\n7,0;x\ninf;x\n" + ";x\n" * 37)
    with pytest.raises(InputError, match="row 1, column 'motor': NaN or empty cell"):
        read_mapped("csv", plain, columns, sent)


def test_plain_csv_turns_the_object_with_the_frame(tmp_path):
    text = "x,y,z,u,ox,oy,oz,qx,qy,qz,qw\n"
    text += "".join(f"{100 + row},0,0,{row},0,0.5,0,0,0.7071068,0,0.7071068\n" for row in range(4))
    (tmp_path / "object.csv").write_text(text)
    columns = CsvColumns.model_validate(
        {
            "sample_time": 0.1,
            "commands": ["u"],
            "command_unit": "mm",
            "positions": [["x", "y", "z"]],
            "position_unit": "mm",
            "axes": ["x", "z", "-y"],
            "object_pose": ["ox", "oy", "oz", "qx", "qy", "qz", "qw"],
        }
    )
    pose = read_mapped("csv", tmp_path / "object.csv", columns).object_pose
    np.testing.assert_allclose(pose[0, :3], [0.0, 0.0, -0.5e-3], atol=1e-12)
    moved = CsvColumns.model_validate(columns.model_dump() | {"origin": [10.0, 0.0, 0.0]})
    shifted = read_mapped("csv", tmp_path / "object.csv", moved).object_pose
    np.testing.assert_allclose(shifted, pose - [0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], atol=1e-12)
    # a cube turned by 90 degrees about the file's y: its x axis points to -z there, which is -y in the base frame
    x, y, z, w = pose[0, 3:]
    first_axis = [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)]
    np.testing.assert_allclose(first_axis, [0.0, -1.0, 0.0], atol=1e-6)


@pytest.mark.parametrize("idle", [1, 2, 5, 12])
def test_rows_before_the_first_action_sent_nothing(optitrack_table, sofa_table, write, tmp_path, idle):
    """The first action, in row k, is sent after row k - 1; a file may have none."""
    table = optitrack_table()
    table.loc[: idle - 1, "action"] = -1
    found = read_optitrack_csv(write(table, tmp_path / "run.csv"))
    usual = read_optitrack_csv(write(optitrack_table(), tmp_path / "usual.csv"))
    expected = cumulative_displacement(optitrack_table()["action"].to_numpy()[idle:])
    np.testing.assert_array_equal(found.command_at(found.time[: idle - 1]), 0.0)
    np.testing.assert_allclose(found.command_at(found.time[idle - 1 : -1]), expected, atol=1e-15)
    np.testing.assert_array_equal(found.time, usual.time)
    episode = sofa_table()
    episode.loc[:1, "action"] = -1
    np.testing.assert_allclose(
        read_sofa_csv(write(episode, tmp_path / "sofa.csv")).command[:, 2], [0.0, 0.005, 0.010, 0.015]
    )
