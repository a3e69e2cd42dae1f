"""Sessions from end to end on simulated drives in processes of their own, in real time."""

from __future__ import annotations

import datetime
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest

import rfdropo_bayes as rb
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.deployment.bench.hub import HubBus
from rfdropo_bayes.deployment.bench.simulated_bus import SimulationTable, simulated_drives
from rfdropo_bayes.deployment.bus import BusTable
from rfdropo_bayes.deployment.causes import Cause
from rfdropo_bayes.deployment.homing import Home, HomingResult, load_homing
from rfdropo_bayes.deployment.log import read_journal, session_trajectory
from rfdropo_bayes.deployment.loop import Phase
from rfdropo_bayes.deployment.policy import OnnxPolicy, pulls_too_hard
from rfdropo_bayes.deployment.sensors import SimulatedMarkers
from rfdropo_bayes.deployment.session import deploy
from rfdropo_bayes.deployment.settings import (
    Deployment,
    DrivesTable,
    HomingTable,
    PolicyTable,
    SafetyTable,
    SimulationSettings,
    load_deployment,
)
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.robots.policy_layout import EVALUATED_EPISODES, PEAK_TENSION, STOPPED_EPISODES, TENSION_LIMIT

from .conftest import PATIENT, SEEN_LATE, Rig
from .policies import linear_policy

SLOW = DrivesTable(answer_s=2.0)


def turning(path: Path, robot: Robot, gain: float = 0.004) -> Path:
    """A policy that turns the command, pushed by the tip's height: cables go round in circles of some millimetres."""
    weight, turn = np.zeros((16, 4)), 0.5
    for a, b in ((0, 2), (1, 3)):
        weight[[a, a, b, b], [a, b, a, b]] = [np.cos(turn) - 1, np.sin(turn), -np.sin(turn), np.cos(turn) - 1]
    weight[-1, :2] = gain / robot.marker_points()[-1, 2]
    return linear_policy(path, robot, weight, np.zeros(4))


@pytest.fixture(scope="module")
def dry_run(tmp_path_factory) -> tuple[Path, Deployment]:
    """A dry run of two seconds."""
    folder = tmp_path_factory.mktemp("dry")
    policy = turning(folder / "policy.onnx", Robot.load("motor_arm"))
    settings = Deployment(
        robot="motor_arm", duration_s=2.0, policy=PolicyTable(file=str(policy)), drives=SLOW, safety=PATIENT,
        sensor=SEEN_LATE,
        simulation=SimulationSettings(settings={"stiffness": 300.0, "pretension": 3.0}),
    )  # fmt: skip
    outcome = rb.deploy(settings, "dry-run", folder / "session")
    assert outcome.cause is Cause.FINISHED, outcome.detail
    return folder / "session", settings


def test_a_dry_run_leaves_everything_a_session_must(dry_run) -> None:
    folder, _ = dry_run
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["cause"] == "finished"
    assert summary["figures"]["cycles"] > 200
    assert len(summary["facts"]["policy_sha256"]) == 64
    assert "robot" in (folder / "config.toml").read_text()
    frames = (folder / "frames.log").read_text()
    assert " 080#" in frames  # SYNC, which we sent
    assert " 181#" in frames  # status, which came


def test_the_phases_follow_each_other(dry_run) -> None:
    phases = read_journal(dry_run[0])[1]["phase"]
    order = phases[np.flatnonzero(np.diff(phases, prepend=0))]
    assert order.tolist() == [
        Phase.ENABLING, Phase.SETTLING, Phase.RUNNING, *([Phase.STOPPING] if Phase.STOPPING in order else []),
        Phase.HOLDING, Phase.BRAKED,
    ]  # fmt: skip


def test_the_log_is_a_recording_of_what_the_policy_did(dry_run, robot: Robot) -> None:
    """Commands, drum angles, tensions and markers against each other: the plant's formulas are known."""
    recording = Trajectory.load(dry_run[0] / "session.nc")
    assert recording.marker_names == robot.marker_names
    gaps = np.diff(recording.command_time)[:-1]
    np.testing.assert_allclose(np.median(gaps), 0.1, atol=1e-6)
    length = recording.motor_angle * np.array([motor.drum_radius_m for motor in robot.motors])
    assert np.abs(recording.command).max() > 0.003
    assert np.abs(length).max() > 0.003
    # One per mille of torque is 0.03 N; a cycle that comes 0.5 ms early or late adds 0.01 N at 50 mm/s and 300 N/m.
    apart = np.abs(recording.tension - np.maximum(0.0, 3.0 + 300.0 * length))
    assert np.percentile(apart, 90) < 0.05
    # Every change takes the robot's ramp_s of 0.1 s; drives lag 1 ms, and their acceleration is limited.
    changes = np.diff(recording.command, axis=0, prepend=recording.initial_command[None])
    share = np.clip((recording.time[:, None] - recording.command_time) / 0.1, 0.0, 1.0)
    behind = np.abs(recording.initial_command + share @ changes - length)
    assert np.percentile(behind, 90) < 2e-4


def test_increments_follow_the_policy(dry_run, robot: Robot) -> None:
    """Each command is the one before plus what the network says of it and of the tip that was seen."""
    rows = read_journal(dry_run[0])[1]
    rows = rows[(rows["phase"] == Phase.RUNNING) & rows["acted"]]
    np.testing.assert_allclose(rows["asked"][1:], rows["command"][:-1] + rows["raw"][1:], atol=1e-6)
    np.testing.assert_allclose(rows["command"], rows["asked"], atol=1e-6)  # nothing was near a limit


def test_a_tension_above_its_limit_is_brought_to_rest_slowly_and_held(dry_run, tmp_path: Path) -> None:
    """It does not fall while the set-points slow down, and is no second cause, which would brake."""
    stiff = SimulationSettings(settings={"stiffness": 8000.0, "pretension": 3.0})
    outcome = deploy(dry_run[1].model_copy(update={"simulation": stiff}), "dry-run", tmp_path / "s")
    assert outcome.cause is Cause.TENSION, outcome.detail
    assert "while stopping" not in (tmp_path / "s" / "log.jsonl").read_text()
    rows = read_journal(tmp_path / "s")[1]
    assert np.count_nonzero(rows["phase"] == Phase.HOLDING) > 10
    assert rows["tension"][rows["phase"] == Phase.HOLDING].max() > 25.0


def test_a_session_is_recovered_from_its_journal(dry_run) -> None:
    folder, _ = dry_run
    phases = (Phase.RUNNING, Phase.STOPPING, Phase.HOLDING, Phase.BRAKED)
    assert session_trajectory(folder, phases).sha256 == Trajectory.load(folder / "session.nc").sha256


def test_a_session_is_replayed(dry_run, tmp_path: Path) -> None:
    folder, settings = dry_run
    short = settings.model_copy(update={"duration_s": 1.0})
    outcome = deploy(short, "replay", tmp_path / "again", simulated=True, commands=folder)
    assert outcome.cause is Cause.FINISHED, outcome.detail
    assert "duration_s = 1 s ends the replay before" in (tmp_path / "again" / "log.jsonl").read_text()
    first, second = (Trajectory.load(path / "session.nc") for path in (folder, tmp_path / "again"))
    rows = len(second.command) - 2
    assert rows > 5
    np.testing.assert_allclose(second.command[:rows], first.command[:rows], atol=1e-9)


def test_nothing_moves_in_the_shadow(dry_run, tmp_path: Path) -> None:
    _, settings = dry_run
    shadow = settings.model_copy(update={"duration_s": 1.0})
    outcome = deploy(shadow, "shadow", tmp_path / "s", simulated=True)
    assert outcome.cause is Cause.FINISHED, outcome.detail
    rows = read_journal(tmp_path / "s")[1]
    assert np.all(rows["length"] == 0.0)
    assert np.all(rows["statusword"] & 0x6F == 0x40)  # switch on disabled throughout
    assert np.abs(rows["command"]).max() > 1e-3  # the policy commanded, in vain
    assert Trajectory.load(tmp_path / "s" / "session.nc").unsent


def test_after_a_quick_stop_the_command_is_where_the_drives_hold(dry_run, tmp_path: Path) -> None:
    """A button is pressed while cables move: the last command has not been reached, and is no longer in force."""
    pressed = deploy(dry_run[1], "dry-run", tmp_path / "s", hooks=(lambda: _running(tmp_path / "s"),))
    assert pressed.cause is Cause.EMERGENCY_STOP, pressed.detail
    recording = Trajectory.load(tmp_path / "s" / "session.nc")
    reached = recording.dataset["length"].to_numpy()[-1]
    np.testing.assert_allclose(recording.command[-1], reached, atol=1.1e-4)
    rows = read_journal(tmp_path / "s")[1]
    last = rows[rows["phase"] == Phase.RUNNING]["command"][-1]
    assert np.abs(last - reached).max() > 2e-4  # the button came in the middle of a ramp


def _running(folder: Path) -> bool:
    """Whether the policy has acted for a second and a half, and is in the middle of a ramp."""
    try:
        rows = read_journal(folder)[1]
    except InputError:
        return False
    rows = rows[rows["phase"] == Phase.RUNNING]
    return len(rows) > 150 and bool(rows["acted"][-4:-1].any())


def test_a_check_writes_nothing(dry_run, tmp_path: Path, rig: Rig) -> None:
    _, settings = dry_run
    outcome = deploy(settings, "check", tmp_path / "s", simulated=True, bus=HubBus(rig.channel))
    assert set(outcome.drives) == {"up", "left", "down", "right"}
    frames = (tmp_path / "s" / "frames.log").read_text().split()
    requests = [word.split("#")[1] for word in frames if word.startswith("60")]
    assert requests
    assert all(data.startswith("40") or data.startswith("6") or data.startswith("7") for data in requests)
    assert not [word for word in frames if word.startswith(("000#", "080#", "20", "30"))]


def test_homing_finds_the_tension_and_keeps_it(tmp_path: Path) -> None:
    """Encoders start anywhere; length zero is where each spring carries its homing tension."""
    homing = HomingTable(file=str(tmp_path / "home.json"), rate_m_s=0.01, rounds=1)
    robot = Robot.load("motor_arm")
    sensor = SimulatedMarkers(len(robot.marker_names))
    bus = BusTable(interface="hub", channel="127.0.0.1:0")
    table = SimulationTable(
        "motor_arm", bus, settings={"stiffness": 400.0, "pretension": 2.0}, encoder_offset=4711, start_length_m=0.002
    )
    with simulated_drives(table) as found:
        settings = Deployment(robot="motor_arm", bus=found, homing=homing, drives=SLOW, safety=PATIENT)
        outcome = deploy(settings, "home", tmp_path / "s", sensor=sensor)
        assert outcome.cause is Cause.FINISHED, outcome.detail
    result = load_homing(tmp_path / "home.json", robot)
    # A median of five readings and the plant's delay, at 10 mm/s: 0.6 mm
    for motor, home in zip(robot.motors, result.homes, strict=True):
        assert home.offset_counts == pytest.approx(4711, abs=0.6e-3 * motor.counts_per_metre)
        assert home.tension_n == pytest.approx(2.0, abs=0.15)


@pytest.mark.slow
def test_a_cable_that_is_off_ends_the_homing(tmp_path: Path) -> None:
    homing = HomingTable(rate_m_s=0.02, travel_m=0.01, rounds=1)
    simulation = SimulationSettings(settings={"stiffness": 0.0, "pretension": 0.0})
    settings = Deployment(robot="motor_arm", homing=homing, simulation=simulation, drives=SLOW, safety=PATIENT)
    outcome = deploy(settings, "home", tmp_path / "s", simulated=True)
    assert outcome.cause is Cause.HOMING_FAILED
    assert "is its cable off, or has it the opposite sign in the robot file?" in outcome.detail
    assert not (tmp_path / "s" / "homing.json").exists()
    assert np.abs(read_journal(tmp_path / "s")[1]["length"]).max() < 0.0101


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"date": "2020-01-01T00:00:00Z"}, "h old; the limit is"),
        ({"date": "2020-01-01T00:00:00"}, "timezone"),  # written by hand
        ({"robot": "other"}, "belongs to robot 'other'"),
        ({"homes": []}, "channels differ"),
    ],
)
def test_a_homing_that_does_not_hold_is_refused(robot: Robot, tmp_path: Path, change: dict, message: str) -> None:
    homes = tuple(Home(channel=n, offset_counts=0, tension_n=2.0, travel_m=0.0) for n in robot.channel_names)
    result = HomingResult(robot=robot.name, date=datetime.datetime.now(datetime.UTC), homes=homes)
    path = tmp_path / "home.json"
    result.save(path)
    load_homing(path, robot)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=message):
        load_homing(path, robot)


@pytest.mark.slow
def test_a_plant_may_live_in_a_process_of_its_own(dry_run, tmp_path: Path) -> None:
    _, settings = dry_run
    simulation = settings.simulation.model_copy(update={"own_process": True})
    changed = settings.model_copy(update={"simulation": simulation, "duration_s": 1.0})
    outcome = deploy(changed, "dry-run", tmp_path / "s")
    assert outcome.cause is Cause.FINISHED, outcome.detail
    assert np.ptp(read_journal(tmp_path / "s")[1]["tension"]) > 0.5


def test_a_policy_for_another_rate_is_refused_with_its_cause_in_the_log(robot: Robot, tmp_path: Path, rig: Rig) -> None:
    policy = linear_policy(tmp_path / "p.onnx", robot, np.zeros((16, 4)), np.zeros(4), period_s=1 / 30)
    settings = Deployment(robot="motor_arm", policy=PolicyTable(file=str(policy)))
    with pytest.raises(InputError, match="30 Hz of the policy does not divide 100 Hz"):
        deploy(settings, "dry-run", tmp_path / "s", bus=HubBus(rig.channel))
    assert json.loads((tmp_path / "s" / "summary.json").read_text())["cause"] == "refused"
    assert "does not divide" in (tmp_path / "s" / "log.jsonl").read_text()


def with_facts(path: Path, facts: dict[str, str]) -> None:
    """Write metadata into a policy, beside those that it has."""
    model = onnx.load(path)
    onnx.helper.set_model_props(model, {p.key: p.value for p in model.metadata_props} | facts)
    onnx.save(model, path)


def test_a_policy_that_pulled_harder_than_a_motor_bears_is_warned_of(
    robot: Robot, tmp_path: Path, rig: Rig, capsys
) -> None:
    path = linear_policy(tmp_path / "p.onnx", robot, np.zeros((16, 4)), np.zeros(4))
    limit = min(motor.tension_limit_n[1] for motor in robot.motors)
    set_it, longer = f"train with [training] tension_limit = {limit:g}", f"limit of {limit:g} N: train longer"
    for peak in (limit, limit + 1.0):
        with_facts(path, {PEAK_TENSION: f"{peak}"})
        settings = Deployment(robot="motor_arm", policy=PolicyTable(file=str(path)), drives=SLOW)
        deploy(settings, "check", tmp_path / f"{peak}", simulated=True, bus=HubBus(rig.channel))
        told, said = f"pulled up to {peak:.3g} N", capsys.readouterr().err
        assert (told in said) == (set_it in said) == (peak > limit)
        assert (told in (tmp_path / f"{peak}" / "log.jsonl").read_text()) == (peak > limit)
    with_facts(path, {TENSION_LIMIT: f"{limit}", STOPPED_EPISODES: "3", EVALUATED_EPISODES: "64"})
    said = pulls_too_hard(OnnxPolicy(path, robot, {}).pull, robot.motors)
    assert f"3 of 64 evaluation episodes were stopped by the training's {longer}" in said
    with_facts(path, {TENSION_LIMIT: f"{limit + 0.5}"})
    assert set_it in pulls_too_hard(OnnxPolicy(path, robot, {}).pull, robot.motors)


def test_the_master_takes_a_node_number_that_no_drive_has() -> None:
    """Drives of some makers leave the works as node 127."""
    assert SafetyTable().guards([1, 2, 3]).master_node == 127
    assert SafetyTable().guards([127, 126, 3]).master_node == 125


def test_a_serial_number_of_no_channel_is_refused(dry_run, tmp_path: Path) -> None:
    """It would otherwise never be asked for."""
    settings = dry_run[1].model_copy(update={"drives": DrivesTable(serial={"lefd": 5})})
    with pytest.raises(InputError, match="no channel 'lefd'; did you mean 'left'"):
        deploy(settings, "check", tmp_path / "s", simulated=True)


def test_a_robot_without_motors_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has no motors"):
        deploy(Deployment(robot="smooth_arm"), "dry-run", tmp_path / "s")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("robot = 'x'\nrate_hz = 130\n", "whole number of milliseconds"),
        ("robot = 'x'\nrates = 3\n", "unknown key 'rates'"),
        ("robot = 'x'\nrate_hz = 10\n", "every 100 ms, and stop after 60 ms of silence"),
        ("robot = 'x'\n[safety]\nmisses = 0\n", "safety.misses"),
        ("robot = 'x'\n[sensor]\nrotation = [[1,0,0],[0,1,0],[0,0,-1]]\n", "reflection"),
        ("robot = ", "cannot be read"),
    ],
)
def test_bad_deployment_files_say_what_is_wrong(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "d.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        load_deployment(path)


def test_entries_of_a_deployment_file_are_replaced_and_checked(tmp_path: Path) -> None:
    path = tmp_path / "d.toml"
    path.write_text("robot = 'motor_arm'\n[goal]\nx = 0.0\n")
    found = load_deployment(path, ["goal.x=0.02", "duration_s=2", "drives.eds=other.eds"])
    assert (found.goal, found.duration_s) == ({"x": 0.02}, 2.0)
    assert found.drives.eds == str(tmp_path / "other.eds")
    with pytest.raises(InputError, match=r"unknown key 'safety.mises'.*did you mean 'misses'"):
        load_deployment(path, ["safety.mises=3"])
    with pytest.raises(InputError, match="not of the form name=value"):
        load_deployment(path, ["duration_s"])
    with pytest.raises(InputError, match=r"'robot' in 'robot\.name' is not a table"):
        load_deployment(path, ["robot.name=x"])


@pytest.mark.slow
def test_the_command_line_runs_a_dry_run(robot: Robot, tmp_path: Path) -> None:
    turning(tmp_path / "policy.onnx", robot)
    text = """
        robot = "motor_arm"
        duration_s = 0.5
        [policy]
        file = "policy.onnx"
        [safety]
        misses = 50
        heartbeat_s = 1.0
        stale_cycles = 30
        settle_s = 0.1
        following_error_m = 0.02
    """
    (tmp_path / "arm.toml").write_text(text)
    command = [
        sys.executable,
        "-m",
        "rfdropo_bayes",
        "deploy",
        str(tmp_path / "arm.toml"),
        "--out",
        str(tmp_path / "s"),
        "--set",
        "duration_s=0.4",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("finished")
    assert "starting the simulated drives" in done.stderr
    recording = Trajectory.load(tmp_path / "s" / "session.nc")
    assert recording.synthetic
    assert len(recording.command) == 5  # 0.4 s at the policy's 10 Hz, and the ramp to rest
    page = (tmp_path / "s" / "report.html").read_text()
    assert "ended <strong>as planned</strong>" in page
    assert 'href="#goal"' not in page  # this policy has none
    (tmp_path / "s" / "report.html").unlink()
    again = subprocess.run([*command[:3], "report", str(tmp_path / "s")], capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stderr
    assert (tmp_path / "s" / "report.html").read_text() == page
