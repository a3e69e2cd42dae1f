"""Which recordings are taken for slow, and a body's slowest period against the closed form of a cantilever."""

from __future__ import annotations

import numpy as np
import pytest

import rfdropo_bayes as rb
from rfdropo_bayes.verbs.command_lag import APART, apart, errors_by_row
from rfdropo_bayes.verbs.slow_motion import command_rate, first_period, slow_motion

ARM = rb.Robot.outline(name="arm", length=0.2, radius=0.01, markers={"tip": 0.2}, cables=1)


def recording(time, command):
    """Of an arm that stands still: motions do not count."""
    still = np.tile([0.0, 0.0, 0.2], (len(time), 1, 1))
    given = {"markers": ["tip"], "channels": ["pull_1"], "command_time": time, "initial_command": "first"}
    return rb.Trajectory.from_arrays(time=time, position=still, command=np.reshape(command, (-1, 1)), **given)


def test_the_slowest_period_is_that_of_a_cantilever():
    nominal, radius, length = ARM.nominal(), 0.01, 0.2
    rigidity, line = nominal["young_modulus"] * np.pi * radius**4 / 4.0, nominal["trunk_mass"] / length
    exact = 2.0 * np.pi * length**2 / 1.8751041**2 * np.sqrt(line / rigidity)
    assert first_period(ARM) == pytest.approx(exact, rel=1e-3)


def test_a_sine_changes_by_its_size_in_its_period_over_two_pi():
    time = np.arange(0.0, 120.0, 0.1)
    assert command_rate(recording(time, 0.01 * np.sin(2.0 * np.pi * time / 60.0))) == pytest.approx(
        np.pi / 30.0, rel=1e-3
    )


@pytest.mark.parametrize(
    ("time", "command", "slow"),
    [
        (np.arange(0.0, 120.0, 0.1), lambda t: 0.01 * np.sin(2.0 * np.pi * t / 60.0), "commands take"),
        (np.arange(0.0, 12.0, 0.1), lambda t: 0.01 * np.sin(2.0 * np.pi * t / 2.0), None),
        (np.arange(0.0, 100.0, 10.0), lambda t: 0.01 * (t / 10.0 % 2.0), "rows are 10 s apart"),
        (np.arange(0.0, 10.0, 0.1), lambda t: 0.0 * t, None),
        (np.arange(0.0, 10.0, 0.1), lambda t: 0.0 * t + 0.1 / 3.0, None),  # its mean is rounded
    ],
    ids=["slow sine", "fast sine", "poses", "no command", "held command"],
)
def test_slow_commands_and_rows_far_apart_are_told(time, command, slow):
    found = slow_motion(ARM, recording(time, command(time)))
    assert found is None if slow is None else slow in found


def test_rows_that_show_their_own_commands_are_poses_at_rest():
    """The slowest period is of a body that no cable holds."""
    pulled, time = 0.01 * np.random.default_rng(0).random(60), 0.05 * np.arange(60)
    moved = np.stack([pulled, 0.1 * pulled, 0.2 - pulled**2], axis=1)[:, None]
    given = {"markers": ["tip"], "channels": ["pull_1"], "command_time": time, "initial_command": "first"}
    poses = rb.Trajectory.from_arrays(time=time, position=moved, command=pulled[:, None], **given)
    assert "comes to rest in each row" in slow_motion(ARM, poses)
    lagging = np.convolve(pulled, np.full(5, 0.2), "same")
    moved = np.stack([lagging, 0.1 * lagging, 0.2 - lagging**2], axis=1)[:, None]
    assert (
        slow_motion(ARM, rb.Trajectory.from_arrays(time=time, position=moved, command=pulled[:, None], **given)) is None
    )


@pytest.mark.parametrize("stays", [0.0, 0.2], ids=["at rest", "moving"])
def test_held_commands_show_whether_the_body_moves_after_a_change(stays):
    """A row after a change keeps a share of the way, which vanishes in the mean over all rows of a held command."""
    rng = np.random.default_rng(1)
    level = 0.01 * np.repeat(rng.random(20), 12)
    shown = level.copy()
    for row in range(1, len(level)):
        shown[row] = level[row] + stays * (shown[row - 1] - level[row])
    moved = np.stack([shown, 0.1 * shown, 0.2 - shown**2], axis=1)[:, None] + 2e-5 * rng.standard_normal((240, 1, 3))
    given = {
        "markers": ["tip"],
        "channels": ["pull_1"],
        "command_time": 0.05 * np.arange(240),
        "initial_command": "first",
    }
    run = rb.Trajectory.from_arrays(time=0.05 * np.arange(240), position=moved, command=level[:, None], **given)
    assert (apart(run) is None) == (stays > 0.0)
    one, other = sorted(each.error for each in errors_by_row([run], (0, 1)))
    assert one < APART * other
