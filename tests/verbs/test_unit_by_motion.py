"""A guessed unit of commands is believed if it bends the robot as far as its markers moved."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes.data.named_columns import COMMAND_UNITS
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.verbs.column_units import Unit
from rfdropo_bayes.verbs.unit_by_motion import bends_too_far, driven_motion, lengths_for_angles, spread, unit_of_motion

ANSWERS = {"name": "cone", "length": 0.2, "radius": 0.015, "markers": {"middle": 0.1, "tip": 0.2}}
HEIGHTS = {"middle": 0.1, "tip": 0.2}
TIME = np.linspace(0.0, 6.0, 90)


def robot(segments: int = 1, unit: str = "m") -> Robot:
    spool = {"spool_radius": 0.01} if unit == "rad" else {}
    return Robot.outline(**ANSWERS, segments=segments, cables=4, cable_radius=0.01, command_unit=unit, **spool)


def opposed(size: float, segments: int = 1) -> np.ndarray:
    """Cables of the last segment in turn, the one across let out."""
    pull = size * np.column_stack([np.sin(TIME), np.cos(0.7 * TIME), -np.sin(TIME), -np.cos(0.7 * TIME)])
    return np.hstack([np.zeros((len(TIME), 4 * (segments - 1))), pull])


def test_one_segment_bends_to_an_arc():
    """The tip of an arc of length L and turn d / r is L (1 - cos(turn)) / turn off, as is a marker at half of it."""
    command = np.array([[0.004, 0.0, -0.004, 0.0]])
    found = driven_motion(robot(), command, [0.1, 0.2])[0]
    azimuth = np.radians(robot().cables[0].azimuth_deg)
    radius = np.mean([robot().cables[0].anchor_radius_m, *robot().cables[0].guide_radius_m])
    turn = 0.004 / radius
    way = [0.2 / turn * (1.0 - np.cos(turn * h)) for h in (0.5, 1.0)]
    assert np.linalg.norm(found, axis=1) == pytest.approx(way, rel=0.04)
    assert found / np.linalg.norm(found, axis=1, keepdims=True) == pytest.approx(
        np.tile([np.cos(azimuth), np.sin(azimuth)], (2, 1)), abs=1e-6
    )


@pytest.mark.parametrize("segments", [1, 2])
@pytest.mark.parametrize(("true", "guessed"), [("cm", "mm"), ("mm", "mm"), ("m", "mm"), ("mm", "m"), ("m", "m")])
def test_the_unit_that_explains_the_motion_is_taken_with_its_evidence(segments, true, guessed):
    arm, size = robot(segments), COMMAND_UNITS[true][1]
    command = opposed(0.005 / size, segments)
    across = 1.6 * driven_motion(arm, size * command, list(HEIGHTS.values()))  # a body is no arc
    position = np.concatenate([across, np.full((*across.shape[:2], 1), 0.1)], axis=2)
    position[3, 0], position[4, 1] = np.nan, 0.0
    found = unit_of_motion(arm, command, position, HEIGHTS, Unit(guessed, evidence="c1 to c4 reach 5"))
    assert found.unit == true
    position[4, 1] = np.nan
    assert found.evidence.startswith(f"c1 to c4 reach 5; the markers move by {1e3 * spread(position):.3g} mm")
    assert f"in {guessed} " in found.evidence


def test_degrees_are_told_from_radians_and_other_units_are_left():
    arm = robot(unit="rad")
    position = driven_motion(arm, opposed(0.5), list(HEIGHTS.values()))
    position = np.concatenate([position, np.zeros((*position.shape[:2], 1))], axis=2)
    assert unit_of_motion(arm, opposed(0.5 * 180 / np.pi), position, HEIGHTS, Unit("rad")).unit == "deg"
    for unit in ("N", "mm"):  # forces impose no motion, and lengths of cable are no commands of a motor
        assert unit_of_motion(arm, opposed(1.0), position, HEIGHTS, Unit(unit)) == Unit(unit)


@pytest.mark.parametrize(("true", "lengths"), [("mm", True), ("rad", False), ("deg", False)])
def test_angles_that_no_body_bends_by_are_lengths_if_these_explain_the_motion(true, lengths):
    turned, pulled, heights = robot(unit="rad"), robot(), list(HEIGHTS.values())
    own, size = (pulled, 1e-3) if lengths else (turned, COMMAND_UNITS[true][1])
    command = opposed(0.005 / (size if lengths else 0.01 * size))
    across = 1.2 * driven_motion(own, size * command, heights)
    position = np.concatenate([across, np.full((*across.shape[:2], 1), 0.1)], axis=2)
    found = lengths_for_angles(turned, pulled, command, position, heights)
    assert (found is not None) == lengths
    assert found is None or found.startswith("in mm ")


def test_a_motion_that_no_unit_explains_keeps_the_guess():
    position = np.random.default_rng(0).normal(size=(90, 2, 3))
    found = unit_of_motion(robot(), opposed(1e-4), position, HEIGHTS, Unit("mm", evidence="x"))
    assert found.unit == "mm"
    assert "in mm" in found.evidence
    lost = np.full((90, 2, 3), np.nan)
    assert unit_of_motion(robot(), opposed(1e-4), lost, HEIGHTS, Unit("mm", evidence="x")).evidence == "x"


def test_lengths_that_would_bend_a_body_much_farther_than_it_moved_are_no_lengths():
    """Pressures of 70 kPa, read as 70 mm of cable, would bend the body by more than half a turn."""
    arm, heights = robot(), list(HEIGHTS.values())
    position = np.concatenate([driven_motion(arm, opposed(0.002), heights), np.zeros((len(TIME), 2, 1))], axis=2)
    words = bends_too_far(arm, opposed(0.07), position, heights)
    assert f"the markers move by {1e3 * spread(position):.3g} mm" in words
    assert bends_too_far(arm, opposed(0.004), position, heights) is None
    assert bends_too_far(arm, opposed(0.07), np.full_like(position, np.nan), heights) is None
