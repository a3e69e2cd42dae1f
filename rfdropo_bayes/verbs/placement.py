"""First marker positions of a recording compared with the undeformed robot: axes, units, order and origin."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import pdist, squareform

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.data.named_columns import METRES, CsvColumns, axes_matrix, axes_words, in_base, marker_names
from rfdropo_bayes.robots import Robot

FAR = 0.4
"""Share of the robot's length: undeformed markers that are farther off than this, root mean square, are looked at."""
NEAR = 0.15  # share of the robot's length; a remedy that brings the markers this near is reported as the cause
PULLED = 0.25  # share of the largest command with which a recording starts bent: its first row shows no frame
STRETCHED = 1.15  # ratio to the distance of two markers on the undeformed robot above which they are reported


class Start(NamedTuple):
    """Markers that robot and recording share and that are seen in the first row."""

    names: tuple[str, ...]
    rest: Float[np.ndarray, "marker 3"]  # [m]
    first: Float[np.ndarray, "marker 3"]  # [m]


def start_of(robot: Robot, trajectory: Trajectory) -> Start:
    """The undeformed robot's markers, and their positions in the first row."""
    first = np.where(trajectory.position_mask[0, :, None], trajectory.position[0], np.nan)
    return _start(robot, trajectory.marker_names, first)


def _start(robot: Robot, markers: Sequence[str], first: Float[np.ndarray, "marker 3"]) -> Start:
    """The start of markers at ``first`` [m]; NaN for markers that were not seen."""
    chosen = [(index, list(markers).index(name)) for index, name in enumerate(robot.marker_names) if name in markers]
    seen = [(i, j) for i, j in chosen if np.isfinite(first[j]).all()]
    rest = robot.marker_points()[[i for i, _ in seen]]
    return Start(tuple(robot.marker_names[i] for i, _ in seen), rest, first[[j for _, j in seen]])


def far_from_rest(robot: Robot, trajectory: Trajectory) -> dict[str, float] | None:
    """Distance [m] of each marker's first row from the undeformed robot; None if no marker is seen in it."""
    start = start_of(robot, trajectory)
    if not start.names:
        return None
    distance = np.linalg.norm(start.first - start.rest, axis=1)
    return dict(zip(start.names, distance.tolist(), strict=True))


class Read(NamedTuple):
    """Transformation of a file's positions to the frame of the base: subtract the origin, then turn."""

    turn: Float[np.ndarray, "3 3"]  # rotation from the file's frame to the base frame
    origin: Float[np.ndarray, "3"]  # origin of the base in the file's frame [m]
    unit: str  # unit of the file's positions and of ``origin`` in [data.columns]; "" for formats without that table

    @classmethod
    def by(cls, columns: CsvColumns | None) -> Read:
        """The transformation of [data.columns]."""
        if columns is None:
            return cls(np.eye(3), np.zeros(3), "")
        origin = METRES[columns.position_unit] * np.array(columns.origin)
        return cls(axes_matrix(columns.axes), origin, columns.position_unit)

    def shifted(self, turn: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> str:
        """The line for [data.columns] that turns the positions read, and then shifts them [m]."""
        if not self.unit:
            return f"a shift by {_millimetres(shift)} mm"
        # A robot that rests bent gives a position to within millimetres.
        origin = np.round(self.origin - (turn @ self.turn).T @ shift, 3) / METRES[self.unit]
        return f"origin = [{', '.join(f'{value:g}' for value in origin + 0.0)}]"


def placement_hints(robot: Robot, trajectory: Trajectory, columns: CsvColumns | None = None) -> list[str]:
    """Possible faults of axes, origin, units or the order of markers, in words; empty if none is found.

    A soft robot hangs or rests bent, so only a first row far from the undeformed robot is examined, and a cause is
    named only if it brings the markers near. A recording that starts under a large command may start anywhere.

    Args:
        robot: robot with the undeformed markers.
        trajectory: the recording, transformed by ``axes`` and ``origin``.
        columns: table that maps the recording's columns. A hint has the corrected line.
    """
    start = start_of(robot, trajectory)
    length = robot.length
    if not start.names:
        return []
    hints = _stretched(start)
    if _rms(start.first - start.rest) <= FAR * length:
        return hints
    cause = _cause(start, length, Read.by(columns))
    if cause is None and _starts_pulled(trajectory):
        return hints
    head = f"the first row is {float(f'{1e3 * _rms(start.first - start.rest):.2g}'):g} mm off the undeformed robot"
    if cause is None and len(start.names) == 1 < len(trajectory.marker_names):
        cause = f"only {start.names[0]} is seen in it: too few markers to name a cause"
    return [*hints, f"{head}; {cause or 'look at axes, origin, units, the order of markers and their point_m'}"]


def _starts_pulled(trajectory: Trajectory) -> bool:
    """Whether the command before the first row is large."""
    first, largest = np.abs(trajectory.initial_command).max(), np.abs(trajectory.command).max(initial=0.0)
    return bool(first > PULLED * largest)


def frame_lines(robot: Robot, first: Float[np.ndarray, "marker 3"], columns: CsvColumns) -> list[str]:
    """Lines of [data.columns], axes and origin, that bring a first row to the undeformed robot.

    Empty if the first row is near already, or if no frame brings it near.

    Args:
        robot: robot with the undeformed markers.
        first: first seen position of each marker of ``columns``, in the file's frame and unit.
        columns: table used to read the file.
    """
    start, length = _start(robot, marker_names(columns), in_base(first, columns)), robot.length
    if not start.names or _rms(start.first - start.rest) <= FAR * length:
        return []
    frame = _frame(start, length)
    if frame is None:
        return []
    return moved_frame(columns, *frame)


def moved_frame(columns: CsvColumns, turn: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> list[str]:
    """Lines of [data.columns], axes and origin, that turn positions in the base's frame, then shift them [m]."""
    read = Read.by(columns)
    axes = f"axes = {axes_words(turn @ read.turn)}"
    return [axes, read.shifted(turn, shift)] if np.any(shift) else [axes]


def _ordered(start: Start) -> np.ndarray:
    """Which undeformed marker each marker of the first row is nearest to, each taken once."""
    cost = np.linalg.norm(start.first[:, None] - start.rest[None], axis=2)
    return linear_sum_assignment(cost**2)[1]


def _frame(start: Start, length: float) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]] | None:
    """The simplest of a shift, a turn, or both, that brings the first row near, unless an order of markers does."""
    names, rest, first = start
    shift = np.mean(rest - first, axis=0)
    if _rms(first + shift - rest) <= NEAR * length and len(names) > 1:
        return np.eye(3), shift
    if _rms(first - rest[_ordered(start)]) <= NEAR * length:
        return None
    for turn in right_angles():
        if _rms(first @ turn.T - rest) <= NEAR * length:
            return turn, np.zeros(3)
    for turn in right_angles():
        shift = np.mean(rest - first @ turn.T, axis=0)
        if len(names) > 1 and _rms(first @ turn.T + shift - rest) <= NEAR * length:
            return turn, shift
    return None


def _cause(start: Start, length: float, read: Read) -> str | None:
    """The simplest of a shift, an order of markers, axes, or axes and a shift, that brings the first row near."""
    names, rest, first = start
    frame, order = _frame(start, length), _ordered(start)
    if frame is None and _rms(first - rest[order]) <= NEAR * length:
        meant = ", ".join(names[index] for index in order)
        return f"another order of the markers would bring it there: {', '.join(names)} look like {meant}"
    if frame is None:
        return None
    turn, shift = frame
    line = read.shifted(turn, shift)
    if np.array_equal(turn, np.eye(3)):
        if not read.unit:
            return f"{line} would bring it there: give offset_x, offset_y and offset_z priors as wide"
        return f"{line} in [data.columns] would bring it there: the robot's base in the file's frame, in {read.unit}"
    straight = bool(np.all(2.0 * np.linalg.norm(rest[:, :2], axis=1) <= NEAR * length))  # half a turn moves them little
    twist = (
        ". Markers along the body do not show its turn about z; check compares motions with commands once they are near"
    )
    twist = twist if straight else ""
    axes = f"axes = {axes_words(turn @ read.turn)}"
    lines = f"{axes} and {line}" if np.any(shift) else axes
    return f"{lines} in [data.columns] would bring it there{twist}"


def _stretched(start: Start) -> list[str]:
    """Markers that are farther apart than a body that bends can have them."""
    if len(start.names) < 2:
        return []
    apart, rest = squareform(pdist(start.first)), squareform(pdist(start.rest))
    ratio = np.where(rest > 0.0, apart / np.where(rest > 0.0, rest, 1.0), 0.0)
    i, j = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
    if ratio[i, j] <= STRETCHED:
        return []
    return [
        f"{start.names[i]} and {start.names[j]} are {1e3 * apart[i, j]:.4g} mm apart in the first row and "
        f"{1e3 * rest[i, j]:.4g} mm on the undeformed robot: look at position_unit, at the order of "
        "their columns under positions, and at point_m of the markers"
    ]


def right_angles() -> list[Float[np.ndarray, "3 3"]]:
    """The 23 ways to name x, y and z anew that keep a frame right-handed."""
    turns = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix = np.zeros((3, 3))
        matrix[range(3), order] = signs
        if np.linalg.det(matrix) > 0 and not np.allclose(matrix, np.eye(3)):
            turns.append(matrix)
    return turns


def _rms(vectors: Float[np.ndarray, "marker 3"]) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def _millimetres(vector: Float[np.ndarray, "3"]) -> str:
    return f"({', '.join(f'{1e3 * value:.0f}' for value in vector)})"
