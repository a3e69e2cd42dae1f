"""Where a recording's markers are when it begins, beside the undeformed robot: axes, units, order and origin."""

from __future__ import annotations

from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import pdist, squareform

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.data.named_columns import axes_matrix
from rfdropo_bayes.robots import Robot

FAR = 0.4
"""Share of the robot's length: undeformed markers that are farther off than this, root mean square, are looked at."""
NEAR = 0.15
"""Share of the robot's length: what brings the markers as near as this is offered as the cause."""
STRETCHED = 1.15
"""Two markers that are farther apart than so many times their distance on the undeformed robot are said."""


class Start(NamedTuple):
    """Markers that robot and recording share, those seen in the first row."""

    names: tuple[str, ...]
    rest: Float[np.ndarray, "marker 3"]  # [m]
    first: Float[np.ndarray, "marker 3"]  # [m]


def start_of(robot: Robot, trajectory: Trajectory) -> Start:
    """The undeformed robot's markers, and where the first row has them."""
    chosen = [
        (index, trajectory.marker_names.index(name))
        for index, name in enumerate(robot.marker_names)
        if name in trajectory.marker_names
    ]
    seen = [(i, j) for i, j in chosen if trajectory.position_mask[0, j]]
    rest = robot.marker_points()[[i for i, _ in seen]]
    return Start(tuple(robot.marker_names[i] for i, _ in seen), rest, trajectory.position[0, [j for _, j in seen]])


def far_from_rest(robot: Robot, trajectory: Trajectory) -> dict[str, float] | None:
    """Distance [m] of each marker's first row from the undeformed robot; None if no marker is seen in it."""
    start = start_of(robot, trajectory)
    if not start.names:
        return None
    distance = np.linalg.norm(start.first - start.rest, axis=1)
    return dict(zip(start.names, distance.tolist(), strict=True))


def placement_hints(robot: Robot, trajectory: Trajectory, axes: tuple[str, str, str] = ("x", "y", "z")) -> list[str]:
    """What may be wrong with axes, origin, units or the order of markers, in words; nothing where all looks well.

    A soft robot hangs or rests bent, so only a first row far from the undeformed robot is looked at, and a cause is
    named only if it brings the markers near.

    Args:
        robot: with the undeformed markers.
        trajectory: the recording, in the frame that ``axes`` made of its file's.
        axes: under which it was read, as [data.columns] has them. A hint says what to write in their place.
    """
    start = start_of(robot, trajectory)
    length = robot.body.station_m[-1] - robot.body.station_m[0]
    if not start.names:
        return []
    hints = _stretched(start)
    if _rms(start.first - start.rest) <= FAR * length:
        return hints
    found = _cause(start, length, axes_matrix(axes))
    head = f"the first row is {float(f'{1e3 * _rms(start.first - start.rest):.2g}'):g} mm off the undeformed robot"
    return [*hints, f"{head}; {found or 'look at axes, units, the order of markers and their point_m'}"]


def _cause(start: Start, length: float, read: Float[np.ndarray, "3 3"]) -> str | None:
    """The simplest of a shift, an order of markers, axes, or axes and a shift, that brings the first row near."""
    names, rest, first = start
    shift = np.mean(rest - first, axis=0)
    if _rms(first + shift - rest) <= NEAR * length and len(names) > 1:
        remedy = "move the origin to the robot's base, or give offset_x, offset_y and offset_z priors as wide"
        return f"a shift by {_millimetres(shift)} mm would bring it there: {remedy}"
    cost = np.linalg.norm(first[:, None] - rest[None], axis=2)
    order = linear_sum_assignment(cost**2)[1]
    if _rms(first - rest[order]) <= NEAR * length:
        meant = ", ".join(names[index] for index in order)
        return f"another order of the markers would bring it there: {', '.join(names)} look like {meant}"
    straight = bool(np.all(2.0 * np.linalg.norm(rest[:, :2], axis=1) <= NEAR * length))  # half a turn moves them little
    twist = ". Markers along the body do not show its turn about z: compare a motion with its command"
    twist = twist if straight else ""
    for turn in _turns():
        if _rms(first @ turn.T - rest) <= NEAR * length:
            return f"axes = {_words(turn @ read)} in [data.columns] would bring it there{twist}"
    for turn in _turns():
        shift = np.mean(rest - first @ turn.T, axis=0)
        if len(names) > 1 and _rms(first @ turn.T + shift - rest) <= NEAR * length:
            return (
                f"axes = {_words(turn @ read)} in [data.columns], and a shift by {_millimetres(shift)} mm, would bring "
                f"it there{twist}"
            )
    return None


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
        f"{1e3 * rest[i, j]:.4g} mm on the undeformed robot: look at position_unit, and at point_m of the markers"
    ]


def _turns() -> list[Float[np.ndarray, "3 3"]]:
    """The 23 ways to name x, y and z anew that keep a frame right-handed."""
    turns = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix = np.zeros((3, 3))
        matrix[range(3), order] = signs
        if np.linalg.det(matrix) > 0 and not np.allclose(matrix, np.eye(3)):
            turns.append(matrix)
    return turns


def _words(turn: Float[np.ndarray, "3 3"]) -> str:
    """A turn as ``axes`` of [data.columns] has it."""
    names = [f'"{"-" if row.min() < 0.0 else ""}{"xyz"[np.argmax(np.abs(row))]}"' for row in turn]
    return f"[{', '.join(names)}]"


def _rms(vectors: Float[np.ndarray, "marker 3"]) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def _millimetres(vector: Float[np.ndarray, "3"]) -> str:
    return f"({', '.join(f'{1e3 * value:.0f}' for value in vector)})"
