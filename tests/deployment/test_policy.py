"""Policies: what goes in, what comes out, and everything that is refused."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.deployment.causes import Cause, Stop
from rfdropo_bayes.deployment.policy import OnnxPolicy, RecordedCommands, Scene, observer
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Robot

from .policies import linear_policy

INPUTS = 7


def scene(robot: Robot, seed: int = 0) -> Scene:
    random = np.random.default_rng(seed)
    markers, channels = len(robot.marker_names), len(robot.channel_names)
    return Scene(
        *[random.normal(size=(markers, 3)) for _ in range(2)], *[random.normal(size=channels) for _ in range(4)]
    )


def matrix(robot: Robot, seed: int = 1) -> np.ndarray:
    return 1e-4 * np.random.default_rng(seed).normal(size=(INPUTS, len(robot.channel_names)))


def test_every_feature_finds_its_value(robot: Robot) -> None:
    names = ["marker.m2.y", "velocity.m4.z", "command.left", "action.down", "length.right", "tension.up", "goal.x"]
    seen = scene(robot)
    expected = [
        seen.position[1, 1], seen.velocity[3, 2], seen.command[1], seen.action[2], seen.length[3], seen.tension[0], 0.7,
    ]  # fmt: skip
    np.testing.assert_allclose(observer(names, robot, {"x": 0.7})(seen), np.float32(expected))


@pytest.mark.parametrize(
    "name", ["marker.m9.x", "marker.m1.w", "command.nobody", "goal.unknown", "weather", "tension.up.x", "goal"]
)
def test_an_unknown_feature_is_refused(robot: Robot, name: str) -> None:
    with pytest.raises(InputError, match="not known here"):
        observer([name], robot, {"x": 0.0})


def test_a_policy_acts_as_its_matrix_says(robot: Robot, tmp_path: Path) -> None:
    weight, bias, seen = matrix(robot), np.full(4, 1e-3), scene(robot)
    policy = OnnxPolicy(linear_policy(tmp_path / "p.onnx", robot, weight, bias), robot, {})
    act = policy.act(seen)
    expected = np.concatenate([seen.command, seen.position[-1]]) @ weight + bias
    np.testing.assert_allclose(act.raw, expected, atol=1e-7)
    np.testing.assert_allclose(act.command, seen.command + expected, atol=1e-7)


def test_outputs_are_sorted_to_the_robots_channels(robot: Robot, tmp_path: Path) -> None:
    backwards = robot.channel_names[::-1]
    path = linear_policy(
        tmp_path / "p.onnx", robot, np.zeros((INPUTS, 4)), np.array([1, 2, 3, 4]) * 1e-3, channels=backwards
    )
    np.testing.assert_allclose(OnnxPolicy(path, robot, {}).act(scene(robot)).raw, [4e-3, 3e-3, 2e-3, 1e-3], atol=1e-9)


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
        ({"robot": "trunk_sofa"}, "was made for robot 'trunk_sofa'"),
        ({"unit": "rad"}, "acts in rad"),
        ({"channels": ("a", "b", "c", "d")}, "drives a, b, c, d"),
        ({"observation": ("command.up",)}, "its card lists 1 observations"),
        ({"low": (0.0,)}, "do not fit its channels"),
        ({"high": (-0.01,) * 4}, "do not fit its channels"),
        ({"rate_hz": -1.0}, "greater than 0"),
    ],
)
def test_cards_that_do_not_fit_are_refused(robot: Robot, tmp_path: Path, changes: dict, message: str) -> None:
    path = tmp_path / "p.onnx"
    if "rate_hz" in changes:
        import onnx

        linear_policy(path, robot, matrix(robot), np.zeros(4))
        model = onnx.load(str(path))
        for entry in model.metadata_props:
            entry.value = "-1.0" if entry.key == "rfdropo.rate_hz" else entry.value
        onnx.save(model, str(path))
    else:
        linear_policy(path, robot, matrix(robot), np.zeros(4), **changes)
    with pytest.raises(InputError, match=message):
        OnnxPolicy(path, robot, {})


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
    with pytest.raises(InputError, match="is no ONNX model"):
        OnnxPolicy(path, robot, {})
    linear_policy(path, robot, matrix(robot), np.zeros(4), card=False)
    with pytest.raises(InputError, match="no card"):
        OnnxPolicy(path, robot, {})


def recording(robot: Robot, **changes: object) -> Trajectory:
    time = np.arange(11) * 0.1
    table = {
        "name": "r", "robot": robot.name, "format": "test", "time": time, "marker_names": robot.marker_names,
        "position": np.broadcast_to(robot.marker_points(), (11, 4, 3)), "command_time": time[:-1],
        "command": 1e-3 * np.arange(40).reshape(10, 4), "command_unit": "m", "cable_names": robot.channel_names,
    }  # fmt: skip
    return Trajectory.build(**(table | changes))


def test_a_recording_is_replayed_command_by_command_and_ends(robot: Robot) -> None:
    source = RecordedCommands(recording(robot), robot, 10.0)
    acts = [source.act(scene(robot)) for _ in range(12)]
    np.testing.assert_allclose([act.command for act in acts[:10]], 1e-3 * np.arange(40).reshape(10, 4))
    assert acts[11] is None


def test_a_recording_of_another_robot_is_refused(robot: Robot) -> None:
    with pytest.raises(InputError, match="drives a, b, c, d"):
        RecordedCommands(recording(robot, cable_names=["a", "b", "c", "d"]), robot, 10.0)
