"""A search for the arrangement of a robot's commands by a chain of arcs, from scratch.

First, the cables of each column may run anywhere and end at any height at which cables of the robot end. The column
that explains most is placed first, then the next; then each column is placed once more with the others fixed. Order and
turns of the robot's description have no part in this, so no order is a bad start. Then the columns are given to the
channels that
run nearest, sections turned as a whole: an assignment problem.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from rfdropo_bayes.robots import Robot
from rfdropo_bayes.verbs.arcs import arcs_of, arms
from rfdropo_bayes.verbs.arrangement import Arrangement, motion_of, neighbours, sections_of

GAIN = 1e-4  # agreement that another round must gain to be worth its time
SWEEPS = 6  # most rounds
FINE = np.radians(15.0) * np.array([-1.0, -0.5, -0.25, 0.0, 0.25, 0.5, 1.0])
"""Trial turns of a section about its present position."""
TURNED = 4  # number of the best exchanges after which sections are turned again
HOPELESS = 3.0  # ratio of unexplained motion above which the worse sign is discarded
IN_PLACE = 1e-6  # agreement by which a column that makes no difference is given to its own channel
AZIMUTHS = 24  # azimuths at which a column's cables are tried


class Placed(NamedTuple):
    """Apparent courses of the cables of each column, regardless of the robot's description."""

    kind: tuple[int, ...]  # number of the kind of channel
    azimuth: tuple[float, ...]  # azimuth [rad]


class ArcSearch:
    """A search by arcs.

    Args:
        robot: robot as described.
        command: commands as recorded.
        position: positions of markers [m], NaN if not seen.
        markers: their names.
    """

    def __init__(
        self,
        robot: Robot,
        command: Float[np.ndarray, "row channel"],
        position: Float[np.ndarray, "row marker 3"],
        markers: Sequence[str],
    ) -> None:
        self.chain, self.kinds, self.channels = arcs_of(robot, tuple(markers))
        self.command, self.sections = command, sections_of(robot)
        self.target = motion_of(position)
        self.seen = np.isfinite(position).all(axis=2)
        angle = np.arange(AZIMUTHS) * 2.0 * np.pi / AZIMUTHS
        self.azimuths = angle
        self.slots = max(len(kind.radius) for kind in self.kinds)
        self.channel_kind = np.array([kind for kind, _ in self.channels])
        self.channel_azimuth = np.array([azimuth for _, azimuth in self.channels])
        self.channel_section = np.array(self.sections.of_channel)

    def scores(self, kind: np.ndarray, azimuth: np.ndarray, sign: np.ndarray, use: np.ndarray) -> np.ndarray:
        """Correlation with the measured motion of each guess: (guess, column) kinds, azimuths, signs, and whether a
        column counts."""
        guesses, columns, slots = *kind.shape, self.slots
        arm = np.zeros((guesses, columns, slots, 3, len(self.chain.length)))
        gain, there = np.zeros((guesses, columns, slots)), np.zeros((guesses, columns, slots), dtype=bool)
        for number, each in enumerate(self.kinds):
            mine = kind == number
            if mine.any():
                count = len(each.radius)
                arm[mine, :count] = arms(self.chain, each, azimuth[mine])
                gain[mine, :count], there[mine, :count] = np.array(each.gain), True
        there &= use[:, :, None]
        asked = self.command[None, :, :, None] * (sign[:, :, None] * gain)[:, None]
        flat = (guesses, columns * slots)
        made = self.chain.markers(
            asked.reshape(guesses, len(self.command), -1), arm.reshape(*flat, 3, -1), there.reshape(flat)
        )
        made = np.where(self.seen[None, ..., None], made, 0.0)
        count = np.maximum(self.seen.sum(axis=0), 1)[None, None, :, None]
        about = np.where(self.seen[None, ..., None], made - made.sum(axis=1, keepdims=True) / count, 0.0)
        target = np.stack([self.target.across.real, self.target.across.imag, self.target.along], axis=-1)
        together = np.einsum("grma,rma->g", about, target)
        scale = np.sqrt(np.einsum("grma,grma->g", about, about) * self.target.square)
        return together / np.where(scale > 0.0, scale, np.inf)

    def relaxed(self, sign: int) -> tuple[Placed, np.ndarray]:
        """Apparent courses of each column's cables, and scores of all other places (column, kind, azimuth)."""
        columns, kinds = self.command.shape[1], len(self.kinds)
        kind, azimuth, use = np.zeros(columns, int), np.zeros(columns), np.zeros(columns, dtype=bool)
        moving = np.ptp(self.command, axis=0) > 0.0
        table = np.zeros((columns, kinds, AZIMUTHS))
        for _ in range(int(moving.sum())):
            waiting = [int(c) for c in np.flatnonzero(moving) if not use[c]]
            scores = {c: self._scan(c, kind, azimuth, sign, use) for c in waiting}
            best = max(waiting, key=lambda c: scores[c].max())
            kind[best], azimuth[best] = self._argmax(scores[best])
            use[best] = True
        score = -1.0
        for _ in range(SWEEPS):
            for c in map(int, np.flatnonzero(moving)):
                table[c] = self._scan(c, kind, azimuth, sign, use)
                kind[c], azimuth[c] = self._argmax(table[c])
            if table[c].max() <= score + GAIN:
                break
            score = float(table[c].max())
        return Placed(tuple(kind.tolist()), tuple(azimuth.tolist())), table

    def _argmax(self, table: np.ndarray) -> tuple[int, float]:
        kind, k = np.unravel_index(int(np.argmax(table)), table.shape)
        return int(kind), float(self.azimuths[k])

    def _scan(self, column: int, kind: np.ndarray, azimuth: np.ndarray, sign: int, use: np.ndarray) -> np.ndarray:
        kinds, guesses = len(self.kinds), len(self.kinds) * AZIMUTHS
        every = [np.repeat(each[None], guesses, axis=0) for each in (kind, azimuth, use)]
        every[0][:, column] = np.repeat(np.arange(kinds), AZIMUTHS)
        every[1][:, column] = np.tile(self.azimuths, kinds)
        every[2][:, column] = True
        return self.scores(every[0], every[1], np.full(every[0].shape, sign), every[2]).reshape(kinds, AZIMUTHS)

    def best(self) -> list[Arrangement]:
        """The arrangements that explain the motion best, with each sign of all commands that may explain it."""
        relaxed = {sign: self.relaxed(sign) for sign in (1, -1)}
        unexplained = {sign: 1.0 - max(float(table.max()), 0.0) ** 2 for sign, (_, table) in relaxed.items()}
        likely = [sign for sign in relaxed if unexplained[sign] <= HOPELESS * min(unexplained.values())]
        return [self.improved(self.turned(self._assigned(*relaxed[sign], sign))) for sign in likely]

    def improved(self, arrangement: Arrangement) -> Arrangement:
        """An arrangement that no exchange of two columns or two sections betters, sections turned anew."""
        for _ in range(SWEEPS):
            others = list(neighbours(arrangement, self.sections))
            likely = np.argsort(-self.score_of(others))[:TURNED]
            tried = [arrangement, *(self.turned_far(others[k]) for k in likely)]
            scores = self.score_of(tried)
            if scores.max() <= scores[0] + GAIN:
                break
            arrangement = tried[int(np.argmax(scores))]
        return arrangement

    def score_of(self, arrangements: Sequence[Arrangement]) -> np.ndarray:
        """Correlation with the measured motion of each arrangement."""
        guesses, columns = len(arrangements), self.command.shape[1]
        kind, azimuth = np.zeros((guesses, columns), int), np.zeros((guesses, columns))
        sign = np.array([each.signs for each in arrangements])
        for g, each in enumerate(arrangements):
            kind[g, list(each.columns)] = self.channel_kind
            azimuth[g, list(each.columns)] = self.channel_azimuth + np.array(each.turns)[self.channel_section]
        return self.scores(kind, azimuth, sign, np.ones((guesses, columns), dtype=bool))

    def turned(self, arrangement: Arrangement) -> Arrangement:
        """The arrangement with the section azimuths that explain the motion best."""
        for _ in range(2):
            for section in range(self.sections.number):
                tried = [_with_turn(arrangement, section, angle) for angle in FINE]
                arrangement = tried[int(np.argmax(self.score_of(tried)))]
        return arrangement

    def turned_far(self, arrangement: Arrangement) -> Arrangement:
        """The arrangement after a search over all azimuths of each section in turn."""
        for section in range(self.sections.number):
            tried = [_with_turn(arrangement, section, angle) for angle in self.azimuths]
            arrangement = tried[int(np.argmax(self.score_of(tried)))]
        return self.turned(arrangement)

    def _assigned(self, placed: Placed, table: np.ndarray, sign: int) -> Arrangement:
        """Columns assigned to channels by their scores at each channel's place."""
        columns, own = len(table), np.arange(len(table))
        turns = np.array([self._turn_of(placed, section) for section in range(self.sections.number)])

        def assigned(turns: np.ndarray) -> tuple[float, tuple[int, ...]]:
            azimuth = self.channel_azimuth + turns[self.channel_section]
            value = _between(table[:, self.channel_kind], azimuth) + IN_PLACE * np.eye(columns)
            column, channel = linear_sum_assignment(value, maximize=True)
            return float(value[column, channel].sum()), tuple(int(c) for c in column[np.argsort(channel)])

        for _ in range(2):
            for section in range(self.sections.number):
                tried = [turns + angle * (np.arange(len(turns)) == section) for angle in self.azimuths]
                turns = max(tried, key=lambda each: assigned(each)[0])
        return Arrangement(assigned(turns)[1], (sign,) * len(own), tuple(turns.tolist()))

    def _turn_of(self, placed: Placed, section: int) -> float:
        """A first guess: one of the section's columns at its first channel."""
        first = int(np.flatnonzero(self.channel_section == section)[0])
        there = [a for k, a in zip(placed.kind, placed.azimuth, strict=True) if k == self.channel_kind[first]]
        return float(there[0] - self.channel_azimuth[first]) if there else 0.0


def _with_turn(arrangement: Arrangement, section: int, angle: float) -> Arrangement:
    turns = list(arrangement.turns)
    turns[section] += angle
    return arrangement._replace(turns=tuple(turns))


def _between(
    table: Float[np.ndarray, "column channel azimuth"], azimuth: Float[np.ndarray, " channel"]
) -> Float[np.ndarray, "column channel"]:
    """Values at azimuths [rad] interpolated in a periodic table."""
    at = azimuth / (2.0 * np.pi) * table.shape[2]
    below = np.floor(at)
    share, k = at - below, below.astype(int)
    channel = np.arange(table.shape[1])
    one, other = table[:, channel, k % table.shape[2]], table[:, channel, (k + 1) % table.shape[2]]
    return one + share * (other - one)
