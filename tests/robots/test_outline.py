"""Robots from a few answers: what is written can be read, and is what was answered."""

from __future__ import annotations

import inspect

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.robots.outline import ASSUMED, KNOWN, SILICONE, RobotOutline, robot_text

ARM = {"name": "arm", "length": 0.3, "radius": 0.015, "markers": {"low": 0.15, "tip": 0.3}}


def test_the_answers_are_shown_and_a_mistyped_one_is_named():
    """Help and tab completion of `Robot.outline` show every answer, and the text explains each."""
    shown = set(inspect.signature(Robot.outline).parameters)
    assert shown == set(inspect.signature(RobotOutline).parameters) - {"assumed"}
    assert [name for name in shown if f"``{name}``" not in (Robot.outline.__doc__ or "")] == []
    with pytest.raises(InputError, match="outline: not given: markers"):
        Robot.outline(name="arm", length=0.3, radius=0.015)
    with pytest.raises(InputError, match="unknown keyword 'length_mm'; did you mean 'length'"):
        Robot.outline(**ARM, length_mm=300.0)
    with pytest.raises(InputError, match="command_unit = 'deg' is not a unit of a robot"):
        Robot.outline(**ARM, command_unit="deg")


def test_what_is_not_given_has_a_wide_prior():
    """A robot made in Python is no surer of its defaults than one that ``rfdropo init`` writes."""
    assumed, given = Robot.outline(**ARM), Robot.outline(**ARM, mass=0.1)
    assert assumed.parameters["trunk_mass"].prior["sigma"] == ASSUMED
    assert given.parameters["trunk_mass"].prior["sigma"] == KNOWN


def test_a_robot_shows_itself_in_a_line():
    robot = Robot.outline(**ARM, cables=3, command_unit="rad")
    assert repr(robot) == (
        "<Robot arm: 300 mm long, 3 cables, 3 commands [rad] (motor_1, motor_2, motor_3), markers low, tip>"
    )


def written(tmp_path, **answers):
    path = tmp_path / "arm.toml"
    path.write_text(robot_text(RobotOutline(**ARM | answers)))
    return Robot.load(path)


@pytest.mark.parametrize(
    "answers",
    [
        {},
        {"shape": "cone", "tip_radius": 0.009},
        {"shape": "tube", "inner_radius": 0.005},
        {"shape": "disks", "disks": 12, "inner_radius": 0.003, "segments": 3},
        {"segments": 3, "cables": 3, "command_unit": "rad", "spool_radius": 0.008},
        {"cables": 4, "pairs": True, "command_unit": "rad", "gravity": "-y"},
    ],
)
def test_every_outline_is_a_robot(tmp_path, answers):
    outline, robot = RobotOutline(**ARM | answers), written(tmp_path, **answers)
    assert robot.marker_names == ("low", "tip")
    assert robot.body.station_m[-1] == pytest.approx(0.3)
    assert len(robot.cables) == outline.segments * outline.cables
    assert robot.channel_names == tuple(outline.channel_names())
    assert robot.command_unit == outline.command_unit
    assert robot.nominal()["trunk_mass"] == pytest.approx(SILICONE * robot.body.volume_m3, rel=1e-5)
    for cable, guides in zip(robot.cables, robot.guides(), strict=True):
        segment = robot.cables.index(cable) // outline.cables
        assert guides[-1, 2] == pytest.approx(0.3 * (segment + 1) / outline.segments, abs=0.002)


@given(length=st.floats(0.1, 3.0), shape=st.sampled_from(["cone", "disks"]), unit=st.sampled_from(["m", "Pa"]))
@settings(max_examples=30, deadline=None)
def test_sizes_of_any_digits_make_a_robot(length, shape, unit):
    """Lengths in inches have more digits than a file of six; the last guide lies no higher than the body."""
    sizes = {"tip_radius": 0.02 * length} if shape == "cone" else {"inner_radius": 0.01 * length}
    answers = {"length": length, "radius": 0.05 * length, "shape": shape, "command_unit": unit, **sizes}
    robot = Robot.outline(name="arm", markers={"tip": length}, segments=3, cables=3, **answers)
    assert robot.marker_points()[-1, 2] == pytest.approx(length, rel=1e-8)


def test_pairs_pull_and_let_out(tmp_path):
    robot = written(tmp_path, cables=4, pairs=True, command_unit="rad", spool_radius=0.01)
    expected = 0.01 * np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    np.testing.assert_allclose(robot.channel_matrix(robot.nominal()), expected)


def test_cables_follow_the_taper(tmp_path):
    robot = written(tmp_path, shape="cone", tip_radius=0.0075, cable_radius=0.01)
    guides = robot.guides()[0]
    np.testing.assert_allclose(guides[:, 0], 0.01 * (1.0 - 0.5 * guides[:, 2] / 0.3), atol=1e-6)


def test_what_was_assumed_is_marked_and_has_a_wide_prior(tmp_path):
    text = robot_text(RobotOutline(**ARM, mass=0.2, assumed=frozenset({"gravity"})))
    assert "gravity_m_s2 = [0.0, 0.0, 9.81]  # ASSUMED: gravity" in text
    assumed = robot_text(RobotOutline(**ARM, assumed=frozenset({"mass"})))
    assert "[parameters.trunk_mass]  # ASSUMED: trunk_mass" in assumed
    spread = [written(tmp_path, **a).parameters["trunk_mass"].prior["sigma"] for a in ({}, {"assumed": {"mass"}})]
    assert spread[1] > 2 * spread[0]


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        ({"gravity": "down"}, "is not a direction; use one of"),
        ({"shape": "box"}, "unknown shape 'box'"),
        ({"length": -1.0}, "length = -1 is not positive"),
        ({"cables": 3, "pairs": True}, "make no pairs"),
        ({"shape": "disks", "disks": 10, "segments": 3}, "do not share out"),
        ({"markers": {}}, "no markers"),
    ],
)
def test_answers_that_make_no_robot_are_refused(answers, message):
    with pytest.raises(InputError, match=message):
        RobotOutline(**ARM | answers)


@pytest.mark.parametrize(("unit", "newtons"), [("N", 1.0), ("N m", 100.0), ("-", None)])
def test_drives_that_hold_forces_pull_by_tensions(unit, newtons):
    robot = Robot.outline(
        name="arm", length=0.2, radius=0.02, markers={"tip": 0.2}, command_unit=unit, usual_command=2.0
    )
    assert robot.held_by_force
    assert robot.initial_displacement_names == ()
    gain = np.asarray(robot.channel_matrix(robot.nominal()))
    if newtons is None:  # the usual command bends the body by a usual pull, 0.15 of the length
        inertia, arm = np.pi / 4 * 0.02**4, 0.75 * 0.02
        newtons = 1e6 * inertia * 0.15 / arm**2 / 2.0
    np.testing.assert_allclose(gain, newtons * np.eye(4), rtol=1e-6)
    assert robot.drive_limits()[0, 1] == pytest.approx(5.0 * 2.0 * newtons, rel=1e-5)


def test_segments_have_lengths_of_their_own():
    lengths = (0.06, 0.0625, 0.064)
    given = {"name": "arm", "radius": 0.01, "markers": {"tip": 0.18}, "segments": 3, "cables": 3}
    robot = Robot.outline(**given, length=sum(lengths), segment_lengths=lengths)
    ends = [guides[-1, 2] for guides in robot.guides()]
    np.testing.assert_allclose(ends, np.repeat(np.cumsum(lengths), 3), atol=1e-6)
    with pytest.raises(InputError, match="do not make up the body"):
        Robot.outline(**given, length=0.2, segment_lengths=lengths)


def test_segments_of_disks_end_at_disks_of_their_own():
    given = {"name": "arm", "radius": 0.01, "markers": {"tip": 0.18}, "segments": 2, "cables": 3, "shape": "disks"}
    with pytest.raises(InputError, match="two segments end at one disk"):
        Robot.outline(**given, length=0.2, segment_lengths=(0.199, 0.001))


@pytest.mark.parametrize(
    ("unit", "assumed"), [("rad", "spool_radius"), ("m", "cable_radius"), ("N", "young_modulus"), ("Pa", "area")]
)
def test_a_robot_of_another_size_bends_by_the_given_factor(unit, assumed):
    """Bend of a command: pull over the cables' distance, or tension times distance and length over the stiffness."""
    unknown = frozenset({"length", "radius", "markers", assumed})
    small = RobotOutline("arm", 0.2, 0.012, {"tip": 0.2}, command_unit=unit, assumed=unknown)
    large = small.resized(1.5, 2.0, 2.0 if unit == "N" else 1.0, "measured")

    def bend(o: RobotOutline) -> float:
        if unit == "N":
            return o.arm * o.length / (o.young_modulus * o.radius**4)
        if unit == "Pa":
            return o.chamber_area * o.arm * o.length / o.radius**4
        return (o.spool_radius if unit == "rad" else 1.0) / o.arm

    assert small.sets_bend == assumed
    assert bend(large) == pytest.approx(2.0 * bend(small), rel=0.01)  # sizes have three digits
    assert (large.length, large.markers["tip"]) == pytest.approx((0.3, 0.3))
    assert "measured" in robot_text(large)
    assert RobotOutline("arm", 0.2, 0.012, {"tip": 0.2}).sets_bend is None
