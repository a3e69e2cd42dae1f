"""Which arrangement of the commands explains recordings: the simplest with the best agreement of a rod at rest.

Tried are: as written; with the whole turned; with each section turned; with columns exchanged or reversed, and sections
turned. A proposal is reported with its alternatives: arrangements that explain the motion equally well.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rfdropo_bayes.robots import Robot
from rfdropo_bayes.verbs.arc_search import ArcSearch
from rfdropo_bayes.verbs.arrangement import (
    Agreement,
    Arrangement,
    agreement,
    as_written,
    motion_of,
    neighbours,
    sections_of,
    turned_robot,
)
from rfdropo_bayes.verbs.at_rest import RestingRobot, Rows, spread_rows

ROWS, SEARCHED = 100, 60  # rows that are simulated by the rod at rest, and of them by arcs
WELL = 0.98  # agreement at or above which no other arrangement is looked for
ALIKE = 1.3
"""Ratio of two shares of unexplained motion below which the simpler arrangement is taken, and alternatives are
named.
"""
ALTERNATIVES = 6  # number of simulated alternatives
SAME_TURN = np.radians(1.0)


class Finding(NamedTuple):
    """Result of a search for another arrangement."""

    written: Agreement  # agreement of the robot and the commands as written
    arrangement: Arrangement  # the simplest arrangement as good as the best
    agreement: float  # its correlation
    alternatives: tuple[tuple[Arrangement, float], ...] = ()  # alternatives of equal quality, and their correlations
    mirror: float = 0.0  # correlation of the robot's mirror image, turned

    @property
    def unexplained(self) -> float:
        """Share of the unexplained motion that is left, of the arrangement as written."""
        return unexplained(self.agreement) / max(unexplained(self.written.straight), 1e-12)

    @property
    def mirrored(self) -> bool:
        """Whether a mirror image would explain the motion as well."""
        return unexplained(self.mirror) <= ALIKE * unexplained(self.agreement)

    @property
    def common_turn(self) -> float:
        """Rotation of the whole robot [rad], -pi to pi: the mean over the sections."""
        return float(np.angle(np.mean(np.exp(1j * np.array(self.arrangement.turns)))))

    @property
    def sections_differ(self) -> bool:
        """Whether sections are turned against each other."""
        return bool(np.ptp(np.angle(np.exp(1j * (np.array(self.arrangement.turns) - self.common_turn)))) > SAME_TURN)


def unexplained(correlation: float) -> float:
    """Share of a motion that another of this correlation leaves, at the size that fits best."""
    return 1.0 - max(correlation, 0.0) ** 2


def find_arrangement(resting: RestingRobot, rows: Rows) -> Finding:
    """Find the arrangement of a robot's commands.

    Args:
        resting: the robot of the file, with the markers of the rows.
        rows: rows of recordings.
    """
    robot = resting.simulator.robot
    finder = _Finder(resting, robot, rows.of(spread_rows(rows, ROWS)))
    start = as_written(len(robot.channel_names), finder.sections.number)
    written = finder.agreement(start)
    if written.straight >= WELL or not np.ptp(rows.command, axis=0).any():
        return Finding(written, start, written.straight)
    tried = finder.simple(start) + [finder.canonical(finder.levelled(each)) for each in finder.search.best()]
    least = min(unexplained(finder.straight(each)) for each in tried)
    chosen = next(each for each in tried if unexplained(finder.straight(each)) <= ALIKE * least)
    best = finder.straight(chosen)
    return Finding(written, chosen, best, finder.alternatives(chosen), written.mirrored)


class _Finder:
    def __init__(self, resting: RestingRobot, robot: Robot, rows: Rows) -> None:
        self.resting, self.robot, self.rows = resting, robot, rows
        self.sections = sections_of(robot)
        fewer = rows.of(spread_rows(rows, SEARCHED))
        self.search = ArcSearch(robot, fewer.command, fewer.position, resting.shown)
        self.moves = np.ptp(rows.command, axis=0) > 0.0
        self._seen: dict[Arrangement, Agreement] = {}

    def agreement(self, arrangement: Arrangement) -> Agreement:
        """Agreement of the rod at rest with the recording."""
        if arrangement not in self._seen:
            made = arranged(self.resting, arrangement).markers(arrangement.commands(self.rows.command))[0]
            both = np.isfinite(made) & np.isfinite(self.rows.position)
            one, other = (motion_of(np.where(both, each, np.nan)) for each in (made, self.rows.position))
            self._seen[arrangement] = agreement(one, other)
        return self._seen[arrangement]

    def straight(self, arrangement: Arrangement) -> float:
        """Correlation without rotation."""
        return self.agreement(arrangement).straight

    def levelled(self, arrangement: Arrangement) -> Arrangement:
        """The arrangement turned as a whole as the rod at rest agrees best."""
        turn = self.agreement(arrangement).turn
        moved = arrangement._replace(turns=tuple(each + turn for each in arrangement.turns))
        return max(arrangement, moved, key=self.straight)

    def simple(self, start: Arrangement) -> list[Arrangement]:
        """The robot as written, then turned as a whole, then with each section turned."""
        whole = self.levelled(start)
        sections = [] if len(start.turns) == 1 else [self.levelled(self.search.turned_far(whole))]
        return [start, whole, *sections]

    def canonical(self, arrangement: Arrangement) -> Arrangement:
        """The equivalent arrangement with most columns in place, then least turned."""
        for section in range(self.sections.number):
            arrangement = max(
                self._equals(arrangement, section),
                key=lambda each: (
                    sum(k == c for k, c in enumerate(each.columns)),
                    -abs(round(float(np.angle(np.exp(1j * each.turns[section]))), 6)),
                ),
            )
        turns = tuple(float(np.angle(np.exp(1j * turn))) for turn in arrangement.turns)
        return arrangement._replace(turns=turns)

    def _equals(self, arrangement: Arrangement, section: int) -> list[Arrangement]:
        """Arrangements that differ by a turn of one section which takes its channels to each other."""
        search = self.search
        mine = np.flatnonzero(search.channel_section == section)
        azimuth = search.channel_azimuth[mine]
        equals = [arrangement]
        for beside in azimuth[1:] - azimuth[0]:
            apart = np.abs(np.angle(np.exp(1j * (azimuth[:, None] + beside - azimuth[None]))))
            onto = np.argmin(apart, axis=1)
            if apart.min(axis=1).max() > SAME_TURN or len(set(onto.tolist())) < len(mine):
                continue
            if np.any(search.channel_kind[mine] != search.channel_kind[mine[onto]]):
                continue
            columns, turns = list(arrangement.columns), list(arrangement.turns)
            for k, other in zip(mine, mine[onto], strict=True):
                columns[k] = arrangement.columns[other]
            turns[section] += float(beside)
            equals.append(arrangement._replace(columns=tuple(columns), turns=tuple(turns)))
        return equals

    def alternatives(self, chosen: Arrangement) -> tuple[tuple[Arrangement, float], ...]:
        """Other arrangements that explain the motion as well as the chosen arrangement."""
        others = [each for each in neighbours(chosen, self.sections) if self._differs(each, chosen)]
        if not others:
            return ()
        likely = np.argsort(-self.search.score_of(others))[:ALTERNATIVES]
        turned = [self.levelled(self.search.turned_far(others[k])) for k in likely]
        limit, same = ALIKE * unexplained(self.straight(chosen)), self.canonical(chosen)
        errors = {
            self.canonical(each): self.straight(each) for each in turned if unexplained(self.straight(each)) <= limit
        }
        unlike = [(each, value) for each, value in errors.items() if each[:2] != same[:2]]
        return tuple(sorted(unlike, key=lambda each: -each[1]))

    def _differs(self, one: Arrangement, other: Arrangement) -> bool:
        """Whether a column that moves is sent elsewhere, or the other way round."""
        sent = [each.commands(self.rows.command - self.rows.command[:1]) for each in (one, other)]
        return not np.array_equal(sent[0], sent[1])


def arranged(resting: RestingRobot, arrangement: Arrangement) -> RestingRobot:
    """The robot with its sections turned."""
    if not any(arrangement.turns):
        return resting
    return resting.as_robot(turned_robot(resting.simulator.robot, arrangement.turns))


def order_lines(arrangement: Arrangement, robot: Robot, own: Sequence[str], key: str) -> list[str]:
    """Lines of an experiment file for an arrangement.

    Args:
        arrangement: found arrangement.
        robot: robot as written.
        own: names of the columns.
        key: template of the order of columns, with {} for the list.
    """
    lines = []
    if arrangement.columns != tuple(range(len(own))):
        lines.append(key.format(", ".join(f'"{own[k]}"' for k in arrangement.columns)))
    if -1 in arrangement.signs:
        sent = np.array(arrangement.signs)[list(arrangement.columns)]
        gain = np.array(robot.channels.gain) * sent + 0.0
        rows = ", ".join(str([float(f"{value:g}") for value in row]) for row in gain)
        lines.append(f"gain = [{rows}] in [channels] of the robot file")
    if any(abs(turn) > SAME_TURN for turn in arrangement.turns):
        azimuths = [
            f"{each.name} {each.azimuth_deg % 360.0:.0f}" for each in turned_robot(robot, arrangement.turns).actuators
        ]
        lines.append(f"azimuth_deg in the robot file: {', '.join(azimuths)}")
    return lines
