"""Unit of the commands for which cables bend a robot as far as its markers moved: constant curvature, no simulation.

A cable that is pulled by :math:`d` at radius :math:`r` turns the body at its end by :math:`d / r` towards itself. The
turn of a segment is the least-squares fit to the displacements of its cables. It adds up from segment to segment, and a
marker follows the mean turn below it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.data.named_columns import COMMAND_UNITS, METRES
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.verbs.column_units import ANGLES, METRIC, Unit
from rfdropo_bayes.verbs.motion_size import EXPLAINED, IMPOSED, OFF, Size

MOST_TURN = np.pi  # largest turn of a body [rad] by its cables
MISREAD = 5.0  # ratio of the measured motion and this estimate at or above which another unit replaces a guess
BARELY = 0.999  # share of `MOST_TURN` that rounding does not carry beyond it
STEPS = 81  # along the body


def driven_motion(
    robot: Robot, command: Float[np.ndarray, "row channel"], heights: Sequence[float]
) -> Float[np.ndarray, "row marker 2"] | None:
    """Positions of markers at these heights across the body [m] under commands [m or rad]; None if the turn exceeds
    `MOST_TURN`.
    """
    place = np.linspace(min(cable.anchor_z_m for cable in robot.cables), max(heights), STEPS)
    pull = command @ np.asarray(robot.channel_matrix(robot.nominal()), dtype=float).T
    if np.linalg.norm(_turns(robot, pull, place), axis=2).max() > MOST_TURN:
        return None
    turn = _turns(robot, np.clip(pull, *np.array(robot.drive_limits()).T), place)
    slope = turn * np.sinc(np.linalg.norm(turn, axis=2, keepdims=True) / np.pi)
    between = 0.5 * np.diff(place)[:, None, None] * (slope[1:] + slope[:-1])
    across = np.concatenate([np.zeros_like(slope[:1]), np.cumsum(between, axis=0)])
    return np.stack([across[np.argmin(np.abs(place - height))] for height in heights], axis=1)


def _turns(
    robot: Robot, pull: Float[np.ndarray, "row cable"], place: Float[np.ndarray, " place"]
) -> Float[np.ndarray, "place row 2"]:
    """Rotation of the body at each height, towards x and y [rad]."""
    ends = np.array([cable.guide_z_m[-1] for cable in robot.cables])
    azimuth = np.radians([cable.azimuth_deg for cable in robot.cables])
    radius = np.array([np.mean([cable.anchor_radius_m, *cable.guide_radius_m]) for cable in robot.cables])
    arm = radius[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    turn, below, reached = np.zeros((len(place), len(pull), 2)), float(place[0]), np.zeros((len(pull), 2))
    for end in np.unique(ends):
        own = ends == end
        whole = pull[:, own] @ np.linalg.pinv(arm[own]).T
        share = np.clip((place - below) / (end - below), 0.0, 1.0)
        turn += share[:, None, None] * (whole - reached)
        below, reached = float(end), whole
    return turn


def spread(position: Float[np.ndarray, "row marker axis"]) -> float:
    """Root mean square motion of markers about their mean [m]; 0 if none is seen."""
    lost = ~np.isfinite(position).all(axis=2)
    places = [own[~gone] for own, gone in zip(np.moveaxis(position, 1, 0), lost.T, strict=True) if not gone.all()]
    squares = [np.sum((own - own.mean(axis=0)) ** 2, axis=1) for own in places]
    return float(np.sqrt(np.mean(np.concatenate(squares)))) if squares else 0.0


def unit_of_motion(
    robot: Robot,
    command: Float[np.ndarray, "row channel"],
    position: Float[np.ndarray, "row marker 3"],
    heights: Mapping[str, float],
    guessed: Unit,
) -> Unit:
    """The guessed unit of commands, or another unit if only that explains the motion, with the evidence.

    Args:
        robot: robot whose cables impose lengths or angles.
        command: values in the unknown unit.
        position: positions of the markers [m], in any frame.
        heights: heights of the same markers on the robot [m].
        guessed: unit guessed from the size of the commands.
    """
    kind, size = COMMAND_UNITS.get(guessed.unit, ("", 1.0))
    if kind not in IMPOSED or kind != robot.command_unit or not np.isfinite(command).all():
        return guessed
    seen = np.where((position == 0.0).all(axis=2, keepdims=True), np.nan, position)  # how some trackers lose a marker
    measured, moved = spread(seen), dict[str, Size]()
    if measured == 0.0:
        return guessed
    for name, (other, own) in COMMAND_UNITS.items():
        tried = other == kind and name in (*METRIC, *ANGLES, guessed.unit)
        driven = driven_motion(robot, own * command, list(heights.values())) if tried else None
        if driven is not None:
            moved[name] = Size(measured, spread(driven))
    explaining = [name for name in moved if moved[name].within(EXPLAINED)]
    chosen = guessed.unit
    if explaining and not (chosen in moved and moved[chosen].within(MISREAD)):
        chosen = min(explaining, key=lambda name: abs(np.log(COMMAND_UNITS[name][1] / size)))
    said = [_driven_words(moved.get(name), name) for name in dict.fromkeys((chosen, guessed.unit))]
    words = f"the markers move by {1e3 * measured:.3g} mm, by the cables {', '.join(said)}"
    return Unit(chosen, guessed.others, f"{guessed.evidence}; {words}")


def lengths_for_angles(
    turned: Robot,
    pulled: Robot,
    command: Float[np.ndarray, "row channel"],
    position: Float[np.ndarray, "row marker 3"],
    heights: Sequence[float],
) -> str | None:
    """Motion by millimetres of cable, in words, if it explains the measured motion and no unit of angles does; None
    otherwise.

    Args:
        turned: robot whose commands are angles.
        pulled: robot whose commands are lengths of cable.
        command: values in the unknown unit.
        position: positions of the markers [m], in any frame.
        heights: heights of the same markers on the robot [m].
    """
    measured = spread(position)

    def moved(robot: Robot, factor: float) -> Size | None:
        driven = driven_motion(robot, factor * command, heights)
        return None if driven is None else Size(measured, spread(driven))

    angles = [moved(turned, COMMAND_UNITS[unit][1]) for unit in ("rad", "deg")]
    if measured == 0.0 or any(size is not None and size.within(EXPLAINED) for size in angles):
        return None
    size = moved(pulled, METRES["mm"])
    return None if size is None or not size.within(EXPLAINED) else _driven_words(size, "mm")


def bends_too_far(
    robot: Robot,
    command: Float[np.ndarray, "row channel"],
    position: Float[np.ndarray, "row marker 3"],
    heights: Sequence[float],
) -> str | None:
    """Why commands cannot be these lengths of cable [m], in words: markers move a small part of the way to which cables
    of these lengths, or of a share of these that bends the body by `MOST_TURN`, would drive it. None if they can be."""
    if not np.isfinite(command).all():
        return None
    place = np.linspace(min(cable.anchor_z_m for cable in robot.cables), max(heights), STEPS)
    pull = command @ np.asarray(robot.channel_matrix(robot.nominal()), dtype=float).T
    turn = float(np.linalg.norm(_turns(robot, pull, place), axis=2).max())
    driven = driven_motion(robot, min(1.0, BARELY * MOST_TURN / max(turn, 1e-12)) * command, heights)
    size = None if driven is None else Size(spread(position), spread(driven))
    if size is None or size.measured == 0.0 or size.ratio > 1.0 / OFF:
        return None
    return f"the markers move by {1e3 * size.measured:.3g} mm, and by such lengths of cable {1e3 * size.nominal:.3g} mm"


def _driven_words(size: Size | None, unit: str) -> str:
    """Displacement of the markers by the cables, in words."""
    return f"in {unit} " + ("farther than any body bends" if size is None else f"{1e3 * size.nominal:.3g} mm")
