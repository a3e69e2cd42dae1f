"""A slender body layered along its axis: geometry, section profile, and the stiffness and mass of every layer.

The effective section of a layer need not be the square that its nodes span. The stiffness is that of a virtual box with
the section's ratio of bending to axial stiffness, a = sqrt(3 I / A), and modulus factor A / (4 a_x a_y); it acts on the
actual nodes through the bilinear interpolation that evaluates their field at the corners of the box. Linear fields pass
through that map unchanged, so rigid motions stay free of strain. A rank-one term on the twist then sets the torsional
stiffness.

A solid bar contracts sideways as it stretches. Where the section jumps from layer to layer, as at the notches of a
trunk, each layer's own contraction would pull its neighbours' nodes about and stiffen the body, which the profile's
true section does not. ``sectional`` bodies leave that coupling out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem import hexahedron


class LayeredBody(NamedTuple):
    """Geometry and effective section profile of a body layered along z; NumPy arrays, fixed for a simulation.

    Node ``station * nodes_across**2 + iy * nodes_across + ix``. Layer i lies between stations i and i + 1.
    """

    station: Float[np.ndarray, " stations"]  # axial coordinate [m], increasing
    half_width: Float[np.ndarray, "stations 2"]  # of the square of nodes, in x and y [m]
    nodes_across: int
    axial_area: Float[np.ndarray, " layers"]  # EA / E [m2]
    bending_moment_area: Float[np.ndarray, "layers 2"]  # EI / E: integral of x^2, of y^2 [m4]
    torsion_constant: Float[np.ndarray, " layers"]  # GJ / G [m4]
    mass_area: Float[np.ndarray, " layers"]  # volume per length [m2]
    mass_moment_area: Float[np.ndarray, "layers 2"]  # rotary inertia per density and length [m4]
    sectional: bool = False  # elasticity of sections that do not contract as they stretch, see `sectional_elasticity`

    @property
    def section_nodes(self) -> int:
        """Nodes in the cross-section at a station."""
        return self.nodes_across**2

    @property
    def nodes(self) -> int:
        """Nodes of the whole body."""
        return len(self.station) * self.section_nodes


class PointMap(NamedTuple):
    """Material points as weighted sums of the eight nodes around each."""

    node: Int[np.ndarray, "points 8"]
    weight: Float[np.ndarray, "points 8"]


def solid_torsion_constant(half_width_x: float, half_width_y: float) -> float:
    """Torsion constant [m4] of a solid rectangle (Timoshenko and Goodier, Theory of Elasticity, art. 109)."""
    wide, thin = 2.0 * max(half_width_x, half_width_y), 2.0 * min(half_width_x, half_width_y)
    odd = np.arange(1, 60, 2)
    series = np.sum(np.tanh(odd * np.pi * wide / (2.0 * thin)) / odd**5.0)
    return wide * thin**3 / 3.0 * (1.0 - 192.0 * thin / (np.pi**5 * wide) * series)


def uniform_body(
    length: float, half_width_x: float, half_width_y: float, layers: int, nodes_across: int = 2
) -> LayeredBody:
    """Solid rectangular bar along z from 0 to ``length`` [m], cut into equal layers."""
    area = 4.0 * half_width_x * half_width_y
    moment = np.tile(area / 3.0 * np.array([half_width_x**2, half_width_y**2]), (layers, 1))
    return profile_body(
        station=np.linspace(0.0, length, layers + 1),
        half_width=np.tile([half_width_x, half_width_y], (layers + 1, 1)),
        axial_area=np.full(layers, area),
        bending_moment_area=moment,
        torsion_constant=np.full(layers, solid_torsion_constant(half_width_x, half_width_y)),
        mass_area=np.full(layers, area),
        mass_moment_area=moment,
        nodes_across=nodes_across,
    )


def profile_body(
    *,
    station: np.ndarray,
    half_width: np.ndarray,
    axial_area: np.ndarray,
    bending_moment_area: np.ndarray,
    torsion_constant: np.ndarray,
    mass_area: np.ndarray,
    mass_moment_area: np.ndarray,
    nodes_across: int = 2,
    sectional: bool = False,
) -> LayeredBody:
    """Body with the given effective section in every layer; fields and units as in ``LayeredBody``.

    Raises:
        InputError: arrays that do not fit together, stations out of order, or anything not positive.
    """
    station = np.asarray(station, dtype=float)
    if station.ndim != 1 or len(station) < 2 or not np.all(np.diff(station) > 0.0):
        raise InputError("stations are not an increasing list of at least two", where="body.station")
    if int(nodes_across) != nodes_across or nodes_across < 2:
        raise InputError(f"nodes_across is {nodes_across}", where="body", remedy="use 2 or 3")
    layers = len(station) - 1

    def checked(name: str, values: np.ndarray, *shape: int) -> np.ndarray:
        values = np.asarray(values, dtype=float)
        if values.shape != shape:
            raise InputError(f"shape {values.shape}, expected {shape}", where=f"body.{name}")
        if not (np.all(np.isfinite(values)) and np.all(values > 0.0)):
            raise InputError("a value is not positive", where=f"body.{name}")
        return values

    return LayeredBody(
        station=station,
        half_width=checked("half_width", half_width, layers + 1, 2),
        nodes_across=int(nodes_across),
        axial_area=checked("axial_area", axial_area, layers),
        bending_moment_area=checked("bending_moment_area", bending_moment_area, layers, 2),
        torsion_constant=checked("torsion_constant", torsion_constant, layers),
        mass_area=checked("mass_area", mass_area, layers),
        mass_moment_area=checked("mass_moment_area", mass_moment_area, layers, 2),
        sectional=bool(sectional),
    )


def rest_positions(body: LayeredBody) -> Float[np.ndarray, "nodes 3"]:
    """Node coordinates of the undeformed body [m]."""
    grid = np.linspace(-1.0, 1.0, body.nodes_across)
    unit_y, unit_x = np.meshgrid(grid, grid, indexing="ij")
    unit = np.stack([unit_x.ravel(), unit_y.ravel()], axis=1)
    plane = body.half_width[:, None, :] * unit[None]
    axial = np.broadcast_to(body.station[:, None, None], (*plane.shape[:2], 1))
    return np.concatenate([plane, axial], axis=2).reshape(-1, 3)


def rest_layers(body: LayeredBody) -> Float[np.ndarray, "layers nodes2 3"]:
    """Node coordinates of the undeformed body by layer [m], those of the lower station first."""
    stations = rest_positions(body).reshape(len(body.station), body.section_nodes, 3)
    return np.concatenate([stations[:-1], stations[1:]], axis=1)


def layer_positions(body: LayeredBody, position: Float[Array, "nodes 3"]) -> Float[Array, "layers nodes2 3"]:
    """Nodes of each layer, those of the lower station first."""
    stations = position.reshape(len(body.station), body.section_nodes, 3)
    return jnp.concatenate([stations[:-1], stations[1:]], axis=1)


def _cell_nodes(nodes_across: int) -> Int[np.ndarray, "cells 8"]:
    """Layer nodes of every hexahedron of a layer, in the hexahedron's order."""
    cells = []
    for row in range(nodes_across - 1):
        for column in range(nodes_across - 1):
            first = row * nodes_across + column
            face = np.array([first, first + 1, first + nodes_across, first + nodes_across + 1])
            cells.append(np.concatenate([face, face + nodes_across**2]))
    return np.array(cells)


def centre_gradient(body: LayeredBody) -> Float[np.ndarray, "layers nodes2 3"]:
    """Weights g with F = sum_a x_a (x) g_a: the deformation gradient of a layer, mean over its hexahedra's centres."""
    rest = rest_layers(body)
    local = hexahedron.shape_gradients(np.zeros((1, 3)))[0]
    cells = _cell_nodes(body.nodes_across)
    gradient = np.zeros_like(rest)
    for layer in range(len(rest)):
        for nodes in cells:
            jacobian = local.T @ rest[layer, nodes]
            gradient[layer, nodes] += np.linalg.solve(jacobian, local.T).T / len(cells)
    return gradient


def _interpolation(grid: np.ndarray, points: np.ndarray) -> Float[np.ndarray, "points grid"]:
    """Piecewise linear interpolation matrix on a grid, continued beyond its ends."""
    cell = np.clip(np.searchsorted(grid, points, side="right") - 1, 0, len(grid) - 2)
    fraction = (points - grid[cell]) / (grid[cell + 1] - grid[cell])
    matrix = np.zeros((len(points), len(grid)))
    rows = np.arange(len(points))
    matrix[rows, cell], matrix[rows, cell + 1] = 1.0 - fraction, fraction
    return matrix


def box_maps(body: LayeredBody, box: Float[np.ndarray, "layers 2"]) -> Float[np.ndarray, "layers cells 8 nodes2"]:
    """For every hexahedron of the virtual box, the map from layer nodes to its corners."""
    across, section = body.nodes_across, body.section_nodes
    grid = np.linspace(-1.0, 1.0, across)
    maps = np.zeros((len(box), 2 * section, 2 * section))
    for layer, half in enumerate(box):
        for face in range(2):
            scale = half / body.half_width[layer + face]
            plane = np.kron(_interpolation(grid, scale[1] * grid), _interpolation(grid, scale[0] * grid))
            maps[layer, face * section : (face + 1) * section, face * section : (face + 1) * section] = plane
    return maps[:, _cell_nodes(across)]


def virtual_box(area: np.ndarray, moment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Half widths (layers, 2) of the box with the section's I / A, and the factor that restores its area."""
    half = np.sqrt(3.0 * moment / area[:, None])
    return half, area / (4.0 * half[:, 0] * half[:, 1])


def _box_corners(body: LayeredBody, box: np.ndarray) -> Float[np.ndarray, "layers 8 3"]:
    """Corners of one of the equal hexahedra that a layer's virtual box is cut into."""
    half = np.concatenate([box / (body.nodes_across - 1), np.diff(body.station)[:, None] / 2.0], axis=1)
    return half[:, None, :] * hexahedron.CORNERS[None]


def free_twist(body: LayeredBody) -> Float[np.ndarray, "layers dofs"]:
    """Displacement of the layer nodes in free torsion by one radian from face to face, warping included."""
    rest = rest_layers(body)
    length = np.diff(body.station)[:, None]
    angle = np.repeat([-0.5, 0.5], body.section_nodes)[None]
    moment_x, moment_y = body.bending_moment_area[:, :1], body.bending_moment_area[:, 1:]
    warping = (moment_y - moment_x) / (moment_x + moment_y) / length
    x, y = rest[..., 0], rest[..., 1]
    return np.stack([-angle * y, angle * x, warping * x * y], axis=-1).reshape(len(rest), -1)


def layer_stiffness(
    body: LayeredBody, young_modulus: Float[Array, ""], poisson_ratio: Float[Array, ""]
) -> Float[Array, "layers dofs dofs"]:
    """Stiffness [N/m] of every layer at rest, degrees of freedom ``node * 3 + axis`` with the lower station first.

    Section stiffnesses EA, EI and GJ are those of the profile. The twist correction deflates along K m, where m is the
    free torsion of the uncorrected layer: the result stays positive semi-definite for any torsion constant, and
    bending, shear and extension, which are orthogonal to torsion in energy, are untouched.
    """
    box, factor = virtual_box(body.axial_area, body.bending_moment_area)
    corners = _box_corners(body, box)
    elastic = hexahedron.sectional_elasticity if body.sectional else hexahedron.elasticity
    moduli = elastic(young_modulus, poisson_ratio)
    hexahedra = jax.vmap(hexahedron.elastic_stiffness, (0, None))(jnp.asarray(corners), moduli)
    hexahedra = (hexahedra * factor[:, None, None]).reshape(len(corners), 8, 3, 8, 3)
    maps = box_maps(body, box)
    stiffness = jnp.einsum("lcan,laibj,lcbm->lnimj", maps, hexahedra, maps)
    stiffness = stiffness.reshape(len(corners), 6 * body.section_nodes, 6 * body.section_nodes)
    shear_modulus = young_modulus / (2.0 * (1.0 + poisson_ratio))
    wanted = shear_modulus * body.torsion_constant / np.diff(body.station)
    twist = free_twist(body)
    reaction = jnp.einsum("lij,lj->li", stiffness, twist)
    actual = jnp.einsum("li,li->l", twist, reaction)
    change = (wanted - actual) / actual**2
    return stiffness + change[:, None, None] * reaction[:, :, None] * reaction[:, None, :]


def layer_mass(body: LayeredBody) -> Float[Array, "layers nodes2 nodes2"]:
    """Consistent mass of every layer per unit density [m^3], for each displacement component alike."""
    box, factor = virtual_box(body.mass_area, body.mass_moment_area)
    hexahedra = jax.vmap(hexahedron.mass)(jnp.asarray(_box_corners(body, box))) * factor[:, None, None]
    maps = box_maps(body, box)
    return jnp.einsum("lcan,lab,lcbm->lnm", maps, hexahedra, maps)


def attach(body: LayeredBody, points: Float[np.ndarray, "points 3"]) -> PointMap:
    """Bind material points of the undeformed body [m] to the nodes around them.

    Trilinear inside a layer; points beside the square of nodes, or beyond the ends of the axis, follow by
    extrapolation.
    """
    points = np.atleast_2d(np.asarray(points, dtype=float))
    if points.shape[1] != 3 or not np.all(np.isfinite(points)):
        raise InputError("points must be finite and have three coordinates", where="attach")
    across, section = body.nodes_across, body.section_nodes
    layer = np.clip(np.searchsorted(body.station, points[:, 2], side="right") - 1, 0, len(body.station) - 2)
    height = (points[:, 2] - body.station[layer]) / np.diff(body.station)[layer]
    half = (1.0 - height[:, None]) * body.half_width[layer] + height[:, None] * body.half_width[layer + 1]
    if not np.all(half > 0.0):
        raise InputError("a point lies too far beyond the end of a tapered body", where="attach")
    place = (points[:, :2] / half + 1.0) * (across - 1) / 2.0
    cell = np.clip(np.floor(place).astype(int), 0, across - 2)
    natural = np.concatenate([2.0 * (place - cell), 2.0 * height[:, None]], axis=1) - 1.0
    first = layer * section + cell[:, 1] * across + cell[:, 0]
    offsets = np.array([dz * section + dy * across + dx for dz in range(2) for dy in range(2) for dx in range(2)])
    return PointMap(node=first[:, None] + offsets[None], weight=hexahedron.shape_functions(natural))


def joined(maps: Sequence[PointMap]) -> PointMap:
    """The points of all maps, one after the other."""
    width = max(points.node.shape[1] for points in maps)
    padded = [[np.pad(part, ((0, 0), (0, width - part.shape[1]))) for part in points] for points in maps]
    return PointMap(*(np.concatenate(parts) for parts in zip(*padded, strict=True)))


def point_positions(points: PointMap, position: Float[Array, "nodes 3"]) -> Float[Array, "points 3"]:
    """Where the attached points are, given the node positions [m]; velocities likewise."""
    return jnp.einsum("pk,pki->pi", points.weight, position[points.node])


def spread_forces(points: PointMap, force: Float[Array, "points 3"], nodes: int) -> Float[Array, "nodes 3"]:
    """Nodal forces [N] equivalent to forces at attached points: the transpose of ``point_positions``."""
    shares = points.weight[:, :, None] * force[:, None, :]
    return jnp.zeros((nodes, 3)).at[points.node].add(shares)
