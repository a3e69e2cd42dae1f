"""Data of the kernels of a trunk that pushes a cube: touching bodies, cubes, and contacts of a step."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.native.rod_tables import SIZE, entries_of
from rfdropo_bayes.fem.native.simd import aligned_zeros
from rfdropo_bayes.fem.pushing import PushGeometry

CUBE_STATE, CUBE_VALUES, CORNERS = 13, 4, 8
"""Rows of a cube: centre, quaternion (x, y, z, w), velocity, spin; and mass, side, radius of gyration, friction."""
NOTHING = 1e-13
"""Weights of a sphere's entries below this are rounding."""
MISSED = {"float64": 1e-9, "float32": 1e-5}
"""[m/s] Velocity at which a surface may go through another that it was not taken to touch in a step."""


class ContactScene(NamedTuple):
    """Bodies that can touch; sphere s is bound to rows ``place[k]`` of the velocities, k in ``first[s]:first[s + 1]``;
    see ``sphere_maps``.

    The centre of a mesh's sphere is bound only to entries before ``within[s]``.
    """

    first: Int[np.ndarray, " spheres_1"]
    within: Int[np.ndarray, " spheres"]
    place: Int[np.ndarray, " entries"]
    centre: Float[np.ndarray, " entries"]
    gradient: Float[np.ndarray, "entries 3"] | None  # of a mesh
    arm: Float[np.ndarray, "entries 3"] | None  # of a rod, in the section's frame [m]
    radius: Float[np.ndarray, " spheres"]  # [m]
    up: Float[np.ndarray, "3"]  # unit vector out of the plate
    height: float  # of the plate along it [m]
    distance: float  # that surfaces keep [m]
    spheres: int


class Cubes(NamedTuple):
    """Cubes of a batch at the start; one row a rollout."""

    state: Float[np.ndarray, "batch 13"]
    values: Float[np.ndarray, "batch 4"]


class PushOutput(NamedTuple):
    """Motion of the cubes of a batch; recorded row 0 is the initial state."""

    pose: Float[np.ndarray, "batch records 7"]


class ContactRecords(NamedTuple):
    """Cubes and contacts of one lane block; the last axis is the lane.

    A pair is a corner of the cube and the plate, a sphere and the cube, or a sphere and the plate. Pairs that are near
    each other in any lane are the candidates of a step, ``count`` of each kind; candidates chosen by any lane are its
    contacts.
    """

    cube: Float[np.ndarray, "13 lanes"]
    values: Float[np.ndarray, "4 lanes"]
    memory: Float[np.ndarray, "pairs3 lanes"]  # impulses of the step before, in space [N s]
    turn: Float[np.ndarray, "9 lanes"]  # matrix of the cube's orientation, row-major
    twist: Float[np.ndarray, "6 lanes"]  # at the end of the stage without contacts
    after: Float[np.ndarray, "6 lanes"]  # with them
    carried: Float[np.ndarray, "6 lanes"]  # change of the twist with which the stage before goes on; then zero again
    middle: Float[np.ndarray, "spheres3 lanes"]  # the spheres' centres [m]
    reach: Float[np.ndarray, "spheres lanes"]  # gap within which a sphere may meet something in the step [m]
    rate: Float[np.ndarray, "pairs3 lanes"]  # of a candidate: relative velocity by the trunk's at the start of the step
    gap: Float[np.ndarray, "pairs lanes"]  # of a candidate: distance less the contact distance [m]
    frame: Float[np.ndarray, "pairs9 lanes"]  # rows: normal, two tangents
    arm: Float[np.ndarray, "pairs3 lanes"]  # from the cube's centre to the contact [m]
    offset: Float[np.ndarray, "pairs3 lanes"]  # from the sphere's centre to its surface [m], see ``sphere_maps``
    lever: Float[np.ndarray, "entries3 lanes"]  # arms of a rod's spheres in space [m]
    chosen: Float[np.ndarray, "pairs lanes"]  # 1 for a lane's contacts
    on_cube: Float[np.ndarray, "pairs18 lanes"]  # of a contact: relative velocity by the cube's twist
    pair: Int[np.ndarray, " pairs"]  # that a candidate is
    contact: Int[np.ndarray, " pairs"]  # candidate that a contact is
    count: Int[np.ndarray, "4"]  # candidates of the three kinds; contacts without the trunk


def pairs_of(spheres: int) -> int:
    """Pairs that can touch."""
    return CORNERS + 2 * spheres


def touch_storage(scene: ContactScene, lanes: int, dtype: type) -> ContactRecords:
    """Zeroed, aligned storage of one lane block."""
    spheres, pairs = scene.spheres, pairs_of(scene.spheres)
    sizes = {
        "cube": CUBE_STATE, "values": CUBE_VALUES, "memory": 3 * pairs, "turn": 9, "twist": 6, "after": 6, "carried": 6,
        "middle": 3 * spheres, "reach": spheres, "rate": 3 * pairs, "gap": pairs, "frame": 9 * pairs,
        "arm": 3 * pairs, "offset": 3 * pairs, "lever": 3 * len(scene.place),
        "chosen": pairs, "on_cube": 18 * pairs,
    }  # fmt: skip
    arrays = {name: aligned_zeros((size, lanes), dtype) for name, size in sizes.items()}
    numbers = np.zeros(pairs, dtype=np.int64), np.zeros(pairs, dtype=np.int64), np.zeros(4, dtype=np.int64)
    return ContactRecords(**arrays, pair=numbers[0], contact=numbers[1], count=numbers[2])


def rod_scene(scene: PushGeometry, dtype: type) -> ContactScene:
    """Tables of a scene whose spheres are bound to the sections of a rod."""
    first, station, weight, arm = entries_of(scene.spheres.centre)
    place = np.stack([SIZE * station, SIZE * station + 3], axis=1).ravel()
    return _scene(scene, 2 * first, 2 * first[1:], place, np.repeat(weight, 2), None, np.repeat(arm, 2, axis=0), dtype)


def mesh_scene(scene: PushGeometry, number: Int[np.ndarray, " nodes"], dtype: type) -> ContactScene:
    """Tables of a scene whose spheres are bound to nodes of a mesh; ``number`` has each node's index in the engine's
    order.
    """
    spheres = scene.spheres
    weight = np.concatenate([spheres.centre[..., None], spheres.gradient], axis=2)
    first, within, place, values = [0], [], [], []
    for nodes, weights in zip(number[spheres.node], weight, strict=True):
        order = np.argsort(nodes, kind="stable")
        entries = list(zip(nodes[order], weights[order], strict=True))
        central = [(k, row) for k, row in entries if abs(row[0]) > NOTHING]
        others = [(k, row) for k, row in entries if abs(row[0]) <= NOTHING < np.abs(row).max()]
        place.extend(3 * k for k, _ in central + others)
        values.extend(row for _, row in central + others)
        within.append(first[-1] + len(central))
        first.append(len(place))
    table = np.array(values, dtype=dtype).reshape(-1, 4)
    return _scene(
        scene, np.array(first), np.array(within), np.array(place), table[:, 0], table[:, 1:], None, dtype
    )  # fmt: skip


def _scene(
    scene: PushGeometry,
    first: np.ndarray,
    within: np.ndarray,
    place: np.ndarray,
    centre: np.ndarray,
    gradient: np.ndarray | None,
    arm: np.ndarray | None,
    dtype: type,
) -> ContactScene:
    def floats(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else np.ascontiguousarray(values, dtype=dtype)

    return ContactScene(
        first=first.astype(np.int64),
        within=within.astype(np.int64),
        place=place.astype(np.int64),
        centre=np.ascontiguousarray(centre, dtype=dtype),
        gradient=floats(gradient),
        arm=floats(arm),
        radius=np.asarray(scene.spheres.radius, dtype=dtype),
        up=np.asarray(scene.plate_normal, dtype=dtype),
        height=float(scene.plate_height),
        distance=float(scene.contact_distance),
        spheres=len(scene.spheres.radius),
    )


def cube_rows(
    state: Float[np.ndarray, "*batch 13"], values: Float[np.ndarray, "*batch 4"], count: int, dtype: np.dtype
) -> Cubes:
    """Cubes of a batch in the precision of the kernels.

    Raises:
        InputError: shapes that do not fit.
    """
    rows = []
    for name, given, width in (("state", state, CUBE_STATE), ("values", values, CUBE_VALUES)):
        array = np.asarray(given, dtype=float)
        if array.shape not in ((width,), (1, width), (count, width)):
            raise InputError(f"{name} has shape {array.shape}, expected {(count, width)}", where="cube")
        rows.append(np.array(np.broadcast_to(array, (count, width)), dtype=dtype, order="C"))
    return Cubes(*rows)
