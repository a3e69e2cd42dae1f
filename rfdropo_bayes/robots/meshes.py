"""Tetrahedral meshes from files (VTK, Gmsh and other formats of meshio), checked and in metres."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import NamedTuple

import meshio
import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float, Int
from scipy.sparse.csgraph import connected_components

from rfdropo_bayes.errors import InputError

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}  # length units a mesh file may be in


class TetrahedralMesh(NamedTuple):
    """Nodes and elements of a body, in the order of the file."""

    position: Float[np.ndarray, "nodes 3"]  # [m]
    element: Int[np.ndarray, "elements 4"]  # of positive volume


def read_tetrahedra(path: str | Path, unit: str) -> TetrahedralMesh:
    """Read the linear tetrahedra of a mesh file whose coordinates are in ``unit``; other cells are ignored.

    Raises:
        InputError: a file that cannot be read, an unknown unit, no tetrahedra, coordinates that are not finite, flat or
            inverted elements, nodes that belong to no element, or parts that do not touch.
    """
    if unit not in METRES:
        raise InputError(f"unknown length unit {unit!r}", where=str(path), remedy=f"use one of {', '.join(METRES)}")
    path = Path(path)
    if not path.is_file():
        raise InputError("no such file", where=str(path))
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # meshio announces unknown formats there before it raises
            mesh = meshio.read(path)
    except (Exception, SystemExit) as error:  # meshio's readers raise whatever their parsers meet
        reason = str(error) or "unknown format"
        raise InputError(f"not a readable mesh: {reason}", where=str(path), remedy="give VTK or Gmsh") from error
    cells = [np.asarray(block.data) for block in mesh.cells if block.type == "tetra"]
    found = ", ".join(sorted({block.type for block in mesh.cells})) or "nothing"
    if not cells:
        raise InputError(
            f"no tetrahedra, only {found}", where=str(path), remedy="mesh the volume with linear tetrahedra"
        )
    position = np.asarray(mesh.points, dtype=float) * METRES[unit]
    element = np.concatenate(cells).astype(int)
    _check(position, element, str(path))
    return TetrahedralMesh(position, element)


def _check(position: Float[np.ndarray, "nodes 3"], element: Int[np.ndarray, "elements 4"], where: str) -> None:
    if position.shape[1:] != (3,) or not np.all(np.isfinite(position)):
        raise InputError("coordinates are not finite triples", where=where)
    if element.min() < 0 or element.max() >= len(position):
        raise InputError(f"an element names node {element.max()} of {len(position)}", where=where)
    corners = position[element]
    edges = corners[:, 1:] - corners[:, :1]
    volume = np.linalg.det(edges) / 6.0
    smallest = 1e-9 * np.max(np.linalg.norm(edges, axis=2), axis=1) ** 3
    if np.any(volume < smallest):
        number = int(np.argmin(volume))
        kind = "inverted" if volume[number] < -smallest[number] else "flat"
        count = int(np.sum(volume < smallest))
        raise InputError(
            f"{count} flat or inverted elements, element {number} is {kind} ({volume[number]:.3g} m3)",
            where=where,
            remedy="swap two nodes of inverted elements, or mesh again",
        )
    used = np.zeros(len(position), dtype=bool)
    used[element] = True
    if not np.all(used):
        raise InputError(
            f"{np.sum(~used)} nodes belong to no tetrahedron, the first is {int(np.argmin(used))}",
            where=where,
            remedy="remove unused nodes",
        )
    ones = np.ones(3 * len(element))
    graph = sparse.coo_matrix((ones, (np.repeat(element[:, 0], 3), element[:, 1:].ravel())), shape=(len(position),) * 2)
    parts, _ = connected_components(graph, directed=False)
    if parts > 1:
        raise InputError(f"the mesh falls into {parts} parts that share no node", where=where, remedy="keep one body")
