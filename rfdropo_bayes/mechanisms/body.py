"""Mechanisms of the body itself: its masses, its stiffness along the axis, and the direction of gravity."""

from __future__ import annotations

import jax.numpy as jnp

from rfdropo_bayes.fem import LayeredBody, Material
from rfdropo_bayes.simulators.mechanisms import Values
from rfdropo_bayes.simulators.parameters import ParameterSpec


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
    """The base is mounted at an angle: gravity turns about the base's x and y axes; zero is the base simulator."""

    name = "base_tilt"
    stage = "body"
    cause = "a mount that is not level, or a motion-capture frame that is not plumb"
    remedy = "level the base and recalibrate the frame's vertical"
    parameters = (
        ParameterSpec(
            "base_tilt_x", "rad", -0.8, 0.8, 0.0, {"distribution": "Normal", "loc": 0.0, "scale": 0.05}, "tilt about x"
        ),
        ParameterSpec(
            "base_tilt_y", "rad", -0.8, 0.8, 0.0, {"distribution": "Normal", "loc": 0.0, "scale": 0.05}, "tilt about y"
        ),
    )

    def embody(self, values: Values, material: Material, body: LayeredBody) -> Material:
        """Rotate gravity into the tilted base."""
        cx, sx = jnp.cos(values["base_tilt_x"]), jnp.sin(values["base_tilt_x"])
        cy, sy = jnp.cos(values["base_tilt_y"]), jnp.sin(values["base_tilt_y"])
        about_x = jnp.stack([jnp.array([1.0, 0.0, 0.0]), jnp.stack([0 * cx, cx, sx]), jnp.stack([0 * cx, -sx, cx])])
        about_y = jnp.stack([jnp.stack([cy, 0 * cy, -sy]), jnp.array([0.0, 1.0, 0.0]), jnp.stack([sy, 0 * cy, cy])])
        return material._replace(gravity=about_y @ (about_x @ material.gravity))
