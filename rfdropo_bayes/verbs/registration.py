"""How a first recording lies to its robot at rest: order and azimuth of the cables, sizes, and the measuring frame.

A rod at rest under the recorded commands is compared with the measured positions. Cables are arranged by
`order_finder`, or with two of them exchanged; the frame is the rotation, the shift and, for a body of unknown length,
the scale that bring the rod to the measured positions (Kabsch 1976, Umeyama 1991). If the size that turns a command
into a bend was not given, several are tried: the form of the motion shows how far the body bends. The weight of a body
that lies bends it as well, so the cables are turned about the axis until the bends by cables and by weight fit.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.verbs.arrangement import Arrangement, as_written, sections_of
from rfdropo_bayes.verbs.at_rest import RestingRobot, Rows, resting, rows_of, spread_rows
from rfdropo_bayes.verbs.command_lag import best_delay
from rfdropo_bayes.verbs.motion_check import SOLVED, UNEXPLAINED
from rfdropo_bayes.verbs.motion_direction import AGREEING
from rfdropo_bayes.verbs.order_finder import ALIKE, ROWS, SEARCHED, arranged, find_arrangement
from rfdropo_bayes.verbs.placement import right_angles

EXPLAINED = 0.5  # least share of the squared motion that the rod explains in a frame that is taken from it
BENDS = tuple(np.geomspace(1.0 / 8.0, 8.0, 13))
"""Factors of the bend of a command that are tried if no answer sets it, a factor of 1.4 apart. An arm whose cables lie
at half the assumed distance, and whose spool is a guess, bent 2.1 times as far."""

REACHED = 1.5
"""Factor of a bend that the priors of gains and spools reach, so that a calibration finds it from motion. In five
of eleven arms that move, whose cables lie where `init` assumes, a rod at rest of guessed stiffness put them elsewhere,
by up to a factor of 1.33."""

ENOUGH = 0.99  # share at or above which no exchange of channels is looked for
LIKELY = 4  # exchanges that are looked at with all compliances
ACROSS = 0.1  # least share of gravity across the body that shows the azimuth of the cables
TURNS = tuple(
    float(turn) for turn in np.arange(12) * 2.0 * np.pi / 12.0
)  # turns of all cables about the axis of a body that lies [rad]
SOFTNESS = tuple(np.geomspace(1.0 / 8.0, 8.0, 7))  # compliances that are tried if the stiffness was not given
MOST = np.log(16.0)  # largest logarithm of a factor
NOTHING = 1e3  # unexplained share without equilibria
MINIMA = 3  # turns from which the best is sought
TURNED, SOFTER, EVALUATIONS = np.radians(15.0), 0.3, 10
"""First steps of the turn [rad] and of the logarithms of the factors, and the most evaluations for each corner of a
simplex."""
UNSTATED = ("Pa", "-")  # units of commands whose force per command is not stated
FINELY = 0.03  # accuracy of the best turn and factors, in first steps


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
    # bend, softness: bend of the body by a command that explains the recording, and its compliance, over the robot as
    # written
    bend: float = 1.0
    softness: float = 1.0


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


def lies(robot: Robot) -> bool:
    """Whether a robot's weight bends it, which the azimuths of its cables decide on."""
    return bool(np.linalg.norm(robot.gravity[:2]) > ACROSS * np.linalg.norm(robot.gravity))


class _Sight(NamedTuple):
    """An arrangement of a robot in the frame, and with the bend, that bring it nearest to a recording."""

    arrangement: Arrangement
    frame: Frame
    bend: float
    softness: float

    @property
    def unexplained(self) -> float:
        """Share of the squared motion that is left."""
        return 1.0 - self.frame.explained


Factors = tuple[float, float]  # bend and softness, see `Registration`


class _Sights:
    """Sights of a robot in a recording.

    Args:
        robot: robot at rest, with the markers of the recording.
        rows: rows of the recording.
        scaled: whether lengths may be scaled.
        bends: bends of a command to try.
        stiff: whether the stiffness is unknown: if forces move the body, a bend is that of a softer body, and if it
            lies, its compliance is tried as well.
    """

    def __init__(self, robot: RestingRobot, rows: Rows, *, scaled: bool, bends: Sequence[float], stiff: bool) -> None:
        own = robot.simulator.robot
        self.robot, self.scaled, self.lies = robot, scaled, lies(own)
        self.rows = rows.of(spread_rows(rows, ROWS))
        self.fewer = self.rows.of(spread_rows(self.rows, SEARCHED))
        self.held_by_force, self.modulus = own.held_by_force, own.nominal()["young_modulus"]
        # Of forces, the compliance alone sets both, unless the force of a command is not stated.
        tied, free = own.held_by_force and own.command_unit not in UNSTATED, self.lies and stiff
        self.written = [(bend, bend if own.held_by_force and stiff else 1.0) for bend in bends]
        self.soft = [1.0] if not free or tied else list(SOFTNESS)
        self.steps = [[SOFTER, SOFTER]] if tied else [[0.0, SOFTER], *([[SOFTER, 0.0]] * own.held_by_force)]
        self.steps = self.steps if free else []

    def of(self, arrangement: Arrangement, rows: Rows, tried: Sequence[Factors]) -> _Sight | None:
        """The best frame and factors of an arrangement; None if the rod finds no equilibria."""
        sent, turned = arrangement.commands(rows.command), arranged(self.robot, arrangement)
        frames: dict[Factors, Frame] = {}
        for bend, softness in tried:
            size = bend / softness if self.held_by_force else bend  # a softer body bends farther under a force
            path = turned.markers(size * sent, {"young_modulus": np.array([self.modulus / softness])})[0]
            if np.isfinite(path).all(axis=(1, 2)).mean() >= SOLVED:
                frames[bend, softness] = frame_of(path, rows.position, scaled=self.scaled)
        if not frames:
            return None
        least = 1.0 - max(frame.explained for frame in frames.values())
        alike = [factors for factors, frame in frames.items() if 1.0 - frame.explained <= ALIKE * least]
        best = min(alike, key=lambda factors: float(np.abs(np.log(factors)).sum()))  # small bends are all of one form
        return _Sight(arrangement, frames[best], *best)

    def whole(self, arrangement: Arrangement) -> _Sight | None:
        """An arrangement in all rows, as written."""
        return self.of(arrangement, self.rows, self.written)

    def far(self, arrangement: Arrangement, like: _Sight, soft: Sequence[float]) -> list[_Sight]:
        """Good sights in fewer rows, best first; of a body that lies, turns about the axis that are better than their
        neighbours, with the bend of another sight."""
        if not self.lies:
            sights = [self.of(arrangement, self.fewer, self.written)]
            return [each for each in sights if each is not None]
        tried = [(like.bend, like.softness if len(soft) == 1 else each) for each in soft]
        sights = [self.of(arrangement.turned(turn), self.fewer, tried) for turn in TURNS]
        left = np.array([np.inf if each is None else each.unexplained for each in sights])
        lowest = np.flatnonzero((left <= np.roll(left, 1)) & (left <= np.roll(left, -1)) & np.isfinite(left))
        return [each for k in lowest[np.argsort(left[lowest])] if (each := sights[k]) is not None]

    def near(self, sight: _Sight, *, turning: bool = True) -> _Sight | None:
        """The best sight in all rows; of a body that lies, of factors, and turns if asked, near those of a sight."""
        if not self.lies:
            return self.whole(sight.arrangement)
        sights: list[_Sight | None] = []

        def unexplained(steps: Float[np.ndarray, " step"]) -> float:
            turn, *factor = steps @ directions
            factors = (float(np.exp(factor[0])) * sight.bend, float(np.exp(factor[1])) * sight.softness)
            if np.abs(np.log(factors)).max() > MOST:
                return NOTHING
            made = self.of(sight.arrangement.turned(float(turn)), self.rows, [factors])
            sights.append(made)
            return NOTHING if made is None else made.unexplained

        directions = np.array([[TURNED, 0.0, 0.0]] * turning + [[0.0, *step] for step in self.steps]).reshape(-1, 3)
        if count := len(directions):
            first = np.vstack([np.zeros(count), np.eye(count)])
            options = {"initial_simplex": first - first.mean(axis=0), "maxfev": EVALUATIONS * (count + 1)}
            minimize(unexplained, first[0], method="Nelder-Mead", options=options | {"xatol": FINELY})
        if not self.held_by_force:
            tried = [(bend, sight.softness) for bend, _ in self.written]
            sights.append(self.of(sight.arrangement, self.rows, tried))
        return _best(sights)


def _best(sights: Iterable[_Sight | None]) -> _Sight | None:
    return min((each for each in sights if each is not None), key=lambda each: each.unexplained, default=None)


def register(
    spec: ModelSpec,
    recording: Trajectory,
    *,
    scaled: bool,
    bends: bool,
    stiff: bool = False,
    zero: Float[np.ndarray, " channel"] | None = None,
) -> Registration:
    """Bring the robot of a model, at rest and at nominal values, to a recording.

    Args:
        spec: model of a robot that can be at rest.
        recording: recording, read with the present settings.
        scaled: whether the body's length is not known, so that lengths may be scaled.
        bends: whether the bending per command is unknown.
        stiff: whether the stiffness is unknown.
        zero: command at which the body is about straight; zero by default.
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
    rows = rows if zero is None else rows._replace(command=rows.command - zero)
    factors = BENDS if bends else (1.0,)
    sights = _Sights(robot, rows, scaled=scaled, bends=factors, stiff=stiff)
    start = as_written(len(own.channel_names), sections_of(own).number)
    written = sights.whole(start)
    if written is None:
        return nothing
    chosen, evidence = written, ""
    finding = find_arrangement(robot, sights.rows)
    positive = all(sign > 0 for sign in finding.arrangement.signs)
    if (
        finding.agreement >= AGREEING
        and finding.unexplained <= UNEXPLAINED
        and positive
        and not finding.alternatives
        and not finding.mirrored
    ):
        better = sights.whole(finding.arrangement)
        if better is not None and better.unexplained <= UNEXPLAINED * written.unexplained:
            chosen = better
            evidence = (
                f"the motion agrees to {finding.agreement:.2f} with a rod at rest, and to "
                f"{finding.written.straight:.2f} without"
            )
    if sights.lies:
        straight = sights.near(chosen, turning=False) or chosen
        turned = _best(map(sights.near, sights.far(chosen.arrangement, chosen, sights.soft)[:MINIMA]))
        if ALIKE * straight.unexplained < chosen.unexplained:
            chosen = straight
        if turned is not None and ALIKE * turned.unexplained < min(straight.unexplained, chosen.unexplained):
            evidence = _explains(turned, chosen)
            chosen = turned
    if chosen.frame.explained < ENOUGH:
        exchanged = [
            each
            for one in _exchanged(chosen.arrangement, own)
            for each in sights.far(one, chosen, sights.soft[::3])[:1]
        ]
        likely = sorted(exchanged, key=lambda each: each.unexplained)[: LIKELY if len(sights.soft) > 1 else 1]
        closer = [each for one in likely for each in sights.far(one.arrangement, chosen, sights.soft)]
        better = _best(map(sights.near, sorted(closer, key=lambda each: each.unexplained)[:MINIMA]))
        if better is not None and better.unexplained <= UNEXPLAINED * chosen.unexplained:
            evidence = _explains(better, chosen)
            chosen = better
    arrangement = None if chosen.arrangement == start else chosen.arrangement
    if chosen.frame.explained < EXPLAINED:
        return Registration(None, arrangement, evidence)
    # The swing of a body, or a compliance that is a guess, makes its motion larger or smaller than a rod's at rest. A
    # length that is not known depends on the bend. Under forces the compliance sets it, and its prior is wide.
    if not (sights.held_by_force or scaled) and 0.0 < abs(np.log(chosen.bend)) <= np.log(REACHED):
        chosen = sights.of(chosen.arrangement, sights.rows, [(1.0, chosen.softness)]) or chosen
    return Registration(chosen.frame, arrangement, evidence, chosen.bend, chosen.softness)


def _explains(better: _Sight, before: _Sight) -> str:
    return (
        f"a rod at rest explains {100 * better.frame.explained:.3g} % of the motion, and "
        f"{100 * max(before.frame.explained, 0.0):.3g} % without"
    )


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
