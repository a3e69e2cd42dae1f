"""Laws at ports: features against their formulas, null values that change nothing, files that say what laws are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import StateSpace, lsim

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.mechanisms.features import KINDS, Feature, dictionary, gauges_of, motion_dictionary, own_dictionary
from rfdropo_bayes.mechanisms.laws import unit_of
from rfdropo_bayes.mechanisms.ports import port_map
from rfdropo_bayes.model.assembly import build_robot_simulator
from rfdropo_bayes.model.experiment import Experiment
from rfdropo_bayes.model.model_spec import spec_of
from rfdropo_bayes.simulators.black_box import BlackBoxSimulator
from rfdropo_bayes.simulators.robot_simulator import PASSES
from rfdropo_bayes.tables import parse_table
from tests.verbs.toys import BOX

STEP = 0.01
LEVELS = np.cumsum(np.random.default_rng(0).normal(size=(40, 2)), axis=0) * 1e-3


def spec(*laws, **simulator):
    tables = {"robot": "smooth_arm", "model": {"laws": list(laws)}, "simulator": {"time_step": STEP, **simulator}}
    return spec_of(parse_table(Experiment, tables, where="test"), Path())


def law(port, feature="time", **term):
    return {"port": port, "terms": [{"coefficient": "c", "feature": feature, "scale": 1.0, **term}]}


def commands(simulator):
    value = np.random.default_rng(1).uniform(0.0, 0.008, (5, 4))
    return simulator.commands(0.1 * np.arange(5), value, np.zeros(4), 0.05 * np.arange(10))


def test_features_are_what_their_formulas_say():
    u, v = LEVELS.T
    move = np.diff(u)
    slow = lsim(StateSpace(-1.0 / 0.3, 1.0 / 0.3, 1.0, 0.0), u, STEP * np.arange(len(u)), X0=u[0])[1]
    lead, play = 0.0, [0.0]
    for k in range(1, len(u)):
        lead = np.clip(lead + move[k - 1] / 2e-3, -1.0, 1.0)
        play.append(lead)
    truth = {
        "constant": np.ones(len(u)),
        "time": STEP * np.arange(len(u)),
        "command": u,
        "drift": STEP * np.arange(len(u)) * u,
        "product": u * v,
        "magnitude": np.abs(u),
        "rate": np.append(0.0, move / STEP),
        "direction": np.append(0.0, np.sign(move)),
        "low_pass": slow,
        "lag": u - slow,
        "play": np.array(play),
        "largest": np.maximum.accumulate(np.abs(u)),
        "travelled": np.append(0.0, np.cumsum(np.abs(move))),
    }
    truth["position"] = u
    assert set(truth) == set(KINDS)
    shapes = {"low_pass": 0.3, "lag": 0.3, "play": 2e-3}
    for name, kind in KINDS.items():
        feature = Feature(name, (0, 1)[: kind.channels], shapes.get(name))
        assert np.allclose(feature.over(jnp.asarray(LEVELS), STEP), truth[name]), name
    assert len(dictionary(4, 0.01)) == 2 + 4 * 8 + 10 + 4 * 2 * 2 + 4 * 3 - 4
    own = own_dictionary(0.01)
    assert [feature.of(3) for feature in own] == [f for f in dictionary(4, 0.01) if set(f.channels) <= {3}]
    assert own[-1].formula(["up", "left"]) == "travel(u_own)"


PORTS = ["cable left", "every cable", "command delay", "force x at the tip", "stiffness", "damping", "base tilt z",
         "marker m3 x", "marker m3 along the body", "camera y", "camera turn z", "camera scale",
         "observation delay"]  # fmt: skip

SAME_WAY = ("damping", "marker m3 x", "camera y", "camera scale", "observation delay")  # as another port acts


@pytest.fixture(scope="module")
def without_law():
    """The arm without a law, its commands, and how it moves."""
    plain = build_robot_simulator(spec())
    given = commands(plain)
    return plain, given, np.asarray(plain.rollout({}, given).position)


@pytest.mark.parametrize("port", [pytest.param(port, marks=[pytest.mark.slow] * (port in SAME_WAY)) for port in PORTS])
def test_a_law_of_zero_changes_no_bit_and_another_one_acts(without_law, port):
    _, given, still = without_law
    acting = build_robot_simulator(spec(law(port, "magnitude", commands=["left"])))
    null = acting.rollout({"c": jnp.asarray(0.0)}, given)
    assert np.array_equal(still, null.position)
    moved = acting.rollout({"c": jnp.asarray(3.0)}, given)
    assert np.abs(moved.position - still).max() > 1e-6


@pytest.mark.parametrize("axis", ["x", "z"])
def test_a_base_tilt_at_a_port_is_the_mechanism_of_the_other_sign(without_law, axis):
    """The port turns gravity, the mechanism the base: docs/mechanisms.md says how the signs relate."""
    _, given, still = without_law
    angle = 1e-4
    acting = build_robot_simulator(spec(law(f"base tilt {axis}", "constant")))
    tables = {"robot": "smooth_arm", "model": {"mechanisms": ["base_tilt"]}, "simulator": {"time_step": STEP}}
    tilted = build_robot_simulator(spec_of(parse_table(Experiment, tables, where="test"), Path()))
    port = np.asarray(acting.rollout({"c": jnp.asarray(angle)}, given).position) - still
    level = {f"base_tilt_{other}": jnp.asarray(0.0) for other in "xz"}
    mechanism = tilted.rollout(level | {f"base_tilt_{axis}": jnp.asarray(-angle)}, given).position - still
    assert np.abs(port).max() > 1e-8
    np.testing.assert_allclose(port, mechanism, atol=5e-3 * np.abs(port).max())


@pytest.mark.slow
def test_a_law_at_a_cable_is_a_change_of_its_command_in_rollouts_and_in_sessions():
    acting, plain = build_robot_simulator(spec(law("cable left", "product", commands=["up", "left"]))), None
    plain = build_robot_simulator(spec())
    given = commands(plain)
    values = {"c": jnp.asarray(15.0)}
    step = np.array(given.step)
    step[:, 1] += 15.0 * step[:, 0] * step[:, 1]
    known = plain.rollout({}, given._replace(step=step))
    assert np.abs(acting.rollout(values, given).position - known.position).max() < 1e-12
    lanes = acting.session(1, 0.1)
    lanes.reset(np.array([0]), {"c": np.array([15.0])})
    value = np.random.default_rng(1).uniform(0.0, 0.008, (5, 4))
    seen = [np.asarray(lanes.act(row[None]).position)[0] for row in value[:3]]
    whole = acting.rollout(values, acting.commands(0.1 * np.arange(3), value[:3], np.zeros(4), 0.1 * np.arange(4)))
    assert np.abs(np.stack(seen) - whole.position[1:]).max() < 1e-12


@pytest.mark.slow
def test_a_shape_that_is_a_parameter_moves_the_arm_as_a_stated_one_does():
    term = {"feature": "lag", "commands": ["left"], "scale": 1.0}
    free = build_robot_simulator(spec(law("cable left", shape=0.1, shape_parameter="slow", **term)))
    stated = build_robot_simulator(spec(law("cable left", shape=0.3, **term)))
    assert [(each.name, each.unit, each.nominal) for each in free.parameters[-2:]] == [
        ("c", "-", 0.0),
        ("slow", "s", 0.1),
    ]
    given, size = commands(free), {"c": jnp.asarray(0.5)}
    known = stated.rollout(size, given).position
    assert np.abs(free.rollout({**size, "slow": jnp.asarray(0.3)}, given).position - known).max() < 1e-12
    ends = []
    for simulator, values in (
        (free, {"c": np.array([0.5]), "slow": np.array([0.3])}),
        (stated, {"c": np.array([0.5])}),
    ):
        lanes = simulator.session(1, 0.1)
        lanes.reset(np.array([0]), values)
        for row in np.random.default_rng(1).uniform(0.0, 0.008, (3, 4)):
            seen = lanes.act(row[None])
        ends.append(np.asarray(seen.position))
    assert np.abs(ends[0] - ends[1]).max() < 1e-12


HALF = 1.5e-3  # of a play [m]


def test_a_play_of_every_cable_is_the_mechanism_of_the_library():
    """One law at every cable, by each cable's own command, moves the arm as play in all drives does."""
    by_law = build_robot_simulator(spec(law("every cable", "play", commands=["own"], shape=HALF)))
    named = spec()
    named = build_robot_simulator(named.with_mechanisms("backlash"))
    given = commands(named)
    seen = by_law.rollout({"c": jnp.asarray(-HALF)}, given).position
    truth = named.rollout({"backlash": jnp.asarray(HALF)}, given).position
    still = named.rollout({"backlash": jnp.asarray(0.0)}, given).position
    assert np.abs(truth - still).max() > 1e-4
    assert np.abs(seen - truth).max() < 1e-9


@pytest.mark.slow
def test_a_session_holds_the_play_of_every_cable():
    acting = build_robot_simulator(spec(law("every cable", "play", commands=["own"], shape=HALF)))
    value = np.random.default_rng(1).uniform(0.0, 0.008, (3, 4))
    lanes = acting.session(1, 0.1)
    lanes.reset(np.array([0]), {"c": np.array([-HALF])})
    seen = [np.asarray(lanes.act(row[None]).position)[0] for row in value]
    given = acting.commands(0.1 * np.arange(3), value, np.zeros(4), 0.1 * np.arange(4))
    whole = acting.rollout({"c": jnp.asarray(-HALF)}, given)
    assert np.abs(np.stack(seen) - whole.position[1:]).max() < 1e-12


def test_gauges_are_where_the_tip_is_and_their_slope_is_finite_at_rest():
    path = jnp.asarray(np.cumsum(np.random.default_rng(2).normal(size=(30, 3)), axis=0))
    way = np.asarray(path - path[0])
    gauges = gauges_of(path)
    assert np.allclose(gauges[:, :3], way)
    assert np.allclose(gauges[:, 3], np.linalg.norm(way, axis=1))
    assert np.isfinite(jax.jacobian(gauges_of)(path)).all()
    largest = Feature("largest", (3,), of_motion=True)
    assert np.allclose(largest.over(gauges, STEP), np.maximum.accumulate(np.linalg.norm(way, axis=1)))
    assert (largest.formula(()), largest.unit("rad")) == ("max|tip distance|", (("m", 1),))
    assert len(motion_dictionary()) == len(set(motion_dictionary())) == 8


def by_hand(simulator, given, port, signal, rollouts):
    """What a law of the motion does, by signals of the motion that the rollout before shows."""
    ports = port_map(simulator, simulator.marker_names)
    rows = np.arange(len(given.step) + 1)
    every = given._replace(sample_step=rows, sample_fraction=np.zeros(len(rows)))
    acted = every
    for _ in range(rollouts):
        tip = np.asarray(simulator.rollout({}, acted).position)[:, -1]
        acted = every._replace(signals=ports.signals(ports.named(port), jnp.asarray(signal(tip - tip[0]))))
    return np.asarray(simulator.rollout({}, given._replace(signals=acted.signals)).position)


@pytest.mark.parametrize(
    ("port", "term", "size", "signal"),
    [
        ("force x at the tip", {"feature": "position", "motion": ["tip x"]}, -6.0, lambda w: -6.0 * w[:, 0]),
        (
            "stiffness",
            {"feature": "largest", "motion": ["tip distance"]},
            -10.0,
            lambda w: -10.0 * np.maximum.accumulate(np.linalg.norm(w, axis=1)),
        ),
    ],
)
def test_a_law_of_the_motion_is_given_the_motion_that_it_makes(without_law, port, term, size, signal):
    plain, given, still = without_law
    acting = build_robot_simulator(spec(law(port, **term)))
    assert np.array_equal(still, acting.rollout({"c": jnp.asarray(0.0)}, given).position)
    seen = np.asarray(acting.rollout({"c": jnp.asarray(size)}, given).position)
    assert np.abs(seen - by_hand(plain, given, port, signal, PASSES)).max() < 1e-9
    settled, moved = by_hand(plain, given, port, signal, 8), np.abs(seen - still).max()
    assert moved > 5e-4
    assert np.abs(seen - settled).max() < 0.05 * moved


@pytest.mark.parametrize(("unit", "usual", "size"), [("-", 200.0, 10.0), ("N", None, 0.05), ("m", None, 1e-3)])
def test_an_effect_on_commands_of_another_unit_is_measured_by_their_size(unit, usual, size):
    """A duty cycle of 200 counts is disturbed by counts, not by hundredths of one."""
    simulator = BlackBoxSimulator(replace(BOX, command_unit=unit, usual_command=usual))
    port = port_map(simulator, simulator.marker_names).named("cable pull")
    assert (port.size, port.unit) == (pytest.approx(size), unit)


@pytest.mark.parametrize(
    ("port", "command", "kind", "unit"),
    [
        ("rad", "rad", "product", "1/rad"),
        ("m", "m", "rate", "s"),
        ("-", "-", "command", "-"),
        ("s", "-", "product", "s"),
        ("N", "-", "rate", "N s"),
        ("s", "N m", "product", "s/N2 m2"),
    ],
)
def test_a_coefficient_has_the_unit_of_its_port_over_that_of_its_feature(port, command, kind, unit):
    feature = Feature(kind, (0,) * KINDS[kind].channels)
    assert unit_of(port, feature, command) == unit


def test_what_a_law_cannot_be_is_said():
    for wrong, match in (
        (law("cable left", "position", motion=["tip x"]), "cannot follow the motion here"),
        (law("stiffness", "position", motion=["tip x"], commands=["up"]), "cannot follow the motion and commands"),
        (law("stiffness", "position", motion=["tip top"]), "unknown part of the motion"),
        (law("stiffness", "travelled", motion=["tip x"]), "not made of the motion"),
        (law("stiffness", "position", commands=["up"]), "not made of commands"),
        (law("cable top"), "no port 'cable top'"),
        (law("cable left", "speed"), "unknown feature"),
        (law("cable left", "product", commands=["up"]), "made of 2 commands"),
        (law("cable left", "command", commands=["top"]), "unknown command"),
        (law("cable left", "command", commands=["own"]), "unknown command"),
        (law("cable left", "low_pass", commands=["up"]), "takes a positive shape"),
    ):
        with pytest.raises(InputError, match=match):
            build_robot_simulator(spec(wrong))
    body = build_robot_simulator(spec(law("stiffness", "position", motion=["tip x"])))
    with pytest.raises(InputError, match=r"follows the motion of a whole rollout.*laws at cables and on the body"):
        body.session(1, 0.1)


def test_a_model_says_its_laws_as_a_file_has_them():
    given = law("cable left", "play", commands=["up"], shape=1e-3)
    tables = spec(given).tables()
    assert tables["model"]["laws"] == [given]
    assert tables["model"]["mechanisms"] == []
    simulator = build_robot_simulator(spec(given))
    (own,) = [each for each in simulator.parameters if each.name == "c"]
    assert (own.unit, own.nominal, own.prior) == ("m", 0.0, {"distribution": "Normal", "loc": 0.0, "scale": 1.0})


def test_features_that_depend_on_seconds_are_those_that_another_clock_changes():
    """A law of poses without times may follow the order of commands, and no clock."""
    levels = jnp.asarray(np.random.default_rng(5).normal(size=(12, 2)).cumsum(axis=0))
    for feature in dictionary(2, 1.0):
        same = np.allclose(feature.over(levels, 0.1), feature.over(levels, 0.4))
        assert same != feature.in_time, feature
