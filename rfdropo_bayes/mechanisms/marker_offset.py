"""Markers that sit beside the points of the body that the model takes them for."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.mechanisms import Values
from rfdropo_bayes.simulators.parameters import ParameterSpec

NUMBERED = tuple(str(k + 1) for k in range(4))
ROUNDING = 1e-30  # [m2] under the square root


class MarkerOffset:
    """Each marker displaced from its place by an arm that turns with the body; nowhere at null.

    The arm is given as it is in the first row. From there it turns as little as takes the body's direction at the
    marker, which its neighbours in the robot's order show (their chord), to what it is later: without twist, exact for
    bending between markers that are close. A robot with one marker shows no direction, and its arm keeps its own.

    Args:
        markers: names; numbers by default.
    """

    name = "marker_offset"
    stage = "sensing"
    cause = "markers glued beside the places that the robot's description gives"
    remedy = "measure where each marker sits on the body, and correct the robot's description"

    def __init__(self, markers: Sequence[str] = NUMBERED) -> None:
        self.parameters = tuple(
            ParameterSpec(
                f"marker_offset_{marker}_{axis}",
                "m",
                -0.05,
                0.05,
                0.0,
                {"distribution": "Normal", "loc": 0.0, "scale": 0.002},
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
        return position + _turned(_direction(first), _direction(position), arm)


def _direction(position: Float[Array, "time marker 3"]) -> Float[Array, "time marker 3"]:
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
