"""Cables driven by a tension: what a robot file says of them, and what does not hold together."""

from __future__ import annotations

import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Robot

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


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: pulled(command={"unit": "m", "ramp_s": 0.0, "dead_time_s": 0.0}),
            "driven in N, and commands are in m",
        ),
        (lambda: pulled(parameters=ARM.parameters), r"nothing uses the table \[parameters.initial_displacement\]"),
    ],
)
def test_drives_that_do_not_fit_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
