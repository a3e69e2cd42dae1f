"""Section profiles from shapes: cylinders, cones, hollow tubes and disks on a backbone, in sequence along z.

A robot file may state shapes in the place of a section profile, as ``[[body.section]]``. Within a layer compliances add
up along z, as do masses: stiffnesses are harmonic means over the layer, masses are arithmetic means. Both are integrals
of rational functions of z, taken by the rule of Gauss and Legendre.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from pydantic import Field, model_validator

from rfdropo_bayes.robots.body import Body, PointMass
from rfdropo_bayes.robots.table import Positive, RobotTable
from rfdropo_bayes.tables import parse_table

QUADRATURE_POINTS = 24
Radii = tuple[Positive, Positive]


class Profile(NamedTuple):
    """Sections of the layers of one shape."""

    thickness: Float[np.ndarray, " layer"]  # thickness of each layer [m]
    outer: Float[np.ndarray, " station"]  # radius that encloses the shape at each of the layers' ends [m]
    # area, second_moment: each layer's harmonic mean for the stiffness [m2, m4]
    area: Float[np.ndarray, " layer"]
    second_moment: Float[np.ndarray, " layer"]
    # mass_area, mass_second_moment: each layer's mean for the mass [m2, m4]
    mass_area: Float[np.ndarray, " layer"]
    mass_second_moment: Float[np.ndarray, " layer"]


def tapered(length: float, layers: int, outer: tuple[float, float], inner: tuple[float, float] = (0.0, 0.0)) -> Profile:
    """Profile of a round shape whose outer and inner radii [m] change linearly from its base to its tip."""
    node, weight = np.polynomial.legendre.leggauss(QUADRATURE_POINTS)
    share = (np.arange(layers)[:, None] + 0.5 * (node + 1.0)) / layers
    large, small = (ends[0] + share * (ends[1] - ends[0]) for ends in (outer, inner))
    area, moment = np.pi * (large**2 - small**2), 0.25 * np.pi * (large**4 - small**4)

    def mean(values: np.ndarray) -> np.ndarray:
        return values @ weight / 2.0

    return Profile(
        np.full(layers, length / layers),
        np.linspace(*outer, layers + 1),
        1.0 / mean(1.0 / area),
        1.0 / mean(1.0 / moment),
        mean(area),
        mean(moment),
    )


class Cylinder(RobotTable):
    """A solid round rod."""

    shape: Literal["cylinder"] = Field(default="cylinder", description="form of the section")
    length_m: Positive = Field(description="length along z")
    layers: int = Field(ge=1, description="number of layers of equal thickness")
    radius_m: Positive = Field(description="radius")

    def profile(self) -> Profile:
        """Sections of its layers."""
        return tapered(self.length_m, self.layers, (self.radius_m, self.radius_m))


class Cone(RobotTable):
    """A solid round rod that tapers."""

    shape: Literal["cone"] = Field(default="cone", description="form of the section")
    length_m: Positive = Field(description="length along z")
    layers: int = Field(ge=1, description="number of layers of equal thickness")
    radius_m: Radii = Field(description="radius at the base end, and at the tip end")

    def profile(self) -> Profile:
        """Sections of its layers."""
        return tapered(self.length_m, self.layers, self.radius_m)


class Tube(RobotTable):
    """A hollow round rod, straight or tapering."""

    shape: Literal["tube"] = Field(default="tube", description="form of the section")
    length_m: Positive = Field(description="length along z")
    layers: int = Field(ge=1, description="number of layers of equal thickness")
    radius_m: Positive | Radii = Field(description="outer radius, or two values, towards the base and the tip")
    inner_radius_m: Positive | Radii = Field(
        description="radius of the hollow, or two values, towards the base and the tip"
    )

    @model_validator(mode="after")
    def _has_a_wall(self) -> Tube:
        if any(inner >= outer for outer, inner in zip(_both(self.radius_m), _both(self.inner_radius_m), strict=True)):
            raise ValueError("inner_radius_m is not less than radius_m")
        return self

    def profile(self) -> Profile:
        """Sections of its layers."""
        return tapered(self.length_m, self.layers, _both(self.radius_m), _both(self.inner_radius_m))


class Disks(RobotTable):
    """Disks stacked on a backbone, the last disk at the end towards the tip; each layer is a disk or bare backbone."""

    shape: Literal["disks"] = Field(default="disks", description="form of the section")
    length_m: Positive = Field(description="length along z")
    disks: int = Field(ge=1, description="number of disks, at equal distances")
    radius_m: Positive = Field(description="radius of the disks")
    thickness_m: Positive = Field(description="thickness of a disk")
    backbone_radius_m: Positive = Field(description="radius of the backbone between the disks")
    modulus_ratio: Positive = Field(default=1.0, description="Young's modulus of the disks over the backbone's")
    density_ratio: Positive = Field(default=1.0, description="ratio of the densities of disks and backbone")

    @model_validator(mode="after")
    def _fits(self) -> Disks:
        if self.disks * self.thickness_m >= self.length_m:
            raise ValueError(f"{self.disks} disks of {self.thickness_m:g} m leave no backbone on {self.length_m:g} m")
        if self.backbone_radius_m >= self.radius_m:
            raise ValueError("backbone_radius_m is not less than radius_m")
        return self

    def profile(self) -> Profile:
        """Sections of its layers: backbone, disk, backbone, disk."""
        radius = np.tile([self.backbone_radius_m, self.radius_m], self.disks)
        stiffness, mass = (np.tile([1.0, ratio], self.disks) for ratio in (self.modulus_ratio, self.density_ratio))
        area, moment = np.pi * radius**2, 0.25 * np.pi * radius**4
        bare = self.length_m / self.disks - self.thickness_m
        return Profile(
            np.tile([bare, self.thickness_m], self.disks),
            np.full(2 * self.disks + 1, self.radius_m),
            stiffness * area,
            stiffness * moment,
            mass * area,
            mass * moment,
        )


Section = Annotated[Cylinder | Cone | Tube | Disks, Field(discriminator="shape")]
SHAPES: tuple[type[Cylinder | Cone | Tube | Disks], ...] = (Cylinder, Cone, Tube, Disks)


class SectionedBody(RobotTable):
    """A body given by shapes, ``[[body.section]]``, in the place of a section profile."""

    section: tuple[Section, ...] = Field(min_length=1, description="shapes from the clamp to the tip")
    point_masses: tuple[PointMass, ...] = Field(
        default=(), description="rigid parts on top of the body's own mass, at ends of sections or layers"
    )

    def body(self) -> Body:
        """The section profile of the shapes; the first section is clamped at its start, z = 0.

        The larger radius holds at the joint of two sections.
        """
        profiles = [section.profile() for section in self.section]
        thickness, area, moment, mass_area, mass_moment = (
            np.concatenate([getattr(profile, key) for profile in profiles])
            for key in ("thickness", "area", "second_moment", "mass_area", "mass_second_moment")
        )
        outer = profiles[0].outer
        for profile in profiles[1:]:
            outer = np.concatenate([outer[:-1], [max(outer[-1], profile.outer[0])], profile.outer[1:]])
        return Body(
            station_m=tuple(np.round(np.concatenate([[0.0], np.cumsum(thickness)]), 12).tolist()),
            half_width_m=tuple((r, r) for r in outer.tolist()),
            axial_area_m2=tuple(area.tolist()),
            bending_moment_area_m4=tuple((i, i) for i in moment.tolist()),
            torsion_constant_m4=tuple((2.0 * moment).tolist()),
            mass_area_m2=tuple(mass_area.tolist()),
            mass_moment_area_m4=tuple((i, i) for i in mass_moment.tolist()),
            volume_m3=float(np.sum(thickness * mass_area)),
            point_masses=self.point_masses,
        )


def section_profile(sections: Sequence[Cylinder | Cone | Tube | Disks]) -> Body:
    """The body of consecutive shapes from the clamp to the tip.

    Args:
        sections: e.g. ``[Cone(length_m=0.2, layers=10, radius_m=(0.014, 0.009))]``.
    """
    return SectionedBody(section=tuple(sections)).body()


def body_tables(table: Mapping[str, Any], where: str) -> dict[str, Any]:
    """The table [body] of a robot file with shapes written out as a section profile; any other as it is.

    Raises:
        InputError: shapes that do not hold together, or shapes beside a profile.
    """
    if "station_m" in table and "section" not in table:
        return dict(table)
    return parse_table(SectionedBody, table, where=f"{where} [body]").body().model_dump()


def _both(radius: float | tuple[float, float]) -> tuple[float, float]:
    return radius if isinstance(radius, tuple) else (radius, radius)
