"""The robot as it is installed: sizes of its priors follow the robot and its recording."""

from functools import partial

import numpy as np
import pytest

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.inference.method_options import options_table
from rfdropo_bayes.inference.modes.mode_search import LaplaceConfig
from rfdropo_bayes.model.experiment_file import describe
from rfdropo_bayes.model.run_folder import CONFIG
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.verbs.budget import FEWEST_DRAWS, FEWEST_ROLLOUTS, MOST_DRAWS, budget_within
from rfdropo_bayes.verbs.calibrate import _budgeted
from rfdropo_bayes.verbs.installation import (
    ORIGIN,
    ZERO,
    DriveZero,
    installed_mechanisms,
    installed_priors,
    largest_pull,
    zero_of_drives,
)


def arm(scale: float = 1.0, unit: str = "rad") -> Robot:
    return Robot.outline(
        name="arm", length=0.2 * scale, radius=0.02 * scale, markers={"tip": 0.2 * scale}, command_unit=unit
    )


def run(unit: str, size: float, rows: int = 90) -> Trajectory:
    command = np.zeros((rows, 4))
    command[:, 1] = -size * np.linspace(0.0, 1.0, rows)
    return recorded(unit, command)


def recorded(unit: str, command: np.ndarray, start: str = "zero") -> Trajectory:
    time = 0.1 * np.arange(len(command))
    return Trajectory.from_arrays(
        time=time,
        time_unit="s",
        position=0.1 * np.sin(time)[:, None, None] * np.ones(3),
        position_unit="m",
        markers=("tip",),
        channels=tuple(f"c{k}" for k in range(4)),
        command=command,
        command_unit=unit,
        initial_command=start,
        name="run",
    )


def priors_of(lines: list[str]) -> dict[str, float]:
    return {line.split(" = ")[0]: float(line.split("scale = ")[1].split(" ")[0]) for line in lines if "scale" in line}


@pytest.mark.parametrize("scale", [1.0, 0.1, 7.0])
def test_sizes_follow_the_robot_and_its_commands(scale):
    size = 0.012 * scale / 0.01
    sent = run("rad", size)
    robot = arm(scale)
    assert largest_pull(robot, sent) == pytest.approx(0.01 * size)
    found = priors_of(installed_priors(robot, sent))
    assert found["initial_displacement"] == pytest.approx(ZERO * 0.01 * size, rel=0.05)
    assert found["offset_x"] == pytest.approx(ORIGIN * 0.2 * scale, rel=0.05)
    assert "command_gain_error" not in found


def test_cables_in_metres_have_a_gain_and_angles_their_spool():
    assert "command_gain" in installed_mechanisms(arm(unit="m"))
    assert "command_gain" not in installed_mechanisms(arm())
    assert "command_gain_error" in priors_of(installed_priors(arm(unit="m"), None))


def test_zeros_without_a_recording_are_lengths_of_cable_whatever_the_unit_of_commands():
    in_metres, in_angles = (priors_of(installed_priors(arm(unit=unit), None)) for unit in ("m", "rad"))
    assert in_angles["initial_displacement"] == pytest.approx(in_metres["initial_displacement"], rel=0.05)


def test_zeros_of_drives_that_count_from_anywhere_are_centred_at_the_mean_of_the_commands():
    robot, zero = arm(), np.array([3.0, -1.0, 0.5, 2.0])[: len(arm().channel_names)]
    lines = installed_priors(robot, run("rad", 2.0), zero=DriveZero(zero, "the mean of the commands"))
    wound = np.asarray(robot.channel_matrix(robot.nominal())) @ zero
    for name, place in zip(robot.initial_displacement_names, wound, strict=True):
        assert any(line.startswith(f"{name} = ") and f"loc = {-place:.3g}," in line for line in lines)


@pytest.mark.parametrize(
    ("rest", "moved", "zero"),
    [
        (3.1, 1.0, 3.1),  # a servo in the middle of its counts
        (1.6, -1.0, 1.6),  # at 90 degrees
        (0.0, 1.0, None),  # cables that are pulled in
        (0.2, 1.0, None),  # and that a little tension keeps straight
    ],
)
def test_drives_that_never_come_near_zero_have_a_zero_of_their_own(rest, moved, zero):
    going = moved * np.random.default_rng(0).random((2, 90, 4))
    going[:, 0] = 0.01 * going[:, 1]  # the drives' places were measured
    runs = [recorded("rad", rest + each, "first") for each in going]
    found = zero_of_drives(runs, wraps=False)
    assert (found is None) == (zero is None)
    if found is not None:
        np.testing.assert_allclose(found.command, zero, atol=0.01)
        assert found.words == "the command at which recordings begin"
        elsewhere = [runs[0], recorded("rad", rest + going[1][::-1], "first")]
        assert zero_of_drives(elsewhere, wraps=False).words == "the mean of the commands"


def test_steps_that_are_held_from_rest_on_are_no_zeros():
    held = [recorded("rad", np.full((90, 4), level)) for level in (0.5, 0.9)]
    assert zero_of_drives(held, wraps=False) is None
    assert zero_of_drives([recorded("rad", np.full((90, 4), 0.5), "first")], wraps=False) is None


def test_commands_that_never_move_leave_zeros_fixed():
    assert "initial_displacement" not in priors_of(installed_priors(arm(), run("rad", 0.0)))


def test_cables_of_an_arm_with_sections_stretch_and_are_turned():
    """Sections are put together by hand, and their cables pull against each other."""
    several = partial(Robot.outline, name="arm", length=0.2, radius=0.02, markers={"tip": 0.2}, segments=2)
    robot = several(command_unit="m")
    assert {"cable_compliance", "guide_azimuth"} <= set(installed_mechanisms(robot))
    wide, narrow = (priors_of(installed_priors(robot, None, None, known)) for known in (["segment_azimuths"], []))
    assert wide["guide_azimuth_error"] == 5 * narrow["guide_azimuth_error"]
    # The turn of the first section is that of the measuring frame: its cables are evenly around it.
    assert {name for name in wide if name.startswith("guide_azimuth_error_")} == {
        f"guide_azimuth_error_s1_pull_{k}" for k in range(1, 5)
    }
    assert wide["guide_azimuth_error_s1_pull_1"] == narrow["guide_azimuth_error"]
    assert "guide_azimuth" not in installed_mechanisms(several(command_unit="m", pairs=True))
    forces = several(command_unit="N")
    assert not {"cable_compliance", "guide_azimuth"} & {*installed_mechanisms(forces), *installed_mechanisms(arm())}


def test_cables_of_a_metal_backbone_stretch_before_it_shortens():
    disks = {"shape": "disks", "radius": 0.006, "inner_radius": 0.0006, "cable_radius": 0.0045, "young_modulus": 5e10}
    backbone = Robot.outline(name="arm", length=0.18, markers={"tip": 0.18}, command_unit="m", **disks)
    assert "cable_compliance" in installed_mechanisms(backbone)
    assert any(line.startswith("cable_compliance = {}") for line in installed_priors(backbone, None))
    assert "cable_compliance" not in installed_mechanisms(arm(unit="m"))


def test_gravity_turns_about_an_arm_that_lies_with_unknown_azimuths():
    lying = Robot.outline(name="arm", length=0.2, radius=0.02, markers={"tip": 0.2}, gravity="-y")
    known = ["segment_azimuths"]
    assert "base_tilt" in priors_of(installed_priors(lying, None, None, known))
    found = [installed_mechanisms(robot, given) for robot, given in ((lying, known), (lying, ()), (arm(), known))]
    assert ["base_tilt" in each for each in found] == [True, False, False]


def test_a_budget_in_minutes_follows_the_time_of_a_rollout():
    slow, fast = budget_within(3.0, 1.0, 1.5), budget_within(3.0, 0.01, 1.5)
    assert slow.rollouts == pytest.approx(90)
    assert fast.rollouts == pytest.approx(9000)
    assert slow.draws == pytest.approx(24)
    assert fast.draws == MOST_DRAWS
    starved = budget_within(0.01, 10.0, 1.0)
    assert starved == (FEWEST_ROLLOUTS, FEWEST_DRAWS)


def test_a_timed_budget_is_written_down_and_a_resumed_run_keeps_it(tmp_path):
    """The clock decides once: the folder states the rollouts, whatever a second timing would say."""
    first = _budgeted(LaplaceConfig(blocks=1), 120, None)
    assert (first.rollouts, first.draws, first.blocks) == (120, 200, 1)
    text = describe({"inference": {"method": "laplace", **options_table(first)}})
    (tmp_path / CONFIG).write_text(text)
    assert _budgeted(LaplaceConfig(blocks=1), 9000, tmp_path) == first
    assert _budgeted(LaplaceConfig(blocks=1), 9000, None).draws == 2000
