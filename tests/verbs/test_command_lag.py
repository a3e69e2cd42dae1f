"""Which row's command a pose shows is told from recordings alone."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.data.named_columns import CsvColumns
from rfdropo_bayes.verbs.command_lag import best_delay, errors_by_row, lag_words

TABLE = {
    "sample_time": 1.0,
    "commands": ["a", "b"],
    "command_unit": "m",
    "positions": [["x", "y", "z"]],
    "position_unit": "m",
}


def recording(lag: int, rows: int = 80, *, with_poses: bool = False) -> Trajectory:
    """Poses that follow the command of so many rows before; commands may be in force before their row."""
    random = np.random.default_rng(0)
    command = random.uniform(-0.01, 0.01, size=(rows, 2))
    shown = np.roll(command, lag, axis=0)
    position = np.stack([shown[:, 0], shown[:, 1], 0.2 - 10.0 * np.sum(shown**2, axis=1)], axis=1)
    return Trajectory.from_arrays(
        time=np.arange(float(rows)),
        position=position[:, None],
        command=command,
        command_time=np.arange(float(rows)) - 0.5 * with_poses,
        markers=["tip"],
        channels=["a", "b"],
    )


@pytest.mark.parametrize("lag", [-1, 0, 1, 2])
def test_the_row_whose_command_a_pose_shows_is_found(lag):
    left = {each.rows: each.error for each in errors_by_row([recording(lag)])}
    assert min(left, key=lambda rows: left[rows]) == lag
    assert left[lag] < 0.2 * sorted(left.values())[1]


@pytest.mark.parametrize(("lag", "least", "most"), [(0, 0.0, 0.0), (1, 0.1, 1.0)])
def test_the_delay_is_that_of_the_row(lag, least, most):
    assert least <= best_delay([recording(lag)]) <= most


@pytest.mark.parametrize(
    ("lag", "with_poses", "remedy"),
    [
        (0, False, "commands_with_poses = true"),
        (1, False, None),
        (0, True, None),
        (1, True, "commands_with_poses = false"),
        (2, False, "look at the clocks"),
    ],
)
def test_a_doubt_names_the_key_that_mends_it(lag, with_poses, remedy):
    told = lag_words([recording(lag, with_poses=with_poses)], CsvColumns(**TABLE, commands_with_poses=with_poses))
    assert (told.doubt is None) == (remedy is None)
    assert remedy is None or remedy in told.doubt


def test_commands_of_a_clock_of_their_own_are_taken_as_they_act():
    """Commands in force before their row: the simulation takes that of the pose, whatever table they came from."""
    assert lag_words([recording(0, with_poses=True)], None).doubt is None
    assert "look at the clocks" in (lag_words([recording(1, with_poses=True)], None).doubt or "")
