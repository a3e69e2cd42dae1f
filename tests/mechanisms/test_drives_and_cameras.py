"""Mechanisms of drives and cameras: null values through the active code path, derivatives there, closed forms."""

from __future__ import annotations

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.mechanisms import REGISTRY, mechanisms_named
from rfdropo_bayes.mechanisms.actuation import CableDelay
from rfdropo_bayes.mechanisms.registry import choose_mechanisms
from rfdropo_bayes.model.assembly import build_simulator
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.commands import commands_on_grid

REPOSITORY = Path(__file__).resolve().parents[2]
STEP = 0.01
TIME = jnp.asarray(np.cumsum(np.concatenate([[0.0], np.random.default_rng(0).uniform(0.04, 0.06, 79)])))
COMMAND = jnp.stack([0.01 * jnp.sin(jnp.arange(80) / 9.0), 0.008 * (1 - jnp.cos(jnp.arange(80) / 13.0))], axis=1)
START = jnp.zeros(2)
POSITION = jnp.asarray(np.random.default_rng(1).normal(size=(80, 4, 3)).cumsum(axis=0)) * 1e-3

DRIVES = (
    "backlash",
    "cable_gain",
    "cable_lag",
    "cable_slack",
    "drive_creep",
    "cable_gain_drift",
    "cable_slack_drift",
    "drive_zero_drift",
    "command_gain_drift",
    "end_stop",
    "travel_stop",
    "rate_limit",
    "spool_growth",
)
CAMERAS = (
    "camera_offset_drift",
    "camera_rotation_drift",
    "camera_scale_drift",
    "camera_offset",
    "clock_offset",
    "marker_offset",
    "sensor_lag",
)


def applied(name: str, values: dict):
    mechanism = REGISTRY[name]()
    values = {spec.name: jnp.asarray(spec.nominal) for spec in mechanism.parameters} | values
    if name in DRIVES:
        return mechanism.actuate(values, COMMAND, START, STEP)
    if hasattr(mechanism, "sense"):
        return mechanism.sense(values, POSITION)
    return mechanism.sense_over_time(values, POSITION, TIME)


def test_rounding_in_a_held_command_is_no_reversal():
    """Ramped commands waver by 1e-18 while they are held; the derivative of play must not flip with them."""
    time = np.arange(0.0, 4.0, 0.2)
    level = np.random.default_rng(3).choice([0.0, 0.0025, 0.005], (len(time), 2))
    sent = commands_on_grid(time, level, np.zeros(2), np.arange(0.0, 4.0, 0.05), time_step=STEP, ramp=0.1).step
    moves = np.abs(np.diff(sent, axis=0))
    assert ((moves > 0.0) & (moves < 1e-12)).any()

    def driven(half):
        return REGISTRY["backlash"]().actuate({"backlash": half}, jnp.asarray(sent), jnp.zeros(2), STEP)

    slope = jax.jvp(driven, (jnp.asarray(0.0),), (jnp.asarray(1.0),))[1]
    np.testing.assert_allclose(slope, (driven(jnp.asarray(1e-6)) - sent) / 1e-6, atol=1e-6)


@pytest.mark.parametrize("name", [*DRIVES, *CAMERAS])
def test_the_null_value_is_the_base_simulator_and_its_derivative_is_the_one_sided_difference(name):
    """Thresholds that nothing reaches have no derivative: their grid is tried instead."""
    specs, step = REGISTRY[name]().parameters, 1e-7
    null = {spec.name: jnp.asarray(float(spec.nominal)) for spec in specs}
    act = jax.jit(lambda values: applied(name, values))
    there, slopes = act(null), jax.jit(jax.jacfwd(act))(null)
    np.testing.assert_allclose(there, COMMAND if name in DRIVES else POSITION, rtol=0, atol=1e-17)
    for spec in specs:
        slope = slopes[spec.name]
        assert np.isfinite(slope).all()
        difference = (act(null | {spec.name: null[spec.name] + step}) - there) / step
        np.testing.assert_allclose(slope, difference, rtol=1e-4, atol=2e-5)
        channel = spec.name.removesuffix("_rate").removeprefix("cable_gain_error_").removeprefix("cable_lag_")
        channels_beyond = channel.isdigit() and int(channel) > COMMAND.shape[1]
        if not spec.grid and not channels_beyond:
            assert np.abs(slope).max() > 0


def test_play_follows_by_half_its_width():
    """A ramp up by 1 and down again: the cable lags by the half play, and stands still for the whole of it."""
    ramp = jnp.concatenate([jnp.linspace(0, 1, 101), jnp.linspace(1, 0, 101)[1:]])[:, None]
    moved = REGISTRY["backlash"]().actuate({"backlash": jnp.asarray(0.1)}, ramp, jnp.zeros(1), STEP)[:, 0]
    np.testing.assert_allclose(moved[20:101], ramp[20:101, 0] - 0.1, atol=1e-12)
    np.testing.assert_allclose(moved[101:120], 0.9, atol=1e-12)
    np.testing.assert_allclose(moved[125:], ramp[125:, 0] + 0.1, atol=1e-12)


def test_an_end_stop_cuts():
    cut = applied("end_stop", {"inverse_travel_limit": jnp.asarray(200.0)})
    np.testing.assert_allclose(cut, np.clip(COMMAND, -0.005, 0.005), atol=1e-15)


def test_a_travel_stop_forgets_what_was_commanded_beyond_it():
    """Released by 8 mm with 3 mm to go, then pulled by 8 mm, the drive stands 5 mm out and not where it began."""
    sent = jnp.asarray([0.0, -0.004, -0.008, -0.004, 0.0, 0.010])[:, None] + 0.002
    travel = REGISTRY["travel_stop"]().actuate(
        {"inverse_release_travel": jnp.asarray(1 / 0.003), "inverse_pull_travel": jnp.asarray(1 / 0.012)},
        sent,
        sent[0],
        0.1,
    )
    expected = np.array([0.0, -0.003, -0.003, 0.001, 0.005, 0.012]) + 0.002
    np.testing.assert_allclose(travel[:, 0], expected, atol=1e-15)


def test_a_rate_limit_slows():
    slow = applied("rate_limit", {"inverse_speed_limit": jnp.asarray(15.0)})
    assert np.abs(np.diff(slow, axis=0)).max() <= STEP / 15.0 + 1e-12
    np.testing.assert_allclose(slow[:, 1], COMMAND[:, 1], atol=1e-15)  # never faster than 0.062 m/s


def test_each_cable_has_its_own_gain_and_a_wrong_one_leaves_the_others_alone():
    errors = {f"cable_gain_error_{k + 1}": jnp.asarray(v) for k, v in enumerate((0.3, 0.1))}
    np.testing.assert_allclose(applied("cable_gain", errors), COMMAND * jnp.array([1.3, 1.1]), atol=1e-15)
    (mechanism,) = mechanisms_named(["cable_gain"], Robot.load("smooth_arm"))
    assert [spec.name for spec in mechanism.parameters] == [
        f"cable_gain_error_{channel}" for channel in ("up", "left", "down", "right")
    ]


def test_a_held_command_creeps_exponentially():
    """After a pull of one step the loss is g (1 - exp(-t / tau) m), m = (exp(s / tau) - 1) tau / s in steps of s."""
    held, tau = jnp.full((60, 1), 0.01), 0.3
    values = {"drive_creep": jnp.asarray(0.2), "drive_creep_time": jnp.asarray(tau)}
    crept = REGISTRY["drive_creep"]().actuate(values, held, jnp.zeros(1), STEP)[:, 0]
    left = np.exp(-np.arange(1, 61) * STEP / tau) * np.expm1(STEP / tau) * tau / STEP
    np.testing.assert_allclose(crept, 0.01 * (1 - 0.2 * (1 - left)), rtol=1e-12)


def test_a_lagging_camera_answers_a_ramp_in_closed_form():
    """tau y' = t - y from 0: y = t - tau (1 - exp(-t / tau))."""
    ramp = jnp.broadcast_to(TIME[:, None, None], (80, 1, 3))
    seen = REGISTRY["sensor_lag"]().sense_over_time({"sensor_lag": jnp.asarray(0.2)}, ramp, TIME)
    np.testing.assert_allclose(seen[:, 0, 0], TIME - 0.2 * (1 - np.exp(-TIME / 0.2)), atol=1e-12)


def test_a_clock_offset_shifts_straight_motion():
    ramp = jnp.broadcast_to(TIME[:, None, None], (80, 1, 3))
    for offset in (-0.07, 0.07):
        seen = REGISTRY["clock_offset"]().sense_over_time({"clock_offset": jnp.asarray(offset)}, ramp, TIME)
        np.testing.assert_allclose(seen[3:-3, 0, 0], TIME[3:-3] - offset, atol=1e-12)


OWN = """
from rfdropo_bayes.mechanisms.actuation import CommandGain
class Half(CommandGain):
    name = "half"
class Nothing:
    pass
"""


def test_a_mechanism_of_the_users_own_is_found_beside_the_experiment(tmp_path):
    (tmp_path / "mine.py").write_text(OWN)
    (mechanism,) = mechanisms_named(["mine.py:Half"], folder=tmp_path)
    assert mechanism.name == "half"
    assert mechanisms_named(["rfdropo_bayes.mechanisms.actuation:Backlash"])[0].name == "backlash"
    for wrong in ("mine.py:None_", "other.py:Half", "no.such:Thing", "mine.py:Nothing"):
        with pytest.raises(InputError):
            mechanisms_named([wrong], folder=tmp_path)


BASE = "from rfdropo_bayes.mechanisms.actuation import CommandGain\n"


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("class Own(CommandGain)\n    pass", "SyntaxError"),
        (BASE + "class Own(CommandGain):\n    name = nowhere", "NameError"),
        ("class Own:\n    name, stage, cause, remedy = 'own', 'actuation', '', ''", "lacks parameters"),
        (
            "class Own:\n    name, stage, cause, remedy, parameters = 'own', 'actuation', '', '', ()",
            "no method actuate",
        ),
        (BASE + "class Own(CommandGain):\n    name, stage = 'own', 'sensing'", "no method sense or sense_over_time"),
        (BASE + "class Own(CommandGain):\n    pass", "has the name of a mechanism of the library, 'command_gain'"),
    ],
)
def test_what_is_wrong_with_a_mechanism_of_the_users_own_is_said(tmp_path, code, message):
    (tmp_path / "own.py").write_text(code)
    with pytest.raises(InputError, match=message):
        mechanisms_named(["own.py:Own"], folder=tmp_path)


def test_a_users_file_may_hold_dataclasses_and_have_any_name(tmp_path):
    (tmp_path / "numpy.py").write_text(
        "from __future__ import annotations\nfrom dataclasses import dataclass\n"
        + BASE
        + "@dataclass\nclass Own(CommandGain):\n    share: float = 0.5\n    name = 'own'\n"
    )
    (mechanism,) = mechanisms_named(["numpy.py:Own"], folder=tmp_path)
    assert mechanism.share == 0.5
    assert sys.modules["numpy"] is np


def test_the_code_of_a_mechanism_is_part_of_what_a_simulator_is(tmp_path):
    """A checkpoint made with other code, or with another robot of the same name, must not be taken up."""
    robot = Robot.load("smooth_arm")
    stiffer = robot.model_copy(update={"description": "the same name, other content"})

    def content(robot, share):
        (tmp_path / "own.py").write_text(BASE + f"class Own(CommandGain):\n    name, share = 'own', {share}")
        spec = ModelSpec(robot, folder=tmp_path).with_mechanisms("own.py:Own")
        return build_simulator(spec).description["content_sha256"]

    assert content(robot, 1) == content(robot, 1)
    assert len({content(robot, 1), content(robot, 2), content(stiffer, 1)}) == 3


def test_the_documented_example_is_a_mechanism(tmp_path):
    text = (REPOSITORY / "docs" / "mechanisms.md").read_text()
    (tmp_path / "overshoot.py").write_text(text.split("```python\n")[1].split("```")[0])
    (mechanism,) = mechanisms_named(["overshoot.py:Overshoot"], folder=tmp_path)
    np.testing.assert_array_equal(mechanism.actuate({"overshoot_time": 0.0}, COMMAND, START, STEP), COMMAND)
    ramp = STEP * jnp.arange(1, 81)[:, None] * jnp.ones(2)
    moved = mechanism.actuate({"overshoot_time": 0.03}, ramp, START, STEP)
    np.testing.assert_allclose(moved, ramp + 0.03, atol=1e-12)


def test_markers_beside_their_places_turn_with_the_body():
    """A body that bends in a plane as an arc: an arm across it, and one along it, against the rotated frame."""
    place = np.linspace(0.1, 0.4, 40)
    angles = np.array([0.0, 0.4, 1.1])  # of the direction at the end of a length of 0.4 m

    def arc(angle):
        curvature = max(angle, 1e-9) / 0.4
        turned = curvature * place
        return np.stack([(1 - np.cos(turned)) / curvature, 0 * place, np.sin(turned) / curvature], axis=1), turned

    position = np.stack([arc(angle)[0] for angle in angles])
    mechanism = REGISTRY["marker_offset"]([str(k) for k in range(len(place))])
    arms = np.random.default_rng(2).normal(size=(len(place), 3)) * 2e-3
    values = dict(zip((s.name for s in mechanism.parameters), arms.ravel(), strict=True))
    seen = np.asarray(mechanism.sense(values, jnp.asarray(position)))
    for row, angle in enumerate(angles):
        for k in range(1, len(place) - 1):  # chords of the neighbours have the direction of the arc between them
            c, s = np.cos(arc(angle)[1][k]), np.sin(arc(angle)[1][k])
            frame = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
            np.testing.assert_allclose(seen[row, k] - position[row, k], frame @ arms[k], atol=1e-9)
    one = REGISTRY["marker_offset"](["tip"])
    moved = one.sense(
        {f"marker_offset_tip_{a}": v for a, v in zip("xyz", (1.0, 2.0, 3.0), strict=True)}, POSITION[:, :1]
    )
    np.testing.assert_allclose(moved - POSITION[:, :1], np.broadcast_to([1.0, 2.0, 3.0], (80, 1, 3)))


def test_sizes_of_commands_are_in_the_unit_that_the_robot_is_commanded_in():
    """Sizes are shares of usual commands, in their unit; the limit of a stop is in one over it."""
    names = ["backlash", "cable_slack", "end_stop", "travel_stop", "spool_growth", "drive_zero_drift", "rate_limit"]
    robots = [Robot.load(robot) for robot in ("smooth_arm", "asl_trunk")]
    cables, motors = (mechanisms_named(names, robot) for robot in robots)
    units = [spec.unit for mechanism in motors for spec in mechanism.parameters]
    assert units == ["rad", "rad", "1/rad", "1/rad", "1/rad", "1/rad", "rad/s", "s/rad"]
    ratio = robots[1].usual_command / robots[0].usual_command
    play, turned = cables[0].parameters[0], motors[0].parameters[0]
    assert play.unit == "m"
    assert (turned.prior["scale"], turned.high) == pytest.approx((ratio * play.prior["scale"], ratio * play.high))
    stop, turned = cables[2].parameters[0], motors[2].parameters[0]
    np.testing.assert_allclose(turned.grid, np.array(stop.grid) / ratio)
    assert turned.prior["distribution"] == "HalfNormal"
    assert stop.prior["scale"] == pytest.approx(ratio * turned.prior["scale"])


def test_a_drift_of_actuation_is_the_mechanism_with_the_size_of_each_step():
    drifted = applied("command_gain_drift", {"command_gain_error_rate": jnp.asarray(0.2)})
    elapsed = STEP * np.arange(1, len(COMMAND) + 1)[:, None]
    np.testing.assert_allclose(drifted, (1.0 + 0.2 * elapsed) * COMMAND, rtol=1e-12)


def test_a_drift_of_a_camera_is_the_mechanism_with_the_size_of_each_row():
    drifted = applied("camera_scale_drift", {"camera_scale_error_rate": jnp.asarray(0.01)})
    elapsed = (TIME - TIME[0])[:, None, None]
    np.testing.assert_allclose(drifted, (1.0 + 0.01 * elapsed) * POSITION, rtol=1e-12)


def test_a_class_of_the_library_is_named_as_in_a_file():
    """Drifts are made by a function: their classes cannot be imported by module and name."""
    for name, kind in REGISTRY.items():
        (choice,) = choose_mechanisms([kind])
        assert choice.source == name
        (again,) = choose_mechanisms([choice.source])
        assert again.kind is kind


def test_each_command_may_have_a_delay_of_its_own():
    """In a recording and step by step."""
    delays = (0.034, 0.0)
    each = CableDelay(("a", "b"))
    values = {f"cable_delay_{name}": jnp.asarray(delay) for name, delay in zip("ab", delays, strict=True)}
    step, history = np.arange(len(COMMAND) + 1), np.vstack([START, COMMAND])
    late = [np.interp(step[1:] - d / STEP, step, own) for d, own in zip(delays, history.T, strict=True)]
    expected = np.stack(late, axis=1)
    np.testing.assert_allclose(each.actuate(values, COMMAND, START, STEP), expected, atol=1e-15)
    begun = each.begin(values, START, STEP)
    reached = jax.lax.scan(lambda memory, given: each.advance(values, memory, given, STEP), begun, COMMAND)[1]
    np.testing.assert_allclose(reached, expected, atol=1e-15)
