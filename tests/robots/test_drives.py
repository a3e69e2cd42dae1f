"""Cables driven by a tension, and chambers: what a robot file says of them, and what does not hold together."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.robots.shape import robot_shape

ARM = Robot.load("smooth_arm")
LIMITS = {"displacement_limit_m": None, "drive": "tension", "tension_limit_n": (0.0, 5.0)}


def without_zeros():
    return {name: p for name, p in ARM.parameters.items() if name != "initial_displacement"}


def pulled(**changes):
    cables = tuple(cable.model_copy(update=LIMITS) for cable in ARM.cables)
    given = {
        "cables": cables,
        "command": {"unit": "N", "ramp_s": 0.0, "dead_time_s": 0.0},
        "parameters": without_zeros(),
    }
    return ARM.with_changes(**{**given, **changes})


def test_tensions_have_limits_and_no_zeros():
    robot = pulled()
    assert robot.drive_limits().tolist() == [[0.0, 5.0]] * len(ARM.cables)
    assert robot.initial_displacement_names == ()
    assert not any(name.startswith("initial_displacement") for name in robot.parameter_table())
    assert robot.stroke == 5.0


CHAMBER = {
    "name": "front", "azimuth_deg": 90.0, "radius_m": 0.005, "z_m": (0.05, 0.15), "area_m2": 2e-5,
    "pressure_limit_pa": (0.0, 5e4),
}  # fmt: skip


def inflated(**changes):
    given = {"cables": (), "chambers": ({**CHAMBER, **changes},), "parameters": without_zeros()}
    channels = {"names": ("air",), "gain": ((1.0,),)}
    return ARM.with_changes(**given, channels=channels, command={"unit": "Pa", "ramp_s": 0.0, "dead_time_s": 0.0})


def test_a_chamber_lies_beside_the_axis():
    robot = inflated()
    assert robot.cable_names == robot.initial_displacement_names == ()
    np.testing.assert_allclose(robot.chambers[0].ends(), [[0.0, 0.005, 0.05], [0.0, 0.005, 0.15]], atol=1e-12)
    assert (robot.stroke, robot.held_by_force) == (5e4, True)
    assert robot_shape(robot)["cables"] == {"front": robot.chambers[0].ends().tolist()}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: pulled(command={"unit": "m", "ramp_s": 0.0, "dead_time_s": 0.0}),
            "driven in N, and commands are in m",
        ),
        (lambda: pulled(parameters=ARM.parameters), r"nothing uses the table \[parameters.initial_displacement\]"),
        (
            lambda: ARM.with_changes(cables=(), channels={"names": ("a",), "gain": ((1.0,),)}),
            "neither cables nor chambers",
        ),
        (lambda: inflated(z_m=(0.15, 0.05)), "does not begin with the end towards the base"),
        (lambda: inflated(z_m=(0.05, 0.25)), "end of front lies outside the body"),
        (lambda: inflated(pressure_limit_pa=(1.0, 2.0)), "does not enclose zero"),
    ],
)
def test_drives_that_do_not_fit_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
