"""Readings of a load cell while poses are held have one value for each pose; other commands stay as they are."""

import numpy as np
import pytest

from rfdropo_bayes.data.held_commands import averaged_while_held

RNG = np.random.default_rng(7)
POSES = np.repeat(RNG.uniform(0.0, 5.0, (40, 3)), 20, axis=0)
NOISE = 0.015 * RNG.standard_normal(POSES.shape)


@pytest.mark.parametrize("rows", [20, 200])
@pytest.mark.parametrize("seed", range(5))
def test_readings_of_held_poses_have_their_mean(seed, rows):
    """By chance a pose is split in one of 10^6 data sets."""
    rng = np.random.default_rng(seed)
    poses = np.repeat(rng.uniform(0.0, 5.0, (40, 3)), rows, axis=0)
    command, (note,) = averaged_while_held(poses + 0.015 * rng.standard_normal(poses.shape), "N")
    assert "a noise of 0.01" in note
    assert "each of 40 held poses" in note
    off = np.sqrt(np.mean((command - poses) ** 2))
    assert 0.7 * 0.015 / np.sqrt(rows) < off < 1.3 * 0.015 / np.sqrt(rows)
    assert not np.diff(command.reshape(40, rows, 3), axis=1).any()


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
