"""What the base simulator leaves out around the body: a fluid, and a wall that it may touch."""

from __future__ import annotations

import math

from rfdropo_bayes.fem import LayeredBody, Material, Wall
from rfdropo_bayes.mechanisms.priors import half_normal, normal
from rfdropo_bayes.simulators.mechanisms import Values
from rfdropo_bayes.simulators.parameters import ParameterSpec


class QuadraticDrag:
    """Drag with the square of the speed; zero is the base simulator."""

    name = "quadratic_drag"
    stage = "body"
    bodies = ("layered",)
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

    def embody(self, values: Values, material: Material, body: LayeredBody) -> Material:
        """Let every section be dragged."""
        return material._replace(effects=material.effects._replace(drag=values["drag_density"]))


class WallContact:
    """A surface beside the body pushes back where the body's axis passes it; zero stiffness is the base simulator."""

    name = "wall_contact"
    stage = "body"
    bodies = ("layered",)
    cause = "the body touches its mount, a table, a cable bundle or itself"
    remedy = "look where the trajectory ends on one side; clear the workspace or measure where the surface is"
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

    def embody(self, values: Values, material: Material, body: LayeredBody) -> Material:
        """Put the wall there."""
        wall = Wall(values["wall_stiffness"], values["wall_distance"], values["wall_azimuth"])
        return material._replace(effects=material.effects._replace(wall=wall))
