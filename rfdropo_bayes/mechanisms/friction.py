"""Friction of the cables in their guides, and their elasticity: what a length-driven cable loses along its way.

A cable whose length is imposed finds its own tension, so friction at its drive would move nothing. These act between
the guides, or in series with the drive; see ``fem.cable_friction``.
"""

from __future__ import annotations

from rfdropo_bayes.fem import LayeredBody, Material
from rfdropo_bayes.mechanisms.priors import half_normal
from rfdropo_bayes.simulators.mechanisms import Values
from rfdropo_bayes.simulators.parameters import ParameterSpec


class CoulombFriction:
    """Each guide holds its cable back with a constant force, by stick and slip; zero is the base simulator."""

    name = "coulomb_friction"
    stage = "body"
    bodies = ("layered",)
    cause = "cables that rub in their guides, sheaths or seals with a force that does not depend on tension"
    remedy = "pull a slack cable through the body with a spring scale; lubricate or line the guides"
    parameters = (
        ParameterSpec(
            "coulomb_friction", "N", 0.0, 50.0, 0.0, half_normal(0.5), "friction force of every guide along the cable"
        ),
    )

    def embody(self, values: Values, material: Material, body: LayeredBody) -> Material:
        """Give every guide the friction force."""
        return material._replace(effects=material.effects._replace(coulomb_friction=values["coulomb_friction"]))


class CapstanFriction:
    """Tension decays along a bent cable by exp(-mu angle) where it slides; zero is the base simulator."""

    name = "capstan_friction"
    stage = "body"
    bodies = ("layered",)
    cause = "friction of cables pressed against their guides where the body bends"
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

    def embody(self, values: Values, material: Material, body: LayeredBody) -> Material:
        """Give every guide the coefficient of friction."""
        return material._replace(effects=material.effects._replace(capstan_friction=values["capstan_friction"]))


class CableCompliance:
    """Cables and transmission stretch in proportion to tension; zero is the base simulator."""

    name = "cable_compliance"
    stage = "body"
    bodies = ("layered",)
    cause = "stretch of the cables, of their anchorage and of the transmission under load"
    remedy = "hang a known weight on each cable and measure its stretch; use stiffer cable"
    parameters = (
        ParameterSpec(
            "cable_compliance", "m/N", 0.0, 0.1, 0.0, half_normal(5e-4), "stretch of every cable per tension"
        ),
    )

    def embody(self, values: Values, material: Material, body: LayeredBody) -> Material:
        """Put the compliance in series with every cable."""
        return material._replace(effects=material.effects._replace(cable_compliance=values["cable_compliance"]))
