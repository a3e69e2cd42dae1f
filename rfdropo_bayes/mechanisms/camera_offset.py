"""A measuring frame whose origin is off."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.simulators.mechanisms import Values
from rfdropo_bayes.simulators.parameters import ParameterSpec


class CameraOffset:
    """The origin of the measuring frame lies beside that of the robot's base; nowhere else at null."""

    name = "camera_offset"
    stage = "sensing"
    cause = "registration of the motion-capture frame, or a base that was moved"
    remedy = "register the frame's origin on the base again"
    parameters = tuple(
        ParameterSpec(
            f"camera_offset_{axis}",
            "m",
            -0.2,
            0.2,
            0.0,
            {"distribution": "Normal", "loc": 0.0, "scale": 0.002},
            f"shift of measured positions along {axis}",
        )
        for axis in "xyz"
    )

    def sense(self, values: Values, position: Float[Array, "time marker 3"]) -> Float[Array, "time marker 3"]:
        """Shift all positions."""
        return position + jnp.stack([values[spec.name] for spec in self.parameters])
