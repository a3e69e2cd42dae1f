"""Repeats of one experiment, and the noise that no model can explain, measured from them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.data.trajectory import Trajectory
from rfdropo_bayes.errors import InputError


def group_repeats(trajectories: Sequence[Trajectory]) -> list[list[int]]:
    """Indices of recordings with identical commands, group by group, in order of first appearance.

    Recordings on different robots, or under conditions that the recording itself says differ (the payload hung at the
    tip), are not repeats. Times are not compared: repeats are sampled with the jitter of their own clocks.
    """
    groups: dict[tuple[object, ...], list[int]] = {}
    for index, trajectory in enumerate(trajectories):
        command = np.concatenate([trajectory.initial_command[None], trajectory.command])
        key = (
            trajectory.robot,
            trajectory.command_unit,
            trajectory.cable_names,
            trajectory.settings.get("payload_mass", 0.0),
            command.shape,
            np.round(command, 9).tobytes(),
        )
        groups.setdefault(key, []).append(index)
    return list(groups.values())


FIRST_OPENING = 4  # commands


def command_openings(trajectory: Trajectory) -> dict[str, str]:
    """Hashes of the first 4, 8, 16 ... commands of a recording, and of all, by their number."""
    command = np.round(np.concatenate([trajectory.initial_command[None], trajectory.command]), 9)
    counts = {len(command)}
    count = FIRST_OPENING
    while count < len(command):
        counts.add(count)
        count *= 2
    return {str(n): hashlib.sha256(command[:n].tobytes()).hexdigest()[:16] for n in sorted(counts)}


def same_opening(one: Mapping[str, str], other: Mapping[str, str]) -> bool:
    """Whether two recordings have the same commands, as far as both can be compared (`command_openings`)."""
    shared = set(one) & set(other)
    return bool(shared) and one[max(shared, key=int)] == other[max(shared, key=int)]


def _squares(repeats: Sequence[Trajectory]) -> Float[np.ndarray, " marker"]:
    """Mean square distance of each marker from the mean of the repeats of ONE experiment [m2], masked positions left
    out.

    Rows are compared with rows: row k follows the same command in every repeat, though its time may differ a little.

    Raises:
        InputError: they differ in rows or markers.
    """
    shape, names = repeats[0].position.shape, repeats[0].marker_names
    for other in repeats[1:]:
        if other.position.shape != shape or other.marker_names != names:
            raise InputError(
                f"{other.name} ({other.position.shape}) and {repeats[0].name} ({shape}) differ in rows or markers",
                where="noise floor",
                remedy="give repeats of one experiment",
            )
    position = np.stack([repeat.position for repeat in repeats])
    weight = np.stack([repeat.position_mask for repeat in repeats]).astype(float)
    weight *= weight.sum(axis=0) >= 2  # a row seen once says nothing about spread
    count = weight.sum(axis=0)
    mean = (weight[..., None] * position).sum(axis=0) / np.maximum(count, 1.0)[..., None]
    square = weight * ((position - mean) ** 2).sum(axis=-1)
    return square.sum(axis=(0, 1)) / np.maximum(count.sum(axis=0), 1.0)


def noise_floor(trajectories: Sequence[Trajectory]) -> dict[str, float] | None:
    """Unbiased noise per marker [m], pooled over every group of repeats; None if nothing was repeated.

    The first row of a group counts like any other: rest poses that differ from repeat to repeat are part of the floor.
    """
    squares: dict[str, float] = {}
    freedom = 0
    for group in group_repeats(trajectories):
        if len(group) > 1:
            repeats = [trajectories[index] for index in group]
            freedom += len(group) - 1
            for marker, value in zip(repeats[0].marker_names, _squares(repeats), strict=True):
                squares[marker] = squares.get(marker, 0.0) + len(group) * value
    return {marker: float(np.sqrt(value / freedom)) for marker, value in squares.items()} if freedom else None
