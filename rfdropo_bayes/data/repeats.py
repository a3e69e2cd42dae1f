"""Repeats of one experiment, and the noise that no model can explain, measured from them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence

import numpy as np

from rfdropo_bayes.data.sample_times import ONE_RATE, sample_time
from rfdropo_bayes.data.trajectory import Trajectory


def group_repeats(trajectories: Sequence[Trajectory]) -> list[list[int]]:
    """Indices of recordings with identical commands, group by group, in order of first appearance.

    Recordings are not repeats if the robots, the recorded conditions (a payload at the tip) or the speeds of the
    commands differ. Times are not compared further, since the sampling times of repeats jitter.
    """
    groups: dict[tuple[object, ...], list[list[int]]] = {}
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
        alike, own = groups.setdefault(key, []), _span(trajectory)
        group = next((each for each in alike if _of_one_rate(own, _span(trajectories[each[0]]))), None)
        if group is None:
            alike.append([index])
        else:
            group.append(index)
    return sorted(group for alike in groups.values() for group in alike)


def _span(trajectory: Trajectory) -> float:
    """Time from the first command to the last [s]."""
    return float(np.ptp(trajectory.command_time))


def _of_one_rate(one: float, other: float) -> bool:
    """Whether two times are equal within the jitter of clocks; a zero time means a single command."""
    return one == other or (min(one, other) > 0.0 and max(one, other) < ONE_RATE * min(one, other))


FIRST_OPENING = 4  # commands


def command_openings(trajectory: Trajectory) -> dict[str, str]:
    """Hashes of the first 4, 8, 16 ... commands of a recording, and of all commands, by their number, each with a
    duration [s].
    """
    command = np.round(np.concatenate([trajectory.initial_command[None], trajectory.command]), 9)
    given = np.concatenate([trajectory.command_time[:1], trajectory.command_time])
    counts = {len(command)}
    count = FIRST_OPENING
    while count < len(command):
        counts.add(count)
        count *= 2
    return {
        str(n): f"{hashlib.sha256(command[:n].tobytes()).hexdigest()[:16]} {float(np.ptp(given[:n])):.6g}"
        for n in sorted(counts)
    }


def same_opening(one: Mapping[str, str], other: Mapping[str, str]) -> bool:
    """Whether two recordings have the same commands at the same speed, over their shared rows; see
    `command_openings`. If one speed is unknown, only commands are compared.
    """
    shared = set(one) & set(other)
    if not shared:
        return False
    count = max(shared, key=int)
    (begun, *took), (theirs, *their) = one[count].split(), other[count].split()
    return begun == theirs and all(_of_one_rate(float(a), float(b)) for a, b in zip(took, their, strict=False))


def _variances(repeats: Sequence[Trajectory]) -> dict[str, float]:
    """Variance [m2] of each marker that all repeats of ONE experiment have, masked positions left out.

    Rows are compared with rows, as far as all repeats go: row k follows the same command in each, though its time may
    differ a little. A marker that no two of them saw at once has none.
    """
    names = [name for name in repeats[0].marker_names if all(name in other.marker_names for other in repeats)]
    rows = min(len(repeat.time) for repeat in repeats)
    columns = [[repeat.marker_names.index(name) for name in names] for repeat in repeats]
    own = list(zip(repeats, columns, strict=True))
    position = np.stack([repeat.position[:rows, index] for repeat, index in own])
    weight = np.stack([repeat.position_mask[:rows, index] for repeat, index in own]).astype(float)
    weight *= weight.sum(axis=0) >= 2  # a row seen once gives no spread
    count = weight.sum(axis=0)
    mean = (weight[..., None] * position).sum(axis=0) / np.maximum(count, 1.0)[..., None]
    square = (weight * ((position - mean) ** 2).sum(axis=-1)).sum(axis=(0, 1))
    freedom = np.maximum(count - 1.0, 0.0).sum(axis=0)
    return {name: float(s / f) for name, s, f in zip(names, square, freedom, strict=True) if f}


def noise_floor(trajectories: Sequence[Trajectory]) -> dict[str, float] | None:
    """Unbiased noise per marker [m], pooled over every group of repeats; None if nothing was repeated.

    Repeats in rows of another rate are not compared. The first row of a group counts like any other: rest poses that
    differ from repeat to repeat are part of the floor.
    """
    total: dict[str, float] = {}
    freedom: dict[str, int] = {}
    for repeated in group_repeats(trajectories):
        for group in _in_rows_alike([trajectories[index] for index in repeated]):
            for marker, variance in (_variances(group) if len(group) > 1 else {}).items():
                total[marker] = total.get(marker, 0.0) + (len(group) - 1) * variance
                freedom[marker] = freedom.get(marker, 0) + len(group) - 1
    return {marker: float(np.sqrt(total[marker] / freedom[marker])) for marker in total} or None


def _in_rows_alike(repeats: Sequence[Trajectory]) -> list[list[Trajectory]]:
    """Repeats, grouped by the time between rows."""
    groups: list[list[Trajectory]] = []
    for repeat in repeats:
        own = sample_time(repeat.time)
        group = next((each for each in groups if _of_one_rate(own, sample_time(each[0].time))), None)
        if group is None:
            groups.append([repeat])
        else:
            group.append(repeat)
    return groups
