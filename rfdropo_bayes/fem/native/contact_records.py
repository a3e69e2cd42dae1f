"""What the kernels of a trunk that pushes a cube work on: what can touch, the cubes, and the contacts of a step."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.native.section_modes import sparse_points
from rfdropo_bayes.fem.native.simd import aligned_zeros
from rfdropo_bayes.fem.pushing import ALARM, LYING, PUSHING, RESTING, PushScene

CUBE_STATE, CUBE_VALUES = 13, 4
"""Rows of a cube: centre, quaternion (x, y, z, w), velocity, spin; and mass, side, radius of gyration, friction."""
SPACE = 7
"""Rows of a candidate's ``space``."""
MOST, TRUNK_MOST = RESTING + PUSHING + LYING, PUSHING + LYING
"""Contacts of a step, at most, and those that the trunk takes part in."""
SWELLING = 1.5
"""A band that is this much larger than at rest is still searched as a whole when its mean comes near."""


MISSED = {"float64": 1e-9, "float32": 1e-5}
"""[m/s] Velocity at which a point of the trunk may go through a surface that it was not taken to touch in a step."""
SETTLED = {"float64": 1e-12, "float32": 1e-6}
"""Relative change of the impulses in a sweep below which a lane's contacts are solved."""


class Scene(NamedTuple):
    """What can touch; points are sparse sums of rows of a field, as in ``section_modes.LayeredTables``: those of the
    surface, then the mean of every band."""

    first: Int[np.ndarray, " points_1"]
    place: Int[np.ndarray, " entries"]
    weight: Float[np.ndarray, " entries"]
    band_first: Int[np.ndarray, " bands_1"]
    member: Int[np.ndarray, " members"]  # points of the bands, in ascending order
    reach: Float[np.ndarray, " bands"]  # a band whose mean is further from a body does not touch it [m]
    up: Float[np.ndarray, "3"]  # unit vector out of the plate
    height: float  # of the plate along it [m]
    distance: float  # that surfaces keep [m]
    bands: int
    points: int  # of the surface


class Cubes(NamedTuple):
    """Cubes of a batch at the start; one row a rollout."""

    state: Float[np.ndarray, "batch 13"]
    values: Float[np.ndarray, "batch 4"]


class PushOutput(NamedTuple):
    """What a batch returns of the cubes; recorded row 0 is the initial state."""

    pose: Float[np.ndarray, "batch records 7"]
    converged: UInt8[np.ndarray, " batch"]


class Touch(NamedTuple):
    """Cubes and contacts of one lane block; the last axis is the lane.

    Candidates are ``count[0]`` points of the trunk near the cube, then ``count[1]`` near the plate. Contacts are those
    of the cube on the plate, then the candidates that each lane has chosen, with three rows each in ``border``, laid
    out as the engine's own border is.
    """

    cube: Float[np.ndarray, "13 lanes"]
    values: Float[np.ndarray, "4 lanes"]
    turn: Float[np.ndarray, "9 lanes"]  # matrix of the cube's orientation, row-major
    twist: Float[np.ndarray, "6 lanes"]  # at the end of the step without contacts
    after: Float[np.ndarray, "6 lanes"]  # with them
    level: Float[np.ndarray, "8 lanes"]  # of the cube's corners above the plate [m]
    gap: Float[np.ndarray, "trunk_contacts lanes"]  # of the nearest points to the cube, then to the plate [m]
    nearest: Float[np.ndarray, "trunk_contacts lanes"]  # these points
    candidate: Float[np.ndarray, "trunk_contacts lanes"]  # the trunk's points that may touch, negative beyond the last
    space: Float[np.ndarray, "trunk_contacts7 lanes"]  # of these: gap, normal, and arm from the cube's centre
    chosen: Float[np.ndarray, "trunk_contacts lanes"]  # 1 for those that are contacts of the step
    point: Float[np.ndarray, "trunk_contacts lanes"]  # the trunk's point in a contact, negative where there is none
    frame: Float[np.ndarray, "contacts9 lanes"]  # rows: normal, two tangents
    on_cube: Float[np.ndarray, "rows6 lanes"]  # relative velocity by the cube's twist
    near: Float[np.ndarray, "contacts lanes"]  # 1 where a contact may act
    opening: Float[np.ndarray, "contacts lanes"]  # gap over the time step [m/s]
    moving: Float[np.ndarray, "rows lanes"]  # velocity of the trunk's points along the rows [m/s]
    border: Float[np.ndarray, "values lanes"]
    own: Float[np.ndarray, "tiles lanes"]  # of condensed trunk contacts
    across: Float[np.ndarray, "tiles lanes"]  # of trunk contacts and the engine's border
    pull: Float[np.ndarray, "cables_rows lanes"]  # compliance of cables and contact rows
    matrix: Float[np.ndarray, "rows2 lanes"]
    reduced: Float[np.ndarray, "rows2 lanes"]  # less what the cables that pull hold
    free: Float[np.ndarray, "rows lanes"]  # relative velocity without impulses [m/s]
    reduced_free: Float[np.ndarray, "rows lanes"]
    ease: Float[np.ndarray, "contacts2 lanes"]  # what divides a contact's normal and tangential velocity
    impulse: Float[np.ndarray, "rows lanes"]  # [N s]
    held: Float[np.ndarray, "cables_rows lanes"]  # tensions per contact impulse
    offset: Float[np.ndarray, "cables lanes"]
    before: Float[np.ndarray, "cables lanes"]  # the cables that pulled before
    first: Float[np.ndarray, "cables lanes"]  # those to try first in the step
    going: Float[np.ndarray, "1 lanes"]  # 1 while contacts are not solved
    stuck: Float[np.ndarray, "1 lanes"]  # 1 where a step's contacts were not solved
    failed: Float[np.ndarray, "1 lanes"]  # 1 once they were not
    count: Int[np.ndarray, "2"]


def touch_storage(border: int, panels: int, cables: int, lanes: int, dtype: type) -> Touch:
    """Zeroed, aligned storage of one lane block; ``border`` rows for contacts, ``panels`` in the engine's own."""
    rows = 3 * MOST
    sizes = {
        "cube": CUBE_STATE, "values": CUBE_VALUES, "turn": 9, "twist": 6, "after": 6, "level": 8, "gap": TRUNK_MOST,
        "nearest": TRUNK_MOST, "candidate": TRUNK_MOST, "space": SPACE * TRUNK_MOST, "chosen": TRUNK_MOST,
        "point": TRUNK_MOST, "ease": 2 * MOST, "first": cables, "frame": 9 * MOST, "on_cube": 6 * rows, "near": MOST,
        "opening": MOST, "moving": rows, "border": border, "own": 9 * TRUNK_MOST**2, "across": 9 * TRUNK_MOST * panels,
        "pull": cables * rows, "matrix": rows**2, "reduced": rows**2, "free": rows, "reduced_free": rows,
        "impulse": rows, "held": cables * (rows + 1), "offset": cables, "before": cables, "going": 1, "stuck": 1,
        "failed": 1,
    }  # fmt: skip
    arrays = {name: aligned_zeros((max(size, 1), lanes), dtype) for name, size in sizes.items()}
    return Touch(**arrays, count=np.zeros(2, dtype=np.int64))


def scene_tables(
    scene: PushScene,
    shape: Float[np.ndarray, "nodes nodes"],
    number: Int[np.ndarray, " nodes"],
    rest: Float[np.ndarray, "nodes 3"],
    dtype: type,
) -> Scene:
    """Tables of a scene.

    Args:
        shape: values of the modes of a section at its nodes; 1 for a body without sections.
        number: of every node in the engine's order.
        rest: node positions at rest, in the body's own order [m].
    """
    surface = scene.surface
    members = [np.unique(band) for band in scene.band]
    position = np.einsum("pk,pki->pi", surface.weight, rest[surface.node])
    spread = [np.linalg.norm(position[band] - position[band].mean(axis=0), axis=1).max() for band in members]
    node = [*number[surface.node], *(number[surface.node[band]].ravel() for band in members)]
    share = [*surface.weight, *(surface.weight[band].ravel() / len(band) for band in members)]
    first, place, weight = sparse_points(node, share, shape)
    return Scene(
        first=first,
        place=place,
        weight=weight.astype(dtype),
        band_first=np.concatenate([[0], np.cumsum([len(band) for band in members])]).astype(np.int64),
        member=np.concatenate(members).astype(np.int64),
        reach=(SWELLING * np.array(spread) + scene.contact_distance + ALARM).astype(dtype),
        up=np.asarray(scene.plate_normal, dtype=dtype),
        height=float(scene.plate_height),
        distance=float(scene.contact_distance),
        bands=len(members),
        points=len(position),
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
        rows.append(np.ascontiguousarray(np.broadcast_to(array, (count, width)), dtype=dtype))
    return Cubes(*rows)
