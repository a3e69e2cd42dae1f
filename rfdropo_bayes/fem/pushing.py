"""A trunk that pushes a cube on a plate: where they touch, and what the contacts do to a step of the body.

Points of the trunk's surface are tested against the cube and the plate, corners of the cube against the plate. The
surface is cut into bands along the axis; each offers its nearest point, and the nearest bands make the contacts of the
step: their number is fixed, so that a step has one shape, and far ones exert nothing. Surfaces keep the contact
distance from each other, which rounds the cube's edges by as much (SOFA's LocalMinDistance).
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.contact import contact_frame, distance_to_box, solve_constraints
from rfdropo_bayes.fem.layered import PointMap, point_positions
from rfdropo_bayes.fem.rigid_body import CORNERS, Cube, CubeState, inverse_inertia, moved, rotation_matrix

Scalar = Float[Array, ""] | float

RESTING, PUSHING, LYING = 4, 8, 6
"""Contacts of a step: corners of the cube on the plate, the trunk on the cube, the trunk on the plate."""
ALARM = 0.005
"""[m] Surfaces further apart than this, beyond the contact distance, do not see each other in a step."""

RIGID = 1e-12
"""Share of the largest compliance below which a contact counts as one of two parts that cannot move."""


class PushScene(NamedTuple):
    """What does not change between rollouts; static, never traced."""

    surface: PointMap  # points of the trunk that can touch
    band: Int[np.ndarray, "bands width"]  # points of each band along the axis; short bands repeat their first
    plate_normal: Float[np.ndarray, "3"]  # unit vector out of the plate
    plate_height: float  # of the plate's top along its normal [m]
    contact_distance: float  # [m]


class Touch(NamedTuple):
    """The contacts of one step: `RESTING`, then `PUSHING`, then `LYING`."""

    gap: Float[Array, " contacts"]  # distance less the contact distance [m]
    frame: Float[Array, "contacts 3 3"]  # rows: normal, two tangents
    arm: Float[Array, "contacts 3"]  # from the cube's centre to the contact [m]
    trunk_node: Int[Array, "trunk_contacts 8"]  # of the trunk's point, for the contacts that it takes part in
    trunk_weight: Float[Array, "trunk_contacts 8"]


class Pushed(NamedTuple):
    """What contacts and cables made of a step."""

    change: Float[Array, " dofs"]  # of the body's velocity [m/s]
    cable: Float[Array, " cables"]  # impulses [N s]
    cube: CubeState
    converged: Bool[Array, ""]
    cables_converged: Bool[Array, ""]


class PushStatus(NamedTuple):
    """How the steps of a rollout went."""

    diverged: Bool[Array, ""]
    cables_converged: Bool[Array, ""]
    contacts_converged: Bool[Array, ""]

    @classmethod
    def fine(cls) -> PushStatus:
        """Before the first step."""
        return cls(jnp.array(False), jnp.array(True), jnp.array(True))

    def joined(self, other: PushStatus) -> PushStatus:
        """Of both stretches together."""
        return PushStatus(
            self.diverged | other.diverged,
            self.cables_converged & other.cables_converged,
            self.contacts_converged & other.contacts_converged,
        )


class PushRollout(NamedTuple):
    """Recorded motion; a diverged rollout stays finite, but its rows from then on mean nothing."""

    position: Float[Array, "rows points 3"]  # [m]
    tension: Float[Array, "rows cables"]  # [N]
    pose: Float[Array, "rows 7"]  # of the cube: centre [m] and unit quaternion (x, y, z, w)
    status: PushStatus


def push_scene(
    surface: PointMap,
    height: Float[np.ndarray, " points"],
    bands: int,
    *,
    plate_normal: Float[np.ndarray, "3"],
    plate_height: float,
    contact_distance: float,
) -> PushScene:
    """Scene of a body whose surface points lie at these heights along its axis [m], cut into equal bands.

    Raises:
        InputError: fewer occupied bands than contacts between trunk and cube.
    """
    edges = np.linspace(np.min(height), np.max(height), bands + 1)
    place = np.clip(np.searchsorted(edges, height, side="right") - 1, 0, bands - 1)
    members = [np.flatnonzero(place == index) for index in np.unique(place)]
    if len(members) < max(PUSHING, LYING):
        raise InputError(f"the body's surface has points in {len(members)} bands only", where="push")
    width = max(len(member) for member in members)
    band = np.stack([np.concatenate([member, np.repeat(member[:1], width - len(member))]) for member in members])
    normal = np.asarray(plate_normal, float)
    return PushScene(surface, band, normal / np.linalg.norm(normal), float(plate_height), float(contact_distance))


def _nearest(scene: PushScene, gap: Float[Array, " points"], count: int) -> Int[Array, " contacts"]:
    """The nearest point of each of the nearest bands, in ascending order, which rounding does not change."""
    banded = gap[scene.band]
    chosen = jnp.argmin(banded, axis=1)
    best = jnp.take_along_axis(banded, chosen[:, None], axis=1)[:, 0]
    band = lax.top_k(-lax.stop_gradient(best), count)[1]
    return jnp.sort(jnp.asarray(scene.band)[band, chosen[band]])


def find_contacts(scene: PushScene, cube: Cube, state: CubeState, position: Float[Array, "nodes 3"]) -> Touch:
    """Contacts at the start of a step, from the positions of the body's nodes [m]."""
    turn, up = rotation_matrix(state.orientation), jnp.asarray(scene.plate_normal)
    corner = cube.side * CORNERS @ turn.T
    clearance = corner @ up + state.position @ up - scene.plate_height
    lowest = jnp.sort(lax.top_k(-lax.stop_gradient(clearance), RESTING)[1])
    points = point_positions(scene.surface, position)
    distance, normal = distance_to_box(points, state.position, turn, cube.side)
    height = points @ up - scene.plate_height
    pushing, lying = _nearest(scene, distance, PUSHING), _nearest(scene, height, LYING)
    both = jnp.concatenate([pushing, lying])
    # A contact on the cube lies on its surface, below the trunk's point.
    arm = points[pushing] - distance[pushing, None] * normal[pushing] - state.position
    return Touch(
        gap=jnp.concatenate([clearance[lowest], distance[pushing], height[lying]]) - scene.contact_distance,
        frame=contact_frame(jnp.concatenate([jnp.tile(up, (RESTING, 1)), normal[pushing], jnp.tile(up, (LYING, 1))])),
        arm=jnp.concatenate([corner[lowest], arm, jnp.zeros((LYING, 3))]),
        trunk_node=jnp.asarray(scene.surface.node)[both],
        trunk_weight=jnp.asarray(scene.surface.weight)[both],
    )


def trunk_rows(touch: Touch, nodes: int) -> Float[Array, "rows nodes 3"]:
    """Derivatives of the contacts' relative velocities with respect to the velocities of the body's nodes."""
    frame = touch.frame[RESTING:]
    count = len(frame)
    weight = jnp.zeros((count, nodes)).at[jnp.arange(count)[:, None], touch.trunk_node].add(touch.trunk_weight)
    return jnp.einsum("cn,cri->crni", weight, frame).reshape(3 * count, nodes, 3)


def cube_rows(touch: Touch) -> Float[Array, "rows 6"]:
    """Derivatives of the contacts' relative velocities with respect to the cube's velocity and spin."""
    rows = jnp.concatenate([touch.frame, jnp.cross(touch.arm[:, None, :], touch.frame)], axis=2)
    sign = np.concatenate([np.ones(RESTING), -np.ones(PUSHING), np.zeros(LYING)])
    return (jnp.asarray(sign)[:, None, None] * rows).reshape(-1, 6)


def push(
    touch: Touch,
    cube: Cube,
    state: CubeState,
    friction: Scalar,
    twist: Float[Array, "6"],
    rows: Float[Array, "dofs rows"],
    response: Float[Array, "dofs rows"],
    velocity: Float[Array, " dofs"],
    cable_rate: Float[Array, " cables"],
    previous: Float[Array, " cables"],
    time_step: Scalar,
) -> Pushed:
    """Let the contacts and cables of a step act.

    Args:
        twist: of the cube at the end of the step without contacts.
        rows: -dl/dx of the cables, then `trunk_rows`, over the free degrees of freedom of the body.
        response: A^-1 times these, A the matrix of the implicit step.
        velocity: of the body at the end of the step without contacts and cables [m/s].
        cable_rate: rate at which each cable's commanded length lies above its length at that velocity [m/s].
        previous: impulses of the cables in the step before [N s].
    """
    cables, resting = len(cable_rate), 3 * RESTING
    on_cube, mass = cube_rows(touch), inverse_inertia(cube)
    compliance = jnp.zeros((cables + len(on_cube),) * 2)
    trunk = np.concatenate([np.arange(cables), np.arange(cables + resting, cables + len(on_cube))])
    compliance = compliance.at[np.ix_(trunk, trunk)].add(rows.T @ response)
    compliance = compliance.at[cables:, cables:].add((on_cube * mass) @ on_cube.T)
    rate = jnp.concatenate([jnp.zeros(resting), rows[:, cables:].T @ velocity]) + on_cube @ twist
    size = jnp.diagonal(compliance)[cables::3]
    # Between the plate and a held part of the body nothing can give way, and there is nothing to solve.
    near = (touch.gap < ALARM) & (size > RIGID * jnp.max(size))
    opening = jnp.where(near, touch.gap / time_step, 1e6)
    rate = rate + jnp.zeros((len(touch.gap), 3)).at[:, 0].set(opening).ravel()
    found = solve_constraints(compliance, jnp.concatenate([cable_rate, rate]), cables, friction, previous)
    contact = found.contact.ravel()
    change = response @ jnp.concatenate([found.cable, contact[resting:]])
    after = moved(state, twist + mass * (on_cube.T @ contact), time_step)
    return Pushed(change, found.cable, after, found.converged, found.cables_converged)
