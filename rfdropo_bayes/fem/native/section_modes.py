"""A layered body in section modes: the coordinates in which its layers are sparse.

The nodes of a section move as constant, linear, ... polynomials in x and y, each even or odd under x -> -x and y -> -y.
A layer has both mirror planes, so its stiffness couples component i of mode m with component j of mode n only where the
parities agree. Of every 3 x 3 block three entries are left on the diagonal if m and n have the same parity, else two
beside it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.fem.cable_strings import crossing_weights
from rfdropo_bayes.fem.cables import CableLayout, routes
from rfdropo_bayes.fem.dynamics import LOST, System
from rfdropo_bayes.fem.layered import PointMap, centre_gradient, rest_positions
from rfdropo_bayes.fem.native.layer_moduli import layer_moduli, layer_volume
from rfdropo_bayes.fem.surroundings import drag_areas, tributary_lengths

# Entries (row, column) of a block of two modes, by the parity (bit 0: odd in x, bit 1: odd in y) in which the modes
# differ.
BLOCK_ENTRIES = (((0, 0), (1, 1), (2, 2)), ((0, 2), (2, 0)), ((1, 2), (2, 1)), ((0, 1), (1, 0)))


class LayeredTables(NamedTuple):
    """What the kernels know of a body, its cables and its recorded points. Field values count ``(station, mode,
    component)``.

    Blocks of a layer come in the order (lower, lower), (upper, upper) with row mode >= column mode, then (lower,
    upper). Points are sparse sums: point p is the sum of ``weight[k]`` times the mode at row ``place[k]``, k in
    ``first[p]:first[p + 1]``.
    """

    parity: Int[np.ndarray, " modes2"]  # of the modes of both sections of a layer
    shape: Float[np.ndarray, "nodes modes"]  # value of every mode at the nodes of a section
    inverse: Float[np.ndarray, "modes nodes"]
    square: Float[np.ndarray, " modes"]  # sum over the nodes
    stiffness: Float[np.ndarray, "layers entries 3"]  # per modulus of ``layer_moduli`` [m]
    entry_row: Int[np.ndarray, " entries"]  # of a layer's 6 modes values, in the order of ``stiffness``
    entry_column: Int[np.ndarray, " entries"]
    station_mass: Float[np.ndarray, "stations pairs"]  # per density, of the pairs of equal parity [m3]
    layer_mass: Float[np.ndarray, "layers coupled"]
    lumped: Float[np.ndarray, " pairs"]  # of a unit mass shared by the nodes of a section
    gradient: Float[np.ndarray, "layers 2 modes"]  # centre gradient: by x, y or z as the parity says [1/m]
    rest: Float[np.ndarray, " values"]  # [m]
    cable_first: Int[np.ndarray, " cables_1"]  # guides of every cable
    guide_first: Int[np.ndarray, " guides_1"]
    guide_place: Int[np.ndarray, " entries"]
    guide_weight: Float[np.ndarray, " entries"]
    guide_station: Int[np.ndarray, " entries"]
    anchor: Float[np.ndarray, "cables 3"]
    rest_length: Float[np.ndarray, " cables"]
    crossing: Float[np.ndarray, "layers cables 2 modes"]  # way of every cable through every layer
    section_length: Float[np.ndarray, " stations"]  # of the body that a station stands for [m]
    section_area: Float[np.ndarray, " stations"]  # that times the body's width [m2]
    point_first: Int[np.ndarray, " points_1"]
    point_place: Int[np.ndarray, " entries"]
    point_weight: Float[np.ndarray, " entries"]
    reach: float  # a node farther from its rest position has been lost [m]
    held: int
    across: int  # modes along x, and along y
    modes: int
    stations: int
    entries: int
    pairs: int
    coupled: int
    cables: int
    points: int


def section_modes(nodes_across: int) -> tuple[Float[np.ndarray, "nodes modes"], Int[np.ndarray, " modes"]]:
    """Mode shapes, products of Gram polynomials that are one in the corner x = y = 1, and their parities."""
    grid = np.linspace(-1.0, 1.0, nodes_across)
    line = np.linalg.qr(np.vander(grid, increasing=True))[0]
    line = line / line[-1]
    odd = np.arange(nodes_across) % 2
    return np.kron(line, line), (odd[None, :] + 2 * odd[:, None]).ravel().astype(np.int64)


def block_pairs(modes: int) -> list[tuple[int, int, int, int]]:
    """Blocks (row face, row mode, column face, column mode) of a layer, in the order of the tables."""
    below = [(0, m, 0, n) for m in range(modes) for n in range(m + 1)]
    above = [(1, m, 1, n) for m in range(modes) for n in range(m + 1)]
    return below + above + [(0, m, 1, n) for m in range(modes) for n in range(modes)]


def border_panels(cables: int) -> int:
    """Panels of three rows that hold the right-hand side and one row for every cable."""
    return (cables + 3) // 3


def sparse_points(node: np.ndarray, weight: np.ndarray, shape: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points given by nodes as sparse sums of modes: first, place, weight."""
    section = len(shape)
    first, place, value = [0], [], []
    for nodes, weights in zip(node, weight, strict=True):
        total: dict[int, np.ndarray] = {}
        for one, factor in zip(nodes, weights, strict=True):
            station, member = divmod(int(one), section)
            total[station] = total.get(station, np.zeros(section)) + factor * shape[member]
        for station in sorted(total):
            used = np.flatnonzero(np.abs(total[station]) > 1e-14)
            place.extend(3 * (station * section + used))
            value.extend(total[station][used])
        first.append(len(place))
    return np.array(first, dtype=np.int64), np.array(place, dtype=np.int64), np.array(value, dtype=float)


def _guides(layout: CableLayout, shape: np.ndarray) -> dict[str, np.ndarray]:
    used = layout.guide_used
    first, place, weight = sparse_points(layout.guide_node[used], layout.guide_weight[used], shape)
    return {
        "cable_first": np.concatenate([[0], np.cumsum(used.sum(axis=1))]).astype(np.int64),
        "guide_first": first,
        "guide_place": place,
        "guide_weight": weight,
        "guide_station": place // (3 * len(shape)),
        "anchor": np.asarray(layout.anchor, dtype=float).reshape(-1, 3),
    }


def layered_tables(system: System, points: PointMap, dtype: type) -> LayeredTables:
    """Tables of a body with cables and recorded points, in the precision of the kernels."""
    body = system.body
    shape, parity = section_modes(body.nodes_across)
    modes, layers = len(parity), len(body.station) - 1
    faces = np.kron(np.eye(2), shape)
    moduli = np.einsum("am,plaibj,bn->plminj", faces, layer_moduli(body), faces, optimize=True)
    mass = np.einsum("am,lab,bn->lmn", faces, layer_volume(body), faces, optimize=True)
    blocks = [(f * modes + m, g * modes + n, parity[m] ^ parity[n]) for f, m, g, n in block_pairs(modes)]
    entries = [(r, i, c, j) for r, c, kind in blocks for i, j in BLOCK_ENTRIES[kind]]
    below = [(m, n) for m in range(modes) for n in range(m + 1) if parity[m] == parity[n]]
    coupled = [(m, n) for m in range(modes) for n in range(modes) if parity[m] == parity[n]]
    station_mass = np.zeros((layers + 1, len(below)))
    for k, (m, n) in enumerate(below):
        station_mass[:-1, k] += mass[:, m, n]
        station_mass[1:, k] += mass[:, modes + m, modes + n]
    rest = rest_positions(body)
    point_first, point_place, point_weight = sparse_points(points.node, points.weight, shape)
    gradient = np.einsum("am,lai->lmi", faces, centre_gradient(body)).reshape(layers, 2, modes, 3)
    axis = np.array([2, 0, 1, 2])[parity]
    slopes = gradient[:, :, np.arange(modes), axis] * (parity != 3)
    tables = LayeredTables(
        parity=np.tile(parity, 2),
        shape=shape,
        inverse=np.linalg.inv(shape),
        square=np.sum(shape**2, axis=0),
        stiffness=np.stack([moduli[:, :, r, i, c, j].T for r, i, c, j in entries], axis=1),
        entry_row=np.array([3 * r + i for r, i, _, _ in entries], dtype=np.int64),
        entry_column=np.array([3 * c + j for _, _, c, j in entries], dtype=np.int64),
        station_mass=station_mass,
        layer_mass=np.stack([mass[:, m, modes + n] for m, n in coupled], axis=1),
        lumped=np.array([shape[:, m] @ shape[:, n] for m, n in below]) / modes,
        gradient=slopes,
        rest=np.linalg.solve(shape, rest.reshape(layers + 1, modes, 3)).ravel(),
        **_guides(system.cables, shape),
        rest_length=np.array([np.linalg.norm(np.diff(r, axis=0), axis=1).sum() for r in routes(system.cables, rest)]),
        crossing=crossing_weights(body, system.cables) @ faces,
        section_length=tributary_lengths(body),
        section_area=drag_areas(body),
        point_first=point_first,
        point_place=point_place,
        point_weight=point_weight,
        reach=float(LOST * (body.station[-1] - body.station[0])),
        held=int(system.clamped_stations),
        across=body.nodes_across,
        modes=modes,
        stations=layers + 1,
        entries=len(entries),
        pairs=len(below),
        coupled=len(coupled),
        cables=len(system.cables.anchor),
        points=len(points.node),
    )
    return LayeredTables(*(_as_kernel_array(value, dtype) for value in tables))


def _as_kernel_array(value: np.ndarray | float, dtype: type) -> np.ndarray | float:
    if not isinstance(value, np.ndarray):
        return value
    return np.ascontiguousarray(value, dtype=dtype if value.dtype.kind == "f" else value.dtype)
