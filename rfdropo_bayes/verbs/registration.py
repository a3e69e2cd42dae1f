"""How a first recording lies to its robot at rest: order and azimuth of the cables, and the measuring frame.

A rod at rest under the recorded commands is compared with the measured positions. Cables are arranged by
`order_finder`; the frame is the rotation, the shift and, for a body of unknown length, the scale that bring the rod to
the measured positions (Kabsch 1976, Umeyama 1991).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.verbs.arrangement import Arrangement
from rfdropo_bayes.verbs.at_rest import RestingRobot, resting, rows_of, spread_rows
from rfdropo_bayes.verbs.command_lag import best_delay
from rfdropo_bayes.verbs.motion_check import LEFT, SOLVED
from rfdropo_bayes.verbs.motion_direction import AGREEING
from rfdropo_bayes.verbs.order_finder import ROWS, arranged, find_arrangement
from rfdropo_bayes.verbs.placement import right_angles

EXPLAINED = 0.5
"""Least share of the squared motion that the rod explains in a frame that is taken from it."""


class Frame(NamedTuple):
    """The measured positions are ``scale * rotation @ simulated + shift``.

    Attributes:
        explained: share of the squared motion that this leaves no part of.
    """

    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]  # [m]
    scale: float
    explained: float

    @property
    def quarter(self) -> Float[np.ndarray, "3 3"]:
        """The rotation by right angles that is nearest to the frame's."""
        return max([np.eye(3), *right_angles()], key=lambda matrix: float(np.sum(matrix * self.rotation)))

    @property
    def left_over(self) -> Float[np.ndarray, "3"]:
        """Rotation vector that is left of the frame's, once it is turned back by right angles [rad]."""
        return Rotation.from_matrix(self.quarter.T @ self.rotation).as_rotvec()


class Registration(NamedTuple):
    """How a recording lies to its robot at rest.

    Attributes:
        frame: frame that brings the robot to the recording; None if the robot explains the motion in no frame.
        arrangement: order of the commands, if it explains much more than the written order.
        evidence: reason for the arrangement, in words.
    """

    frame: Frame | None
    arrangement: Arrangement | None = None
    evidence: str = ""


def frame_of(
    made: Float[np.ndarray, "row marker 3"], seen: Float[np.ndarray, "row marker 3"], *, scaled: bool
) -> Frame:
    """The frame that brings simulated markers nearest to the measured markers; missing positions are left out."""
    both = np.isfinite(made).all(axis=2) & np.isfinite(seen).all(axis=2)
    still = np.nanmean(np.where(both[..., None], seen, np.nan), axis=0)
    motion = np.sum((seen - still)[both] ** 2)  # about each marker's own mean: distances between markers are no motion
    made, seen = made[both], seen[both]
    centre, place = made.mean(axis=0), seen.mean(axis=0)
    left, size, right = np.linalg.svd((seen - place).T @ (made - centre))
    proper = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = left @ np.diag(proper) @ right
    scale = float(np.sum(size * proper) / np.sum((made - centre) ** 2)) if scaled else 1.0
    moved = scale * made @ rotation.T
    shift = place - moved.mean(axis=0)
    if motion == 0.0:
        return Frame(rotation, shift, scale, 0.0)
    return Frame(rotation, shift, scale, float(1.0 - np.sum((moved + shift - seen) ** 2) / motion))


def register(spec: ModelSpec, recording: Trajectory, *, scaled: bool) -> Registration:
    """Bring the robot of a model, at rest and at nominal values, to a recording.

    Args:
        spec: model of a robot that can be at rest.
        recording: recording as it is read at present.
        scaled: whether the body's length is not known, so that lengths may be scaled.
    """
    nothing = Registration(None)
    try:
        robot = resting(spec)
    except InputError:
        return nothing
    own = robot.simulator.robot
    if len(own.channel_names) != len(recording.cable_names) or set(recording.marker_names) != set(own.marker_names):
        return nothing
    robot = robot.showing(recording.marker_names)
    rows = rows_of([recording], recording.marker_names, best_delay([recording]))
    rows = rows.of(spread_rows(rows, ROWS))

    def seen_by(robot: RestingRobot, command: Float[np.ndarray, "row channel"]) -> Frame | None:
        made = robot.markers(command)[0]
        if np.isfinite(made).all(axis=(1, 2)).mean() < SOLVED:
            return None
        return frame_of(made, rows.position, scaled=scaled)

    written = seen_by(robot, rows.command)
    if written is None:
        return nothing
    found = find_arrangement(robot, rows)
    positive = all(sign > 0 for sign in found.arrangement.signs)
    if found.agreement >= AGREEING and found.left <= LEFT and positive and not found.rivals and not found.mirrored:
        better = seen_by(arranged(robot, found.arrangement), found.arrangement.commands(rows.command))
        if better is not None and 1.0 - better.explained <= LEFT * (1.0 - written.explained):
            evidence = (
                f"the motion agrees to {found.agreement:.2f} with a rod at rest, and to {found.written.straight:.2f} "
                "without"
            )
            return Registration(better if better.explained >= EXPLAINED else None, found.arrangement, evidence)
    return Registration(written if written.explained >= EXPLAINED else None)
