"""Measured motor angles: the motion of the drives, separate from the body's.

Marker positions alone cannot distinguish a slow drive from a damped body, or a drive that stops short from a smaller
spool. A motor encoder measures only the drive's part of each pair (`Observation.motor_angle`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.channels.channel import Seen, WhiteSeries, padded_readings
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.parameters import ParameterSpec

MOTOR_ANGLE_NOISE = ParameterSpec(
    "motor_angle_noise",
    "rad",
    1e-5,
    3.0,
    0.01,
    {"distribution": "LogNormal", "median": 0.02, "sigma": 1.5},
    "standard deviation of a motor angle: the encoder, and errors of the drive model; white",
)


@dataclass(frozen=True)
class MotorAngle(WhiteSeries):
    """Motor angles [rad]; columns are the channels of the commands. Repeated readings do not count."""

    name: ClassVar[str] = "motor_angle"
    linear: ClassVar[bool] = True
    size: ClassVar[ParameterSpec] = MOTOR_ANGLE_NOISE

    @classmethod
    def gather(cls, trajectories: Sequence[Trajectory], length: int, needed: int | None = None) -> MotorAngle:
        """Motor angles of recordings padded to ``length`` rows; only the first ``needed`` recordings must have them.

        Columns of angles follow the order of the columns of commands, which follow the order of the robot's channels.

        Raises:
            InputError: a recording without motor angles, or commands that are no angles.
        """

        def read(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray] | None:
            if trajectory.motor_angle is None:
                return None
            if trajectory.command_unit != "rad":
                raise InputError(
                    f"the commands are in {trajectory.command_unit}; motor angles need commands in rad",
                    where=trajectory.name,
                    remedy="leave [model] motor_angle = true out, or give the commands as angles of the motors",
                )
            angle, mask = np.asarray(trajectory.motor_angle, dtype=float), trajectory.motor_angle_mask
            valid = np.ones(angle.shape, dtype=bool) if mask is None else mask
            if not valid.any():
                raise InputError(
                    "no row has a new reading of the motor angles",
                    where=trajectory.name,
                    remedy="resample less coarsely: only rows with a new reading count",
                )
            return np.where(valid, angle, 0.0), valid

        return cls(*padded_readings(trajectories, length, needed, read, cls.name, "motor angles"))

    def expected(self, seen: Seen) -> Float[Any, "recording time channel"]:
        """See `Series.expected`.

        Raises:
            InputError: a simulator without drive positions.
        """
        if seen.observation.motor_angle is None:
            raise InputError(
                "the simulator has no drive positions",
                where="[model] motor_angle",
                remedy="leave it out, or let its rollout return Observation.motor_angle",
            )
        return seen.observation.motor_angle

    def deviation(
        self, measured: Float[Any, "recording time channel"], about: Float[Any, "recording time channel"]
    ) -> Float[Any, "recording time channel"]:
        """Difference of measured and simulated angles [rad]; see `Series.deviation`."""
        return measured - about
