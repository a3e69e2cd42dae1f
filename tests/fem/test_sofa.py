"""SOFA's own recordings of the trunk: mesh, cables and commands of the paper's scene."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes.data.sofa_csv import read_sofa_csv
from rfdropo_bayes.fem.cable_drive import DriveLimits, animated_commands
from rfdropo_bayes.fem.native.tetrahedral_engine import TetrahedralEngine
from rfdropo_bayes.fem.tetrahedra import locate, mean_points, route_cables, tetrahedral_body
from rfdropo_bayes.robots.meshes import read_tetrahedra
from rfdropo_bayes.runtime import configure_jax

configure_jax()

TIME_STEP, STEPS = 0.01, 5
PARAMETERS = {
    "young_modulus": 4.5e6,
    "poisson_ratio": 0.45,
    "rayleigh_mass": 0.1,
    "rayleigh_stiffness": 0.1,
    "gravity": [0.0, -9.81, 0.0],
}
ROUNDING = 0.00025
"""[mm] SOFA's recordings are means of four cables, each sum rounded to 0.001 mm: errors below this mean equality."""


def scene_guides(pairs: int) -> list[np.ndarray]:
    """Guide points [m] of the four cables of the scene, by azimuth; their cone's direction is a unit vector."""
    direction = np.array([0.0, -8.0, 195.0]) / np.hypot(8.0, 195.0)
    along = 17.5 * np.repeat(np.arange(pairs), 2)
    radius, height = 10.0 + direction[1] * along, np.tile([21.0, 27.0], pairs) + direction[2] * along
    angles = 1.57 * np.arange(4)  # not pi / 2: as in the scene
    return [1e-3 * np.column_stack([-np.sin(angle) * radius, np.cos(angle) * radius, height]) for angle in angles]


class Scene:
    """The trunk of the SOFA scene, ready for the compiled engine."""

    def __init__(self, folder) -> None:
        mesh = read_tetrahedra(folder / "trunk.vtk", "mm")
        self.body = tetrahedral_body(mesh.position, mesh.element, mesh.position[:, 2] <= 0.02, "edges")
        pull = 1e-2 * np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
        long = scene_guides(10)
        short = [guides[:9] for guides in scene_guides(5)]  # the scene lists ten of eleven points of a short cable
        self.cables = route_cables(self.body, np.vstack([pull, pull]), long + short)
        self.limits = DriveLimits(np.repeat([0.07, 0.04], 4), rate=1e-3)
        self.points = mean_points([locate(self.body, guides) for guides in long])
        self.mass = np.full(self.body.nodes, 0.42 / self.body.nodes)

    def fast(self, command: np.ndarray, dtype: type = np.float64) -> np.ndarray:
        values = {name: np.asarray([value], float) for name, value in PARAMETERS.items()} | {
            "node_mass": self.mass[None]
        }
        engine = TetrahedralEngine(self.body, self.cables, self.limits, self.points, dtype=dtype, threads=1)
        result = engine.rollouts(values, command.reshape(-1, 8), time_step=TIME_STEP, stride=STEPS)
        assert not result.diverged.any()
        assert result.converged.all()
        return result.position[0, 1:]


@pytest.fixture(scope="module")
def scene(datasets) -> Scene:
    return Scene(datasets / "sofa_trunk")


def recording(datasets, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Commands of every step [m], and the moving centre-line points after every action [m]."""
    trajectory = read_sofa_csv(datasets / "sofa_trunk" / f"{name}.csv")
    return animated_commands(trajectory.command, STEPS, TIME_STEP), trajectory.position[1:, 1:]


def error_mm(position: np.ndarray, recorded: np.ndarray) -> np.ndarray:
    return 1e3 * np.linalg.norm(np.asarray(position) - recorded, axis=2)


@pytest.mark.parametrize(
    ("name", "rows"), [pytest.param("reach_1", 100, marks=pytest.mark.slow), ("push_2", 100), ("push_1", 10)]
)
def test_follows_sofa_to_its_last_digit_before_contact(scene, datasets, name, rows):
    """The trunk of push_2 never meets the cube; that of push_1 does in the eleventh action."""
    command, recorded = recording(datasets, name)
    error = error_mm(scene.fast(command[:rows]), recorded[:rows])
    assert error.shape == (rows, 20)
    assert error.max() < ROUNDING
    assert error.mean() < ROUNDING / 2


@pytest.mark.slow
def test_single_precision_stays_close(scene, datasets):
    command, recorded = recording(datasets, "reach_1")
    error = error_mm(scene.fast(command, np.float32), recorded)
    assert error.mean() < 0.001
    assert error.max() < 0.01


def test_commands_include_the_sixth_update_of_rounded_clocks():
    """1 mm an update: a row of 5 steps gives 5 updates, and a sixth where the clock's sum rounds below the duration."""
    command = 5e-3 * np.cumsum(np.ones((100, 1)), axis=0)
    steps = animated_commands(command, STEPS, TIME_STEP)
    updates = np.diff(steps.ravel(), prepend=0.0) / 1e-3
    np.testing.assert_allclose(updates, np.round(updates), atol=1e-9)
    assert set(np.round(updates).astype(int)) == {1, 2}
    extra = round(float(updates.sum())) - 500
    assert 0 < extra < 100
    assert np.all(np.round(updates.reshape(100, 5)[:, 1:]) == 1)
