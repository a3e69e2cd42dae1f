"""Measured motor angles: what the drives did, apart from what the body made of it.

Marker positions alone cannot tell a slow drive from a damped body, or a drive that stops short from a smaller spool. An
encoder on the motor sees the first of each pair only (`Observation.motor_angle`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

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
    "standard deviation of a motor angle: the encoder, and what the model of the drives misses; white",
)


class AngleData(NamedTuple):
    """Measured motor angles of all recordings, padded like their positions; channels are those of the commands.

    Attributes:
        measured: [rad], zero where there is none.
        valid: True at new readings; False where an older one is repeated, and in the padding.
    """

    measured: Float[Any, "recording time channel"]
    valid: Bool[np.ndarray, "recording time channel"]


def angle_specs(used: bool) -> tuple[ParameterSpec, ...]:
    """Parameters of the motor angles; none where they are not used."""
    return (MOTOR_ANGLE_NOISE,) if used else ()


def gather_angles(trajectories: Sequence[Trajectory], length: int) -> AngleData:
    """Motor angles of recordings padded to ``length`` rows.

    They belong to the columns of commands, and these to the robot's channels, in the order in which they stand.

    Raises:
        InputError: a recording without motor angles, or commands that are no angles.
    """
    measured, valid = [], []
    for trajectory in trajectories:
        if trajectory.motor_angle is None:
            raise InputError(
                "has no motor angles",
                where=trajectory.name,
                remedy="leave [model] motor_angle = true out, or record them",
            )
        if trajectory.command_unit != "rad":
            raise InputError(
                f"its commands are in {trajectory.command_unit}: motor angles tell of commands in rad only",
                where=trajectory.name,
                remedy="leave [model] motor_angle = true out, or give the commands as angles of the motors",
            )
        angle, mask = np.asarray(trajectory.motor_angle, dtype=float), trajectory.motor_angle_mask
        missing = ((0, length - len(angle)), (0, 0))
        measured.append(np.pad(angle, missing))
        valid.append(np.pad(np.ones(angle.shape, dtype=bool) if mask is None else mask, missing))
        if not valid[-1].any():
            raise InputError(
                "none of its motor angles is a new reading",
                where=trajectory.name,
                remedy="resample less coarsely: a row counts where the angles were just read",
            )
    known = np.stack(valid)
    return AngleData(np.where(known, np.stack(measured), 0.0), known)


def angle_residuals(
    simulated: Float[Array, "recording time channel"] | None, values: Mapping[str, Any], data: AngleData
) -> Float[Array, "recording time channel"]:
    """Unit-variance residuals of the angles, zero where there is no new one.

    Raises:
        InputError: a simulator that does not tell where its drives stand.
    """
    if simulated is None:
        raise InputError(
            "the simulator does not tell where its drives stand",
            where="[model] motor_angle",
            remedy="leave it out, or let its rollout return Observation.motor_angle",
        )
    white = (data.measured - simulated) / values[MOTOR_ANGLE_NOISE.name]
    return jnp.where(data.valid, white, 0.0)


def angle_log_density(
    simulated: Float[Array, "recording time channel"] | None, values: Mapping[str, Any], data: AngleData
) -> Float[Array, " time"]:
    """Log density of the new readings of each row, summed over recordings and channels."""
    white = angle_residuals(simulated, values, data)
    normaliser = 0.5 * jnp.log(2.0 * jnp.pi) + jnp.log(values[MOTOR_ANGLE_NOISE.name])
    return jnp.sum(-0.5 * white**2 - jnp.where(data.valid, normaliser, 0.0), axis=(0, 2))
