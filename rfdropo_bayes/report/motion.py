"""A rollout as geometry: the trunk as a tube around its markers, the cube and the plate, in a frame with z upwards."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

AROUND, ALONG = 16, 60  # points around and along a tube
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
