"""Actuation mechanisms: null values, derivatives there, and closed forms."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.mechanisms import REGISTRY, mechanisms_named

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
    assert (np.abs(slope).max() > 0) == (name != "actuator_lag")  # much shorter than a step, a lag is not seen


def test_a_delay_of_whole_steps_shifts_the_command():
    late = act("command_delay", command_delay=3 * STEP)
    np.testing.assert_allclose(late[3:], RAMP[:-3], atol=1e-12)
    np.testing.assert_allclose(late[:3], 0.0, atol=1e-12)


def test_a_delay_between_steps_is_interpolated():
    late = act("command_delay", command_delay=2.25 * STEP)
    np.testing.assert_allclose(late[3:], 0.75 * RAMP[1:-2] + 0.25 * RAMP[:-3], atol=1e-12)


def test_a_lag_answers_a_step_exponentially():
    """tau y' = 1 - y: y = 1 - exp(-t / tau), whatever the time step."""
    tau = 0.027
    for time_step in (STEP, STEP / 4):
        step = jnp.ones((50, 2))
        lagged = REGISTRY["actuator_lag"]().actuate({"actuator_lag": jnp.asarray(tau)}, step, START, time_step)
        time = time_step * np.arange(1, 51)
        np.testing.assert_allclose(lagged[:, 0], 1 - np.exp(-time / tau), rtol=1e-12)


@pytest.mark.parametrize("tau", [0.0, 1e-300, 1e-9, 1e-4])
def test_a_lag_much_shorter_than_a_step_changes_nothing_and_neither_does_its_derivative(tau):
    lagged, slope = jax.jvp(lambda value: act("actuator_lag", actuator_lag=value), (tau,), (1.0,))
    np.testing.assert_array_equal(lagged, RAMP)
    np.testing.assert_allclose(slope, 0.0, atol=1e-30)


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
