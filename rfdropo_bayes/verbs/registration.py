"""How a first recording lies to its robot at rest: order and azimuth of the cables, sizes, and the measuring frame.

A rod at rest under the recorded commands is compared with the measured positions. Cables are arranged by
`order_finder`, or with two of them exchanged; the frame is the rotation, the shift and, for a body of unknown length,
the scale that bring the rod to the measured positions (Kabsch 1976, Umeyama 1991). If the size that turns a command
into a bend was not given, several are tried: the form of the motion shows how far the body bends.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.verbs.arrangement import Arrangement, as_written, sections_of
from rfdropo_bayes.verbs.at_rest import Rows, resting, rows_of, spread_rows
from rfdropo_bayes.verbs.command_lag import best_delay
from rfdropo_bayes.verbs.motion_check import SOLVED, UNEXPLAINED
from rfdropo_bayes.verbs.motion_direction import AGREEING
from rfdropo_bayes.verbs.order_finder import ALIKE, ROWS, SEARCHED, arranged, find_arrangement
from rfdropo_bayes.verbs.placement import right_angles

EXPLAINED = 0.5  # least share of the squared motion that the rod explains in a frame that is taken from it
BENDS = tuple(np.geomspace(1.0 / 8.0, 8.0, 13))
"""Factors of the bend of a command that are tried if no answer sets it, a factor of 1.4 apart. An arm whose cables lie
at half the assumed distance, and whose spool is a guess, bent 2.1 times as far."""


class Frame(NamedTuple):
    """The measured positions are ``scale * rotation @ simulated + shift``."""

    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]  # [m]
    scale: float
    explained: float  # share of the squared motion that this leaves no part of

    @property
    def quarter(self) -> Float[np.ndarray, "3 3"]:
        """The rotation by right angles that is nearest to the frame's."""
        return max([np.eye(3), *right_angles()], key=lambda matrix: float(np.sum(matrix * self.rotation)))

    @property
    def remaining_turn(self) -> Float[np.ndarray, "3"]:
        """Rotation vector of the frame after its right angles are removed [rad]."""
        return Rotation.from_matrix(self.quarter.T @ self.rotation).as_rotvec()


class Registration(NamedTuple):
    """Frame and arrangement of a recording relative to its robot at rest."""

    # frame that brings the robot to the recording; None if the robot explains the motion in no frame
    frame: Frame | None
    arrangement: Arrangement | None = None  # order of the commands, if it explains much more than the written order
    evidence: str = ""  # reason for the arrangement, in words
    bend: float = 1.0  # bend of the body that explains the recording, over the bend of the robot as written


def frame_of(
    made: Float[np.ndarray, "row marker 3"], seen: Float[np.ndarray, "row marker 3"], *, scaled: bool
) -> Frame:
    """The frame that brings simulated markers nearest to the measured markers; missing positions are left out."""
    both = np.isfinite(made).all(axis=2) & np.isfinite(seen).all(axis=2)
    still = np.nanmean(np.where(both[..., None], seen, np.nan), axis=0)
    motion = np.sum((seen - still)[both] ** 2)  # about each marker's own mean: distances between markers are no motion
    made, seen = made[both], seen[both]
    centre, place = made.mean(axis=0), seen.mean(axis=0)
    first, size, second = np.linalg.svd((seen - place).T @ (made - centre))
    proper = np.array([1.0, 1.0, np.sign(np.linalg.det(first @ second))])
    rotation = first @ np.diag(proper) @ second
    scale = float(np.sum(size * proper) / np.sum((made - centre) ** 2)) if scaled else 1.0
    moved = scale * made @ rotation.T
    shift = place - moved.mean(axis=0)
    if motion == 0.0:
        return Frame(rotation, shift, scale, 0.0)
    return Frame(rotation, shift, scale, float(1.0 - np.sum((moved + shift - seen) ** 2) / motion))


class _Sight(NamedTuple):
    """An arrangement of a robot in the frame, and with the bend, that bring it nearest to a recording."""

    arrangement: Arrangement
    frame: Frame
    bend: float

    @property
    def unexplained(self) -> float:
        """Share of the squared motion that is left."""
        return 1.0 - self.frame.explained


def register(spec: ModelSpec, recording: Trajectory, *, scaled: bool, bends: bool) -> Registration:
    """Bring the robot of a model, at rest and at nominal values, to a recording.

    Args:
        spec: model of a robot that can be at rest.
        recording: recording, read with the present settings.
        scaled: whether the body's length is not known, so that lengths may be scaled.
        bends: whether the bending per command is unknown.
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
    fewer = rows.of(spread_rows(rows, SEARCHED))
    tensions = own.actuators[0].unit != "m"

    def sight(arrangement: Arrangement, of: Rows) -> _Sight | None:
        """The best frame and bend of an arrangement; None if the rod finds no equilibria."""
        sent, turned = arrangement.commands(of.command), arranged(robot, arrangement)
        factors = BENDS if bends else (1.0,)
        if tensions:
            modulus = own.nominal()["young_modulus"] / np.array(factors)
            paths = turned.markers(sent, {"young_modulus": modulus} if bends else None)
        else:
            every = np.concatenate([factor * sent for factor in factors])
            paths = turned.markers(every)[0].reshape(len(factors), len(sent), len(turned.shown), 3)
        solved = [k for k, path in enumerate(paths) if np.isfinite(path).all(axis=(1, 2)).mean() >= SOLVED]
        frames = {k: frame_of(paths[k], of.position, scaled=scaled) for k in solved}
        if not frames:
            return None
        least = 1.0 - max(frame.explained for frame in frames.values())
        alike = [k for k, frame in frames.items() if 1.0 - frame.explained <= ALIKE * least]
        best = min(alike, key=lambda k: abs(np.log(factors[k])))  # small bends are all of one form
        return _Sight(arrangement, frames[best], float(factors[best]))

    start = as_written(len(own.channel_names), sections_of(own).number)
    written = sight(start, rows)
    if written is None:
        return nothing
    chosen, evidence = written, ""
    finding = find_arrangement(robot, rows)
    positive = all(sign > 0 for sign in finding.arrangement.signs)
    if (
        finding.agreement >= AGREEING
        and finding.unexplained <= UNEXPLAINED
        and positive
        and not finding.alternatives
        and not finding.mirrored
    ):
        better = sight(finding.arrangement, rows)
        if better is not None and better.unexplained <= UNEXPLAINED * written.unexplained:
            chosen = better
            evidence = (
                f"the motion agrees to {finding.agreement:.2f} with a rod at rest, and to "
                f"{finding.written.straight:.2f} without"
            )
    tried = [each for one in _exchanged(chosen.arrangement, own) if (each := sight(one, fewer)) is not None]
    best = min(tried, key=lambda each: each.unexplained, default=None)
    better = None if best is None else sight(best.arrangement, rows)
    if better is not None and better.unexplained <= UNEXPLAINED * chosen.unexplained:
        evidence = (
            f"a rod at rest explains {100 * better.frame.explained:.3g} % of the motion, and "
            f"{100 * chosen.frame.explained:.3g} % without"
        )
        chosen = better
    frame = chosen.frame if chosen.frame.explained >= EXPLAINED else None
    arrangement = None if chosen.arrangement == start else chosen.arrangement
    return Registration(frame, arrangement, evidence, 1.0 if frame is None else chosen.bend)


def _exchanged(arrangement: Arrangement, robot: Robot) -> Iterator[Arrangement]:
    """Two channels exchanged, and the channels of every section in the other direction about the axis."""
    channels = range(len(arrangement.columns))
    for i, j in combinations(channels, 2):
        yield arrangement.exchanged(i, j)
    section = sections_of(robot).of_channel
    columns = list(arrangement.columns)
    for number in set(section):
        members = [k for k in channels if section[k] == number]
        for k, other in zip(members, reversed(members), strict=True):
            columns[k] = arrangement.columns[other]
    yield arrangement._replace(columns=tuple(columns))
