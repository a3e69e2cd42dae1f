"""``rfdropo init --recording``, then ``check`` and ``calibrate``, for each format that it recognises."""

from __future__ import annotations

import json
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from rfdropo_bayes.cli import main
from rfdropo_bayes.data import Trajectory, load_recordings
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.experiment import load_experiment
from rfdropo_bayes.verbs.column_names import guess_columns
from tests.data.test_motive_rosbag_lerobot import check_motion
from tests.data.written import Motion, commands_csv, lerobot, motive_csv, rosbag, swaying

DEMO = Path(__file__).resolve().parents[2] / "experiments" / "demo"
FORMATS = ("motive-csv", "bag of ROS 1", "bag of ROS 2", "mcap", "lerobot 2.1", "lerobot 3.0")
ANSWERS = ("--length-mm", "200", "--radius-mm", "12", "--command-unit", "m", "--markers", "low=100,tip=200")


def write(format: str, motions: list[Motion]) -> list[str]:
    """Files of a format in the current folder, one per motion; returns the options of `init` that name them."""
    if format == "motive-csv":
        for number, motion in enumerate(motions, start=1):
            motive_csv(motion, Path(f"take_{number}.csv"))
            commands_csv(motion, Path(f"sent_{number}.csv"))
        return ["--recording", "take_*.csv", "--commands", "sent_*.csv"]
    if format.startswith("lerobot"):
        lerobot(motions, Path("dataset"), version=f"v{format.split()[1]}")
        return ["--recording", "dataset"]
    storage = {"bag of ROS 1": "bag", "bag of ROS 2": "db3", "mcap": "mcap"}[format]
    for number, motion in enumerate(motions, start=1):
        rosbag(motion, Path(f"run_{number}" + (".bag" if storage == "bag" else "")), storage=storage, commands="joint")
    return ["--recording", "run_*"]


def rfdropo(monkeypatch, capsys, *words: str) -> tuple[int, str]:
    monkeypatch.setattr(sys, "argv", ["rfdropo", *words])
    with pytest.raises(SystemExit) as stopped:
        main()
    told = capsys.readouterr()
    return int(stopped.value.code or 0), told.out + told.err


@pytest.mark.parametrize("format", FORMATS)
def test_what_init_writes_reads_what_was_recorded(tmp_path, monkeypatch, capsys, format):
    monkeypatch.chdir(tmp_path)
    every = 1 if format.startswith("lerobot") else 5
    motions = [swaying(rows, every=every) for rows in (40, 50, 60)]
    if every == 1:  # a dataset has a command in each frame, sent then
        motions = [motion._replace(command_time=motion.time) for motion in motions]
    named = write(format, motions)
    status, told = rfdropo(monkeypatch, capsys, "init", "arm", *named, *ANSWERS, "--defaults")
    assert status == 0, told
    experiment, _ = load_experiment(Path("arm/experiment.toml"))
    assert experiment.data is not None
    recordings = [load_recordings(experiment.data, Path("arm"), role) for role in ("fit", "test")]
    assert [len(part) for part in recordings] == [2, 1]
    for recording, motion in zip([*recordings[0], *recordings[1]], motions, strict=True):
        check_motion(recording, motion, position=1e-7)


def test_what_is_assumed_of_a_motive_export_is_marked(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    named = write("motive-csv", [swaying()])
    assert rfdropo(monkeypatch, capsys, "init", "arm", *named, *ANSWERS, "--gravity", "-z", "--defaults")[0] == 0
    text = Path("arm/experiment.toml").read_text()
    table = tomllib.loads(text)["data"]
    assert table["missing"] == "mask"
    assert table["columns"]["axes"] == ["x", "-z", "y"]
    assert table["columns"]["position_unit"] == "mm"
    assumed = [line.split()[0] for line in text.splitlines() if "ASSUMED" in line]
    assert assumed == ["test", "command_time_unit", "#", "axes"]
    status, told = rfdropo(monkeypatch, capsys, "init", "other", "--recording", "take_1.csv", "--defaults")
    assert status == 2
    assert "found no commands" in told
    assert "--commands" in told
    status, told = rfdropo(monkeypatch, capsys, "init", "other", *named, "--commands", "take_1.csv", "--defaults")
    assert status == 2
    assert "recordings of several formats" in told


def test_a_trial_of_vicon_is_guessed_with_its_rate_and_the_blocks_that_are_left_out(tmp_path):
    motion, path = swaying(), tmp_path / "trial.csv"
    commands = commands_csv(motion, tmp_path / "sent.csv")
    speed = [",".join("0" * 3)] * len(motion.time)
    rows = [
        f"{k + 1},0,{','.join(f'{1e3 * value:.6g}' for value in place.ravel())},{fast}"
        for k, (place, fast) in enumerate(zip(motion.position, speed, strict=True))
    ]
    head = [
        ",,arm:low,,,arm:tip,,,arm:tip,,",
        "Frame,Sub Frame,X,Y,Z,X,Y,Z,X',Y',Z'",
        ",," + 6 * "mm," + "mm/s,mm/s,mm/s",
    ]
    blocks = ["Devices", "1000", ",,Cell", "Frame,Sub Frame,Fz", ",,N", "1,0,3", ""]
    path.write_text("\n".join([*blocks, "Trajectories", "50", *head, *rows]) + "\n")
    guess = guess_columns(path, commands)
    assert guess.positions == [["low_X", "low_Y", "low_Z"], ["tip_X", "tip_Y", "tip_Z"]]
    assert (guess.markers, guess.position_unit) == (["low", "tip"], "mm")
    assert (guess.time, guess.sample_time, guess.evidence["sample_time"]) == (None, 0.02, "the file says 50 Hz")
    assert guess.unused[:2] == ["Frame", "Sub Frame"]
    assert guess.unused[-1] == "all of the block Devices"


@pytest.mark.parametrize("poses", ["stamped", "tf", "array", "mocap"])
@pytest.mark.parametrize("commands", ["array", "joint", "single"])
def test_topics_are_recognised(tmp_path, poses, commands):
    """Places are told from orientations, commands from velocities, bodies from the markers on them."""
    guess = guess_columns(rosbag(swaying(), tmp_path / "run", poses=poses, commands=commands))
    assert guess.format == "rosbag"
    assert guess.markers == (["m0", "m1"] if poses == "array" else ["low", "tip"])
    assert len(guess.commands) == 4
    assert all("position" in name or commands != "joint" for name in guess.commands)
    assert guess.position_unit == "m"


def test_labelled_markers_are_taken_where_there_are_no_bodies(tmp_path):
    path = motive_csv(swaying(), tmp_path / "take.csv")
    path.write_text(path.read_text().replace("Rigid Body,", "Bone Thing,"))
    commands_csv(swaying(), tmp_path / "sent.csv")
    guess = guess_columns(path, tmp_path / "sent.csv")
    assert [triple[0] for triple in guess.positions] == [
        "Marker.low:Marker 001.Position.X",
        "Marker.tip:Marker 001.Position.X",
    ]


def test_a_bag_without_commands_is_refused(tmp_path):
    folder = rosbag(swaying()._replace(command=np.zeros((0, 4)), command_time=np.zeros(0)), tmp_path / "run")
    with pytest.raises(InputError, match="found no commands"):
        guess_columns(folder)


def demo_motion(name: str, rows: int, *, every_row: bool) -> Motion:
    """The first rows of a recording of the bundled example, whose arm lies level: y is up in the base frame."""
    recording = Trajectory.load(DEMO / f"{name}.nc").slice_rows(0, rows - 1)
    sent = recording.time if every_row else recording.command_time
    command = recording.command_at(sent)[:, [3, 0, 1, 2]]  # init's cables begin at +x
    return Motion(recording.time, recording.position, sent, command, recording.marker_names)


@pytest.mark.slow
@pytest.mark.parametrize("format", ["motive-csv", "bag of ROS 2", "mcap", "lerobot 3.0"])
def test_two_commands_calibrate_an_arm_from_each_format(tmp_path, monkeypatch, capsys, format):
    """With a small budget the test recording is told better than by an arm that does not move."""
    monkeypatch.chdir(tmp_path)
    every_row = format.startswith("lerobot")
    motions = [demo_motion(name, 21, every_row=every_row) for name in ("demo_1", "demo_2", "demo_3")]
    body = ("--shape", "cone", "--length-mm", "200", "--radius-mm", "14", "--tip-radius-mm", "9")
    weight = ("--mass-g", "75", "--modulus-mpa", "1.5")
    drive = ("--cables", "4", "--gravity=-y", "--command-unit", "m", "--cable-radius-mm", "10.5")
    named = write(format, motions)
    status, told = rfdropo(monkeypatch, capsys, "init", "arm", *named, *body, *weight, *drive, "--defaults")
    assert status == 0, told
    small = ["simulator.refine=1", "inference.minutes=0.5"]
    if format == "motive-csv":
        small.append('data.columns.axes=["x", "z", "-y"]')  # as it was written
    options = [word for assignment in small for word in ("--set", assignment)]
    status, told = rfdropo(monkeypatch, capsys, "calibrate", "arm/experiment.toml", *options, "--out", "fit")
    assert status == 0, told
    summary = json.loads(Path("fit/summary.json").read_text())
    assert summary["status"] == "done"
    moved = motions[2].position[:, -1] - motions[2].position[0, -1]
    assert summary["rmse"]["test"][motions[0].markers[-1]] < 1e3 * np.sqrt((moved**2).sum(axis=1).mean())
