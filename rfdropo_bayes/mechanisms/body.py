"""Mechanisms of the body itself: its masses, its stiffness along the axis, and the direction of gravity."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from rfdropo_bayes.fem import LayeredBody, Material
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.mechanisms import Values
from rfdropo_bayes.simulators.parameters import ParameterSpec

AXES = ("x", "y", "z")


class Payload:
    """A point mass at the tip; zero is the base simulator."""

    name = "payload"
    stage = "body"
    cause = "a gripper, marker or weight at the tip that the model lacks"
    remedy = "weigh what hangs at the tip"
    parameters = (
        ParameterSpec(
            "payload_mass", "kg", 0.0, 5.0, 0.0, {"distribution": "HalfNormal", "scale": 0.1}, "mass hung at the tip"
        ),
    )

    def embody(self, values: Values, material: Material, body: LayeredBody) -> Material:
        """Add the mass to the last station."""
        return material._replace(point_mass=material.point_mass.at[-1].add(values["payload_mass"]))


class StiffnessGradient:
    """Young's modulus changes along the axis as ``exp(kappa (s - 1/2))``, s from 0 at the clamp to 1 at the tip."""

    name = "stiffness_gradient"
    stage = "body"
    cause = "uneven curing or ageing of the material, or a section profile that is off towards one end"
    remedy = "measure the sections, or test samples cast from both ends"
    parameters = (
        ParameterSpec(
            "stiffness_gradient",
            "-",
            -5.0,
            5.0,
            0.0,
            {"distribution": "Normal", "loc": 0.0, "scale": 0.5},
            "log ratio of the moduli of tip and clamp",
        ),
    )

    def embody(self, values: Values, material: Material, body: LayeredBody) -> Material:
        """Scale each layer by the gradient at its middle."""
        middle = 0.5 * (body.station[1:] + body.station[:-1])
        s = (middle - body.station[0]) / (body.station[-1] - body.station[0])
        return material._replace(
            stiffness_scale=material.stiffness_scale * jnp.exp(values["stiffness_gradient"] * (s - 0.5))
        )


class BaseTilt:
    """The base is mounted at an angle: gravity turns about axes of the base; zero is the base simulator.

    Args:
        axes: that it turns about, one after the other.
    """

    name = "base_tilt"
    stage = "body"
    cause = "a mount that is not level, or a motion-capture frame that is not plumb"
    remedy = "level the base and recalibrate the frame's vertical"

    def __init__(self, axes: Sequence[str] = AXES) -> None:
        self.axes = tuple(axes)
        prior = {"distribution": "Normal", "loc": 0.0, "scale": 0.05}
        self.parameters = tuple(
            ParameterSpec(f"base_tilt_{axis}", "rad", -0.8, 0.8, 0.0, dict(prior), f"tilt about {axis}")
            for axis in self.axes
        )

    @classmethod
    def for_robot(cls, robot: Robot) -> BaseTilt:
        """The two axes across a robot's gravity: about the one that is most along it, a tilt changes nothing."""
        along = int(np.argmax(np.abs(robot.gravity)))
        return cls([axis for k, axis in enumerate(AXES) if k != along])

    def embody(self, values: Values, material: Material, body: LayeredBody) -> Material:
        """Rotate gravity into the tilted base."""
        gravity = material.gravity
        for axis in self.axes:
            angle = values[f"base_tilt_{axis}"]
            first, second = ((AXES.index(axis) + k) % 3 for k in (1, 2))
            c, s = jnp.cos(angle), jnp.sin(angle)
            turned = gravity.at[first].set(c * gravity[first] + s * gravity[second])
            gravity = turned.at[second].set(c * gravity[second] - s * gravity[first])
        return material._replace(gravity=gravity)
