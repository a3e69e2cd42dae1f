"""A simulated robot behind drives that pushes a cube: it begins as an episode does, and is seen with noise."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes.policies.tasks import resting_height
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.control_session import Session
from rfdropo_bayes.verbs.simulated_plant import PERIOD, true_simulator, trunk

SCENE = {"simulator.push": True, "cube_x": 0.003, "cube_yaw": 0.1}
NOISE = 5e-4  # [m]


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.load("motor_trunk")


def test_a_cube_rests_on_its_plate_until_it_is_pushed(robot: Robot) -> None:
    plant = trunk(robot, **SCENE)
    begun = plant.advance(np.zeros(8), 0.0).object_pose
    assert begun is not None
    np.testing.assert_allclose(begun[0], 0.003)
    np.testing.assert_allclose(begun[1], resting_height(robot, np.array(0.035)))
    np.testing.assert_allclose(2.0 * np.arctan2(begun[4], begun[6]), 0.1)
    for _ in range(20):
        rested = plant.advance(np.zeros(8), PERIOD).object_pose
    np.testing.assert_allclose(rested, begun, atol=1e-4)


def test_the_cube_goes_where_a_rollout_takes_it(robot: Robot) -> None:
    """Cables are pulled steadily, as drums do between two states: by 30 mm in 0.6 s, towards the cube."""
    plant = trunk(robot, **SCENE)
    drums = robot.command.model_copy(update={"ramp_s": PERIOD, "dead_time_s": 0.0})
    base = robot.with_changes(command=drums)
    simulator, values = true_simulator(robot, "", SCENE, base)
    session = Session(simulator, 1, PERIOD)
    session.reset(np.array([0]), values | {"cube_y": float(resting_height(robot, np.array(0.035)))})
    start = plant.advance(np.zeros(8), 0.0)
    for step in range(1, 61):
        length = np.zeros(8)
        length[[0, 2]] = -5e-4 * step, 5e-4 * step
        state, found = plant.advance(length, PERIOD), session.act(length[None])
    assert state.object_pose is not None
    np.testing.assert_allclose(state.object_pose, np.asarray(found.object_pose)[0], atol=1e-9)
    np.testing.assert_allclose(state.position, np.asarray(found.position)[0], atol=1e-9)
    assert start.object_pose is not None
    assert np.linalg.norm(state.object_pose[:3] - start.object_pose[:3]) > 0.01


def test_the_cube_is_seen_with_the_markers_noise(robot: Robot) -> None:
    plant = trunk(robot, marker_noise=NOISE, seed=3, **SCENE)
    seen = np.array([plant.advance(np.zeros(8), 0.0).object_pose for _ in range(100)])
    np.testing.assert_allclose(seen[:, :3].std(axis=0), NOISE, rtol=0.25)
    np.testing.assert_allclose(np.linalg.norm(seen[:, 3:], axis=1), 1.0)
    # Half the angle about the vertical, which points 17.5 mm from the centre show.
    np.testing.assert_allclose(seen[:, 4].std(), 0.5 * NOISE / 0.0175, rtol=0.3)
