"""The installed robot: zeros of cables, frame and drives as parameters of the base model.

Every real robot has these offsets, and no drawing gives their values. Prior widths depend on the robot and its
recording: shares of the largest pull and of the body's length, and angles of a frame that was aligned by hand.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.data.first_command import far_from_zero
from rfdropo_bayes.mechanisms.actuation import GuideAzimuth
from rfdropo_bayes.mechanisms.sizes import scales_of
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.verbs.arrangement import sections_of
from rfdropo_bayes.verbs.registration import UNSTATED, Frame, lies

ZERO = 0.25
"""Standard deviation of the zero of a cable over the largest pull. A silicone arm that pulls 8 mm had zeros of up to
1.5 mm, and a slack of 2 mm on another day."""
ALIKE = 0.05  # share of a channel's range by which the commands may differ at which recordings begin: measured, they do
ORIGIN = 0.05  # standard deviation of the frame's origin over the body's length
TILT, TURN = 0.1, 0.5
"""Standard deviations of the frame's tilt, and of its turn about the body's axis [rad]. That arm's frame was turned by
0.3 rad."""
GAIN = 0.1  # standard deviation of the relative error of a command in metres of cable
UNKNOWN = 0.5
"""The same of a robot whose cables' distance from the axis, or whose length, was not given; and of inputs of drives,
whose force per command no answer states, as of pressures in chambers of unknown area."""


class DriveZero(NamedTuple):
    """Commands [m or rad] at which the body is about straight, and how they are known."""

    command: Float[np.ndarray, " channel"]
    words: str


def zero_of_drives(recordings: Sequence[Trajectory], *, wraps: bool) -> DriveZero | None:
    """The zero of drives that have their own, as servos at 2048 counts; None if zero commands are near.

    Args:
        recordings: of one robot, with commands of imposed lengths.
        wraps: whether commands are counts that begin anew after a turn, whose zero is anywhere.
    """
    if not wraps and not all(far_from_zero(run.command) for run in recordings):
        return None
    sent = np.concatenate([run.command for run in recordings])
    first = np.array([run.command[0] for run in recordings])
    if wraps or (np.ptp(first, axis=0) > ALIKE * np.ptp(sent, axis=0)).any():
        return DriveZero(sent.mean(axis=0), "the mean of the commands")
    return DriveZero(first.mean(axis=0), "the command at which recordings begin")


def largest_pull(robot: Robot, recording: Trajectory, zero: Float[np.ndarray, " channel"] | float = 0.0) -> float:
    """Largest displacement of a cable that the commands of a recording ask for [m], at nominal parameters, from a zero
    of the drives on.
    """
    commands = np.vstack([recording.initial_command, recording.command]) - zero
    return float(np.max(np.abs(commands @ np.asarray(robot.channel_matrix(robot.nominal())).T)))


def installed_mechanisms(robot: Robot, assumed: Collection[str] = ()) -> list[str]:
    """Mechanisms of the base model: the measuring frame, the body's stiffness in tension, the gain of the drives, the
    scale of lengths if the body's length was ``assumed``, the stretch of cables that pull against each other, and of a
    robot with several sections, which are turned by hand, the azimuths of its cables. Gravity turns about the axis of a
    body that lies, if the azimuths of its cables were assumed."""
    gain = ["command_gain"] if robot.command_unit in ("m", *UNSTATED) else []
    scale = ["camera_scale"] if "length" in assumed else []
    stretch = ["cable_compliance"] if _pulled_by_section(robot) or _hardly_shortens(robot) else []
    sections = ["guide_azimuth"] if _turned_by_hand(robot) else []
    tilt = ["base_tilt"] if lies(robot) and "segment_azimuths" in assumed else []
    return ["axial_stiffness", "camera_rotation", *gain, *scale, *stretch, *sections, *tilt]


def _pulled_by_section(robot: Robot) -> bool:
    """Whether cables of imposed lengths end at several heights."""
    return robot.actuators[0].unit == "m" and sections_of(robot).number > 1


def _turned_by_hand(robot: Robot) -> bool:
    """Whether the cables of several sections have azimuths of their own; cables that share a drive have none."""
    return _pulled_by_section(robot) and bool(GuideAzimuth.for_robot(robot).parameters)


def _first_section(robot: Robot) -> list[str]:
    """The channels of the cables that end lowest."""
    ends = [robot.cables[int(np.argmax(np.abs(column)))].guide_z_m[-1] for column in np.array(robot.channels.gain).T]
    return [channel for channel, end in zip(robot.channel_names, ends, strict=True) if end == min(ends)]


def _hardly_shortens(robot: Robot) -> bool:
    """Whether zeros of cables of imposed lengths would press a body, such as a metal backbone, by more than the tension
    that bends it: the cables stretch instead."""
    sizes, length = scales_of(robot), np.diff(robot.body.station_m)
    give = float(np.sum(length / np.array(robot.body.axial_area_m2))) / robot.nominal()["young_modulus"]
    return robot.actuators[0].unit == "m" and ZERO * sizes.pull > give * sizes.force


def installed_priors(
    robot: Robot,
    recording: Trajectory | None,
    frame: Frame | None = None,
    assumed: Collection[str] = (),
    gain: float = 1.0,
    zero: DriveZero | None = None,
) -> list[str]:
    """Lines of [model.priors] of a robot as it is installed.

    Args:
        robot: robot whose lengths set the sizes of the priors.
        recording: recording whose commands set the sizes of the cables' zeros.
        frame: frame in which a rod at rest explains that recording; priors are centred there.
        assumed: unknown sizes of the robot, which get wide priors.
        gain: force of drives that explains that recording, over the robot file's, if no answer states it.
        zero: zero of drives that have their own.
    """
    lines = []

    def normal(name: str, scale: float, words: str, loc: float = 0.0) -> None:
        lines.append(f'{name} = {{ distribution = "Normal", loc = {loc:.3g}, scale = {scale:.2g} }}  # {words}')

    if robot.initial_displacement_names:
        from_zero = 0.0 if zero is None else zero.command
        pull = scales_of(robot).pull if recording is None else largest_pull(robot, recording, from_zero)
        if pull > 0.0 and zero is not None:
            wound = np.asarray(robot.channel_matrix(robot.nominal())) @ zero.command
            lengths = "; lengths of cables are to be written as pulls" if robot.command_unit == "m" else ""
            lines.append(f"# ASSUMED: drives have zeros of their own, {zero.words}{lengths}")
            for name, place in zip(robot.initial_displacement_names, wound, strict=True):
                normal(name, ZERO * pull, f"zero of the cable: {ZERO:g} of the largest pull", -place)
        elif pull > 0.0:
            normal("initial_displacement", ZERO * pull, f"zero of every cable: {ZERO:g} of the largest pull")
    turn, shift = (np.zeros(3), np.zeros(3)) if frame is None else (frame.remaining_turn, frame.shift)
    explained = "" if frame is None else f"; a rod at rest explains {100 * frame.explained:.3g} % of the motion there"
    for axis, place in zip("xyz", shift, strict=True):
        words = f"origin of the measuring frame: {ORIGIN:g} of the body's length"
        normal(f"offset_{axis}", ORIGIN * robot.length, words, place)
    for axis, angle, wide in zip("xyz", turn, (TILT, TILT, TURN), strict=True):
        normal(f"camera_rotation_{axis}", wide, f"turn of the measuring frame{explained}", angle)
    if lies(robot) and "segment_azimuths" in assumed:
        normal("base_tilt", TILT, "direction of gravity, about the axis and along it")
    if robot.command_unit == "m":
        wide = UNKNOWN if "cable_radius" in assumed else GAIN
        normal("command_gain_error", wide, "travel of a cable over its command, less 1")
    if robot.command_unit in UNSTATED:
        stated = robot.command_unit == "Pa" and "area" not in assumed and gain == 1.0
        wide = GAIN if stated else UNKNOWN
        normal("command_gain_error", wide * gain, "force of a drive over that of the robot file, less 1", gain - 1.0)
    if "length" in assumed:
        normal("camera_scale_error", UNKNOWN, "lengths over the robot file's lengths, less 1")
    if _pulled_by_section(robot) or _hardly_shortens(robot):
        lines.append("cable_compliance = {}  # stretch of a cable over its tension")
    if _turned_by_hand(robot):
        told = "segment_azimuths" not in assumed
        words = "over the drawing's" if told else "by a turn of their section, which was not given"
        normal("guide_azimuth_error", TILT if told else TURN, f"azimuth of the cables of a channel, {words}")
        for channel in [] if told else _first_section(robot):
            normal(f"guide_azimuth_error_{channel}", TILT, "the first section turns with the measuring frame")
    lines.append("axial_stiffness = {}  # in tension, over that which the profile has for its bending")
    return lines
