"""Commands as a recording whose measurements are unknown, but for where the markers are in one row."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.data.recorded import Measured, Origin, SentCommands
from rfdropo_bayes.data.sample_times import sample_time
from rfdropo_bayes.data.trajectory import Trajectory
from rfdropo_bayes.errors import InputError


def commands_alone(
    origin: Origin,
    sent: SentCommands,
    marker_names: Sequence[str],
    *,
    start: Float[np.ndarray, "row marker 3"] | None = None,
    row: int = 0,
    start_file: str = "",
    motor_angle: Float[np.ndarray, "row channel"] | None = None,
) -> Trajectory:
    """Commands with the start pose at most; they begin from the first one.

    Observations are due at the times of the commands, and once more as long after the last as two are apart.

    Args:
        origin: where they come from.
        sent: the commands; before the first one, it was in force already.
        marker_names: of the robot.
        start: places of the markers [m], of which one row counts; None where none is known.
        row: that of the start pose; a single row has it, whatever its number.
        start_file: that it was read from.
        motor_angle: [rad], not a number where it is not known.

    Raises:
        InputError: a start without that row.
    """
    time = sent.command_time
    clock = np.append(time, time[-1] + (sample_time(time) if len(time) > 1 else 1.0))
    position = np.zeros((len(clock), len(marker_names), 3))
    mask = np.zeros(position.shape[:2], dtype=bool)
    if start is not None:
        if row >= len(clock) or (len(start) != 1 and row >= len(start)):
            raise InputError(f"has no row {row} to start from", where=start_file, remedy="choose other --rows")
        first = start[min(row, len(start) - 1)]
        seen = np.isfinite(first).all(axis=1)
        position[:], mask[row] = np.where(seen[:, None], first, 0.0), seen
    return Trajectory.build(
        replace(origin, settings={"unseen": True}),
        replace(sent, initial_command=sent.command[0]),
        Measured(clock, position, marker_names, mask, motor_angle=motor_angle),
    )
