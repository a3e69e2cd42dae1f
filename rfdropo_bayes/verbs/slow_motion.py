"""Whether a recording moves so slowly that a quasi-static motion is likely enough; needs no simulation."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.verbs.command_lag import apart

LAGGING = 0.02  # share of its way by which a body may stay behind its commands and count as slow
SETTLED = 10.0  # times a body's slowest period and its damping's time after which it has come to rest


def first_period(robot: Robot) -> float:
    """Slowest period of bending [s] at nominal parameters, by Rayleigh's quotient of the sag under its own weight."""
    body, nominal = robot.body, robot.nominal()
    station = np.array(body.station_m)
    length = np.diff(station)
    rigidity = nominal["young_modulus"] * np.array(body.bending_moment_area_m4).mean(axis=1)
    shares = robot.density(nominal["trunk_mass"]) * np.array(body.mass_area_m2) * length / 2.0
    mass = np.append(shares, 0.0) + np.append(0.0, shares) + np.asarray(robot.point_masses(nominal))
    arm = np.maximum(station[None, :] - (station[:-1, None] + station[1:, None]) / 2.0, 0.0)
    turn = np.cumsum(np.append(0.0, length / rigidity * (arm @ mass)))  # under a unit acceleration
    sag = np.cumsum(np.append(0.0, length * (turn[:-1] + turn[1:]) / 2.0))
    return float(2.0 * np.pi * np.sqrt(np.sum(mass * sag**2) / np.sum(mass * sag)))


def slow_motion(robot: Robot, recording: Trajectory) -> str | None:
    """Why a body that is at rest in every row will do, in words; None if it may not.

    Either rows are so far apart that it has come to rest in each, or each shows a pose of its own, or its commands
    change so slowly that it keeps up.
    """
    period, damping = first_period(robot), robot.nominal()["rayleigh_stiffness"]
    if len(recording.time) < 2:
        return None
    interval = float(np.median(np.diff(recording.time)))
    if interval > SETTLED * max(period, damping):
        return f"rows are {interval:.3g} s apart, and the body comes to rest within a few periods of {period:.2g} s"
    if (words := apart(recording)) is not None:
        return f"the body comes to rest in each row: {words}"
    rate = command_rate(recording)
    if rate is not None and rate * damping + (rate * period / (2.0 * np.pi)) ** 2 < LAGGING:
        return (
            f"commands take {1.0 / rate:.3g} s to change by their size, and the body's slowest period is {period:.2g} s"
        )
    return None


def command_rate(recording: Trajectory) -> float | None:
    """Rate of change of commands from row to row, relative to their size [1/s]; None for commands that never change."""
    at = np.searchsorted(recording.command_time, recording.time, side="right")
    command: Float[np.ndarray, "time channel"] = np.vstack([recording.initial_command, recording.command])[at]
    if not np.ptp(command, axis=0).any():
        return None
    size = np.sqrt(np.mean(np.sum((command - command.mean(axis=0)) ** 2, axis=1)))
    speed = np.diff(command, axis=0) / np.diff(recording.time)[:, None]
    return float(np.sqrt(np.mean(np.sum(speed**2, axis=1))) / size)
