"""Commands as a recording whose measurements are unknown, except the marker positions in one row."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.data.recorded import Measured, Origin, SentCommands
from rfdropo_bayes.data.sample_times import sample_time
from rfdropo_bayes.data.trajectory import Trajectory


def commands_alone(
    origin: Origin,
    sent: SentCommands,
    marker_names: Sequence[str],
    *,
    start: Float[np.ndarray, "row marker 3"] | None = None,
    motor_angle: Float[np.ndarray, "row channel"] | None = None,
    poses: bool = False,
) -> Trajectory:
    """Commands with at most a start pose; the recording begins at the first command.

    Observations are due at the times of the commands, and once one interval after the last command unless ``poses``.

    Args:
        origin: origin of the commands.
        sent: the commands; the first was already in force before its time.
        marker_names: names of the robot's markers.
        start: marker positions [m], of which the first row is used; None if unknown.
        motor_angle: motor angles [rad], NaN if unknown.
        poses: whether the pose of a row belongs to its own command, as with ``commands_with_poses``.
    """
    time = sent.command_time
    settled = poses and len(time) > 1
    clock = time if settled else np.append(time, time[-1] + (sample_time(time) if len(time) > 1 else 1.0))
    position = np.zeros((len(clock), len(marker_names), 3))
    mask = np.zeros(position.shape[:2], dtype=bool)
    if start is not None:
        seen = np.isfinite(start[0]).all(axis=1)
        position[:], mask[0] = np.where(seen[:, None], start[0], 0.0), seen
    return Trajectory.build(
        replace(origin, settings={"unseen": True, **({"settled_poses": True} if settled else {})}),
        sent.of_poses() if settled else replace(sent, initial_command=sent.command[0]),
        Measured(clock, position, marker_names, mask, motor_angle=motor_angle),
    )
