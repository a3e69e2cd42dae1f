"""The robot as it is installed: zeros of its cables, its frame and its drives as parameters of the base model.

Every real robot has them, and no drawing has their values. Priors have the sizes of the robot and of its recording:
shares of the largest pull and of the body's length, and angles of a frame that was put up by hand.
"""

from __future__ import annotations

import numpy as np

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.robots import Robot

ZERO = 0.25
"""Standard deviation of the zero of a cable over the largest pull. A silicone arm that pulls 8 mm had zeros of up to
1.5 mm, and a slack of 2 mm on another day."""
ORIGIN = 0.05
"""Standard deviation of the frame's origin over the body's length."""
TILT, TURN = 0.1, 0.5
"""Standard deviations of the frame's tilt, and of its turn about the body's axis [rad]. That arm's frame was turned by
0.3 rad."""
GAIN = 0.1
"""Standard deviation of the relative error of a command in metres of cable."""
FEWEST_ROWS = 60
"""Rows of a recording whose last third, 20 rows, is worth a test."""


def largest_pull(robot: Robot, recording: Trajectory) -> float:
    """Largest displacement of a cable that the commands of a recording ask for [m], at nominal parameters."""
    commands = np.vstack([recording.initial_command, recording.command])
    return float(np.max(np.abs(commands @ np.asarray(robot.channel_matrix(robot.nominal())).T)))


def installed_mechanisms(robot: Robot) -> list[str]:
    """Mechanisms of the base model: the measuring frame, the body's stiffness in tension, the gain of the drives."""
    gain = ["command_gain"] if robot.command_unit == "m" else []
    return ["axial_stiffness", "camera_rotation", *gain]


def installed_priors(robot: Robot, recording: Trajectory | None) -> list[str]:
    """Lines of [model.priors] of a robot as it is installed, from its sizes and its first recording."""
    lines = []

    def normal(name: str, scale: float, words: str) -> None:
        lines.append(f'{name} = {{ distribution = "Normal", loc = 0.0, scale = {scale:.2g} }}  # {words}')

    if robot.initial_displacement_names:
        pull = robot.stroke if recording is None else largest_pull(robot, recording)
        if pull > 0.0:
            normal("initial_displacement", ZERO * pull, f"zero of every cable: {ZERO:g} of the largest pull")
    normal("offset", ORIGIN * robot.length, f"origin of the measuring frame: {ORIGIN:g} of the body's length")
    for axis in "xy":
        normal(f"camera_rotation_{axis}", TILT, "tilt of the measuring frame")
    normal("camera_rotation_z", TURN, "its turn about the body's axis")
    if robot.command_unit == "m":
        normal("command_gain_error", GAIN, "travel of a cable over its command, less 1")
    lines.append("axial_stiffness = {}  # in tension, over that which the profile has for its bending")
    return lines


def rows_to_fit(recording: Trajectory | None) -> tuple[list[int], list[int]] | None:
    """First and last row to fit and to test of a recording that stands alone; None for one that is too short."""
    count = 0 if recording is None else len(recording.time)
    if count < FEWEST_ROWS:
        return None
    cut = 2 * count // 3
    return [0, cut - 1], [cut, count - 1]
