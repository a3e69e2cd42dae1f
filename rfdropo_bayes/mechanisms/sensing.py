"""Mechanisms between the true motion of the markers and the reports of the cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.mechanisms.default_priors import half_normal, normal
from rfdropo_bayes.mechanisms.first_order import first_order
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.mechanisms import Values
from rfdropo_bayes.simulators.parameters import ParameterSpec

NUMBERED = tuple(str(k + 1) for k in range(4))
ROUNDING = 1e-30  # [m2] under the square root
_ANGLE = normal(0.05)


class CameraRotation:
    """The measured frame is turned against the base's by a small rotation vector; zero is the base simulator."""

    name = "camera_rotation"
    stage = "sensing"
    cause = "registration of the motion-capture frame to the robot's base"
    remedy = "register the frame on three points of the base"
    parameters = tuple(
        ParameterSpec(f"camera_rotation_{axis}", "rad", -1.6, 1.6, 0.0, _ANGLE, f"rotation of the frame about {axis}")
        for axis in "xyz"
    )

    def sense(self, values: Values, position: Float[Array, "time marker 3"]) -> Float[Array, "time marker 3"]:
        """Rotate about the base's origin (Rodrigues' formula, written so that it is smooth at zero)."""
        vector = jnp.stack([values[spec.name] for spec in self.parameters])
        square = jnp.sum(vector**2)
        # sin(a)/a and (1 - cos(a))/a^2 by their series near zero, at which the square root has no derivative.
        small = square < 1e-8
        angle = jnp.sqrt(jnp.where(small, 1.0, square))
        first = jnp.where(small, 1.0 - square / 6.0, jnp.sin(angle) / angle)
        second = jnp.where(small, 0.5 - square / 24.0, (1.0 - jnp.cos(angle)) / angle**2)
        turned = jnp.cross(vector, position)
        return position + first * turned + second * jnp.cross(vector, turned)


class CameraScale:
    """Lengths are measured ``1 + camera_scale_error`` too large; zero is the base simulator."""

    name = "camera_scale"
    stage = "sensing"
    cause = "scale calibration of the motion capture"
    remedy = "measure a known length"
    parameters = (
        ParameterSpec("camera_scale_error", "-", -0.9, 9.0, 0.0, normal(0.02), "relative error of measured lengths"),
    )

    def sense(self, values: Values, position: Float[Array, "time marker 3"]) -> Float[Array, "time marker 3"]:
        """Scale about the base's origin."""
        return (1.0 + values["camera_scale_error"]) * position


class CameraOffset:
    """The origin of the measuring frame is displaced from the robot's base; by zero in the base simulator."""

    name = "camera_offset"
    stage = "sensing"
    cause = "registration of the motion-capture frame, or a base that was moved"
    remedy = "register the frame's origin on the base again"
    parameters = tuple(
        ParameterSpec(
            f"camera_offset_{axis}", "m", -0.2, 0.2, 0.0, normal(0.002), f"shift of measured positions along {axis}"
        )
        for axis in "xyz"
    )

    def sense(self, values: Values, position: Float[Array, "time marker 3"]) -> Float[Array, "time marker 3"]:
        """Shift all positions."""
        return position + jnp.stack([values[spec.name] for spec in self.parameters])


class MarkerOffset:
    """Each marker displaced from its place by an arm that turns with the body; zero in the base simulator.

    The arm is given as it is in the first row. The arm turns with the body's direction at the marker (the chord of the
    neighbouring markers), by the smallest rotation. This neglects twist, and is exact for bending between close
    markers. With one marker the direction of the body is unknown, and the arm does not turn.

    Args:
        markers: names; numbers by default.
    """

    name = "marker_offset"
    stage = "sensing"
    cause = "markers glued beside the places that the robot's description gives"
    remedy = "measure each marker's position on the body, and correct the robot's description"

    def __init__(self, markers: Sequence[str] = NUMBERED) -> None:
        self.parameters = tuple(
            ParameterSpec(
                f"marker_offset_{marker}_{axis}",
                "m",
                -0.05,
                0.05,
                0.0,
                normal(0.002),
                f"distance of marker {marker} from its place along {axis}, at the start",
            )
            for marker in markers
            for axis in "xyz"
        )

    @classmethod
    def for_robot(cls, robot: Robot) -> MarkerOffset:
        """One arm for every marker of a robot."""
        return cls(robot.marker_names)

    def sense(self, values: Values, position: Float[Array, "time marker 3"]) -> Float[Array, "time marker 3"]:
        """Add the arms, turned."""
        return self._moved(values, position[:1], position)

    def begin(self, values: Values, first: Float[Array, "marker 3"], interval: float) -> Float[Array, "marker 3"]:
        """The first positions, at which the arms are given."""
        return first

    def advance(
        self, values: Values, memory: Float[Array, "marker 3"], given: Float[Array, "marker 3"], now: Float[Array, ""]
    ) -> tuple[Float[Array, "marker 3"], Float[Array, "marker 3"]]:
        """Add the arms, turned."""
        return memory, self._moved(values, memory[None], given[None])[0]

    def _moved(
        self, values: Values, first: Float[Array, "1 marker 3"], position: Float[Array, "time marker 3"]
    ) -> Float[Array, "time marker 3"]:
        count = position.shape[1]
        arm = jnp.stack([values[spec.name] for spec in self.parameters[: 3 * count]]).reshape(count, 3)
        if count == 1:
            return position + arm
        return position + _turned(direction_along(first), direction_along(position), arm)


def direction_along(position: Float[Array, "time marker 3"]) -> Float[Array, "time marker 3"]:
    """Direction of the body at every marker: the chord of its neighbours."""
    ends = position[:, 1:2] - position[:, :1], position[:, -1:] - position[:, -2:-1]
    chord = jnp.concatenate([ends[0], position[:, 2:] - position[:, :-2], ends[1]], axis=1)
    return chord / jnp.sqrt(jnp.sum(chord**2, axis=-1, keepdims=True) + ROUNDING)


def _turned(
    first: Float[Array, "1 marker 3"], now: Float[Array, "time marker 3"], arm: Float[Array, "marker 3"]
) -> Float[Array, "time marker 3"]:
    """Arms after the smallest rotation that takes one unit direction to another (Rodrigues' formula)."""
    axis = jnp.cross(first, now)  # its length is the sine
    cosine = jnp.sum(first * now, axis=-1, keepdims=True)
    once = jnp.cross(axis, arm)
    return arm + once + jnp.cross(axis, once) / jnp.maximum(1.0 + cosine, 1e-3)  # a body does not turn right round


class SensorLag:
    """Measured positions are smoothed by a first-order filter, ``tau y' = x - y``; tau = 0 at null."""

    name = "sensor_lag"
    stage = "sensing"
    cause = "a low-pass filter of the motion capture, or exposure that blurs over time"
    remedy = "switch the filter off, or record the drives' own encoders for comparison"
    parameters = (ParameterSpec("sensor_lag", "s", 0.0, 5.0, 0.0, half_normal(0.1), "time constant of the filter"),)

    def sense_over_time(
        self, values: Values, position: Float[Array, "time marker 3"], time: Float[Array, " time"]
    ) -> Float[Array, "time marker 3"]:
        """Exact response to positions that run straight from one observation to the next."""

        def follow(memory: tuple[Array, Array, Array], row: tuple[Array, Array]) -> tuple[Any, Array]:
            return self.advance(values, memory, *row)

        return jax.lax.scan(follow, self.begin(values, position[0], 0.0), (position, time - time[0]))[1]

    def begin(self, values: Values, first: Float[Array, "marker 3"], interval: float) -> tuple[Array, Array, Array]:
        """The last position as seen and as it was, and its time, from zero."""
        return first, first, jnp.zeros(())

    def advance(
        self, values: Values, memory: tuple[Array, Array, Array], given: Float[Array, "marker 3"], now: Float[Array, ""]
    ) -> tuple[tuple[Array, Array, Array], Float[Array, "marker 3"]]:
        """Exact response to a position that ran straight from the last position to this."""
        last, before, then = memory
        seen = first_order(last, before, given, jnp.maximum(now - then, 1e-9), values["sensor_lag"])
        return (seen, given, jnp.asarray(now, float)), seen


class ClockOffset:
    """Positions carry time stamps that are late or early by a constant; zero at null."""

    name = "clock_offset"
    stage = "sensing"
    cause = "cameras and drives on clocks that were not synchronised, or frames stamped when they arrive"
    remedy = "synchronise the clocks by a trigger that both record"
    parameters = (
        ParameterSpec("clock_offset", "s", -1.0, 1.0, 0.0, normal(0.05), "delay between motion and its time stamp"),
    )
    shows_future = ("clock_offset",)  # parameters below zero of which no session is possible

    def sense_over_time(
        self, values: Values, position: Float[Array, "time marker 3"], time: Float[Array, " time"]
    ) -> Float[Array, "time marker 3"]:
        """Read the positions at other times, linearly between observations; beyond the ends they stand still."""
        return read_at(position, time, time - values["clock_offset"])

    def begin(self, values: Values, first: Float[Array, "marker 3"], interval: float) -> tuple[Array, Array]:
        """The last observations and their times, as far back as an offset may reach; none before the first."""
        rows = math.ceil(self.parameters[0].high / interval) + 2
        return jnp.broadcast_to(first, (rows, *first.shape)), jnp.zeros(rows)

    def advance(
        self, values: Values, memory: tuple[Array, Array], given: Float[Array, "marker 3"], now: Float[Array, ""]
    ) -> tuple[tuple[Array, Array], Float[Array, "marker 3"]]:
        """Read the positions earlier."""
        position = jnp.concatenate([memory[0][1:], given[None]])
        time = jnp.concatenate([memory[1][1:], jnp.asarray(now, float)[None]])
        return (position, time), read_at(position, time, now - values["clock_offset"])


def read_at(
    position: Float[Array, "time marker 3"], time: Float[Array, " time"], at: Float[Array, "*when"]
) -> Float[Array, "*when marker 3"]:
    """Positions at other times, linearly between the given times; constant beyond the ends."""
    # Not a clip, whose derivative at the first and last row would be halved.
    until = jnp.where(at > time[-1], time[-1], at)
    after = jnp.clip(jnp.searchsorted(time, until), 1, len(time) - 1)
    gap = jnp.maximum(time[after] - time[after - 1], 1e-9)
    weight = ((time[after] - until) / gap)[..., None, None]
    read = position[after] - weight * (position[after] - position[after - 1])
    return jnp.where((at > time[0])[..., None, None], read, position[0])
