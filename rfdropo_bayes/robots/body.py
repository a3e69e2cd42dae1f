"""Geometry of a slender body along z, and the effective section of each of its layers, which are elements of a rod."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from pydantic import Field, model_validator

from rfdropo_bayes.robots.table import Name, Pair, Positive, RobotTable


def poisson_terms(poisson_ratio: Any, reference: float) -> tuple[Any, Any, Any]:
    """x^(-1/4), x^(-1/2) and x, less their values at the reference ratio, with x = 1 - 2 nu.

    Together they follow the bending stiffness of necks, also of locking necks, within 3 % from nu = 0.1 to 0.499.
    """
    here, there = 1.0 - 2.0 * poisson_ratio, 1.0 - 2.0 * reference
    return here**-0.25 - there**-0.25, here**-0.5 - there**-0.5, here - there


class PointMass(RobotTable):
    """A rigid part fixed to the body at a station; the parameter of the same name is its mass [kg]."""

    parameter: Name = Field(description="parameter for the mass [kg] of the part")
    z_m: float = Field(description="station of the part")


class Body(RobotTable):
    """A body of layers along z, from the clamp (first station) to the tip; a layer is one or several elements of a rod.

    A layer's section is effective: the profile makes the layer's ends move like the real body's under unit moments,
    force and torque, for any true shape in between. Poisson's ratio acts on shear and torsion alone, unless
    ``poisson_stiffening`` says more: wide vertebrae keep a neck from contracting, and linear tetrahedra lock.
    """

    station_m: tuple[float, ...] = Field(
        min_length=2, description="axial coordinates of the S stations; the first is clamped"
    )
    half_width_m: tuple[Pair, ...] = Field(
        description="half widths in x and y, at each station: the outer size of the body, which encloses the cable "
        "guides"
    )
    axial_area_m2: tuple[Positive, ...] = Field(description="EA / E of the S - 1 layers")
    bending_moment_area_m4: tuple[tuple[Positive, Positive], ...] = Field(
        description="EI / E of each layer: [integral of x^2, integral of y^2]; the first resists bending in the x-z "
        "plane"
    )
    torsion_constant_m4: tuple[Positive, ...] = Field(description="GJ / G of each layer")
    elements: tuple[Annotated[int, Field(ge=1)], ...] = Field(
        default=(),
        description="elements of a rod in each layer; one by default. A layer that cables press together between two "
        "guides bends more in its middle, which one element does not show",
    )
    mass_area_m2: tuple[Positive, ...] = Field(description="volume per length of each layer")
    mass_moment_area_m4: tuple[tuple[Positive, Positive], ...] = Field(
        description="rotary inertia per density and length of each layer, ordered like bending_moment_area_m4"
    )
    reference_poisson_ratio: float = Field(
        default=0.45, ge=0.0, le=0.499, description="Poisson ratio that the profile holds for"
    )
    poisson_stiffening: tuple[tuple[float, float, float], ...] = Field(
        default=(),
        description="dependence of the stiffness of each layer on Poisson's ratio: three coefficients per layer, of "
        "robots.body.poisson_terms; empty for a stiffness without this dependence",
    )
    volume_m3: Positive = Field(
        description="volume of the whole body, clamped part included; the density is the trunk mass over this volume"
    )
    point_masses: tuple[PointMass, ...] = Field(default=(), description="rigid parts on top of the body's own mass")

    @model_validator(mode="after")
    def _consistent(self) -> Body:
        layers = len(self.station_m) - 1
        if np.any(np.diff(self.station_m) <= 0):
            raise ValueError("station_m does not increase")
        if len(self.half_width_m) != layers + 1 or np.min(self.half_width_m) <= 0:
            raise ValueError(f"half_width_m needs one positive pair for each of the {layers + 1} stations")
        for key in (
            "axial_area_m2",
            "bending_moment_area_m4",
            "torsion_constant_m4",
            "mass_area_m2",
            "mass_moment_area_m4",
        ):
            if len(getattr(self, key)) != layers:
                raise ValueError(f"{key} has {len(getattr(self, key))} entries for {layers} layers")
        if self.elements and len(self.elements) != layers:
            raise ValueError(f"elements has {len(self.elements)} entries for {layers} layers")
        if self.poisson_stiffening:
            if len(self.poisson_stiffening) != layers:
                raise ValueError(f"poisson_stiffening has {len(self.poisson_stiffening)} entries for {layers} layers")
            if min(np.min(self.stiffness_scale(ratio)) for ratio in np.linspace(0.1, 0.499, 50)) <= 0:
                raise ValueError("poisson_stiffening makes a layer's stiffness negative")
        for mass in self.point_masses:
            if np.min(np.abs(np.array(self.station_m) - mass.z_m)) > 1e-6:
                raise ValueError(f"the point mass {mass.parameter} at z = {mass.z_m:g} m is not at a station")
        if self.layer_volume() > self.volume_m3 * 1.001:
            raise ValueError(f"volume_m3 = {self.volume_m3:g} is less than the sum of its layers")
        return self

    def layer_volume(self) -> float:
        """Volume of all layers [m3]; the rest of ``volume_m3`` is held by the clamp."""
        return float(np.sum(np.diff(self.station_m) * np.array(self.mass_area_m2)))

    def shortening(self, course: Float[np.ndarray, "guide 3"]) -> float:
        """How much a cable through guides [m] is wound in per unit of its tension, times Young's modulus, as the body
        bends a little [1/m]: stiff disks on a thin backbone hardly count."""
        station, moment = np.array(self.station_m), np.array(self.bending_moment_area_m4).mean(axis=1)
        passed = np.clip(station, course[0, 2], course[-1, 2])
        radius = np.interp(0.5 * (passed[1:] + passed[:-1]), course[:, 2], np.hypot(course[:, 0], course[:, 1]))
        return float(np.sum(radius**2 * np.diff(passed) / moment))

    def arrays(self) -> dict[str, np.ndarray]:
        """The sections of a rod for the finite-element engine, in SI units."""
        return {
            "station": np.array(self.station_m),
            "half_width": np.array(self.half_width_m),
            "axial_area": np.array(self.axial_area_m2),
            "bending_moment_area": np.array(self.bending_moment_area_m4),
            "torsion_constant": np.array(self.torsion_constant_m4),
            "mass_area": np.array(self.mass_area_m2),
            "mass_moment_area": np.array(self.mass_moment_area_m4),
        }

    def cuts(self) -> tuple[int, ...]:
        """Elements of a rod in each layer."""
        return self.elements or (1,) * (len(self.station_m) - 1)

    def stiffness_scale(self, poisson_ratio: Any) -> Any:
        """Factor (S - 1,) on each layer's stiffness at this Poisson ratio (a JAX tracer is welcome)."""
        if not self.poisson_stiffening:
            return np.ones(len(self.station_m) - 1) + 0.0 * poisson_ratio
        terms = poisson_terms(poisson_ratio, self.reference_poisson_ratio)
        return 1.0 + sum(term * column for term, column in zip(terms, np.array(self.poisson_stiffening).T, strict=True))

    def point_mass_placement(self) -> tuple[tuple[str, ...], Float[np.ndarray, "station mass"]]:
        """Names of the point-mass parameters, and the matrix that lumps their values [kg] at the stations."""
        station = np.array(self.station_m)
        placement = np.zeros((len(station), len(self.point_masses)))
        for column, mass in enumerate(self.point_masses):
            placement[int(np.argmin(np.abs(station - mass.z_m))), column] = 1.0
        return tuple(mass.parameter for mass in self.point_masses), placement
