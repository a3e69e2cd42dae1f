"""What the material of the body does beyond linear elasticity with one modulus."""

from __future__ import annotations

from jaxtyping import Array

from rfdropo_bayes.fem import BendingLaw, LayeredBody, Material, Viscoelasticity
from rfdropo_bayes.simulators.mechanisms import Values
from rfdropo_bayes.simulators.parameters import ParameterSpec


def _bending(material: Material, **changes: Array) -> Material:
    """The material with changes to its bending law, which several mechanisms share."""
    law = material.effects.bending or BendingLaw()
    return material._replace(effects=material.effects._replace(bending=law._replace(**changes)))


class ViscoelasticBranch:
    """One Prony branch, E(t) = E (1 + g exp(-t / tau)); g = 0 is the base simulator."""

    name = "viscoelasticity"
    stage = "body"
    bodies = ("layered",)
    cause = "relaxation of the elastomer: it creeps in holds and is stiffer when moved fast"
    remedy = "record a hold of a minute after a fast move, or a relaxation test of a sample"
    parameters = (
        ParameterSpec(
            "prony_fraction",
            "-",
            0.0,
            10.0,
            0.0,
            {"distribution": "HalfNormal", "scale": 0.3},
            "stiffness of the branch per long-term stiffness",
        ),
        ParameterSpec(
            "prony_time",
            "s",
            0.01,
            100.0,
            1.0,
            {"distribution": "LogNormal", "median": 1.0, "sigma": 1.0},
            "relaxation time of the branch",
            grid=(0.1, 0.3, 1.0, 3.0, 10.0),
        ),
    )

    def embody(self, values: Values, material: Material, body: LayeredBody) -> Material:
        """Put the branch beside the elasticity of every layer."""
        branch = Viscoelasticity(values["prony_fraction"], values["prony_time"])
        return material._replace(effects=material.effects._replace(viscoelasticity=branch))


class BendingStiffening:
    """Bending moments grow with the cube of curvature too; zero is the base simulator."""

    name = "bending_stiffening"
    stage = "body"
    bodies = ("layered",)
    cause = "strain stiffening of the elastomer, notches that close, or cables that stiffen the body as it bends"
    remedy = "measure force against deflection of the tip up to large bends"
    parameters = (
        ParameterSpec(
            "bending_stiffening",
            "-",
            -0.2,
            20.0,
            0.0,
            {"distribution": "Normal", "loc": 0.0, "scale": 0.2},
            "relative growth of the bending moment where the body bends by one radian",
        ),
    )

    def embody(self, values: Values, material: Material, body: LayeredBody) -> Material:
        """Add the cubic moment to every layer."""
        return _bending(material, stiffening=values["bending_stiffening"])


class PlaneAnisotropy:
    """The two planes of bending differ, or are coupled; zero is the base simulator."""

    name = "plane_anisotropy"
    stage = "body"
    bodies = ("layered",)
    cause = "a section that is not round: casting seams, cable channels, embedded tubes"
    remedy = "measure the deflection under a weight at the tip in several directions about the axis"
    parameters = (
        ParameterSpec(
            "plane_anisotropy",
            "-",
            -2.0,
            2.0,
            0.0,
            {"distribution": "Normal", "loc": 0.0, "scale": 0.2},
            "log ratio of the bending stiffnesses in the xz and the yz plane",
        ),
        ParameterSpec(
            "cross_plane_stiffness",
            "-",
            -0.8,
            0.8,
            0.0,
            {"distribution": "Normal", "loc": 0.0, "scale": 0.1},
            "stiffness that couples the planes, relative to their mean",
        ),
    )

    def embody(self, values: Values, material: Material, body: LayeredBody) -> Material:
        """Change the bending stiffness of every layer."""
        return _bending(material, anisotropy=values["plane_anisotropy"], cross_plane=values["cross_plane_stiffness"])


class BendTwistCoupling:
    """Bending twists the body; zero is the base simulator."""

    name = "bend_twist_coupling"
    stage = "body"
    bodies = ("layered",)
    cause = "cables or fibres that run helically, or a section without mirror planes"
    remedy = "watch for twist of the tip when one cable is pulled; check the routing of the cables"
    parameters = tuple(
        ParameterSpec(
            f"bend_twist_{axis}",
            "-",
            -0.5,
            0.5,
            0.0,
            {"distribution": "Normal", "loc": 0.0, "scale": 0.1},
            f"coupling of twist and rotation about {axis}, relative to the mean of EI and GJ",
        )
        for axis in "xy"
    )

    def embody(self, values: Values, material: Material, body: LayeredBody) -> Material:
        """Couple twist and bending of every layer."""
        return _bending(material, twist_x=values["bend_twist_x"], twist_y=values["bend_twist_y"])


class Softening:
    """The modulus falls exponentially with the time since the start of the recording; zero is the base simulator."""

    name = "softening"
    stage = "body"
    bodies = ("layered",)
    cause = "warming of the body or its drives, or softening of the elastomer with use (Mullins)"
    remedy = "warm up before recording, repeat the same commands at the end, and log the temperature"
    parameters = (
        ParameterSpec(
            "softening_rate",
            "1/s",
            -0.05,
            0.05,
            0.0,
            {"distribution": "Normal", "loc": 0.0, "scale": 0.005},
            "relative loss of stiffness per second",
        ),
    )

    def embody(self, values: Values, material: Material, body: LayeredBody) -> Material:
        """Let every modulus drift."""
        return material._replace(effects=material.effects._replace(softening_rate=values["softening_rate"]))
