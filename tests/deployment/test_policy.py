"""Policies: what goes in, what comes out, and everything that is refused."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from rfdropo_bayes.data import Measured, Origin, SentCommands, Trajectory
from rfdropo_bayes.deployment.causes import Cause, Stop
from rfdropo_bayes.deployment.policy import OnnxPolicy, PolicyScene, RecordedCommands, replay_rate
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.robots.policy_layout import ObservationPart

from .policies import linear_policy

INPUTS = 16  # four commands, four markers


def scene(robot: Robot, seed: int = 0) -> PolicyScene:
    random = np.random.default_rng(seed)
    markers, channels = len(robot.marker_names), len(robot.channel_names)
    motion = [random.normal(size=(markers, 3)) for _ in range(2)]
    command, length, tension = (1e-3 * random.normal(size=channels) for _ in range(3))
    return PolicyScene(*motion, command, length, tension, random.normal(size=7))


def matrix(robot: Robot, seed: int = 1) -> np.ndarray:
    return 1e-4 * np.random.default_rng(seed).normal(size=(INPUTS, len(robot.channel_names)))


def test_a_policy_acts_as_its_matrix_says(robot: Robot, tmp_path: Path) -> None:
    weight, bias, seen = matrix(robot), np.full(4, 1e-3), scene(robot)
    policy = OnnxPolicy(linear_policy(tmp_path / "p.onnx", robot, weight, bias), robot, {})
    act = policy.act(seen)
    expected = np.concatenate([seen.command, seen.position.ravel()]) @ weight + bias
    np.testing.assert_allclose(act.raw, expected, atol=1e-7)
    np.testing.assert_allclose(act.command, seen.command + expected, atol=1e-7)
    assert policy.rate_hz == pytest.approx(10.0)


def test_every_part_finds_its_values(robot: Robot, tmp_path: Path) -> None:
    """One policy that copies a chosen input to its outputs, for every part; markers only those that are named."""
    names = ("lengths", "goal", "moved", "object", "tensions", "markers", "commands")
    sizes = {"goal": 3, "moved": 6, "markers": 6, "object": 7}
    parts = tuple(ObservationPart(name, sizes.get(name, 4), "-") for name in names)
    seen = scene(robot)
    chosen = [3, 1]
    expected = np.concatenate(
        [
            seen.length,
            [0.1, 0.2, 0.3],
            seen.moved[chosen].ravel(),
            seen.object_pose,
            seen.tension,
            seen.position[chosen].ravel(),
            seen.command,
        ]
    )
    for column, value in enumerate(expected):
        weight = np.zeros((len(expected), 4))
        weight[column] = 1e-3
        path = linear_policy(tmp_path / "p.onnx", robot, weight, np.zeros(4), observation=parts)
        goal = {"x": 0.1, "y": 0.2, "z": 0.3}
        policy = OnnxPolicy(path, robot, goal, markers=[robot.marker_names[k] for k in chosen])
        np.testing.assert_allclose(policy.act(seen).raw, 1e-3 * value, atol=1e-9)
        assert policy.sees_object


def test_commands_end_at_the_limits_of_the_layout(robot: Robot, tmp_path: Path) -> None:
    path = linear_policy(tmp_path / "p.onnx", robot, np.zeros((INPUTS, 4)), np.full(4, 9e-3), high=(0.001,) * 4)
    np.testing.assert_allclose(OnnxPolicy(path, robot, {}).act(scene(robot)).command, 0.001)


@pytest.mark.parametrize(("value", "cause"), [(np.nan, Cause.ACTION_NOT_FINITE), (0.5, Cause.ACTION_OUTSIDE)])
def test_outputs_that_cannot_be_meant_end_the_session(robot: Robot, tmp_path: Path, value: float, cause: Cause) -> None:
    bias = np.array([0.0, value, 0.0, 0.0])
    policy = OnnxPolicy(linear_policy(tmp_path / "p.onnx", robot, np.zeros((INPUTS, 4)), bias), robot, {})
    with pytest.raises(Stop) as stop:
        policy.act(scene(robot))
    assert stop.value.cause is cause


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"unit": "rad"}, "acts in rad"),
        ({"channels": ("a", "b", "c", "d")}, "drives a, b, c, d"),
        ({"channels": ("right", "down", "left", "up")}, "drives right, down, left, up"),
        ({"observation": (ObservationPart("commands", 16, "m"),)}, "needs 16 numbers of 'commands'"),
        ({"observation": (ObservationPart("markers", 16, "m"),)}, "needs 16 numbers of 'markers'; there are 12"),
        ({"observation": (ObservationPart("wind", 16, "m"),)}, "needs 'wind', which no sensor measures"),
        ({"observation": (ObservationPart("goal", 3, "m"),)}, "needs a goal"),
        ({"observation": (ObservationPart("commands", 4, "m"),)}, "takes .* of width 16, its layout 4"),
    ],
)
def test_layouts_that_do_not_fit_are_refused(robot: Robot, tmp_path: Path, changes: dict, message: str) -> None:
    path = linear_policy(tmp_path / "p.onnx", robot, matrix(robot), np.zeros(4), **changes)
    with pytest.raises(InputError, match=message):
        OnnxPolicy(path, robot, {})


def test_an_unknown_marker_is_refused(robot: Robot, tmp_path: Path) -> None:
    path = linear_policy(tmp_path / "p.onnx", robot, matrix(robot), np.zeros(4))
    with pytest.raises(InputError, match="no marker 'm9'"):
        OnnxPolicy(path, robot, {}, markers=["m9"])


def test_the_hash_must_be_the_one_that_was_meant(robot: Robot, tmp_path: Path) -> None:
    path = linear_policy(tmp_path / "p.onnx", robot, matrix(robot), np.zeros(4))
    right = hashlib.sha256(path.read_bytes()).hexdigest()
    assert OnnxPolicy(path, robot, {}, right).sha256 == right
    with pytest.raises(InputError, match="another policy"):
        OnnxPolicy(path, robot, {}, "0" * 64)


def test_files_that_are_no_policies_are_refused(robot: Robot, tmp_path: Path) -> None:
    path = tmp_path / "p.onnx"
    with pytest.raises(InputError, match="cannot be read"):
        OnnxPolicy(path, robot, {})
    path.write_bytes(b"not a model")
    with pytest.raises(InputError, match="is not an ONNX model"):
        OnnxPolicy(path, robot, {})
    linear_policy(path, robot, matrix(robot), np.zeros(4), card=False)
    with pytest.raises(InputError, match="no layout"):
        OnnxPolicy(path, robot, {})


def recording(robot: Robot, cables: Sequence[str] | None = None) -> Trajectory:
    time = np.arange(11) * 0.1
    return Trajectory.build(
        Origin("r", robot.name, "test"),
        SentCommands(time[:-1], 1e-3 * np.arange(40).reshape(10, 4), "m", cables or robot.channel_names),
        Measured(time, np.broadcast_to(robot.marker_points(), (11, 4, 3)), robot.marker_names),
    )


def test_a_recording_is_replayed_command_by_command_and_ends(robot: Robot) -> None:
    source = RecordedCommands(recording(robot), robot, 10.0)
    acts = [source.act(scene(robot)) for _ in range(12)]
    np.testing.assert_allclose([act.command for act in acts[:10]], 1e-3 * np.arange(40).reshape(10, 4))
    assert acts[11] is None


@pytest.mark.parametrize(("rate", "begins"), [(10, 0.0), (20, 0.0), (30, 0.0), (60, 0.0), (200, 0.0), (10, -1.0)])
def test_a_recording_is_replayed_at_its_own_pace(robot: Robot, rate: int, begins: float) -> None:
    """Commands of any rate, and of before the first row, are sent within half a beat of a 100 Hz loop."""
    sent = begins + np.arange((3.0 - begins) * rate) / rate
    command = 1e-6 * np.arange(1.0, len(sent) + 1)[:, None] * np.ones(4)
    time = 0.01 * np.arange(301)
    places = np.broadcast_to(robot.marker_points(), (301, 4, 3))
    recording = Trajectory.build(
        Origin("r", robot.name, "test"),
        SentCommands(sent, command, "m", robot.channel_names),
        Measured(time, places, robot.marker_names),
    )
    source = RecordedCommands(recording, robot, replay_rate(recording, 100.0))
    acts = iter(lambda: source.act(scene(robot)), None)
    given = np.array([act.command for act in acts])
    assert len(given) / source.rate_hz == pytest.approx(3.0 - begins, abs=0.01)
    assert source.last_s == pytest.approx(sent[-1] - begins, abs=0.005)
    due = begins + np.arange(len(given)) / source.rate_hz
    np.testing.assert_array_equal(given, recording.command_at(due + 0.4999 / 100.0))


def test_commands_without_a_rate_are_replayed_when_they_came(robot: Robot) -> None:
    """Events, seconds apart or tenths of one, and beats that a session missed, which are none."""
    time = 0.01 * np.arange(501)
    places = np.broadcast_to(robot.marker_points(), (501, 4, 3))

    def rows(sent: np.ndarray) -> list[int]:
        command = 1e-3 * np.arange(1.0, len(sent) + 1)[:, None] * np.ones(4)
        made = Trajectory.build(
            Origin("r", robot.name, "test"),
            SentCommands(sent, command, "m", robot.channel_names),
            Measured(time, places, robot.marker_names),
        )
        source = RecordedCommands(made, robot, replay_rate(made, 100.0))
        acts = iter(lambda: source.act(scene(robot)), None)
        given = np.array([act.command[0] for act in acts])
        return (1 + np.flatnonzero(np.diff(given))).tolist()

    assert rows(np.array([0.0, 0.5, 2.5, 3.2])) == [50, 250, 320]
    late = 0.1 * np.arange(40) + 0.01 * (np.arange(40) >= 5)
    assert rows(late) == list(range(1, 40))


def test_a_recording_of_another_robot_is_refused(robot: Robot) -> None:
    with pytest.raises(InputError, match="drives a, b, c, d"):
        RecordedCommands(recording(robot, ["a", "b", "c", "d"]), robot, 10.0)
