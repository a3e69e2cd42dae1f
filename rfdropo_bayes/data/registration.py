"""Bringing a recording to the robot's frame and clock: rigid registration, clock offset."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from rfdropo_bayes.data.trajectory import Trajectory
from rfdropo_bayes.errors import InputError

_COLLINEAR = 1e-2  # second singular value over the first, below which points lie on a line


class Registration(NamedTuple):
    """Rigid motion from the measured frame to the base frame: ``rotation @ point + translation``.

    ``residual`` is the root mean square distance left [m]. ``roll_determined`` is False if the points lie on a line (a
    straight trunk): the rotation about it is then the smallest one, not a measured one.
    """

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    residual: float
    roll_determined: bool


def register(
    measured: Float[np.ndarray, "points 3"],
    reference: Float[np.ndarray, "points 3"],
    weights: Float[np.ndarray, " points"] | None = None,
) -> Registration:
    """Least-squares rigid motion of measured points onto known ones (Kabsch 1976).

    Args:
        measured: points in the measured frame [m], e.g. the mean rest positions of the markers.
        reference: the same points in the base frame [m].
        weights: relative trust in each point; equal by default.

    Raises:
        InputError: if the shapes differ, fewer than two points are given, or all points coincide.
    """
    measured, reference = np.asarray(measured, dtype=float), np.asarray(reference, dtype=float)
    if measured.shape != reference.shape or measured.ndim != 2 or measured.shape[1] != 3 or len(measured) < 2:
        raise InputError(
            f"cannot register {measured.shape} points to {reference.shape}",
            where="registration",
            remedy="give the same two or more points, with x, y and z, in both frames",
        )
    weights = np.ones(len(measured)) if weights is None else np.asarray(weights, dtype=float)
    centre, target = np.average(measured, axis=0, weights=weights), np.average(reference, axis=0, weights=weights)
    spread = np.linalg.svd((reference - target) * np.sqrt(weights)[:, None], compute_uv=False)
    if spread[0] == 0.0:
        raise InputError("all points coincide", where="registration", remedy="give points that lie apart")
    on_line = len(measured) < 3 or spread[1] < _COLLINEAR * spread[0]
    if on_line:
        farthest = int(np.argmax(np.linalg.norm(reference - target, axis=1)))
        start, end = (_line_direction(points, farthest) for points in (measured - centre, reference - target))
        rotation = Rotation.align_vectors(end[None], start[None])[0].as_matrix()
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # SciPy warns where the rotation is not unique; that case is taken above
            rotation = Rotation.align_vectors(reference - target, measured - centre, weights=weights)[0].as_matrix()
    translation = target - rotation @ centre
    left = measured @ rotation.T + translation - reference
    residual = float(np.sqrt(np.average((left**2).sum(axis=1), weights=weights)))
    return Registration(rotation, translation, residual, not on_line)


def to_base_frame(trajectory: Trajectory, registration: Registration) -> Trajectory:
    """The recording with positions and object poses moved by a registration."""
    dataset = trajectory.dataset.copy()
    moved = trajectory.position @ registration.rotation.T + registration.translation
    dataset["position"] = dataset["position"].copy(data=moved)
    if trajectory.object_pose is not None:
        pose = rotate_pose(trajectory.object_pose, registration.rotation, registration.translation)
        dataset["object_pose"] = dataset["object_pose"].copy(data=pose)
    return Trajectory(dataset.assign_attrs(frame=f"registered to the robot base; from: {dataset.attrs['frame']}"))


def rotate_pose(
    pose: Float[np.ndarray, "rows 7"], rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "rows 7"]:
    """Poses (x y z [m], quaternion x y z w) seen from the frame that ``rotation @ point + translation`` leads to; those
    that are not a number stay so."""
    known = np.isfinite(pose).all(axis=1)
    turned = np.full((len(pose), 4), np.nan)
    turned[known] = (Rotation.from_matrix(rotation) * Rotation.from_quat(pose[known, 3:])).as_quat()
    return np.hstack([pose[:, :3] @ rotation.T + translation, turned])


def clock_offset(
    time: Float[np.ndarray, " rows"],
    signal: Float[np.ndarray, " rows"],
    other_time: Float[np.ndarray, " others"],
    other: Float[np.ndarray, " others"],
    largest: float,
) -> float:
    """Delay of ``other`` behind ``signal`` [s]: other(t + offset) looks like signal(t).

    Maximum of the normalised cross-correlation of the two signals' rates of change on a common grid (half the finer
    sample time), refined by a parabola.

    Args:
        time: times of the signal [s].
        signal: any quantity that moves with the other, in any unit.
        other_time: times of the other signal [s], from its own clock.
        other: the other signal.
        largest: largest offset looked for, either way [s].

    Raises:
        InputError: if the two overlap by less than twice ``largest``, or one of them is constant.
    """
    step = 0.5 * min(float(np.median(np.diff(time))), float(np.median(np.diff(other_time))))
    first, last = max(time[0], other_time[0]) + largest, min(time[-1], other_time[-1]) - largest
    if last - first < largest or not largest > step:
        raise InputError(
            f"the recordings share too little time to look for an offset of {largest:g} s",
            where="clock offset",
            remedy="look for a smaller offset, or use longer recordings",
        )
    grid = np.arange(first, last, step)
    rate = np.gradient(np.interp(grid, time, signal))
    shifts = step * np.arange(-int(largest / step), int(largest / step) + 1)
    score = np.array([_correlation(rate, np.gradient(np.interp(grid + shift, other_time, other))) for shift in shifts])
    if not np.any(score > 0.0):
        raise InputError("the signals have nothing in common", where="clock offset", remedy="choose signals that move")
    best = int(np.argmax(score))
    if 0 < best < len(score) - 1:
        low, middle, high = score[best - 1 : best + 2]
        return float(shifts[best] + 0.5 * step * (low - high) / (low - 2.0 * middle + high))
    return float(shifts[best])


def shift_commands(trajectory: Trajectory, delay: float) -> Trajectory:
    """The recording with its commands ``delay`` seconds later on the clock of the observations."""
    dataset = trajectory.dataset.assign_coords(command_time=trajectory.command_time + delay)
    return Trajectory(dataset)


def _line_direction(points: Float[np.ndarray, "points 3"], toward: int) -> Float[np.ndarray, "3"]:
    """Unit vector along centred points on a line, pointing to one of them."""
    direction = np.linalg.svd(points)[2][0]
    return direction * np.copysign(1.0, points[toward] @ direction)


def _correlation(first: np.ndarray, second: np.ndarray) -> float:
    first, second = first - first.mean(), second - second.mean()
    scale = float(np.linalg.norm(first) * np.linalg.norm(second))
    return float(first @ second) / scale if scale > 0.0 else 0.0
