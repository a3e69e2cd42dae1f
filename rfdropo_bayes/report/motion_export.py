"""A motion as surfaces: VTK files for ParaView, and frames rendered off-screen with PyVista."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from jaxtyping import Float

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.report.motion import CUBE_FACES, Motion, tube, tube_faces
from rfdropo_bayes.report.style import ACCENT, POSTERIOR

FRAME = (960, 640)  # [pixel]


def save_vtk(motion: Motion, folder: Path) -> list[Path]:
    """Write trunk and cube at every instant as VTK files, and a .pvd that lists them with their times."""
    folder.mkdir(parents=True, exist_ok=True)
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


def _surfaces(motion: Motion, row: int) -> list[tuple[str, Float[np.ndarray, "points 3"], np.ndarray]]:
    found = [("trunk", tube(motion.centre[row], motion.radius).reshape(-1, 3), tube_faces(len(motion.radius)))]
    if motion.cube is not None:
        found.append(("cube", motion.cube[row], CUBE_FACES))
    return found


def save_frames(motion: Motion, folder: Path, frames_per_second: int) -> list[Path]:
    """Render frames in real time off-screen, one PNG each.

    Raises:
        InputError: PyVista is not installed.
    """
    try:
        pyvista: Any = importlib.import_module("pyvista")
    except ImportError:
        raise InputError("frames need PyVista", remedy="pip install 'rfdropo_bayes[view]'") from None
    folder.mkdir(parents=True, exist_ok=True)
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


def _populate(plotter: Any, pyvista: Any, motion: Motion, row: int) -> None:
    """Put the surfaces of one instant before a camera that stays where it is."""
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
