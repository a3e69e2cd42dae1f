"""``rfdropo view``: geometry in closed form, files of every kind, and refusals."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from PIL import Image
from scipy.spatial.transform import Rotation

from rfdropo_bayes.data import Measured, Origin, SentCommands, Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.report.motion import AROUND, cube_corners, silhouette, smooth_line, tube, tube_faces, upright
from rfdropo_bayes.robots import Robot, known_robots
from rfdropo_bayes.verbs.view import run_view

ROWS = 6


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    """A trunk that bends sideways while a cube slides along and turns."""
    robot = Robot.load("trunk_sofa_mesh")
    rest, share = robot.marker_points(), np.linspace(0.0, 1.0, ROWS)
    position = np.tile(rest, (ROWS, 1, 1))
    position[:, :, 0] += 4.0 * share[:, None] * rest[:, 2] ** 2
    centre = np.array([0.02, -0.0828, 0.1]) + share[:, None] * [0.05, 0.0, -0.02]
    turn = Rotation.from_rotvec(share[:, None] * [0.0, 0.6, 0.0]).as_quat()
    trajectory = Trajectory.build(
        Origin(name="bend", robot=robot.name, format="netcdf", synthetic=True),
        SentCommands(
            command_time=np.zeros(1), command=np.zeros((1, 8)), command_unit="m", cable_names=list(robot.channel_names)
        ),
        Measured(
            time=0.05 * np.arange(ROWS),
            position=position,
            marker_names=list(robot.marker_names),
            object_pose=np.concatenate([centre, turn], axis=1),
        ),
    )
    path = tmp_path_factory.mktemp("view") / "bend.nc"
    trajectory.save(path)
    return path


def test_a_tube_keeps_its_radius_around_a_curve():
    angle = np.linspace(0.0, 2.0, 40)
    centre = np.stack([np.cos(angle), np.sin(angle), 0.3 * angle], axis=1)
    radius = np.linspace(0.1, 0.05, 40)
    rings = tube(centre, radius)
    np.testing.assert_allclose(np.linalg.norm(rings - centre[:, None], axis=2), np.tile(radius[:, None], AROUND + 1))
    tangent = np.gradient(centre, axis=0)
    assert np.abs(np.einsum("pai,pi->pa", rings - centre[:, None], tangent)).max() < 1e-12
    assert tube_faces(40).max() == 40 * (AROUND + 1) - 1


def test_a_straight_tube_seen_from_the_side_is_a_strip():
    centre = np.stack([np.linspace(0.0, 1.0, 5), np.zeros(5)], axis=1)
    outline = silhouette(centre, np.full(5, 0.2))
    np.testing.assert_allclose(outline[:5, 1], 0.2)
    np.testing.assert_allclose(outline[5:, 1], -0.2)


def test_lines_pass_through_the_markers():
    rest = np.array([0.0, 0.1, 0.15, 0.3])
    position = np.random.default_rng(0).normal(size=(3, 4, 3))
    line, at = smooth_line(position, rest, points=7)
    np.testing.assert_allclose(line[:, [0, 2, 3, 6]], position, atol=1e-12)
    np.testing.assert_allclose(at[[2, 3]], [0.1, 0.15])


@pytest.mark.parametrize("gravity", [[0.0, -9.81, 0.0], [0.0, 0.0, 9.81], [1.0, -2.0, 0.5]])
def test_upright_frames_put_gravity_down_and_are_rotations(gravity):
    turn = upright(np.array(gravity))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    np.testing.assert_allclose(turn @ gravity, [0.0, 0.0, -np.linalg.norm(gravity)], atol=1e-12)


def test_corners_of_a_turned_cube():
    pose = np.array([[1.0, 2.0, 3.0, 0.0, 0.0, np.sin(np.pi / 8), np.cos(np.pi / 8)]])  # 45 degrees about z
    corners = cube_corners(pose, 2.0)[0] - [1.0, 2.0, 3.0]
    assert np.abs(corners[:, 0]).max() == pytest.approx(np.sqrt(2.0))
    np.testing.assert_allclose(np.linalg.norm(corners, axis=1), np.sqrt(3.0))


def test_a_still_shows_trunk_and_cube(recording, tmp_path):
    path = tmp_path / "new" / "still.png"
    run_view(recording, path, [], None)
    pixels = np.asarray(Image.open(path).convert("RGB")).reshape(-1, 3).astype(int)
    blue = (pixels[:, 2] - pixels[:, 0] > 80).mean()
    orange = (pixels[:, 0] - pixels[:, 2] > 120).mean()
    assert blue > 0.005
    assert orange > 0.005


@pytest.mark.slow
def test_an_animation_has_a_frame_for_every_instant(recording, tmp_path):
    path = tmp_path / "motion.gif"
    run_view(recording, path, [], None)
    with Image.open(path) as picture:
        assert picture.n_frames == 5  # 0.25 s at 20 frames a second
        first = np.asarray(picture.convert("RGB"))
        picture.seek(2)
        assert np.any(np.asarray(picture.convert("RGB")) != first)


def test_what_cannot_be_drawn_is_refused(recording, tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"unknown format '\.bmp'"):
        run_view(recording, tmp_path / "still.bmp", [], None)
    with pytest.raises(InputError, match="no such file"):
        run_view(tmp_path / "absent.nc", tmp_path / "still.png", [], None)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(InputError, match="MP4 needs ffmpeg"):
        run_view(recording, tmp_path / "motion.mp4", [], None)


def own_robot(folder: Path) -> Path:
    """The bundled arm as one's own: another name, and two markers beside the axis at the tip."""
    text = known_robots()["smooth_arm"].read_text(encoding="utf-8").replace("smooth_arm", "my_arm")
    text = text.replace("point_m = [0.0, 0.0, 0.15]", "point_m = [0.005, 0.0, 0.2]")
    text = text.replace("point_m = [0.0, 0.0, 0.2]", "point_m = [-0.005, 0.0, 0.2]")
    path = folder / "my_arm.toml"
    path.write_text(text, encoding="utf-8")
    return path


def prediction(folder: Path) -> Path:
    """What predict writes of the bundled arm, as far as it is drawn."""
    position = np.tile(Robot.load("smooth_arm").marker_points(), (ROWS, 1, 1))
    position[:, 2:, 0] += [0.005, -0.005]
    data = dict.fromkeys(("mean", "q05", "q95"), (("time", "marker", "axis"), position))
    coords = {"time": 0.05 * np.arange(ROWS), "marker": ["m1", "m2", "m3", "m4"], "axis": list("xyz")}
    path = folder / "prediction.nc"
    xr.Dataset(data, coords, {"robot": "my_arm", "recording": "next"}).to_netcdf(path, engine="h5netcdf")
    return path


def test_own_robots_are_found_beside_the_file_or_given(tmp_path):
    robot, file = own_robot(tmp_path), prediction(tmp_path)
    with pytest.raises(InputError, match=r"'my_arm', does not come with the package.*--robot"):
        run_view(file, tmp_path / "still.png", [], None)
    given = tmp_path / "given.png"
    run_view(file, given, [], None, robot)
    shutil.copy(robot, tmp_path / "robot.toml")
    beside = tmp_path / "beside.png"
    run_view(file, beside, [], None)
    pixels = [np.asarray(Image.open(path).convert("RGB")) for path in (given, beside)]
    assert np.array_equal(*pixels)
    assert pixels[0].std() > 10.0


def test_a_robot_with_other_markers_is_refused(tmp_path):
    file = prediction(tmp_path)
    with pytest.raises(InputError, match=r"no marker of the recording \(m1, m2, m3, m4\) is a marker of the robot"):
        run_view(file, tmp_path / "still.png", [], None, known_robots()["asl_trunk"])
