"""Mesh files: what is read, in which unit, and what is refused."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots.meshes import read_tetrahedra

POINTS = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 5], [2, 3, 5]], dtype=float)
TETRAHEDRA = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])


def write(path: Path, points=POINTS, tetrahedra=TETRAHEDRA, **options) -> Path:
    cells = [("triangle", np.array([[0, 1, 2]])), ("tetra", np.asarray(tetrahedra))]
    if options.get("file_format") == "gmsh":  # meshio writes this version with one kind of cell only
        cells = cells[1:]
    meshio.write(path, meshio.Mesh(np.asarray(points, float), cells), **options)
    return path


@pytest.mark.parametrize(
    ("name", "options"), [("a.vtk", {}), ("a.msh", {"file_format": "gmsh22"}), ("b.msh", {"file_format": "gmsh"})]
)
def test_reads_vtk_and_gmsh_in_metres(tmp_path, name, options):
    mesh = read_tetrahedra(write(tmp_path / name, **options), "mm")
    np.testing.assert_allclose(mesh.position, POINTS * 1e-3, rtol=1e-14)
    np.testing.assert_array_equal(mesh.element, TETRAHEDRA)


@pytest.mark.parametrize(
    ("points", "tetrahedra", "message"),
    [
        (POINTS, [[0, 2, 1, 3], [1, 2, 3, 4]], "element 0 is inverted"),
        (POINTS * [1, 1, 0], TETRAHEDRA, "is flat"),
        (POINTS, TETRAHEDRA[:1], "1 nodes belong to no tetrahedron, the first is 4"),
        (np.vstack([POINTS[:4], POINTS[:4] + 10]), [[0, 1, 2, 3], [4, 5, 6, 7]], "2 parts"),
        (np.where(POINTS == 5, np.nan, POINTS), TETRAHEDRA, "not finite"),
    ],
)
def test_refuses_meshes_that_are_no_single_sound_body(tmp_path, points, tetrahedra, message):
    with pytest.raises(InputError, match=message):
        read_tetrahedra(write(tmp_path / "bad.vtk", points, tetrahedra), "m")


def test_refuses_surfaces_unknown_units_and_unreadable_files(tmp_path):
    surface = tmp_path / "surface.vtk"
    meshio.write(surface, meshio.Mesh(POINTS, [("triangle", np.array([[0, 1, 2]]))]))
    with pytest.raises(InputError, match="only triangle"):
        read_tetrahedra(surface, "m")
    with pytest.raises(InputError, match="unknown length unit 'inch'"):
        read_tetrahedra(write(tmp_path / "a.vtk"), "inch")
    with pytest.raises(InputError, match="no such file"):
        read_tetrahedra(tmp_path / "absent.vtk", "m")
    for name in ("text.vtk", "text.xyz"):
        (tmp_path / name).write_text("not a mesh\n")
        with pytest.raises(InputError, match="not a readable mesh"):
            read_tetrahedra(tmp_path / name, "m")


def test_reads_the_trunk_of_softrobots(datasets):
    mesh = read_tetrahedra(datasets / "sofa_trunk" / "trunk.vtk", "mm")
    assert mesh.position.shape == (709, 3)
    assert mesh.element.shape == (1972, 4)
    corners = mesh.position[mesh.element]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 6.0
    assert volume == pytest.approx(38.9e-6, rel=2e-3)
