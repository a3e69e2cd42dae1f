"""Motive exports, bags and LeRobotDatasets: what was written into them comes out, with the commands' own times."""

from __future__ import annotations

import builtins
import gzip
import re
import shutil
import sqlite3
import sys

import numpy as np
import pandas as pd
import pytest

from rfdropo_bayes.data import DataSpec, load_recordings, load_unseen
from rfdropo_bayes.data.mapped_formats import recognised_format
from rfdropo_bayes.data.motive_csv import read_motive
from rfdropo_bayes.data.streams import Stream, observed
from rfdropo_bayes.errors import InputError

from .written import LATENCY, Motion, commands_csv, lerobot, motive_csv, rosbag, swaying

MOTION = swaying()
HANGING = ["x", "z", "-y"]
PULLS = {"command_unit": "m", "position_unit": "m", "markers": list(MOTION.markers)}
PLACES = {
    "stamped": "/mocap/{0}.pose.position.{1}",
    "tf": "/tf.transforms[{0}].transform.translation.{1}",
    "array": "/poses.poses[{2}].position.{1}",
    "mocap": "/rigid_bodies.rigidbodies[{0}].pose.position.{1}",
    "markers": "/markers.markers[{3}].translation.{1}",
}
SENT = {
    "array": "/commands.data[{1}]",
    "joint": "/joint_command.position[cable{0}]",
    "single": "/cable{0}/command.data",
}


def motive_columns(**changes):
    places = [[f"Rigid Body.{name}.Position.{axis}" for axis in "XYZ"] for name in MOTION.markers]
    sent = [f"cmd_{channel}" for channel in range(1, 5)]
    return {
        "time": "Time (Seconds)", "commands": sent, "positions": places, "axes": HANGING, "command_time": "t"
    } | PULLS | changes  # fmt: skip


def bag_columns(poses="stamped", commands="array", **changes):
    places = [[PLACES[poses].format(name, axis, k, k + 3) for axis in "xyz"] for k, name in MOTION.named]
    sent = [SENT[commands].format(channel + 1, channel) for channel in range(4)]
    return {"time": "header", "commands": sent, "positions": places} | PULLS | changes


def dataset_columns(named=True, **changes):
    state, action = "observation.state", "action"
    if named:
        places = [[f"{state}.{name}_{axis}" for axis in "xyz"] for name in MOTION.markers]
        sent = [f"{action}.cable{channel}.pos" for channel in range(1, 5)]
    else:
        places = [[f"{state}[{3 * k + axis}]" for axis in range(3)] for k, _ in MOTION.named]
        sent = [f"{action}[{channel}]" for channel in range(4)]
    return {"time": "timestamp", "commands": sent, "positions": places} | PULLS | changes


def load(folder, format, fit, columns, **options):
    entries = fit if isinstance(fit, list) else [fit]
    return load_recordings(DataSpec.parse({"format": format, "fit": entries, "columns": columns} | options), folder)


def check_motion(recording, motion: Motion, position=1e-9, moment=1e-6):
    """A recording is a motion, apart from rounding; commands' times are relative to the first observation."""
    np.testing.assert_allclose(recording.time, motion.time - motion.time[0], atol=moment)
    np.testing.assert_allclose(recording.position, motion.position, atol=position)
    np.testing.assert_allclose(recording.command, motion.command, atol=1e-7)
    np.testing.assert_allclose(recording.command_time, motion.command_time - motion.time[0], atol=moment)
    assert recording.position_mask.all()
    assert recording.marker_names == motion.markers


def fails(message):
    return pytest.raises(InputError, match=message)


@pytest.mark.parametrize("unit", ["Meters", "Centimeters", "Millimeters"])
@pytest.mark.parametrize("labelled", [True, False])
def test_a_motive_export_is_read_in_the_unit_of_its_header(tmp_path, unit, labelled):
    motive_csv(MOTION, tmp_path / "take.csv", unit=unit, labelled=labelled)
    commands_csv(MOTION, tmp_path / "sent.csv")
    entry = {"observations": "take.csv", "commands": "sent.csv"}
    (recording,) = load(tmp_path, "motive-csv", entry, motive_columns())
    check_motion(recording, MOTION)
    assert recording.name == "take"


def test_markers_that_motive_lost_are_masked_where_that_is_asked_for(tmp_path):
    motive_csv(MOTION, tmp_path / "take.csv", lost=(7, 8, 20))
    commands_csv(MOTION, tmp_path / "sent.csv")
    entry = {"observations": "take.csv", "commands": "sent.csv"}
    (recording,) = load(tmp_path, "motive-csv", entry, motive_columns(), missing="mask")
    assert np.flatnonzero(~recording.position_mask[:, 1]).tolist() == [7, 8, 20]
    assert recording.position_mask[:, 0].all()
    with fails("row 7, column 'Rigid Body.tip.Position.X': NaN or empty cell"):
        load(tmp_path, "motive-csv", entry, motive_columns())


def test_the_commands_clock_may_be_another(tmp_path):
    """The commands' clock shows zero when that of the take shows 0.25 s."""
    motive_csv(MOTION, tmp_path / "take.csv")
    commands_csv(MOTION, tmp_path / "sent.csv", clock=0.25)
    entry = {"observations": "take.csv", "commands": "sent.csv"}
    (recording,) = load(tmp_path, "motive-csv", entry, motive_columns(command_offset=0.25))
    check_motion(recording, MOTION)
    (own,) = load(tmp_path, "motive-csv", {**entry, "command_offset": 0.25}, motive_columns(command_offset=100.0))
    np.testing.assert_array_equal(own.command_time, recording.command_time)
    with fails("commands were sent from 99.756 to .* correct command_offset"):
        load(tmp_path, "motive-csv", entry, motive_columns(command_offset=100.0))


def test_commands_long_before_a_recording_are_simulated_for_the_lead_in_only(tmp_path):
    early = MOTION._replace(
        command_time=np.concatenate([[-30.0, -1.0], MOTION.command_time]),
        command=np.concatenate([MOTION.command[:1], MOTION.command[1:2], MOTION.command]),
    )
    motive_csv(early, tmp_path / "take.csv")
    commands_csv(early, tmp_path / "sent.csv")
    entry = {"observations": "take.csv", "commands": "sent.csv"}
    (recording,) = load(tmp_path, "motive-csv", entry, motive_columns())
    assert recording.name == "take"
    np.testing.assert_allclose(recording.command_time, early.command_time[1:])
    np.testing.assert_allclose(recording.initial_command, early.command[0])


def test_a_motive_export_is_told_from_other_files(tmp_path):
    motive_csv(MOTION, tmp_path / "take.csv")
    commands_csv(MOTION, tmp_path / "sent.csv")
    assert recognised_format(tmp_path / "take.csv") == "motive-csv"
    assert recognised_format(tmp_path / "sent.csv") == "csv"
    packed = gzip.compress((tmp_path / "take.csv").read_bytes())
    (tmp_path / "packed.csv.gz").write_bytes(packed)
    entry = {"observations": "packed.csv.gz", "commands": "sent.csv"}
    (recording,) = load(tmp_path, "motive-csv", entry, motive_columns())
    check_motion(recording, MOTION)
    assert recording.name == "packed"
    (tmp_path / "cut.csv.gz").write_bytes(packed[: len(packed) // 50])
    assert recognised_format(tmp_path / "cut.csv.gz") in ("csv", "motive-csv")
    with fails("is of the format 'motive-csv', not 'csv'"):
        load(tmp_path, "csv", "take.csv", motive_columns())
    with fails("Motive's own export"):
        load_recordings(DataSpec.parse({"format": "optitrack-csv", "fit": ["take.csv"]}), tmp_path)
    with fails("has no commands: Motive records none"):
        load(tmp_path, "motive-csv", "take.csv", motive_columns())


def test_markers_of_the_same_name_are_told_apart_by_their_ids(tmp_path):
    names = read_motive(motive_csv(MOTION, tmp_path / "take.csv")).table.frame.columns
    assert {f"Marker.Unlabeled 7 U{n}.Position.X" for n in (1, 2)} <= set(names)
    assert "Marker.tip:Marker 001.Position.Z" in names
    assert "Rigid Body.low.Rotation.W" in names
    assert not [name for name in names if "Error" in name or "passed" in name]


@pytest.mark.parametrize("cut", ["half a row", "no axes", "no positions", "furlongs"])
def test_damaged_motive_exports_are_refused(tmp_path, cut):
    path = motive_csv(MOTION, tmp_path / "take.csv")
    text = path.read_text()
    changed = {
        "half a row": text[: len(text) - 60],
        "no axes": text.replace("Frame,Time", "Number,Time"),
        "no positions": text.replace("Position", "Quality"),
        "furlongs": text.replace("Millimeters", "Furlongs"),
    }
    path.write_text(changed[cut])
    said = {"half a row": "cut short", "no axes": "no row of axes", "no positions": "no positions"}
    with fails(said.get(cut, "lengths in 'Furlongs'")):
        load(tmp_path, "motive-csv", {"observations": "take.csv", "commands": "take.csv"}, motive_columns())


@pytest.mark.parametrize("storage", ["db3", "mcap", "bag"])
@pytest.mark.parametrize("poses", [*PLACES])
def test_bags_of_all_kinds_of_poses_are_read(tmp_path, storage, poses):
    name = "run.bag" if storage == "bag" else "run"
    if storage == "bag" and poses in ("mocap", "markers"):
        pytest.skip("messages of ROS 2")
    rosbag(MOTION, tmp_path / name, poses=poses, storage=storage)
    assert recognised_format(tmp_path / name) == "rosbag"
    (recording,) = load(tmp_path, "rosbag", name, bag_columns(poses))
    check_motion(recording, MOTION)
    assert recording.name == "run"


def test_a_bag_without_definitions_is_read_as_far_as_its_messages_are_common(tmp_path):
    """Recorders of ROS 2 before Iron wrote none."""
    for name, poses in (("common", "stamped"), ("other", "mocap")):
        (file,) = rosbag(MOTION, tmp_path / name, poses=poses).glob("*.db3")
        with sqlite3.connect(file) as database:
            database.execute("drop table message_definitions")
            database.execute("update schema set schema_version = 3")
        database.close()
    (recording,) = load(tmp_path, "rosbag", "common", bag_columns())
    check_motion(recording, MOTION)
    with fails("does not define the message mocap4r2_msgs/msg/RigidBodies of /rigid_bodies"):
        load(tmp_path, "rosbag", "other", bag_columns("mocap"))


@pytest.mark.parametrize("commands", ["array", "joint"])
def test_bags_of_all_kinds_of_commands_are_read(tmp_path, commands):
    rosbag(MOTION, tmp_path / "run", commands=commands)
    (recording,) = load(tmp_path, "rosbag", "run", bag_columns(commands=commands))
    check_motion(recording, MOTION)


def test_channels_on_topics_of_their_own_hold_their_commands(tmp_path):
    """Each message changes one channel: a row for each, in which the others keep their commands."""
    rosbag(MOTION, tmp_path / "run", commands="single")
    (recording,) = load(tmp_path, "rosbag", "run", bag_columns(commands="single"))
    assert len(recording.command) == MOTION.command.size
    np.testing.assert_allclose(recording.command[3::4], MOTION.command)
    np.testing.assert_allclose(recording.command[4, 1:], MOTION.command[0, 1:])
    np.testing.assert_allclose(recording.command[4, 0], MOTION.command[1, 0])
    np.testing.assert_allclose(recording.command_time[::4], MOTION.command_time, atol=1e-6)


def test_stamps_of_arrival_in_a_bag_may_be_replaced_by_a_sample_time(tmp_path):
    """As the note on such stamps says; commands keep their distance from the first row."""
    rows = np.arange(len(MOTION.time))
    rosbag(MOTION, tmp_path / "run")
    bunched = MOTION._replace(time=MOTION.time[rows // 4 * 4] + 3e-6 * (rows % 4))
    rosbag(bunched, tmp_path / "late")
    (recording,) = load(tmp_path, "rosbag", "late", bag_columns())
    assert any("give sample_time = 0.0" in note for note in recording.notes)
    step = float(np.diff(MOTION.time)[0])
    (numbered,) = load(tmp_path, "rosbag", "late", bag_columns(time=None, sample_time=step))
    check_motion(numbered, MOTION)
    assert numbered.notes == []


def test_formats_that_have_times_in_seconds_need_no_unit_of_them(tmp_path):
    """The unit that is stated is that of the commands' file; a bag's stamps are nanoseconds for ROS alone."""
    rosbag(MOTION, tmp_path / "run")
    (recording,) = load(tmp_path, "rosbag", "run", bag_columns(time_unit="ns"))
    check_motion(recording, MOTION)
    motive_csv(MOTION, tmp_path / "take.csv")
    commands_csv(MOTION, tmp_path / "sent.csv")
    sent = pd.read_csv(tmp_path / "sent.csv")
    sent.assign(t=1e3 * sent["t"]).to_csv(tmp_path / "sent.csv", index=False)
    entry = {"observations": "take.csv", "commands": "sent.csv"}
    (recording,) = load(tmp_path, "motive-csv", entry, motive_columns(time_unit="ms"))
    check_motion(recording, MOTION)


@pytest.mark.parametrize("storage", ["mcap", "db3"])
def test_a_storage_file_alone_is_a_bag(tmp_path, storage):
    folder = rosbag(MOTION, tmp_path / "whole", storage=storage)
    (file,) = folder.glob(f"*.{storage}")
    shutil.copy(file, tmp_path / f"alone.{storage}")
    (folder / "metadata.yaml").unlink()
    for name in (f"alone.{storage}", "whole"):
        assert recognised_format(tmp_path / name) == "rosbag"
        (recording,) = load(tmp_path, "rosbag", name, bag_columns())
        check_motion(recording, MOTION)


def test_the_recorders_times_may_be_asked_for(tmp_path):
    """Poses were received 13 ms after their stamps; commands without a header are in the recorder's times anyway."""
    rosbag(MOTION, tmp_path / "run")
    (recording,) = load(tmp_path, "rosbag", "run", bag_columns(time="log"))
    np.testing.assert_allclose(recording.command_time, MOTION.command_time - LATENCY, atol=1e-6)
    with fails("time = 't' is not a clock of a bag"):
        load(tmp_path, "rosbag", "run", bag_columns(time="t"))


def test_a_marker_of_another_rate_is_brought_to_the_times_of_the_first():
    """Interpolation of what is linear in time is exact; what is far from any reading is missing."""
    time = np.arange(0.0, 1.0, 0.02)
    fast = np.arange(0.005, 0.9, 0.007)
    slow = np.arange(0.001, 1.0, 0.1)
    fast = fast[(fast < 0.4) | (fast > 0.5)]
    streams = [
        Stream("a", time, pd.DataFrame({"a": time})),
        Stream("b", fast, pd.DataFrame({"b": 2.0 * fast})),
        Stream("c", slow, pd.DataFrame({"c": slow})),
    ]
    table = observed(streams, "t", ["a", "b", "c"], None, "here").to_numpy()
    assert np.array_equal(table[:, 0], time)
    inner = (time > 0.02) & (time < 0.88) & ((time < 0.38) | (time > 0.52))
    np.testing.assert_allclose(table[inner, 2], 2.0 * time[inner])
    assert np.isnan(table[(time > 0.42) & (time < 0.48), 2]).all()
    assert np.isnan(table[time > 0.92, 2]).all()
    assert np.flatnonzero(np.isfinite(table[:, 3])).tolist() == list(range(0, 50, 5))
    np.testing.assert_allclose(table[::5, 3], slow)


def test_the_turn_of_a_pushed_body_is_interpolated_over_lost_poses():
    """The tracker comes back with the other sign of the quaternion, which is the same rotation."""
    time, names = np.arange(0.0, 1.0, 0.0025), [f"o.{name}" for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    turn = 0.3 * time
    pose = np.column_stack([time, time, time, 0.0 * time, 0.0 * time, np.sin(turn / 2.0), np.cos(turn / 2.0)])
    pose[120:122] = np.nan
    pose[122:, 3:] *= -1.0
    rows = np.arange(0.001, 0.99, 0.01)
    streams = [Stream("a", rows, pd.DataFrame({"a": rows})), Stream("o", time, pd.DataFrame(pose, columns=names))]
    table = observed(streams, "t", ["a"], names, "here")
    found = 2.0 * np.arctan(table["o.qz"] / table["o.qw"])
    np.testing.assert_allclose(found, 0.3 * rows, atol=1e-6)
    assert (table["o.qw"] > 0.9).all()


def test_a_pushed_body_may_come_from_the_bag(tmp_path):
    pose = [
        f"/mocap/tip.pose.{part}" for part in (*(f"position.{a}" for a in "xyz"), *(f"orientation.{a}" for a in "xyzw"))
    ]
    rosbag(MOTION, tmp_path / "run")
    (recording,) = load(tmp_path, "rosbag", "run", bag_columns(object_pose=pose))
    np.testing.assert_allclose(recording.object_pose[:, :3], MOTION.position[:, 1])
    np.testing.assert_allclose(recording.object_pose[:, 3:], [[0.0, 0.0, 0.6, 0.8]] * len(MOTION.time))


def test_bags_that_cannot_be_read_say_why(tmp_path):
    folder = rosbag(MOTION, tmp_path / "run", storage="mcap")
    with fails("has no topic '/mocap/tipp'; did you mean '/mocap/tip'"):
        load(
            tmp_path,
            "rosbag",
            "run",
            bag_columns(positions=[[f"/mocap/{name}.{axis}" for axis in "xyz"] for name in ("tipp", "low")]),
        )
    with fails(r"column '/commands.data\[4\]' is missing; did you mean '/commands.data\[3\]'"):
        load(tmp_path, "rosbag", "run", bag_columns(commands="array") | {"commands": ["/commands.data[4]"]})
    rosbag(MOTION, tmp_path / "two", frames=("world", "elbow"))
    with fails("several coordinate frames: elbow, world"):
        load(tmp_path, "rosbag", "two", bag_columns())
    (file,) = folder.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-400])
    with fails("is not a bag that rosbags can read .* `mcap recover`"):
        load(tmp_path, "rosbag", "run", bag_columns())
    (tmp_path / "empty").mkdir()
    with fails("is a folder, but neither a ROS 2 bag nor a LeRobotDataset"):
        load(tmp_path, "rosbag", "empty", bag_columns())


EPISODES = [swaying(rows, 0.02, 1)._replace(command_time=0.02 * np.arange(rows)) for rows in (30, 40, 50)]


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
@pytest.mark.parametrize("named", [True, False])
def test_the_episodes_of_a_dataset_are_recordings(tmp_path, version, named):
    lerobot(EPISODES, tmp_path / "arm", version=version, named=named)
    assert recognised_format(tmp_path / "arm") == "lerobot"
    recordings = load(tmp_path, "lerobot", "arm", dataset_columns(named))
    assert [recording.name for recording in recordings] == ["arm_0", "arm_1", "arm_2"]
    for recording, motion in zip(recordings, EPISODES, strict=True):
        check_motion(recording, motion, position=1e-7)
        np.testing.assert_array_equal(recording.time, np.arange(len(motion.time)) / 50.0)
    (last,) = load(tmp_path, "lerobot", {"observations": "arm", "episodes": [2]}, dataset_columns(named))
    check_motion(last, EPISODES[2], position=1e-7)


def test_episodes_are_split_into_fitted_and_tested_ones(tmp_path):
    lerobot(EPISODES, tmp_path / "arm")
    entries = [{"observations": "arm", "episodes": numbers} for numbers in ([0, 1], [2], [1])]
    spec = {"format": "lerobot", "columns": dataset_columns(), "fit": entries[:1]}
    tested = load_recordings(DataSpec.parse(spec | {"test": entries[1:2]}), tmp_path, "test")
    assert [recording.name for recording in tested] == ["arm_2"]
    with fails("a test recording shares rows"):
        load_recordings(DataSpec.parse(spec | {"test": entries[2:]}), tmp_path)
    with fails("has no episode 7"):
        load(tmp_path, "lerobot", {"observations": "arm", "episodes": [7]}, dataset_columns())
    with fails("format 'csv' has no episodes"):
        load(tmp_path, "csv", {"observations": "arm/meta/info.json", "episodes": [1]}, dataset_columns())


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
@pytest.mark.parametrize("damage", ["file lost", "file cut", "rows lost", "version"])
def test_damaged_datasets_are_refused(tmp_path, version, damage):
    folder = lerobot(EPISODES, tmp_path / "arm", version=version)
    file = sorted((folder / "data").rglob("*.parquet"))[0]
    info = folder / "meta" / "info.json"
    if damage == "file lost":
        file.unlink()
    elif damage == "file cut":
        file.write_bytes(file.read_bytes()[:-100])
    elif damage == "rows lost":
        cut = EPISODES[0]._replace(time=EPISODES[0].time[:9], position=EPISODES[0].position[:9])
        short = lerobot([cut], tmp_path / "short")
        shutil.copy(next((short / "data").rglob("*.parquet")), file)
    else:
        info.write_text(re.sub('"v[23][.].', '"v9.0', info.read_text()))
    said = {
        "file lost": "no such file",
        "file cut": "not a readable Parquet file",
        "rows lost": "has 9 frames, but its description has 30",
        "version": "of version 'v9.0'",
    }
    with fails(said[damage]):
        load(tmp_path, "lerobot", "arm", dataset_columns())


@pytest.mark.parametrize(("package", "format"), [("rosbags", "rosbag"), ("pyarrow", "lerobot")])
def test_a_package_that_is_not_installed_is_named(tmp_path, monkeypatch, package, format):
    path = tmp_path / "run"
    if format == "rosbag":
        rosbag(MOTION, path)
    else:
        lerobot(EPISODES, path)
    real = builtins.__import__

    def without(name, *rest):
        if name.split(".")[0] == package:
            raise ImportError(name)
        return real(name, *rest)

    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(builtins, "__import__", without)
    with fails(rf'{package}, which is not installed.*pip install "rfdropo_bayes\[formats\]"'):
        load(tmp_path, format, "run", bag_columns() if format == "rosbag" else dataset_columns())


def test_commands_alone_start_from_the_first_row_of_a_recording(tmp_path):
    """What a design proposes is a CSV, whichever format the recordings have."""
    motive_csv(MOTION, tmp_path / "take.csv")
    commands_csv(MOTION, tmp_path / "next.csv")
    spec = DataSpec.parse({"format": "motive-csv", "fit": ["take.csv"], "columns": motive_columns()})
    unseen = load_unseen(spec, tmp_path, "next.csv", "take.csv")
    np.testing.assert_allclose(unseen.position[0], MOTION.position[0])
    np.testing.assert_allclose(unseen.command, MOTION.command, atol=1e-9)
    assert not unseen.position_mask[1:].any()
    rosbag(MOTION, tmp_path / "run")
    spec = DataSpec.parse({"format": "rosbag", "fit": ["run"], "columns": bag_columns()})
    unseen = load_unseen(spec, tmp_path, "run")
    np.testing.assert_allclose(unseen.position[0], MOTION.position[0])
    np.testing.assert_allclose(unseen.command, MOTION.command)


def test_an_episode_is_predicted_by_its_number(tmp_path):
    lerobot(EPISODES, tmp_path / "arm")
    spec = DataSpec.parse(
        {"format": "lerobot", "fit": [{"observations": "arm", "episodes": [0]}], "columns": dataset_columns()}
    )
    with fails("has 3 episodes.*name the one to predict, e.g. --episode 0"):
        load_unseen(spec, tmp_path, "arm")
    unseen = load_unseen(spec, tmp_path, "arm", episode=2)
    np.testing.assert_allclose(unseen.position[0], EPISODES[2].position[0], atol=1e-7)
    assert len(unseen.time) == 50
    np.testing.assert_allclose(unseen.position, EPISODES[2].position, atol=1e-7)  # what a prediction is compared with
    sent = {name: EPISODES[1].command[:, channel] for channel, name in enumerate(dataset_columns()["commands"])}
    pd.DataFrame({"timestamp": EPISODES[1].command_time, **sent}).to_csv(tmp_path / "next.csv", index=False)
    started = load_unseen(spec, tmp_path, "next.csv", "arm", episode=1)
    np.testing.assert_allclose(started.position[0], EPISODES[1].position[0], atol=1e-7)
