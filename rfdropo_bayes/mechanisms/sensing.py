"""Mechanisms between the true motion of the markers and what the cameras report."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.simulators.mechanisms import Values
from rfdropo_bayes.simulators.parameters import ParameterSpec

_ANGLE = {"distribution": "Normal", "loc": 0.0, "scale": 0.05}


class CameraRotation:
    """The measured frame is turned against the base's by a small rotation vector; zero is the base simulator."""

    name = "camera_rotation"
    stage = "sensing"
    cause = "registration of the motion-capture frame to the robot's base"
    remedy = "register the frame on three points of the base"
    parameters = tuple(
        ParameterSpec(f"camera_rotation_{axis}", "rad", -0.8, 0.8, 0.0, _ANGLE, f"rotation of the frame about {axis}")
        for axis in "xyz"
    )

    def sense(self, values: Values, position: Float[Array, "time marker 3"]) -> Float[Array, "time marker 3"]:
        """Rotate about the base's origin (Rodrigues' formula, written so that it is smooth at zero)."""
        vector = jnp.stack([values[spec.name] for spec in self.parameters])
        square = jnp.sum(vector**2)
        # sin(a)/a and (1 - cos(a))/a^2 by their series near zero, where the square root has no derivative.
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
        ParameterSpec(
            "camera_scale_error",
            "-",
            -0.5,
            0.5,
            0.0,
            {"distribution": "Normal", "loc": 0.0, "scale": 0.02},
            "relative error of measured lengths",
        ),
    )

    def sense(self, values: Values, position: Float[Array, "time marker 3"]) -> Float[Array, "time marker 3"]:
        """Scale about the base's origin."""
        return (1.0 + values["camera_scale_error"]) * position
