"""A trunk that pushes a cube on a plate: contacts and their rows.

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

from rfdropo_bayes.fem.components import rotation
from rfdropo_bayes.fem.effects import Scalar
from rfdropo_bayes.fem.points import point_positions
from rfdropo_bayes.fem.rigid_body import CORNERS, Cube, CubeState, rotation_matrix
from rfdropo_bayes.fem.rod import PointMap, Rod, attach

NEAREST = 24
"""Spheres that the reference engine looks at, nearest to the cube and to the plate: more than ever come near them."""
SPHERES_PER_METRE = 230.0
"""Spheres along the axis: 4.3 mm apart, a third of the trunk's radius, so that the chain is smooth to 0.2 mm."""

FITTED = 24
"""Nodes of a mesh that a sphere follows, at least: about two rings of SOFA's trunk."""


class Spheres(NamedTuple):
    """Spheres along the centre line of a rod, bound to its sections; NumPy arrays, fixed for a simulation."""

    centre: PointMap
    radius: Float[np.ndarray, " spheres"]  # [m]


class MeshSpheres(NamedTuple):
    """Spheres along the centre line of a mesh, bound to its nodes; NumPy arrays, fixed for a simulation."""

    node: Int[np.ndarray, "spheres width"]
    centre: Float[np.ndarray, "spheres width"]  # weights of the nodes' positions
    gradient: Float[np.ndarray, "spheres width 3"]  # and for the deformation gradient around the centre [1/m]
    radius: Float[np.ndarray, " spheres"]  # [m]


class PushGeometry(NamedTuple):
    """Constants of all rollouts; static, never traced."""

    spheres: Spheres | MeshSpheres
    plate_normal: Float[np.ndarray, "3"]  # unit vector out of the plate
    plate_height: float  # of the plate's top along its normal [m]
    contact_distance: float  # [m]


class Touch(NamedTuple):
    """The contacts of one step: the cube's corners on the plate, the trunk on the cube, the trunk on the plate."""

    gap: Float[Array, " contacts"]  # distance less the contact distance [m]
    frame: Float[Array, "contacts 3 3"]  # rows: normal, two tangents
    on_cube: Float[Array, "contacts 3 6"]  # relative velocity by the cube's velocity and spin
    pair: Int[Array, " contacts"]  # that a contact is: corners on the plate, spheres on the cube, spheres on the plate
    rows: Float[Array, "stations 6 rows"]  # relative velocity by the stations' velocities and spins; three a contact


def push_scene(
    spheres: Spheres | MeshSpheres,
    *,
    plate_normal: Float[np.ndarray, "3"],
    plate_height: float,
    contact_distance: float,
) -> PushGeometry:
    """Scene of a body with these spheres before a plate of any normal."""
    normal = np.asarray(plate_normal, float)
    return PushGeometry(spheres, normal / np.linalg.norm(normal), float(plate_height), float(contact_distance))


def sphere_heights(start: float, tip: float, tip_radius: float) -> Float[np.ndarray, " spheres"]:
    """Heights of the spheres' centres along the axis [m]; the last sphere touches the tip's plane from inside."""
    count = max(2, round(SPHERES_PER_METRE * (tip - start)))
    return np.linspace(start, tip - tip_radius, count)


def rod_spheres(body: Rod) -> Spheres:
    """Spheres of a rod with the mean half width of its sections."""
    half = body.half_width.mean(axis=1)
    height = sphere_heights(float(body.station[0]), float(body.station[-1]), float(half[-1]))
    points = np.stack([0.0 * height, 0.0 * height, height], axis=1)
    return Spheres(attach(body, points), np.interp(height, body.station, half))


def mesh_spheres(
    rest: Float[np.ndarray, "nodes 3"], station: Float[np.ndarray, " stations"], radius: Float[np.ndarray, " stations"]
) -> MeshSpheres:
    """Spheres of a mesh along the z axis, whose outline has these radii [m] at these heights [m].

    A sphere's centre and the deformation around it follow the affine motion that fits the nodes around its height best.
    """
    height = sphere_heights(float(station[0]), float(station[-1]), float(radius[-1]))
    fits = [_affine_fit(rest, at) for at in height]
    width = max(len(node) for node, _ in fits)
    node = np.stack([np.pad(node, (0, width - len(node))) for node, _ in fits])
    fit = np.stack([np.pad(weight, ((0, 0), (0, width - len(node)))) for node, weight in fits])
    return MeshSpheres(node, fit[:, 0], np.swapaxes(fit[:, 1:], 1, 2), np.interp(height, station, radius))


def _affine_fit(
    rest: Float[np.ndarray, "nodes 3"], height: float
) -> tuple[Int[np.ndarray, " width"], Float[np.ndarray, "4 width"]]:
    """Nodes nearest to a height on the z axis, and weights of their positions for the point there and its gradient.

    Nodes in a plane do not determine the motion across it: enough nodes are taken for a full fit.
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


def _trunk_rows(
    spheres: Spheres,
    chosen: Int[Array, " contacts"],
    frame: Float[Array, "contacts 3 3"],
    orientation: Float[Array, "stations 4"],
) -> Float[Array, "stations 6 rows"]:
    """Derivatives of the relative velocities of the chosen spheres by the velocities and spins of the stations."""
    station, weight, arm = (jnp.asarray(part)[chosen] for part in spheres.centre)
    turn = jnp.moveaxis(rotation(orientation.T), -1, 0)[station]
    lever = jnp.einsum("csij,csj->csi", turn, arm)
    rubbing = lever - jnp.asarray(spheres.radius)[chosen, None, None] * weight[..., None] * frame[:, None, 0]
    lever = jnp.stack([lever, rubbing, rubbing], axis=1)
    force = weight[:, None, :, None] * frame[:, :, None, :]
    moment = jnp.cross(lever, jnp.broadcast_to(frame[:, :, None, :], lever.shape))
    bound = station[..., None] == jnp.arange(len(orientation))
    rows = jnp.einsum("crsi,csn->nicr", jnp.concatenate([force, moment], axis=-1), bound.astype(float))
    return rows.reshape(len(orientation), 6, -1)


def find_contacts(
    scene: PushGeometry,
    cube: Cube,
    state: CubeState,
    position: Float[Array, "stations 3"],
    orientation: Float[Array, "stations 4"],
) -> Touch:
    """Contacts at the start of a step, from the places of the stations [m] and the quaternions of their sections."""
    spheres, up = scene.spheres, jnp.asarray(scene.plate_normal)
    assert isinstance(spheres, Spheres)
    turn, radius = rotation_matrix(state.orientation), jnp.asarray(spheres.radius)
    corner = cube.side * CORNERS @ turn.T
    clearance = corner @ up + state.position @ up - scene.plate_height
    centre = point_positions(spheres.centre, position, orientation)
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
    rows = _trunk_rows(spheres, chosen, frame[len(corner) :], orientation)
    return Touch(
        gap - scene.contact_distance,
        frame,
        jnp.asarray(sign)[:, None, None] * jnp.concatenate([frame, jnp.cross(arm[:, None, :], frame)], axis=2),
        jnp.concatenate([jnp.arange(len(corner)), len(corner) + pushing, len(corner) + len(radius) + lying]),
        jnp.concatenate([jnp.zeros((len(position), 6, 3 * len(corner))), rows], axis=2),
    )


def untouched(scene: PushGeometry) -> Float[Array, "pairs 3"]:
    """Impulses of all pairs that can touch, before the first step."""
    return jnp.zeros((len(CORNERS) + 2 * len(scene.spheres.radius), 3))


def unchanged(cube: CubeState, moved: CubeState, taken: Bool[Array, ""]) -> CubeState:
    """The cube after an accepted step, or at rest in its old pose."""
    stopped = cube._replace(velocity=jnp.zeros(3), spin=jnp.zeros(3))
    return CubeState(*(jnp.where(taken, new, old) for new, old in zip(moved, stopped, strict=True)))
