"""One rule of sizes: a robot that is scaled in all lengths, masses and forces has mechanisms scaled alike."""

import numpy as np
import pytest

from rfdropo_bayes.mechanisms import mechanisms_named
from rfdropo_bayes.mechanisms.drift import rates_over
from rfdropo_bayes.mechanisms.registry import REGISTRY
from rfdropo_bayes.mechanisms.sizes import POWERS, USUAL, Scales, scales_of, sized
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.mechanisms import obstacle
from rfdropo_bayes.simulators.parameters import ParameterSpec

RATIOS = Scales(pull=3.0, length=3.0, mass=7.0, force=5.0)


def arm(length: float = 0.2, mass: float = 0.1, modulus: float = 1e6, unit: str = "m") -> Robot:
    return Robot.outline(
        name="arm",
        length=length,
        radius=0.1 * length,
        markers={"tip": length},
        mass=mass,
        young_modulus=modulus,
        command_unit=unit,
    )


def priors(robot: Robot) -> dict[str, tuple[str, float]]:
    """Unit and size of every prior with one scale, by parameter."""
    specs = [spec for m in mechanisms_named(REGISTRY, robot) for spec in m.parameters]
    return {spec.name: (spec.unit, spec.prior["scale"]) for spec in specs if "scale" in spec.prior}


def test_mechanisms_scale_as_their_units_do():
    """Three times as long, seven times as heavy, and bent by five times the force: E scales as force over area."""
    small, large = arm(), arm(length=0.6, mass=0.7, modulus=1e6 * 5.0 / 9.0)
    assert np.array(scales_of(large)) / scales_of(small) == pytest.approx(np.array(RATIOS))
    before, after = priors(small), priors(large)
    commanded = {"cable_slack", "backlash", "drive_zero", "cable_slack_rate", "drive_zero_rate"}
    for name, (unit, size) in before.items():
        if name in commanded or unit in POWERS:
            powers = np.array(Scales(1, 0, 0, 0) if name in commanded else POWERS[unit])
            assert after[name][1] / size == pytest.approx(np.prod(np.array(RATIOS) ** powers)), name
        elif unit in ("-", "rad", "s", "1/s", "kg/m3"):
            assert after[name][1] == size, name


def test_a_usual_command_that_is_stated_sets_the_sizes_of_drives():
    robot = arm(unit="rad")
    stated = robot.with_changes(command=robot.command.model_copy(update={"usual": 2.0 * robot.usual_command}))
    assert priors(stated)["cable_slack"][1] == pytest.approx(2.0 * priors(robot)["cable_slack"][1])
    assert priors(stated)["camera_offset_x"] == priors(robot)["camera_offset_x"]


def test_the_usual_trunk_keeps_its_numbers():
    spec = ParameterSpec("give", "m/N", 0.0, 0.1, 0.0, {"distribution": "HalfNormal", "scale": 5e-4}, "stretch")
    assert sized(spec, USUAL) == spec


def test_a_mechanism_in_time_needs_rows_with_times():
    """A lag and a drift have a time in the unit of a parameter; slack and a payload have none."""
    robot = Robot.load("smooth_arm")
    chosen = mechanisms_named(["actuator_lag", "camera_offset_drift", "rate_limit", "cable_slack", "payload"], robot)
    whys = [obstacle(mechanism, "rod", "numba", "quasi-static", timed=False) for mechanism in chosen]
    assert [why is None for why in whys] == [False, False, False, True, True]
    assert all(obstacle(m, "rod", "numba", "quasi-static") is None for m in chosen)


def test_a_size_drifts_by_its_own_prior_over_a_recording():
    """A minute or an hour: the change from start to end has the scale of the mechanism that drifts."""
    drift, size = mechanisms_named(["camera_offset_drift", "camera_offset"], Robot.load("smooth_arm"))
    other = ParameterSpec("rate", "1/s", 0.0, 1.0, 0.0, {"distribution": "HalfNormal", "scale": 0.1}, "of a law")
    for seconds in (60.0, 3600.0):
        *rates, same = rates_over(seconds, (*drift.parameters, other), (drift, size))
        assert same == other
        assert [seconds * each.prior["scale"] for each in rates] == pytest.approx(
            [each.prior["scale"] for each in size.parameters]
        )


def test_wider_disks_on_a_backbone_hardly_change_the_force_that_bends_a_robot():
    given = {"name": "arm", "length": 0.18, "cable_radius": 0.0045, "markers": {"tip": 0.18}, "young_modulus": 5e10}
    disks = [Robot.outline(**given, shape="disks", radius=r, inner_radius=0.0006) for r in (0.006, 0.012)]
    assert scales_of(disks[1]).force == pytest.approx(scales_of(disks[0]).force, rel=1e-3)
