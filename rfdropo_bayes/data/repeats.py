"""Repeats of one experiment, and the noise that no model can explain, measured from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.data.trajectory import Trajectory
from rfdropo_bayes.errors import InputError


class PureError(NamedTuple):
    """Spread of repeats about their mean.

    ``rms`` maps each marker to the root mean square over rows and repeats of its distance from the mean of the repeats
    [m]; multiply by sqrt(n / (n - 1)) for an unbiased estimate of the noise. ``per_row(time, marker)`` is the same for
    each row. ``degrees_of_freedom`` is n - 1 summed over the groups.
    """

    rms: dict[str, float]
    per_row: Float[np.ndarray, "time marker"]
    repeats: int
    degrees_of_freedom: int


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


def pure_error(repeats: Sequence[Trajectory]) -> PureError:
    """Spread of the repeats of ONE experiment about their mean, row by row; masked positions are left out.

    Rows are compared with rows: row k follows the same command in every repeat, though its time may differ a little.

    Raises:
        InputError: if there are fewer than two repeats, or they differ in rows or markers.
    """
    if len(repeats) < 2:
        raise InputError("one recording has no repeats", where="pure error", remedy="give two or more")
    shape, names = repeats[0].position.shape, repeats[0].marker_names
    for other in repeats[1:]:
        if other.position.shape != shape or other.marker_names != names:
            raise InputError(
                f"{other.name} ({other.position.shape}) and {repeats[0].name} ({shape}) differ in rows or markers",
                where="pure error",
                remedy="give repeats of one experiment",
            )
    position = np.stack([repeat.position for repeat in repeats])
    weight = np.stack([repeat.position_mask for repeat in repeats]).astype(float)
    weight *= weight.sum(axis=0) >= 2  # a row seen once says nothing about spread
    count = weight.sum(axis=0)
    mean = (weight[..., None] * position).sum(axis=0) / np.maximum(count, 1.0)[..., None]
    square = weight * ((position - mean) ** 2).sum(axis=-1)
    per_row = np.sqrt(square.sum(axis=0) / np.maximum(count, 1.0))
    rms = np.sqrt(square.sum(axis=(0, 1)) / np.maximum(count.sum(axis=0), 1.0))
    return PureError(dict(zip(names, rms.tolist(), strict=True)), per_row, len(repeats), len(repeats) - 1)


def noise_floor(trajectories: Sequence[Trajectory]) -> dict[str, float] | None:
    """Unbiased noise per marker [m], pooled over every group of repeats; None if nothing was repeated.

    The first row of a group counts like any other: rest poses that differ from repeat to repeat are part of the floor.
    """
    squares: dict[str, float] = {}
    freedom = 0
    for group in group_repeats(trajectories):
        if len(group) > 1:
            spread = pure_error([trajectories[index] for index in group])
            freedom += spread.degrees_of_freedom
            for marker, value in spread.rms.items():
                squares[marker] = squares.get(marker, 0.0) + spread.repeats * value**2
    return {marker: float(np.sqrt(value / freedom)) for marker, value in squares.items()} if freedom else None
