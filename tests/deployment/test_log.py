"""The journal of a session, and the recording made of it."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.deployment.log import EVENTS, JOURNAL, SessionLog, read_journal, session_trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Robot

WRITER = """
import sys, time
from pathlib import Path
from rfdropo_bayes.deployment.log import SessionLog
from rfdropo_bayes.robots import Robot
log = SessionLog(Path(sys.argv[1]), Robot.load("motor_arm"), {})
for number in range(10**6):
    log.record["time"] = number
    log.write()
    if number == 200:
        print("going", flush=True)
    time.sleep(0.001)
"""


def write(log: SessionLog, robot: Robot, cycles: int = 30, late: float = 0.0) -> None:
    for number in range(cycles):
        record = log.record
        record["time"], record["phase"], record["acted"] = 0.01 * number, 5, number % 10 == 0
        record["command"] = 1e-3 * (number // 10 + 1)
        record["raw"], record["asked"] = 1.0, 2.0
        record["length"], record["tension"] = 1e-3 * number, 2.0 + 0.1 * number
        record["fresh"] = number != 7
        record["position"], record["seen"] = robot.marker_points() + 1e-3 * number, number % 2 == 0
        record["seen_at"] = 0.01 * number - late
        log.write()


def test_a_session_becomes_a_recording(robot: Robot, tmp_path: Path) -> None:
    log = SessionLog(tmp_path / "s", robot, {"mode": "run"})
    write(log, robot)
    log.close()
    made = session_trajectory(tmp_path / "s")
    made.save(tmp_path / "s.nc")
    read = Trajectory.load(tmp_path / "s.nc")
    assert read.sha256 == made.sha256
    assert read.cable_names == robot.channel_names
    assert read.settings["mode"] == "run"
    np.testing.assert_allclose(read.command_time, [0.0, 0.1, 0.2])
    np.testing.assert_allclose(read.command[:, 0], [1e-3, 2e-3, 3e-3])
    np.testing.assert_allclose(read.motor_angle[:, 0], 1e-3 * np.arange(30) / 0.0093)
    there = np.arange(30) != 7
    np.testing.assert_array_equal(read.tension_mask, np.broadcast_to(there[:, None], (30, 4)))
    np.testing.assert_allclose(read.tension[there, 2], 2.0 + 0.1 * np.arange(30)[there])
    assert read.position_mask[::2].all()
    assert not read.position_mask[1::2].any()


def test_markers_stand_in_the_cycle_in_which_they_were_there(robot: Robot, tmp_path: Path) -> None:
    """A sensor that answers 12 ms late, every second cycle: what cycle 8 hears was there in cycle 7."""
    log = SessionLog(tmp_path / "s", robot, {"mode": "run"})
    write(log, robot, late=0.012)
    log.close()
    made = session_trajectory(tmp_path / "s")
    assert made.position_mask[1:28:2].all()
    assert not made.position_mask[2::2].any()
    np.testing.assert_allclose(made.position[7], robot.marker_points() + 8e-3)


def test_an_object_is_recorded_where_it_was_seen(robot: Robot, tmp_path: Path) -> None:
    """Every third cycle, 12 ms late; a recording without one has no poses."""
    log = SessionLog(tmp_path / "s", robot, {})
    for number in range(30):
        log.record["time"], log.record["seen_at"] = 0.01 * number, 0.01 * number - 0.012
        log.record["object_seen"] = number % 3 == 0
        log.record["object_pose"] = [1e-3 * number, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
        log.write()
    log.close()
    pose = session_trajectory(tmp_path / "s").object_pose
    assert pose is not None
    seen = np.flatnonzero(np.isfinite(pose).all(axis=1))
    np.testing.assert_array_equal(seen, [0, *range(2, 27, 3)])
    np.testing.assert_allclose(pose[seen[1:], 0], 1e-3 * (seen[1:] + 1))
    log = SessionLog(tmp_path / "t", robot, {})
    write(log, robot)
    log.close()
    assert session_trajectory(tmp_path / "t").object_pose is None


def test_a_session_without_markers_is_a_recording_of_tensions(robot: Robot, tmp_path: Path) -> None:
    log = SessionLog(tmp_path / "s", robot, {})
    for number in range(5):
        log.record["time"] = number
        log.write()
    log.close()
    assert session_trajectory(tmp_path / "s").settings["unseen"]


def test_a_record_cut_short_is_left_out(robot: Robot, tmp_path: Path) -> None:
    log = SessionLog(tmp_path / "s", robot, {})
    write(log, robot)
    log.close()
    path = tmp_path / "s" / JOURNAL
    path.write_bytes(path.read_bytes()[:-5])
    assert len(read_journal(tmp_path / "s")[1]) == 29


def test_a_killed_writer_loses_less_than_a_second(tmp_path: Path) -> None:
    """SIGKILL, without any warning, half a second after record 200: all before it are there."""
    folder = tmp_path / "s"
    command = [sys.executable, "-c", WRITER, str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "going\n"
        time.sleep(0.5)
        os.kill(process.pid, signal.SIGKILL)
    instants = read_journal(folder)[1]["time"]
    assert len(instants) > 200
    np.testing.assert_array_equal(instants, np.arange(len(instants)))


@pytest.mark.parametrize("room", [True, False])
def test_a_disk_without_room_for_a_while_costs_no_cycle(robot: Robot, tmp_path: Path, room: bool) -> None:
    """It takes ten records and a half; the log goes on when there is room again, or says at its end what is missing."""
    log = SessionLog(tmp_path / "s", robot, {})
    limits, journal = resource.getrlimit(resource.RLIMIT_FSIZE), tmp_path / "s" / JOURNAL
    most = journal.stat().st_size + 10 * log.record.dtype.itemsize + log.record.dtype.itemsize // 2
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, limits[1]))
    try:
        write(log, robot)
        time.sleep(0.1)
        if not room:
            with pytest.raises(InputError, match="its last 20 cycles could not be written"):
                log.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    if room:
        log.close()
    np.testing.assert_allclose(read_journal(tmp_path / "s")[1]["time"], 0.01 * np.arange(30 if room else 10))


def test_a_folder_is_used_once(robot: Robot, tmp_path: Path) -> None:
    SessionLog(tmp_path, robot, {}).close()
    with pytest.raises(InputError, match="holds a session already"):
        SessionLog(tmp_path, robot, {})


def test_what_is_no_journal_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a journal"):
        read_journal(tmp_path)
    (tmp_path / JOURNAL).write_bytes(b"12 years a slave")
    with pytest.raises(InputError, match="not a journal"):
        read_journal(tmp_path)


def test_events_are_lines_with_times(robot: Robot, tmp_path: Path) -> None:
    log = SessionLog(tmp_path, robot, {})
    log.event("stop", "because", code=3)
    log.close()
    (line,) = [json.loads(text) for text in (tmp_path / EVENTS).read_text().splitlines()]
    assert (line["event"], line["text"], line["code"]) == ("stop", "because", 3)
