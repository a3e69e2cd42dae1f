"""Commands on the simulator's clock: holds, ramps, lags, and the times of observation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.assembly import build_robot_simulator
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.commands import commands_on_grid, observed_at, sample, stack_commands


def grid(time, value, observed, **options):
    return commands_on_grid(np.array(time), np.array(value)[:, None], np.zeros(1), np.array(observed), **options)


def test_a_held_command_acts_in_the_step_that_starts_with_it():
    commands = grid([0.0, 0.02], [1.0, 3.0], [0.0, 0.04], time_step=0.01)
    np.testing.assert_array_equal(commands.step[:, 0], [1.0, 1.0, 3.0, 3.0])


@pytest.mark.parametrize("share", [0.0, 0.37], ids=["at a step", "within a step"])
@pytest.mark.parametrize("ramp", [0.0, 0.004, 0.1])
def test_a_robot_carries_changes_out_neither_late_nor_early(share, ramp):
    """The integral of a command that is linear in each step is that of the command that was sent, whatever the ramp is
    below a step; a longer ramp is half of it late."""
    robot = Robot.load("smooth_arm")
    robot = robot.with_changes(command=robot.command.model_copy(update={"ramp_s": ramp, "dead_time_s": 0.0}))
    simulator = build_robot_simulator(ModelSpec(robot))
    step, channels = simulator.time_step, len(robot.channel_names)
    time, level = step * np.array([0.0, 10.0, 20.0 + share]), np.array([1.0, 4.0, 2.0])
    taken = simulator.commands(time, np.tile(level[:, None], channels), np.zeros(channels), step * np.arange(61.0))
    path = np.concatenate([taken.initial[None], taken.step])[:, 0]
    sent = step * (10.0 * level[0] + (10.0 + share) * level[1] + (40.0 - share) * level[2])
    assert np.sum(0.5 * step * (path[1:] + path[:-1])) == pytest.approx(sent - 0.5 * ramp * level[-1], abs=1e-9)


def test_an_observation_that_jitters_by_nanoseconds_belongs_to_the_step_that_ends_there():
    commands = grid([0.0], [1.0], [0.0, 0.05 - 2e-9, 0.1 + 3e-9], time_step=0.01)
    np.testing.assert_array_equal(commands.sample_step, [0, 5, 10])
    np.testing.assert_array_equal(commands.sample_fraction, 0.0)


def test_a_ramp_spreads_a_change_over_its_duration():
    """SOFA's trunk: an action of 5 mm is carried out as 1 mm over each of 5 updates."""
    commands = grid([0.0, 0.05], [5.0, 10.0], [0.0, 0.1], time_step=0.01, ramp=0.05)
    np.testing.assert_allclose(commands.step[:, 0], np.arange(1.0, 11.0), atol=1e-12)


@pytest.mark.parametrize("time_step", [0.005, 0.01])
def test_a_dead_time_postpones_everything_whatever_the_time_step(time_step):
    dead = 0.02
    prompt = grid([0.0, 0.05], [5.0, 10.0], [0.0, 0.1], time_step=time_step, ramp=0.05)
    late = grid([0.0, 0.05], [5.0, 10.0], [0.0, 0.1], time_step=time_step, ramp=0.05, dead_time=dead)
    steps = round(dead / time_step)
    np.testing.assert_allclose(late.step[steps:, 0], prompt.step[:-steps, 0], atol=1e-12)
    np.testing.assert_allclose(late.step[:steps, 0], 0.0, atol=1e-12)


@given(st.lists(st.floats(-5.0, 5.0), min_size=1, max_size=8), st.floats(0.005, 0.3))
@settings(deadline=None, max_examples=50)
def test_every_ramp_ends_at_the_last_command(values, ramp):
    """Whatever the ramp, the command that was sent last is reached once the ramp has passed."""
    time = 0.05 * np.arange(len(values))
    end = time[-1] + ramp + 0.05
    commands = grid(time, values, [0.0, end], time_step=0.01, ramp=ramp)
    np.testing.assert_allclose(commands.step[-1, 0], values[-1], atol=1e-9)


def test_observations_between_steps_are_interpolated():
    commands = grid([0.0], [0.0], [0.0, 0.015, 0.02], time_step=0.01)
    series = np.array([[0.0], [1.0], [4.0]])
    np.testing.assert_allclose(sample(series, commands)[:, 0], [0.0, 2.5, 4.0])


def test_stacking_pads_with_the_last_command():
    stacked = stack_commands(
        [
            grid([0.0], [1.0], [0.0, 0.01], time_step=0.01),
            grid([0.0, 0.01], [1.0, 2.0], [0.0, 0.01, 0.02], time_step=0.01),
        ]
    )
    np.testing.assert_array_equal(stacked.step[:, :, 0], [[1.0, 1.0], [1.0, 2.0]])
    np.testing.assert_array_equal(stacked.sample_step, [[0, 1, 1], [0, 1, 2]])


def test_decreasing_times_are_refused():
    with pytest.raises(InputError, match="command times decrease at row 1"):
        grid([0.1, 0.0], [1.0, 2.0], [0.0, 0.1], time_step=0.01)


def test_commands_from_before_the_first_observation_are_simulated_from_the_first_of_them():
    """A piece that knows all commands before it takes the steps of the whole, and is observed in the same ones."""
    rng = np.random.default_rng(4)
    time = np.arange(0.0, 2.0, 0.05)
    value, observed = rng.normal(size=(len(time), 2)), np.arange(0.0, 2.0, 0.03)
    whole = commands_on_grid(time, value, np.ones(2), observed, time_step=0.02, ramp=0.1, dead_time=0.03)
    first = 20
    start = observed[first]
    piece = commands_on_grid(
        time - start, value, np.ones(2), observed[first:] - start, time_step=0.02, ramp=0.1, dead_time=0.03
    )
    np.testing.assert_array_equal(piece.initial, whole.initial)
    np.testing.assert_allclose(piece.step, whole.step, atol=1e-9)
    np.testing.assert_allclose(observed_at(piece, 0.02), observed_at(whole, 0.02)[first:], atol=1e-9)


ROWS = np.arange(400.0)


@pytest.mark.parametrize(
    ("observed", "said"),
    [
        (10.0 * ROWS, '"ms" taken for "s", "us" for "ms" or "ns" for "us", with rows 10 ms apart'),
        (1e4 * ROWS, '"us" taken for "s" or "ns" for "ms", with rows 10 ms apart'),
        (1e7 * ROWS, '"ns" taken for "s", with rows 10 ms apart'),
        (np.where(ROWS < 150, 0.01 * ROWS, 86400.0 + 0.01 * ROWS), "8.64e.* s of it pass before row 150"),
        (1e6 + 0.01 * ROWS, "the first command comes 1e.06 s before the first observation"),
    ],
)
def test_many_more_steps_than_rows_are_refused_before_they_take_memory(observed, said):
    with pytest.raises(InputError, match=f"400 rows over .* steps of 10 ms, .* a row; .*{said}"):
        grid(np.minimum(observed, 0.0)[:1], [1.0], observed, time_step=0.01)


def test_few_rows_of_a_slow_experiment_are_simulated():
    """Thirty poses at rest, five seconds apart, in steps of a millisecond."""
    assert len(grid([0.0], [1.0], 5.0 * ROWS[:12], time_step=0.001).step) == 55_000


@pytest.mark.parametrize(
    ("time", "observed", "said"),
    [
        ([0.0], [], "no observation"),
        ([0.0], [0.0, np.nan], "observation time of row 1 is not a number"),
        ([np.inf], [0.0, 1.0], "command time of row 0 is not a number"),
    ],
)
def test_times_that_are_none_are_refused(time, observed, said):
    with pytest.raises(InputError, match=said):
        grid(time, [1.0], observed, time_step=0.01)
