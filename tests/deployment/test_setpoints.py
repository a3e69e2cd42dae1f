"""Set-points keep every limit, whatever is asked; motors convert as the formula says."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rfdropo_bayes.deployment.setpoints import SetPoints
from rfdropo_bayes.robots import Motor, Robot

PERIOD = 0.01


def points(robot: Robot, length: float = 0.0) -> SetPoints:
    return SetPoints(robot.motors, PERIOD, np.full(len(robot.motors), length))


@settings(max_examples=60, deadline=None)
@given(goals=st.lists(st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4), min_size=1, max_size=8), data=st.data())
def test_limits_hold_for_any_goals(goals: list[list[float]], data: st.DataObject) -> None:
    """Goals change at any moment, ramps lead anywhere; length, rate and acceleration stay within the limits."""
    robot = Robot.load("motor_arm")
    made = points(robot)
    lengths, rates, ramp = [made.length], [made.rate], None
    for goal in goals:
        wanted = made.clamp(np.array(goal))
        for _ in range(data.draw(st.integers(1, 60))):
            lengths.append(made.towards(wanted, ramp).copy())
            rates.append(made.rate.copy())
        ramp = wanted if data.draw(st.booleans()) else None  # that of the goal before
    tiny = 1e-12
    assert np.all(np.array(lengths) >= made.low - tiny)
    assert np.all(np.array(lengths) <= made.high + tiny)
    assert np.all(np.abs(rates) <= made.rate_limit + tiny)
    assert np.all(np.abs(np.diff(rates, axis=0)) <= made.acceleration_limit * PERIOD + tiny)


def test_a_goal_is_reached_and_not_overshot(robot: Robot) -> None:
    made = points(robot)
    goal = np.array([0.01, -0.02, 0.0, 0.03])
    path = np.array([made.towards(goal).copy() for _ in range(120)])
    np.testing.assert_allclose(path[-1], goal, atol=1e-7)
    assert np.all(np.abs(path) <= np.abs(goal) + 1e-12)


def test_a_goal_is_not_overshot_by_motors_that_take_many_cycles_to_stop(robot: Robot) -> None:
    """With 0.1 m/s2 the last half of 20 mm is there to stop on, and the way takes 2 sqrt(20 mm / 0.1 m/s2)."""
    motors = [motor.model_copy(update={"acceleration_limit_m_s2": 0.1}) for motor in robot.motors]
    made, goal = SetPoints(motors, PERIOD, np.zeros(4)), np.array([0.02, -0.02, 0.0, 0.02])
    path = np.array([made.towards(goal).copy() for _ in range(120)])
    assert np.all(np.abs(path) <= np.abs(goal) + 1e-12)
    shortest = 2.0 * np.sqrt(0.02 / 0.1)
    reached = PERIOD * (1 + np.argmax(np.abs(path[:, 0] - goal[0]) < 1e-5))
    assert reached == pytest.approx(shortest, abs=5 * PERIOD)


def test_the_way_takes_as_long_as_a_trapezoid(robot: Robot) -> None:
    """distance / rate + rate / acceleration, to two cycles."""
    made, goal = points(robot), np.full(4, 0.02)
    steps = 0
    while np.any(np.abs(made.length - goal) > 1e-7):
        made.towards(goal)
        steps += 1
    motor = robot.motors[0]
    expected = 0.02 / motor.rate_limit_m_s + motor.rate_limit_m_s / motor.acceleration_limit_m_s2
    assert steps * PERIOD == pytest.approx(expected, abs=3 * PERIOD)


def test_a_halt_takes_the_stopping_time(robot: Robot) -> None:
    made = points(robot)
    for _ in range(30):
        made.towards(np.full(4, 0.03))
    assert np.all(made.rate == pytest.approx(robot.motors[0].rate_limit_m_s))
    steps = 0
    while not made.at_rest:
        made.halt()
        steps += 1
    motor = robot.motors[0]
    assert steps * PERIOD <= motor.rate_limit_m_s / motor.acceleration_limit_m_s2 + PERIOD + 1e-9


def test_a_motor_found_beyond_its_limit_may_come_back_but_go_no_further(robot: Robot) -> None:
    made = points(robot, 0.04)  # the limit is 0.03
    np.testing.assert_allclose(made.clamp(np.full(4, 0.05)), 0.04)
    np.testing.assert_allclose(made.clamp(np.full(4, 0.035)), 0.035)


def test_counts_of_a_published_drive() -> None:
    """HUMASoft (UC3M): 2048 counts a turn, gear 24: 841 counts/mm on a drum of 9.3 mm, 1043 on one of 7.5 mm."""
    table = Robot.load("motor_arm").motors[0].model_dump()
    assert Motor(**table).counts_per_metre / 1e3 == pytest.approx(841, abs=0.5)
    assert Motor(**(table | {"drum_radius_m": 0.0075})).counts_per_metre / 1e3 == pytest.approx(1043, abs=0.5)


@given(length=st.floats(-0.03, 0.03), offset=st.integers(-(2**20), 2**20), sign=st.sampled_from([-1, 1]))
def test_length_and_counts_are_inverse(length: float, offset: int, sign: int) -> None:
    motor = Robot.load("motor_arm").motors[0].model_copy(update={"sign": sign})
    counts = motor.counts(length, offset)
    assert motor.length(counts, offset) == pytest.approx(length, abs=0.51 / motor.counts_per_metre)
    assert np.sign(counts - offset) in (0, sign * np.sign(length))


def test_torque_and_tension_balance_on_the_drum(robot: Robot) -> None:
    """T r = torque x gear: 1000 per mille are 0.012 N m x 24 / 9.3 mm."""
    for motor in robot.motors:
        assert motor.tension(motor.sign * 1000) == pytest.approx(0.012 * 24 / 0.0093)
        assert motor.tension(motor.sign * motor.per_mille(7.0)) == pytest.approx(7.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sign": 0}, "neither 1 nor -1"),
        ({"length_limit_m": [0.01, 0.01]}, "is empty"),
        ({"tension_limit_n": [5.0, 1.0]}, "not 0 <= least < greatest"),
        ({"homing_tension_n": 99.0}, "outside its tension_limit_n"),
        ({"tension_limit_n": [0.0, 1e4]}, "five times the rated torque"),
        ({"counts_per_turn": 1e9}, "32-bit"),
        ({"node": 0}, "greater than or equal to 1"),
    ],
)
def test_motors_that_cannot_be_are_refused(robot: Robot, change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Motor(**(robot.motors[0].model_dump() | change))


def test_motors_follow_the_channels(robot: Robot) -> None:
    table = robot.model_dump()
    swapped = [table["motors"][k] for k in (1, 0, 2, 3)]
    with pytest.raises(ValueError, match="motors drive"):
        Robot.model_validate(table | {"motors": swapped})
    twice = [motor | {"node": 1} for motor in table["motors"]]
    with pytest.raises(ValueError, match="share a node"):
        Robot.model_validate(table | {"motors": twice})


def test_a_ramp_is_followed_beyond_its_goal(robot: Robot) -> None:
    """Ramps of two commands overlap: on to 1.2 mm by the first, back to 0.4 mm by the second."""
    made = points(robot)
    goal = np.full(4, 4e-4)
    ramp = 2e-4 * np.array([1, 2, 3, 4, 5, 6, 5, 4, 3, 2, 2, 2, 2, 2])
    path = np.array([made.towards(goal, np.full(4, place)).copy() for place in ramp])
    assert np.abs(path[:, 0] - ramp).max() <= 2 * 2.5 * PERIOD**2  # it takes two cycles to turn at 2.5 m/s2
    np.testing.assert_allclose(path[-1], goal, atol=1e-9)
