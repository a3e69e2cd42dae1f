"""A trunk that pushes a cube on a plate: where they touch, and what a contact's rows are.

The trunk's surface is a chain of spheres along its centre line, with the radii of its section profile. A sphere meets
the cube or the plate along the line to its centre, so that normals and gaps are continuous functions of the positions;
corners of the cube meet the plate. Surfaces keep the contact distance from each other (SOFA's LocalMinDistance).
Normal impulses act at a sphere's centre, friction on its surface, which turns with the material around the centre.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rfdropo_bayes.fem.effects import Scalar
from rfdropo_bayes.fem.layered import LayeredBody, attach, centre_gradient
from rfdropo_bayes.fem.rigid_body import CORNERS, Cube, CubeState, rotation_matrix

NEAREST = 24
"""Spheres that the reference engine looks at, nearest to the cube and to the plate: more than ever come near them."""
SPHERES_PER_METRE = 230.0
"""Spheres along the axis: 4.3 mm apart, a third of the trunk's radius, so that the chain is smooth to 0.2 mm."""

FITTED = 24
"""Nodes of a mesh that a sphere follows, at least: about two rings of SOFA's trunk."""


class Spheres(NamedTuple):
    """Spheres along a body's centre line, bound to its nodes; NumPy arrays, fixed for a simulation."""

    node: Int[np.ndarray, "spheres width"]
    centre: Float[np.ndarray, "spheres width"]  # weights of the nodes' positions
    gradient: Float[np.ndarray, "spheres width 3"]  # and for the deformation gradient around the centre [1/m]
    radius: Float[np.ndarray, " spheres"]  # [m]


class PushGeometry(NamedTuple):
    """What does not change between rollouts; static, never traced."""

    spheres: Spheres
    plate_normal: Float[np.ndarray, "3"]  # unit vector out of the plate
    plate_height: float  # of the plate's top along its normal [m]
    contact_distance: float  # [m]


class Touch(NamedTuple):
    """The contacts of one step: the cube's corners on the plate, the trunk on the cube, the trunk on the plate."""

    gap: Float[Array, " contacts"]  # distance less the contact distance [m]
    frame: Float[Array, "contacts 3 3"]  # rows: normal, two tangents
    on_cube: Float[Array, "contacts 3 6"]  # relative velocity by the cube's velocity and spin
    pair: Int[Array, " contacts"]  # that a contact is: corners on the plate, spheres on the cube, spheres on the plate
    trunk_node: Int[Array, "trunk_contacts width"]  # of the contacts that the trunk takes part in
    trunk_weight: Float[Array, "trunk_contacts 3 width"]  # of its nodes in each row


def push_scene(
    spheres: Spheres, *, plate_normal: Float[np.ndarray, "3"], plate_height: float, contact_distance: float
) -> PushGeometry:
    """Scene of a body with these spheres before a plate of any normal."""
    normal = np.asarray(plate_normal, float)
    return PushGeometry(spheres, normal / np.linalg.norm(normal), float(plate_height), float(contact_distance))


def sphere_heights(start: float, tip: float, tip_radius: float) -> Float[np.ndarray, " spheres"]:
    """Heights of the spheres' centres along the axis [m]; the last one touches the tip's plane from inside."""
    count = max(2, round(SPHERES_PER_METRE * (tip - start)))
    return np.linspace(start, tip - tip_radius, count)


def layered_spheres(body: LayeredBody) -> Spheres:
    """Spheres of a layered body with the mean half width of its sections."""
    half = body.half_width.mean(axis=1)
    height = sphere_heights(float(body.station[0]), float(body.station[-1]), float(half[-1]))
    points = np.stack([0.0 * height, 0.0 * height, height], axis=1)
    centre, section = attach(body, points), body.section_nodes
    layer = np.clip(np.searchsorted(body.station, height, side="right") - 1, 0, len(body.station) - 2)
    node = layer[:, None] * section + np.arange(2 * section)
    weight = np.zeros(node.shape)
    for sphere, (nodes, weights) in enumerate(zip(*centre, strict=True)):
        np.add.at(weight[sphere], nodes - node[sphere, 0], weights)
    return Spheres(node, weight, centre_gradient(body)[layer], np.interp(height, body.station, half))


def mesh_spheres(
    rest: Float[np.ndarray, "nodes 3"], station: Float[np.ndarray, " stations"], radius: Float[np.ndarray, " stations"]
) -> Spheres:
    """Spheres of a mesh along the z axis, whose outline has these radii [m] at these heights [m].

    A sphere's centre and the deformation around it are those of the affine motion that fits the nodes around its height
    best.
    """
    height = sphere_heights(float(station[0]), float(station[-1]), float(radius[-1]))
    fits = [_affine_fit(rest, at) for at in height]
    width = max(len(node) for node, _ in fits)
    node = np.stack([np.pad(node, (0, width - len(node))) for node, _ in fits])
    fit = np.stack([np.pad(weight, ((0, 0), (0, width - len(node)))) for node, weight in fits])
    return Spheres(node, fit[:, 0], np.swapaxes(fit[:, 1:], 1, 2), np.interp(height, station, radius))


def _affine_fit(
    rest: Float[np.ndarray, "nodes 3"], height: float
) -> tuple[Int[np.ndarray, " width"], Float[np.ndarray, "4 width"]]:
    """Nodes nearest to a height on the z axis, and weights of their positions for the point there and its gradient.

    Nodes in one plane say nothing of the motion across it: as many are taken as it needs.
    """
    nearest, count = np.argsort(np.abs(rest[:, 2] - height)), FITTED
    while True:
        node = np.sort(nearest[:count])
        place = np.concatenate([np.ones((len(node), 1)), rest[node] - [0.0, 0.0, height]], axis=1)
        if np.linalg.matrix_rank(place) == 4 or len(node) == len(rest):
            return node, np.linalg.pinv(place)
        count += 1


def contact_frame(normal: Float[Array, "contacts 3"]) -> Float[Array, "contacts 3 3"]:
    """Rows: the normal, and two tangents; the first is across the axis that the normal is furthest from."""
    axis = jnp.eye(3)[jnp.argmin(jnp.abs(normal), axis=1)]
    first = jnp.cross(normal, axis)
    first = first / jnp.linalg.norm(first, axis=1, keepdims=True)
    return jnp.stack([normal, first, jnp.cross(normal, first)], axis=1)


def distance_to_box(
    points: Float[Array, "points 3"], centre: Float[Array, "3"], turn: Float[Array, "3 3"], side: Scalar
) -> tuple[Float[Array, " points"], Float[Array, "points 3"]]:
    """Signed distance [m] of points to a cube's surface, negative inside, and its gradient: the outward normal.

    Inside, the nearest face counts.
    """
    local = (points - centre) @ turn
    beyond = jnp.abs(local) - 0.5 * side
    outside = jnp.maximum(beyond, 0.0)
    square = jnp.sum(outside**2, axis=1)
    far = square > 0.0
    length = jnp.sqrt(jnp.where(far, square, 1.0))
    deepest = jnp.eye(3)[jnp.argmax(beyond, axis=1)]
    direction = jnp.where(far[:, None], outside / length[:, None], deepest) * jnp.where(local < 0.0, -1.0, 1.0)
    return jnp.where(far, length, jnp.max(beyond, axis=1)), direction @ turn.T


def smallest_gap(
    scene: PushGeometry, cube: Cube, state: CubeState, centre: Float[Array, "spheres 3"]
) -> Float[Array, ""]:
    """Distance of the trunk, given by the spheres' centres [m], from the nearer of cube and plate, less the contact
    distance."""
    beside = distance_to_box(centre, state.position, rotation_matrix(state.orientation), cube.side)[0]
    above = centre @ jnp.asarray(scene.plate_normal) - scene.plate_height
    return jnp.min(jnp.minimum(beside, above) - jnp.asarray(scene.spheres.radius)) - scene.contact_distance


def _nearest(gap: Float[Array, " spheres"]) -> Int[Array, " contacts"]:
    """The nearest spheres, in ascending order, which rounding does not change."""
    return jnp.sort(lax.top_k(-lax.stop_gradient(gap), min(NEAREST, len(gap)))[1])


def _trunk_weights(
    spheres: Spheres, chosen: Int[Array, " contacts"], normal: Float[Array, "contacts 3"], position: Array
) -> tuple[Array, Array]:
    """Nodes of the chosen spheres, and their weights in the rows of a contact with this normal."""
    node = jnp.asarray(spheres.node)[chosen]
    centre, gradient = jnp.asarray(spheres.centre)[chosen], jnp.asarray(spheres.gradient)[chosen]
    deformation = jnp.einsum("cki,ckj->cij", position[node], gradient)
    place = jnp.linalg.solve(deformation, normal[..., None])[..., 0]
    rubbing = centre - jnp.asarray(spheres.radius)[chosen, None] * jnp.einsum("ckj,cj->ck", gradient, place)
    return node, jnp.stack([centre, rubbing, rubbing], axis=1)


def find_contacts(scene: PushGeometry, cube: Cube, state: CubeState, position: Float[Array, "nodes 3"]) -> Touch:
    """Contacts at the start of a step, from the positions of the body's nodes [m]."""
    spheres, up = scene.spheres, jnp.asarray(scene.plate_normal)
    turn, radius = rotation_matrix(state.orientation), jnp.asarray(spheres.radius)
    corner = cube.side * CORNERS @ turn.T
    clearance = corner @ up + state.position @ up - scene.plate_height
    centre = jnp.einsum("sk,ski->si", spheres.centre, position[spheres.node])
    distance, outward = distance_to_box(centre, state.position, turn, cube.side)
    height = centre @ up - scene.plate_height
    pushing, lying = _nearest(distance - radius), _nearest(height - radius)
    normal = jnp.concatenate([outward[pushing], jnp.tile(up, (len(lying), 1))])
    frame = contact_frame(jnp.concatenate([jnp.tile(up, (len(corner), 1)), normal]))
    # A contact on the cube lies on its surface, below the sphere's centre.
    arm = centre[pushing] - distance[pushing, None] * outward[pushing] - state.position
    arm = jnp.concatenate([corner, arm, jnp.zeros((len(lying), 3))])
    sign = np.repeat([1.0, -1.0, 0.0], [len(corner), len(pushing), len(lying)])
    chosen = jnp.concatenate([pushing, lying])
    gap = jnp.concatenate([clearance, (distance - radius)[pushing], (height - radius)[lying]])
    return Touch(
        gap - scene.contact_distance,
        frame,
        jnp.asarray(sign)[:, None, None] * jnp.concatenate([frame, jnp.cross(arm[:, None, :], frame)], axis=2),
        jnp.concatenate([jnp.arange(len(corner)), len(corner) + pushing, len(corner) + len(radius) + lying]),
        *_trunk_weights(spheres, chosen, normal, position),
    )


def untouched(scene: PushGeometry) -> Float[Array, "pairs 3"]:
    """Impulses of all pairs that can touch, before the first step."""
    return jnp.zeros((len(CORNERS) + 2 * len(scene.spheres.radius), 3))


def trunk_rows(touch: Touch, nodes: int) -> Float[Array, "rows nodes 3"]:
    """Derivatives of the contacts' relative velocities with respect to the velocities of the body's nodes; zero for the
    contacts between cube and plate."""
    count, corners = len(touch.trunk_node), len(touch.gap) - len(touch.trunk_node)
    weight = jnp.zeros((count, 3, nodes))
    place = jnp.arange(count)[:, None, None], jnp.arange(3)[:, None], touch.trunk_node[:, None, :]
    weight = weight.at[place].add(touch.trunk_weight)
    rows = jnp.einsum("crn,cri->crni", weight, touch.frame[corners:]).reshape(3 * count, nodes, 3)
    return jnp.concatenate([jnp.zeros((3 * corners, nodes, 3)), rows])


def unchanged(cube: CubeState, moved: CubeState, taken: Bool[Array, ""]) -> CubeState:
    """The cube after a step that was taken, or where it was, at rest."""
    stopped = cube._replace(velocity=jnp.zeros(3), spin=jnp.zeros(3))
    return CubeState(*(jnp.where(taken, new, old) for new, old in zip(moved, stopped, strict=True)))
