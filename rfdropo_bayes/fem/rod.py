"""A slender body as a rod along its axis: stations, section profile, and material points bound to sections.

A rod has six unknowns a station: the position of the centre line and the rotation of the section. A section does not
deform: guides, markers and loads sit rigidly on sections. Between stations the centre line is Hermite's cubic through
both stations and along both sections' normals, so a point there is a weighted sum of positions and of rotated arms.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.errors import InputError

SHEAR = 5.0 / 6.0
"""Shear area over the section's area. The form of the shear law moves the tip of a slender body by a thousandth."""
AT_STATION = 1e-9
"""A point nearer to a station than this share of its element is bound to that station alone."""


class Rod(NamedTuple):
    """Geometry and effective section profile of a body along z; NumPy arrays, fixed for a simulation.

    Element i lies between stations i and i + 1.
    """

    station: Float[np.ndarray, " stations"]  # axial coordinate [m], increasing
    half_width: Float[np.ndarray, "stations 2"]  # outer size of the body, in x and y [m]
    axial_area: Float[np.ndarray, " elements"]  # EA / E [m2]
    bending_moment_area: Float[np.ndarray, "elements 2"]  # EI / E: integral of x^2, of y^2 [m4]
    torsion_constant: Float[np.ndarray, " elements"]  # GJ / G [m4]
    mass_area: Float[np.ndarray, " elements"]  # volume per length [m2]
    mass_moment_area: Float[np.ndarray, "elements 2"]  # rotary inertia per density and length [m4]

    @property
    def elements(self) -> int:
        """Number of elements."""
        return len(self.station) - 1

    @property
    def length(self) -> float:
        """Length of the undeformed body [m]."""
        return float(self.station[-1] - self.station[0])


class PointMap(NamedTuple):
    """Material points: the sum over two stations of weight * position + rotation @ arm."""

    station: Int[np.ndarray, "points 2"]
    weight: Float[np.ndarray, "points 2"]
    arm: Float[np.ndarray, "points 2 3"]  # in the frame of the section [m]


def solid_torsion_constant(half_width_x: float, half_width_y: float) -> float:
    """Torsion constant [m4] of a solid rectangle (Timoshenko and Goodier, Theory of Elasticity, art. 109)."""
    wide, thin = 2.0 * max(half_width_x, half_width_y), 2.0 * min(half_width_x, half_width_y)
    odd = np.arange(1, 60, 2)
    series = np.sum(np.tanh(odd * np.pi * wide / (2.0 * thin)) / odd**5.0)
    return wide * thin**3 / 3.0 * (1.0 - 192.0 * thin / (np.pi**5 * wide) * series)


def uniform_rod(length: float, half_width_x: float, half_width_y: float, elements: int) -> Rod:
    """Solid rectangular bar along z from 0 to ``length`` [m], cut into equal elements."""
    area = 4.0 * half_width_x * half_width_y
    moment = np.tile(area / 3.0 * np.array([half_width_x**2, half_width_y**2]), (elements, 1))
    return profile_rod(
        station=np.linspace(0.0, length, elements + 1),
        half_width=np.tile([half_width_x, half_width_y], (elements + 1, 1)),
        axial_area=np.full(elements, area),
        bending_moment_area=moment,
        torsion_constant=np.full(elements, solid_torsion_constant(half_width_x, half_width_y)),
        mass_area=np.full(elements, area),
        mass_moment_area=moment,
    )


def profile_rod(
    *,
    station: np.ndarray,
    half_width: np.ndarray,
    axial_area: np.ndarray,
    bending_moment_area: np.ndarray,
    torsion_constant: np.ndarray,
    mass_area: np.ndarray,
    mass_moment_area: np.ndarray,
) -> Rod:
    """Rod with the given effective section in every element; fields and units as in ``Rod``.

    Raises:
        InputError: arrays that do not fit together, stations out of order, or anything not positive.
    """
    station = np.asarray(station, dtype=float)
    if station.ndim != 1 or len(station) < 2 or not np.all(np.diff(station) > 0.0):
        raise InputError("stations are not an increasing list of at least two", where="body.station")
    elements = len(station) - 1

    def checked(name: str, values: np.ndarray, *shape: int) -> np.ndarray:
        values = np.asarray(values, dtype=float)
        if values.shape != shape:
            raise InputError(f"shape {values.shape}, expected {shape}", where=f"body.{name}")
        if not (np.all(np.isfinite(values)) and np.all(values > 0.0)):
            raise InputError("lengths, stiffnesses and masses of a rod must be positive", where=f"body.{name}")
        return values

    return Rod(
        station=station,
        half_width=checked("half_width", half_width, elements + 1, 2),
        axial_area=checked("axial_area", axial_area, elements),
        bending_moment_area=checked("bending_moment_area", bending_moment_area, elements, 2),
        torsion_constant=checked("torsion_constant", torsion_constant, elements),
        mass_area=checked("mass_area", mass_area, elements),
        mass_moment_area=checked("mass_moment_area", mass_moment_area, elements, 2),
    )


def refined(body: Rod, elements: int | Int[np.ndarray, " elements"]) -> Rod:
    """The rod with every element cut into ``elements`` equal elements of the same section, one number for all or one
    for each.
    """
    counts = np.broadcast_to(elements, body.elements)
    rows = np.arange(body.elements + 1)
    at = np.concatenate([k + np.arange(count) / count for k, count in enumerate(counts)] + [[body.elements]])
    sections = {name: np.repeat(getattr(body, name), counts, axis=0) for name in Rod._fields[2:]}
    half_width = np.stack([np.interp(at, rows, body.half_width[:, i]) for i in range(2)], axis=1)
    return Rod(np.interp(at, rows, body.station), half_width, **sections)


def attach(body: Rod, points: Float[np.ndarray, "points 3"]) -> PointMap:
    """Bind material points of the undeformed body [m] to sections; points beyond an end sit rigidly on its section.

    Raises:
        InputError: points that are not finite, or have not three coordinates.
    """
    points = np.atleast_2d(np.asarray(points, dtype=float))
    if points.shape[1] != 3 or not np.all(np.isfinite(points)):
        raise InputError("points must be finite and have three coordinates", where="attach")
    element = np.clip(np.searchsorted(body.station, points[:, 2], side="right") - 1, 0, body.elements - 1)
    first, length = body.station[element], np.diff(body.station)[element]
    share = (points[:, 2] - first) / length
    station = np.stack([element, element + 1], axis=1)
    cubic = share**2 * (3.0 - 2.0 * share)
    weight = np.stack([1.0 - cubic, cubic], axis=1)
    arm = np.zeros((len(points), 2, 3))
    arm[:, 0, :2], arm[:, 1, :2] = (1.0 - share)[:, None] * points[:, :2], share[:, None] * points[:, :2]
    arm[:, 0, 2], arm[:, 1, 2] = length * share * (1.0 - share) ** 2, -length * share**2 * (1.0 - share)
    for place, alone in ((0, share < AT_STATION), (1, share > 1.0 - AT_STATION)):
        station[alone] = (element[alone] + place)[:, None]
        weight[alone] = [1.0, 0.0]
        arm[alone, 0, :2], arm[alone, 1] = points[alone, :2], 0.0
        away = points[alone, 2] - body.station[element[alone] + place]
        arm[alone, 0, 2] = np.where(np.abs(away) > AT_STATION * length[alone], away, 0.0)
    return PointMap(station, weight, arm)


def joined(maps: Sequence[PointMap]) -> PointMap:
    """The points of all maps, one after the other."""
    return PointMap(*(np.concatenate(parts) for parts in zip(*maps, strict=True)))


def tributary_lengths(body: Rod) -> Float[np.ndarray, " stations"]:
    """Length of the body [m] that belongs to each station."""
    half = np.diff(body.station) / 2.0
    return np.concatenate([half, [0.0]]) + np.concatenate([[0.0], half])


def shear_ratios(body: Rod) -> Float[np.ndarray, "elements 2"]:
    """Flexibility of every element in S-shaped bending, h^2 / 12 E I, over that in shear, 1 / k G A, along x and y;
    divided by G / E."""
    square = np.diff(body.station) ** 2
    return (SHEAR * body.axial_area * square / 12.0)[:, None] / body.bending_moment_area


def drag_areas(body: Rod) -> Float[np.ndarray, " stations"]:
    """Width times length [m2] that belongs to each station."""
    return tributary_lengths(body) * np.sum(body.half_width, axis=1)


def inertia_per_density(body: Rod) -> tuple[Float[np.ndarray, " stations"], Float[np.ndarray, "stations 3"]]:
    """Volume [m3] and second moments about the section's axes [m5] that belong to each station: lumped mass and rotary
    inertia over density."""
    half = np.diff(body.station) / 2.0
    about_y, about_x = body.mass_moment_area.T
    parts = np.stack([body.mass_area, about_x, about_y, about_x + about_y], axis=1) * half[:, None]
    none = np.zeros((1, 4))
    total = np.concatenate([parts, none]) + np.concatenate([none, parts])
    return total[:, 0], total[:, 1:]
