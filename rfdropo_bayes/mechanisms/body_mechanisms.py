"""Mechanisms of the body: masses, gravity's direction, a material beyond linear elasticity, cables, a fluid, a wall.

An imposed cable length does not depend on the tension, so friction at the drive would have no effect. Friction and
elasticity of cables act between the guides, or in series with the drive; see ``fem.cable_friction``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rfdropo_bayes.fem import BendingLaw, Material, Rod, Viscoelasticity, Wall
from rfdropo_bayes.mechanisms.default_priors import half_normal, log_normal, normal
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.mechanisms import Values
from rfdropo_bayes.simulators.parameters import ParameterSpec

AXES = ("x", "y", "z")
PART = 0.1  # of the length: half the width of a part of the body


class Payload:
    """A point mass at the tip; zero is the base simulator."""

    name = "payload"
    stage = "body"
    cause = "a gripper, marker or weight at the tip that the model lacks"
    remedy = "weigh the load at the tip"
    parameters = (ParameterSpec("payload_mass", "kg", 0.0, 5.0, 0.0, half_normal(0.1), "mass hung at the tip"),)

    def embody(self, values: Values, material: Material, body: Rod) -> Material:
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
            "stiffness_gradient", "-", -5.0, 5.0, 0.0, normal(0.5), "log ratio of the moduli of tip and clamp"
        ),
    )

    def embody(self, values: Values, material: Material, body: Rod) -> Material:
        """Scale each layer by the gradient at its middle."""
        middle = 0.5 * (body.station[1:] + body.station[:-1])
        s = (middle - body.station[0]) / (body.station[-1] - body.station[0])
        return material._replace(
            stiffness_scale=material.stiffness_scale * jnp.exp(values["stiffness_gradient"] * (s - 0.5))
        )


class AxialStiffness:
    """The body is stiffer or softer in tension than in bending; zero is the base simulator."""

    name = "axial_stiffness"
    stage = "body"
    bodies = ("rod",)
    cause = "a hollow, notched or reinforced section, whose stiffness in tension does not follow from its bending"
    remedy = "hang a known weight on the body and measure how much longer it gets"
    parameters = (
        ParameterSpec(
            "axial_stiffness",
            "-",
            -4.0,
            4.0,
            0.0,
            normal(1.0),
            "log ratio of the stiffness in tension and its value by the section profile",
        ),
    )

    def embody(self, values: Values, material: Material, body: Rod) -> Material:
        """Scale the stiffness in tension of every layer."""
        return material._replace(axial_scale=material.axial_scale * jnp.exp(values["axial_stiffness"]))


class SoftPart:
    """A part of the body, about a fifth of its length, is softer or stiffer; zero is the base simulator."""

    name = "soft_part"
    stage = "body"
    cause = "a cavity, a crack, glue or an insert in a part of the body"
    remedy = "bend the body by hand and look for the part that bends more or less than its neighbours"
    parameters = (
        ParameterSpec("soft_part", "-", -3.0, 3.0, 0.0, normal(0.5), "log ratio of the part's modulus to the others'"),
        ParameterSpec(
            "soft_part_place",
            "-",
            0.0,
            1.0,
            0.5,
            {"distribution": "Uniform", "low": 0.0, "high": 1.0},
            "middle of the part, as a share of the length from the clamp",
            grid=(0.1, 0.3, 0.5, 0.7, 0.9),
        ),
    )

    def embody(self, values: Values, material: Material, body: Rod) -> Material:
        """Scale each element by a bell curve around the part."""
        middle = 0.5 * (body.station[1:] + body.station[:-1])
        s = (middle - body.station[0]) / (body.station[-1] - body.station[0])
        bell = jnp.exp(-(((s - values["soft_part_place"]) / PART) ** 2))
        return material._replace(stiffness_scale=material.stiffness_scale * jnp.exp(values["soft_part"] * bell))


class BaseCompliance:
    """The clamp gives, as if the first element were softer; zero is the base simulator."""

    name = "base_compliance"
    stage = "body"
    cause = "a mount, a glued joint or a printed clamp that bends"
    remedy = "push at the base and watch whether the clamp turns; stiffen it"
    parameters = (
        ParameterSpec(
            "base_compliance",
            "-",
            0.0,
            10.0,
            0.0,
            half_normal(0.1),
            "compliance of the clamp in bending, relative to that of the whole body",
        ),
    )

    def embody(self, values: Values, material: Material, body: Rod) -> Material:
        """Soften the first element by the compliance that the clamp adds."""
        length = np.diff(body.station)
        moment = body.bending_moment_area.mean(axis=1)
        share = float(np.sum(length / moment) / (length[0] / moment[0]))
        factor = 1.0 / (1.0 + values["base_compliance"] * share)
        return material._replace(stiffness_scale=material.stiffness_scale.at[0].multiply(factor))


class BaseTilt:
    """The base is mounted at an angle: gravity turns about axes of the base; zero is the base simulator.

    Args:
        axes: axes of successive turns.
    """

    name = "base_tilt"
    stage = "body"
    cause = "a mount that is not level, or a motion-capture frame that is not plumb"
    remedy = "level the base and recalibrate the frame's vertical"

    def __init__(self, axes: Sequence[str] = AXES) -> None:
        self.axes = tuple(axes)
        prior = normal(0.05)
        self.parameters = tuple(
            ParameterSpec(f"base_tilt_{axis}", "rad", -0.8, 0.8, 0.0, dict(prior), f"tilt about {axis}")
            for axis in self.axes
        )

    @classmethod
    def for_robot(cls, robot: Robot) -> BaseTilt:
        """The two axes across a robot's gravity: a tilt about the axis along gravity has no effect."""
        along = int(np.argmax(np.abs(robot.gravity)))
        return cls([axis for k, axis in enumerate(AXES) if k != along])

    def embody(self, values: Values, material: Material, body: Rod) -> Material:
        """Rotate gravity into the tilted base."""
        gravity = material.gravity
        for axis in self.axes:
            angle = values[f"base_tilt_{axis}"]
            first, second = ((AXES.index(axis) + k) % 3 for k in (1, 2))
            c, s = jnp.cos(angle), jnp.sin(angle)
            turned = gravity.at[first].set(c * gravity[first] + s * gravity[second])
            gravity = turned.at[second].set(c * gravity[second] - s * gravity[first])
        return material._replace(gravity=gravity)


def _bending(material: Material, **changes: Array) -> Material:
    """The material with changes to its bending law, which several mechanisms share."""
    law = material.effects.bending or BendingLaw()
    return material._replace(effects=material.effects._replace(bending=law._replace(**changes)))


class ViscoelasticBranch:
    """One Prony branch, E(t) = E (1 + g exp(-t / tau)); g = 0 is the base simulator."""

    name = "viscoelasticity"
    stage = "body"
    bodies = ("rod",)
    motions = ("dynamic",)
    cause = "relaxation of the elastomer: it creeps in holds and is stiffer when moved fast"
    remedy = "record a hold of a minute after a fast move, or a relaxation test of a sample"
    parameters = (
        ParameterSpec(
            "prony_fraction", "-", 0.0, 10.0, 0.0, half_normal(0.3), "stiffness of the branch per long-term stiffness"
        ),
        ParameterSpec(
            "prony_time",
            "s",
            0.01,
            100.0,
            1.0,
            log_normal(1.0, 1.0),
            "relaxation time of the branch",
            grid=(0.1, 0.3, 1.0, 3.0, 10.0),
        ),
    )

    def embody(self, values: Values, material: Material, body: Rod) -> Material:
        """Put the branch beside the elasticity of every layer."""
        branch = Viscoelasticity(values["prony_fraction"], values["prony_time"])
        return material._replace(effects=material.effects._replace(viscoelasticity=branch))


class FibreLaw:
    """The stiffness of the body's fibres changes with their strain, by 1 - 3 c x at small strains x and never below
    zero; zero is the base simulator. See `fem.sections`.
    """

    name = "fibre_law"
    stage = "body"
    bodies = ("rod",)
    cause = "a material whose stiffness changes with stretch, notches that close, or fibres that take up load"
    remedy = "pull and press a sample of the material along its axis, and compare the two slopes"
    parameters = (
        ParameterSpec(
            "fibre_law",
            "-",
            -2.0,
            2.0,
            0.0,
            normal(0.5),
            "c of the stiffness E (1 - 3 c x) at small strains x: -1 St. Venant-Kirchhoff, 2/3 rubber",
        ),
    )

    def embody(self, values: Values, material: Material, body: Rod) -> Material:
        """Give every section the law."""
        return _bending(material, fibre=values["fibre_law"])


class PlaneAnisotropy:
    """The two planes of bending differ, or are coupled; zero is the base simulator."""

    name = "plane_anisotropy"
    stage = "body"
    bodies = ("rod",)
    cause = "a section that is not round: casting seams, cable channels, embedded tubes"
    remedy = "measure the deflection under a weight at the tip in several directions about the axis"
    parameters = (
        ParameterSpec(
            "plane_anisotropy",
            "-",
            -2.0,
            2.0,
            0.0,
            normal(0.2),
            "log ratio of the bending stiffnesses in the xz and the yz plane",
        ),
        ParameterSpec(
            "cross_plane_stiffness",
            "-",
            -0.8,
            0.8,
            0.0,
            normal(0.1),
            "stiffness that couples the planes, relative to their mean",
        ),
    )

    def embody(self, values: Values, material: Material, body: Rod) -> Material:
        """Change the bending stiffness of every layer."""
        return _bending(material, anisotropy=values["plane_anisotropy"], cross_plane=values["cross_plane_stiffness"])


class BendTwistCoupling:
    """Bending twists the body; zero is the base simulator."""

    name = "bend_twist_coupling"
    stage = "body"
    bodies = ("rod",)
    cause = "cables or fibres that run helically, or a section without mirror planes"
    remedy = "watch for twist of the tip when one cable is pulled; check the routing of the cables"
    parameters = tuple(
        ParameterSpec(
            f"bend_twist_{axis}",
            "-",
            -0.5,
            0.5,
            0.0,
            normal(0.1),
            f"coupling of twist and rotation about {axis}, relative to the mean of EI and GJ",
        )
        for axis in "xy"
    )

    def embody(self, values: Values, material: Material, body: Rod) -> Material:
        """Couple twist and bending of every layer."""
        return _bending(material, twist_x=values["bend_twist_x"], twist_y=values["bend_twist_y"])


class Softening:
    """The modulus falls exponentially with the time since the start of the recording; zero is the base simulator."""

    name = "softening"
    stage = "body"
    bodies = ("rod",)
    motions = ("dynamic",)
    cause = "warming of the body or its drives, or softening of the elastomer with use (Mullins)"
    remedy = "warm up before recording, repeat the same commands at the end, and log the temperature"
    parameters = (
        ParameterSpec(
            "softening_rate", "1/s", -0.05, 0.05, 0.0, normal(0.005), "relative loss of stiffness per second"
        ),
    )

    def embody(self, values: Values, material: Material, body: Rod) -> Material:
        """Let every modulus drift."""
        return material._replace(effects=material.effects._replace(softening_rate=values["softening_rate"]))


class CoulombFriction:
    """Each guide holds its cable back with a constant force, by stick and slip; zero is the base simulator."""

    name = "coulomb_friction"
    stage = "body"
    bodies = ("rod",)
    needs_cables = True
    cause = "cables that rub in their guides, sheaths or seals with a force that does not depend on tension"
    remedy = "pull a slack cable through the body with a spring scale; lubricate or line the guides"
    parameters = (
        ParameterSpec(
            "coulomb_friction", "N", 0.0, 50.0, 0.0, half_normal(0.5), "friction force of every guide along the cable"
        ),
    )

    def embody(self, values: Values, material: Material, body: Rod) -> Material:
        """Give every guide the friction force."""
        return material._replace(effects=material.effects._replace(coulomb_friction=values["coulomb_friction"]))


class CapstanFriction:
    """Tension decays along a bent cable by exp(-mu angle) as it slides; zero is the base simulator."""

    name = "capstan_friction"
    stage = "body"
    bodies = ("rod",)
    needs_cables = True
    cause = "friction of cables pressed against their guides as the body bends"
    remedy = "measure the tension at both ends of a cable over a known bend; lubricate or line the guides"
    parameters = (
        ParameterSpec(
            "capstan_friction",
            "-",
            0.0,
            2.0,
            0.0,
            half_normal(0.3),
            "coefficient of friction between cables and guides",
        ),
    )

    def embody(self, values: Values, material: Material, body: Rod) -> Material:
        """Give every guide the coefficient of friction."""
        return material._replace(effects=material.effects._replace(capstan_friction=values["capstan_friction"]))


class CableCompliance:
    """Cables and transmission stretch in proportion to tension; zero is the base simulator."""

    name = "cable_compliance"
    stage = "body"
    bodies = ("rod",)
    needs_cables = True
    cause = "stretch of the cables, of their anchorage and of the transmission under load"
    remedy = "hang a known weight on each cable and measure its stretch; use stiffer cable"
    parameters = (
        ParameterSpec(
            "cable_compliance", "m/N", 0.0, 0.1, 0.0, half_normal(1e-3), "stretch of every cable per tension"
        ),
    )

    def embody(self, values: Values, material: Material, body: Rod) -> Material:
        """Put the compliance in series with every cable."""
        before = material.effects.cable_compliance
        compliance = values["cable_compliance"] if before is None else before + values["cable_compliance"]
        return material._replace(effects=material.effects._replace(cable_compliance=compliance))


class QuadraticDrag:
    """Drag with the square of the speed; zero is the base simulator."""

    name = "quadratic_drag"
    stage = "body"
    bodies = ("rod",)
    motions = ("dynamic",)
    cause = "resistance of the surrounding air or water"
    remedy = "compare slow and fast sweeps of the same path"
    parameters = (
        ParameterSpec(
            "drag_density",
            "kg/m3",
            0.0,
            1e5,
            0.0,
            half_normal(300.0),
            "half the fluid's density times the drag coefficient",
        ),
    )

    def embody(self, values: Values, material: Material, body: Rod) -> Material:
        """Let every section be dragged."""
        return material._replace(effects=material.effects._replace(drag=values["drag_density"]))


class WallContact:
    """A surface beside the body pushes back if the body's axis passes it; zero stiffness is the base simulator."""

    name = "wall_contact"
    stage = "body"
    bodies = ("rod",)
    cause = "the body touches its mount, a table, a cable bundle or itself"
    remedy = "check whether the trajectory ends on one side; clear the workspace or measure the surface's position"
    parameters = (
        ParameterSpec(
            "wall_stiffness",
            "N/m2",
            0.0,
            1e7,
            0.0,
            half_normal(1e3),
            "force of the surface per depth and length of the body",
        ),
        ParameterSpec(
            "wall_distance",
            "m",
            -1.0,
            1.0,
            0.03,
            normal(0.03, loc=0.03),
            "distance at which the surface stops the axis, from the axis at rest",
            grid=(0.005, 0.01, 0.02, 0.04, 0.08),
        ),
        ParameterSpec(
            "wall_azimuth",
            "rad",
            -2 * math.pi,
            2 * math.pi,
            0.0,
            {"distribution": "Uniform", "low": -math.pi, "high": math.pi},
            "direction in which the surface lies, from x towards y",
            grid=tuple(math.pi / 4 * k for k in range(-3, 5)),
        ),
    )

    def embody(self, values: Values, material: Material, body: Rod) -> Material:
        """Put the wall there."""
        wall = Wall(values["wall_stiffness"], values["wall_distance"], values["wall_azimuth"])
        return material._replace(effects=material.effects._replace(wall=wall))
