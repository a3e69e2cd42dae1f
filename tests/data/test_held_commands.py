"""Readings of a load cell while poses are held have one value for each pose; other commands stay as they are."""

import numpy as np
import pytest

from rfdropo_bayes.data.held_commands import averaged_while_held

RNG = np.random.default_rng(7)
POSES = np.repeat(RNG.uniform(0.0, 5.0, (40, 3)), 20, axis=0)
NOISE = 0.015 * RNG.standard_normal(POSES.shape)


def test_readings_of_held_poses_have_their_mean():
    command, (note,) = averaged_while_held(POSES + NOISE, "N")
    assert "a noise of 0.01" in note
    assert "each of 40 held poses" in note
    off = np.sqrt(np.mean((command - POSES) ** 2))
    assert 0.8 * 0.015 / np.sqrt(20) < off < 1.2 * 0.015 / np.sqrt(20)
    assert not np.diff(command.reshape(40, 20, 3), axis=1).any()


@pytest.mark.parametrize(
    "command",
    [
        pytest.param(POSES, id="sent, without noise"),
        pytest.param(RNG.uniform(0.0, 5.0, (800, 3)), id="a pose in each row"),
        pytest.param(np.linspace(0.0, 5.0, 800)[:, None] + NOISE, id="a slow motion"),
        pytest.param(
            np.repeat([[0.0], [5.0], [0.0], [5.0]], 200, axis=0) + np.linspace(0.0, 0.4, 800)[:, None] + NOISE,
            id="poses that drift",
        ),
        pytest.param(np.cumsum(0.1 * RNG.standard_normal((800, 3)), axis=0), id="a random walk"),
        pytest.param(NOISE + 1.0, id="one pose"),
    ],
)
def test_other_commands_stay(command):
    same, notes = averaged_while_held(command, "N")
    np.testing.assert_array_equal(same, command)
    assert notes == []
