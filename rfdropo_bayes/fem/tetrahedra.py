"""Corotational linear tetrahedra: a mesh, its frames and masses; `native.tetrahedral` computes the motion.

Each element is linear elastic in a frame that turns with it: f_a = -V Q S(H) g_a with g_a the gradients of the shape
functions at rest, H = sum_a (Q' x_a - X_a) (x) g_a and S the isotropic law. Two frames:

- ``"polar"``: rotation of the polar decomposition of the deformation gradient (Mueller and Gross 2004, Graphics
  Interface);
- ``"edges"``: from the element's first three nodes, x along the edge 0-1, z normal to the face 0-1-2, as SOFA's
  TetrahedronFEMForceField does with ``method="large"`` (Nesme, Payan and Faure 2005, Eurographics short papers). It
  depends on the order of the element's nodes.

Constant-strain tetrahedra are stiff in bending and lock near incompressibility: they reproduce meshes of other
simulators, and are not accurate with few unknowns.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.sparse as sparse
from jaxtyping import Array, Bool, Float, Int
from scipy.sparse.csgraph import connected_components

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.cable_drive import DriveLimits
from rfdropo_bayes.fem.mesh_points import NodeCables, NodePoints, node_cables

FRAMES = ("polar", "edges")
POLAR_ITERATIONS = 6
"""Converge to round-off for stretches between 0.3 and 3."""
POISSON_LIMIT = 0.499
"""Larger Poisson ratios are replaced by this limit: the displacement element has no incompressible limit."""
LARGEST_WEIGHTS = 8
"""Nodes that `NodePoints` and `NodeCables` reserve for each point; a tetrahedron uses the first four."""


class TetrahedralBody(NamedTuple):
    """Mesh and rest geometry; NumPy arrays, fixed for a simulation."""

    rest: Float[np.ndarray, "nodes 3"]  # [m]
    element: Int[np.ndarray, "elements 4"]
    fixed: Bool[np.ndarray, " nodes"]  # at rest in all three directions
    gradient: Float[np.ndarray, "elements 4 3"]  # of the shape functions at rest [1/m]
    volume: Float[np.ndarray, " elements"]  # [m3]
    rest_frame: Float[np.ndarray, "elements 3 3"]  # rows: axes of the element's frame at rest
    frames: str  # one of FRAMES

    @property
    def nodes(self) -> int:
        """Nodes of the whole mesh."""
        return len(self.rest)


class TetrahedralSystem(NamedTuple):
    """Constants of all rollouts; static, never traced."""

    body: TetrahedralBody
    cables: NodeCables
    limits: DriveLimits


class TetrahedralMaterial(NamedTuple):
    """Physical parameters of one rollout."""

    young_modulus: Float[Array, ""]  # [Pa]
    poisson_ratio: Float[Array, ""]
    node_mass: Float[Array, " nodes"]  # [kg]
    rayleigh_mass: Float[Array, ""]  # [1/s]
    rayleigh_stiffness: Float[Array, ""]  # [s]
    gravity: Float[Array, "3"]  # [m/s2]
    stiffness_scale: Float[Array, " elements"]  # factor on the stiffness of each element


def tetrahedral_body(
    rest: Float[np.ndarray, "nodes 3"],
    element: Int[np.ndarray, "elements 4"],
    fixed: Bool[np.ndarray, " nodes"],
    frames: str = "polar",
) -> TetrahedralBody:
    """Body from node coordinates [m], tetrahedra of positive volume, and which nodes are fixed.

    Raises:
        InputError: an unknown kind of frame, arrays that do not match, a flat or inverted element, no fixed node, or
        parts of the mesh that are tied to no fixed node.
    """
    rest, element, fixed = np.asarray(rest, float), np.asarray(element, int), np.asarray(fixed, bool)
    if frames not in FRAMES:
        raise InputError(f"element frames {frames!r}", where="mesh", remedy=f"use one of {FRAMES}")
    if (
        rest.ndim != 2
        or rest.shape[1] != 3
        or element.ndim != 2
        or element.shape[1] != 4
        or fixed.shape != rest.shape[:1]
    ):
        raise InputError(f"shapes {rest.shape}, {element.shape} and {fixed.shape} do not fit together", where="mesh")
    if not np.any(fixed):
        raise InputError("no node is fixed", where="mesh", remedy="fix the nodes of the clamped end")
    _check_fixed(element, fixed)
    edges = np.swapaxes(rest[element[:, 1:]] - rest[element[:, :1]], 1, 2)
    volume = np.linalg.det(edges) / 6.0
    if not np.all(volume > 0.0):
        number = int(np.argmin(volume))
        raise InputError(f"element {number} has volume {volume[number]:.3g} m3", where="mesh", remedy="repair the mesh")
    others = np.linalg.inv(edges)
    gradient = np.concatenate([-others.sum(axis=1, keepdims=True), others], axis=1)
    corners = rest[element]
    rest_frame = np.asarray(_edge_axes(corners)) if frames == "edges" else np.tile(np.eye(3), (len(element), 1, 1))
    return TetrahedralBody(rest, element, fixed, gradient, volume, rest_frame, frames)


def _check_fixed(element: Int[np.ndarray, "elements 4"], fixed: Bool[np.ndarray, " nodes"]) -> None:
    """Raise InputError for a free node that no chain of elements ties to a fixed node."""
    first, second = np.repeat(element[:, 0], 3), element[:, 1:].ravel()
    graph = sparse.coo_matrix((np.ones(len(first)), (first, second)), shape=(len(fixed), len(fixed)))
    part = connected_components(graph, directed=False)[1]
    loose = ~np.isin(part, part[fixed])
    if np.any(loose):
        raise InputError(
            f"{np.sum(loose)} nodes are tied to no fixed node, the first is {int(np.argmax(loose))}",
            where="mesh", remedy="remove loose parts and unused nodes",
        )  # fmt: skip


def _edge_axes(corners: Float[Array, "elements 4 3"]) -> Float[Array, "elements 3 3"]:
    """Rows: unit vectors along edge 0-1, in the face 0-1-2 across it, and normal to that face."""
    along, across = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    first = along / jnp.linalg.norm(along, axis=1, keepdims=True)
    normal = jnp.cross(first, across)
    normal = normal / jnp.linalg.norm(normal, axis=1, keepdims=True)
    return jnp.stack([first, jnp.cross(normal, first), normal], axis=1)


def lumped_masses(body: TetrahedralBody, density: Float[Array, ""] | float) -> Float[Array, " nodes"]:
    """A quarter of every element's mass on each of its nodes [kg]."""
    volume = np.zeros(len(body.rest))
    np.add.at(volume, body.element, body.volume[:, None] / 4.0)
    return jnp.asarray(density) * volume


def locate(body: TetrahedralBody, points: Float[np.ndarray, "points 3"]) -> NodePoints:
    """Bind points of the undeformed body [m] to the four nodes around them (weights padded with zeros).

    A point in no element belongs to the element with the nearest centroid, and follows it by extrapolation (as SOFA's
    BarycentricMapping does).
    """
    corners = body.rest[body.element]
    centres = corners.mean(axis=1)
    points = np.atleast_2d(np.asarray(points, float))
    node = np.zeros((len(points), LARGEST_WEIGHTS), dtype=int)
    weight = np.zeros((len(points), LARGEST_WEIGHTS))
    for index, point in enumerate(points):
        natural = np.einsum("eai,ei->ea", body.gradient, point - corners[:, 0])
        natural[:, 0] += 1.0
        outside = -natural.min(axis=1)
        rank = np.where(outside > 0.0, np.sum((point - centres) ** 2, axis=1), outside)
        chosen = int(np.argmin(rank))
        node[index, :4], weight[index, :4] = body.element[chosen], natural[chosen]
    return NodePoints(node, weight)


def mean_points(maps: Sequence[NodePoints]) -> NodePoints:
    """Point k is the mean of the k-th points of all maps."""
    return NodePoints(
        np.concatenate([points.node for points in maps], axis=1),
        np.concatenate([points.weight for points in maps], axis=1) / len(maps),
    )


def route_cables(
    body: TetrahedralBody, anchors: Float[np.ndarray, "cables 3"], guides: Sequence[Float[np.ndarray, "guides 3"]]
) -> NodeCables:
    """Cables of a tetrahedral body; see `node_cables`."""
    return node_cables(partial(locate, body), anchors, guides)
