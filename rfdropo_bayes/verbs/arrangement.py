"""Mapping of commands to a robot: which column drives which channel, which way round, and how sections are turned."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from rfdropo_bayes.robots import Robot


class Arrangement(NamedTuple):
    """Mapping of commands to a robot."""

    columns: tuple[int, ...]  # channel k of the robot takes column ``columns[k]``
    signs: tuple[int, ...]  # signs of the commands of each column, 1 or -1
    turns: tuple[float, ...]  # turn of the cables of each section about +z against the description [rad], base to tip

    def commands(self, given: Float[np.ndarray, "row channel"]) -> Float[np.ndarray, "row channel"]:
        """Commands sent to the robot's channels."""
        return (given * np.array(self.signs))[:, list(self.columns)]

    def exchanged(self, i: int, j: int) -> Arrangement:
        """Channels i and j take each other's columns."""
        columns = list(self.columns)
        columns[i], columns[j] = columns[j], columns[i]
        return self._replace(columns=tuple(columns))

    def reversed(self, columns: Sequence[int]) -> Arrangement:
        """These columns with the other sign."""
        return self._replace(signs=tuple(-s if k in columns else s for k, s in enumerate(self.signs)))

    def turned(self, angle: float) -> Arrangement:
        """All sections turned about +z by one more angle [rad]."""
        return self._replace(turns=tuple(turn + angle for turn in self.turns))


def as_written(channels: int, sections: int) -> Arrangement:
    """Columns in their order, cables as described."""
    return Arrangement(tuple(range(channels)), (1,) * channels, (0.0,) * sections)


class Sections(NamedTuple):
    """The sections of a robot: groups of cables and chambers with equal end height."""

    of_drive: tuple[int, ...]  # number of the section of each cable, then of each chamber, base to tip
    of_channel: tuple[int, ...]  # highest section that each channel drives

    @property
    def number(self) -> int:
        return 1 + max(self.of_drive)


def sections_of(robot: Robot) -> Sections:
    """Sections by the heights at which cables and chambers end."""
    ends = [round(each.end_m, 6) for each in robot.actuators]
    number = {end: k for k, end in enumerate(sorted(set(ends)))}
    of_drive = tuple(number[end] for end in ends)
    gain = np.array(robot.channels.gain) != 0.0
    return Sections(of_drive, tuple(int(max(np.array(of_drive)[moved])) for moved in gain.T))


def turned_robot(robot: Robot, turns: Sequence[float]) -> Robot:
    """The robot with the cables and chambers of each section turned about +z [rad]."""
    angles = np.degrees(np.asarray(turns, dtype=float))[list(sections_of(robot).of_drive)]
    turned = [each.turned(float(angle)) for each, angle in zip(robot.actuators, angles, strict=True)]
    cables = len(robot.cables)
    return robot.with_changes(cables=tuple(turned[:cables]), chambers=tuple(turned[cables:]))


class Moved(NamedTuple):
    """Markers about their means [m]: across the body as complex numbers, and along it; zero if not seen."""

    across: Complex[np.ndarray, "row marker"]
    along: Float[np.ndarray, "row marker"]

    @property
    def square(self) -> float:
        """Sum of squares."""
        return float(np.sum(np.abs(self.across) ** 2) + np.sum(self.along**2))

    def turned(self, angle: float) -> Moved:
        """About +z."""
        return Moved(self.across * np.exp(1j * angle), self.along)


def motion_of(position: Float[np.ndarray, "row marker 3"]) -> Moved:
    """The motion in positions, not a number if a marker was not seen."""
    seen = np.isfinite(position).all(axis=2)
    count = np.maximum(seen.sum(axis=0), 1)
    filled = np.where(seen[..., None], position, 0.0)
    about = np.where(seen[..., None], filled - filled.sum(axis=0) / count[:, None], 0.0)
    return Moved(about[..., 0] + 1j * about[..., 1], about[..., 2])


class Agreement(NamedTuple):
    """Agreement of two motions."""

    straight: float  # their correlation without rotation, -1 to 1
    turned: float  # the same after the turn about +z that agrees best
    turn: float  # turn from the simulated to the measured motion [rad]
    mirrored: float  # the same as ``turned``, of the mirror image of the simulated motion


def agreement(simulated: Moved, measured: Moved) -> Agreement:
    """Compare two motions."""
    scale = np.sqrt(simulated.square * measured.square)
    if scale == 0.0:
        return Agreement(0.0, 0.0, 0.0, 0.0)
    across = complex(np.sum(np.conj(simulated.across) * measured.across))
    mirror = complex(np.sum(simulated.across * measured.across))
    along = float(np.sum(simulated.along * measured.along))
    return Agreement(
        float((across.real + along) / scale),
        float((abs(across) + along) / scale),
        float(np.angle(across)),
        float((abs(mirror) + along) / scale),
    )


def neighbours(arrangement: Arrangement, sections: Sections) -> Iterator[Arrangement]:
    """Arrangements that differ in two columns, in two sections of equal numbers of channels, in one sign, or in all
    signs.
    """
    channels = range(len(arrangement.columns))
    for i, j in combinations(channels, 2):
        yield arrangement.exchanged(i, j)
    members = [[k for k in channels if sections.of_channel[k] == section] for section in range(sections.number)]
    for one, other in combinations(members, 2):
        if len(one) == len(other):
            changed = arrangement
            for i, j in zip(one, other, strict=True):
                changed = changed.exchanged(i, j)
            yield changed
    for k in arrangement.columns:
        yield arrangement.reversed([k])
    yield arrangement.reversed(channels)
