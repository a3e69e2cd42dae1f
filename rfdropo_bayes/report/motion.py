"""A rollout as geometry: the trunk as a tube around its markers, the cube and the plate, in a frame with z upwards.

Its surfaces are written as VTK files for ParaView, or rendered off-screen with PyVista.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any, NamedTuple

import meshio
import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import output_folder
from rfdropo_bayes.report.style import ACCENT, POSTERIOR

AROUND, ALONG = 16, 60  # points around and along a tube
FRAME = (960, 640)  # [pixel]
CUBE_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
CUBE_FACES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


class DrawnMotion(NamedTuple):
    """Geometry to draw, in metres, in a frame whose third axis points upwards."""

    title: str
    time: Float[np.ndarray, " time"]  # [s]
    centre: Float[np.ndarray, "time point 3"]  # line through the trunk's markers
    radius: Float[np.ndarray, " point"]
    measured: Float[np.ndarray, "time marker 3"] | None  # recorded markers, NaN if masked
    cube: Float[np.ndarray, "time 8 3"] | None  # corners
    plate: float | None  # height

    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """Corners of the box around everything that moves."""
        points = [self.centre.reshape(-1, 3)] + ([self.cube.reshape(-1, 3)] if self.cube is not None else [])
        every = np.concatenate(points)
        return np.stack([every.min(axis=0), every.max(axis=0)])


def upright(gravity: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Rotation into a frame with z against gravity, and x along the body's axis if that is not vertical."""
    up = -np.asarray(gravity, float)
    up = up / np.linalg.norm(up) if np.any(up) else np.array([0.0, 0.0, 1.0])
    axis = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    forward = axis - (axis @ up) * up
    forward /= np.linalg.norm(forward)
    return np.stack([forward, np.cross(up, forward), up])


def smooth_line(
    position: Float[np.ndarray, "time marker 3"], rest: Float[np.ndarray, " marker"], points: int = ALONG
) -> tuple[Float[np.ndarray, "time point 3"], Float[np.ndarray, " point"]]:
    """Line through markers at increasing heights ``rest`` [m] along the body, and the heights of its points."""
    at = np.linspace(rest[0], rest[-1], points)
    return PchipInterpolator(rest, position, axis=1)(at), at


def tube(
    centre: Float[np.ndarray, "point 3"], radius: Float[np.ndarray, " point"]
) -> Float[np.ndarray, "point around 3"]:
    """Rings around a line, each turned by the least rotation from its predecessor."""
    tangent = np.gradient(centre, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    side = np.cross(tangent[0], np.eye(3)[np.argmin(np.abs(tangent[0]))])
    sides = np.empty_like(centre)
    for index, along in enumerate(tangent):
        side = side - (side @ along) * along
        side = side / np.linalg.norm(side)
        sides[index] = side
    angle = np.linspace(0.0, 2.0 * np.pi, AROUND + 1)
    ring = np.cos(angle)[:, None, None] * sides + np.sin(angle)[:, None, None] * np.cross(tangent, sides)
    return centre[:, None] + radius[:, None, None] * np.moveaxis(ring, 0, 1)


def tube_faces(points: int) -> Int[np.ndarray, "faces 4"]:
    """Quadrilaterals of a tube whose points are numbered ring after ring."""
    first = (np.arange(points - 1)[:, None] * (AROUND + 1) + np.arange(AROUND)).ravel()
    return np.stack([first, first + 1, first + AROUND + 2, first + AROUND + 1], axis=1)


def cube_corners(pose: Float[np.ndarray, "time 7"], side: float) -> Float[np.ndarray, "time 8 3"]:
    """Corners of a cube from its centre [m] and unit quaternion (x, y, z, w)."""
    turned = Rotation.from_quat(pose[:, 3:]).as_matrix()
    return pose[:, None, :3] + side * np.einsum("tij,cj->tci", turned, CUBE_CORNERS)


def silhouette(
    centre: Float[np.ndarray, "point 2"], radius: Float[np.ndarray, " point"]
) -> Float[np.ndarray, "outline 2"]:
    """Outline of a tube seen from the side: both edges, one after the other."""
    tangent = np.gradient(centre, axis=0)
    length = np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1) / length * radius[:, None]
    return np.concatenate([centre + normal, (centre - normal)[::-1]])


def save_vtk(motion: DrawnMotion, folder: Path) -> list[Path]:
    """Write trunk and cube at every instant as VTK files, and a .pvd that lists them with their times."""
    output_folder(folder)
    written, entries = [], []
    for row, time in enumerate(motion.time):
        for part, (name, points, faces) in enumerate(_surfaces(motion, row)):
            path = folder / f"{name}_{row:04d}.vtu"
            meshio.write_points_cells(path, points, [("quad", faces)])
            entries.append(f'<DataSet timestep="{time - motion.time[0]:.9g}" part="{part}" file="{path.name}"/>')
            written.append(path)
    index = folder / "motion.pvd"
    body = "\n".join(entries)
    index.write_text(
        f'<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n<Collection>\n{body}\n</Collection>\n'
        "</VTKFile>\n",
        encoding="utf-8",
    )
    return [index, *written]


def _surfaces(motion: DrawnMotion, row: int) -> list[tuple[str, Float[np.ndarray, "points 3"], np.ndarray]]:
    surfaces = [("trunk", tube(motion.centre[row], motion.radius).reshape(-1, 3), tube_faces(len(motion.radius)))]
    if motion.cube is not None:
        surfaces.append(("cube", motion.cube[row], CUBE_FACES))
    return surfaces


def save_frames(motion: DrawnMotion, folder: Path, frames_per_second: int) -> list[Path]:
    """Render frames in real time off-screen, one PNG each.

    Raises:
        InputError: PyVista is not installed.
    """
    try:
        pyvista: Any = importlib.import_module("pyvista")
    except ImportError:
        raise InputError("frames need PyVista", remedy="pip install 'rfdropo_bayes[view]'") from None
    output_folder(folder)
    count = max(2, round(float(motion.time[-1] - motion.time[0]) * frames_per_second))
    rows = np.searchsorted(motion.time, np.linspace(motion.time[0], motion.time[-1], count))
    written = []
    for number, row in enumerate(rows):
        plotter = pyvista.Plotter(off_screen=True, window_size=list(FRAME))
        plotter.set_background("white")
        _populate(plotter, pyvista, motion, int(row))
        path = folder / f"frame_{number:04d}.png"
        plotter.screenshot(str(path))
        plotter.close()
        written.append(path)
    return written


def _populate(plotter: Any, pyvista: Any, motion: DrawnMotion, row: int) -> None:
    """Put the surfaces of one instant before a fixed camera."""
    for name, points, faces in _surfaces(motion, row):
        mesh = pyvista.PolyData(points, np.insert(faces, 0, 4, axis=1).ravel())
        plotter.add_mesh(mesh, color=ACCENT if name == "cube" else POSTERIOR, smooth_shading=name == "trunk")
    low, high = motion.bounds()
    middle, reach = (low + high) / 2.0, float(np.linalg.norm(high - low))
    if motion.plate is not None:
        ground = pyvista.Plane(
            center=(middle[0], middle[1], motion.plate), direction=(0, 0, 1), i_size=2 * reach, j_size=2 * reach
        )
        plotter.add_mesh(ground, color="#E8E8E8")
    plotter.camera_position = [middle + reach * np.array([0.9, -1.6, 0.8]), middle, (0, 0, 1)]
