"""Actuation mechanisms: null values, derivatives there, and closed forms."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.mechanisms import REGISTRY, mechanisms_named
from rfdropo_bayes.mechanisms.actuation import GuideAzimuth
from rfdropo_bayes.robots import Robot

STEP = 0.01
RAMP = jnp.stack([jnp.linspace(0.1, 5.0, 50), jnp.sin(jnp.arange(50) / 7.0)], axis=1)
START = jnp.zeros(2)


def act(name: str, **values: float):
    return REGISTRY[name]().actuate({key: jnp.asarray(v) for key, v in values.items()}, RAMP, START, STEP)


@pytest.mark.parametrize(
    ("name", "parameter"),
    [("command_delay", "command_delay"), ("actuator_lag", "actuator_lag"), ("command_gain", "command_gain_error")],
)
def test_the_null_value_is_the_base_simulator_and_its_derivative_is_the_one_sided_difference(name, parameter):
    np.testing.assert_array_equal(act(name, **{parameter: 0.0}), RAMP)
    slope = jax.jacfwd(lambda value: act(name, **{parameter: value}))(0.0)
    step = 1e-7
    np.testing.assert_allclose(slope, (act(name, **{parameter: step}) - RAMP) / step, rtol=1e-4, atol=1e-4)
    assert np.abs(slope).max() > 0


def test_a_delay_of_whole_steps_shifts_the_command():
    late = act("command_delay", command_delay=3 * STEP)
    np.testing.assert_allclose(late[3:], RAMP[:-3], atol=1e-12)
    np.testing.assert_allclose(late[:3], 0.0, atol=1e-12)


def test_a_delay_between_steps_is_interpolated():
    late = act("command_delay", command_delay=2.25 * STEP)
    np.testing.assert_allclose(late[3:], 0.75 * RAMP[1:-2] + 0.25 * RAMP[:-3], atol=1e-12)


@pytest.mark.parametrize("tau", [1e-5, 1e-3, 0.027, 0.4])
@pytest.mark.parametrize("time_step", [STEP, STEP / 4])
def test_a_lag_answers_a_ramp_exactly_in_any_step(tau, time_step):
    """tau y' = t - y from 0: y = t - tau (1 - exp(-t / tau)), and the slope in tau is right for the shortest lags."""
    time = time_step * np.arange(1, 51)
    ramp = jnp.asarray(np.stack([time, 2.0 * time], axis=1))
    lagged, slope = jax.jvp(
        lambda lag: REGISTRY["actuator_lag"]().actuate({"actuator_lag": lag}, ramp, START, time_step), (tau,), (1.0,)
    )
    kept = np.exp(-time / tau)
    np.testing.assert_allclose(lagged[:, 0], time - tau * (1 - kept), rtol=1e-10)
    np.testing.assert_allclose(slope[:, 0], -(1 - kept) + time / tau * kept, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(lagged[:, 1], 2.0 * lagged[:, 0], rtol=1e-12)


def test_each_drive_follows_with_its_own_lag():
    (made,) = mechanisms_named(["cable_lag"], Robot.load("smooth_arm"))
    assert [spec.name for spec in made.parameters] == [f"cable_lag_{c}" for c in ("up", "left", "down", "right")]
    own = act("cable_lag", cable_lag_1=0.2, cable_lag_2=0.0)
    np.testing.assert_allclose(own[:, 0], act("actuator_lag", actuator_lag=0.2)[:, 0], rtol=1e-12)
    np.testing.assert_array_equal(own[:, 1], RAMP[:, 1])


def test_an_unknown_mechanism_is_refused_with_the_nearest_name():
    with pytest.raises(InputError, match="did you mean 'command_delay'"):
        mechanisms_named(["comand_delay"])


def test_every_mechanism_says_what_it_is():
    for name, kind in REGISTRY.items():
        mechanism = kind()
        assert mechanism.name == name
        assert mechanism.cause
        assert mechanism.remedy
        for spec in mechanism.parameters:
            assert spec.low <= spec.nominal <= spec.high


@pytest.mark.parametrize("cables", [3, 4])
def test_lengths_at_turned_guides_are_read_as_those_of_the_same_shape_at_the_drawn_ones(cables):
    """A light body of constant curvature takes up d (k_x cos a + k_y sin a) + s of a cable at azimuth a; opposed cables
    have lengths that no shape has, which stay."""
    robot = Robot.outline(name="arm", length=0.1, radius=0.01, markers={"tip": 0.1}, cables=cables)
    mechanism = GuideAzimuth.for_robot(robot)
    turn = np.array([0.1, -0.05, 0.2, 0.0])[:cables]
    values = {spec.name: jnp.asarray(angle) for spec, angle in zip(mechanism.parameters, turn, strict=True)}
    drawn = np.deg2rad([cable.azimuth_deg for cable in robot.cables])
    shape = np.array([0.3, -0.2, 0.1])

    def lengths(azimuth):
        return 0.1 * np.stack([np.cos(azimuth), np.sin(azimuth), np.ones(cables)], axis=1) @ shape

    np.testing.assert_allclose(mechanism.reach(values, lengths(drawn + turn)), lengths(drawn), atol=1e-6)
    nothing = {name: jnp.zeros(()) for name in values}
    sent = np.linspace(-0.01, 0.02, cables)
    np.testing.assert_allclose(mechanism.reach(nothing, sent), sent, atol=1e-9)


def test_channels_that_share_cables_have_no_turned_guides():
    robot = Robot.load("trunk_sofa")
    shared = robot.with_changes(channels={"names": ["pair"], "gain": [[1.0]] * len(robot.cables)})
    assert GuideAzimuth.for_robot(shared).parameters == ()
