"""Robot files: what they describe holds together, and what does not is refused with a line that helps."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Robot, known_robots
from rfdropo_bayes.robots.parameter import Parameter

TRUNKS = ("trunk_sofa", "trunk_physical")
ROBOTS = (*TRUNKS, "asl_trunk")


def edited(tmp_path: Path, old: str, new: str, robot: str = "trunk_sofa") -> Path:
    """A copy of a robot file with its first ``old`` replaced."""
    text = known_robots()[robot].read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "edited.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    return path


def test_the_three_robots_come_with_the_package():
    assert set(ROBOTS) <= set(known_robots())
    assert all(Robot.load(name).name == name for name in known_robots())


def test_a_path_serves_as_well_as_a_name():
    assert Robot.load(known_robots()["asl_trunk"]) == Robot.load("asl_trunk")


def test_unknown_robot_lists_the_known_ones():
    with pytest.raises(InputError, match=r"unknown robot 'trunk_soft'.*asl_trunk, .*trunk_physical, trunk_sofa"):
        Robot.load("trunk_soft")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("dead_time_s = 0.0", "dead_time_s = 0\nramp_ms = 1", r"unknown key 'command.ramp_ms'; did you mean 'ramp_s'"),
        ("time_step_s = 0.01", "", "'time_step_s' is missing"),
        ("time_step_s = 0.01", "time_step_s = 0.0", "time_step_s"),
        ("time_step_s = 0.01", "time_step_s = nan", "time_step_s"),
        ("time_step_s = 0.01", "time_step_s = ", "not valid TOML"),
        ("station_m = [\n    0, 0.021,", "station_m = [\n    0, -0.021,", "does not increase"),
        ("volume_m3 = 3.89e-05", "volume_m3 = 3.5e-05", "less than the sum of its layers"),
        ("azimuth_deg = 90\n", "azimuth_deg = 90\nazimuth = 90\n", r"azimuth'; did you mean 'azimuth_deg'"),
        ("anchor_radius_m = 0.01", "anchor_radius_m = -0.01", "anchor_radius_m"),
        ("anchor_radius_m = 0.01", "anchor_radius_m = 10", r"long_0 is 10 m, and the body is 0.195 m long.*in metres"),
        ("anchor_z_m = 0", "anchor_z_m = -9", "anchor_z_m of the cable long_0 from the body is 9 m"),
        ("-9.81", "-9810", r"gravity_m_s2 is 9810 m/s2: is it in metres"),
        ("time_step_s = 0.01", "time_step_s = 10", "time_step_s is 10 s"),
        ("nominal = 0.42", "nominal = 9", r"trunk_mass is 9 kg.*in kilograms"),
        ("guide_radius_m = [\n    0.01,", "guide_radius_m = [\n    0.02,", "guide of long_0 lies outside the body"),
        ("displacement_limit_m = [-0.5, 0.07]", "displacement_limit_m = [0.01, 0.07]", "does not enclose zero"),
        ('name = "long_1"', 'name = "long_0"', "cables share a name"),
        ('unit = "m"', 'unit = "rad"', "radius_parameter"),
        ("point_m = [0, 0, 0.184368]", "point_m = [0, 0, 0.3]", "marker p20 lies outside the body"),
        ("[parameters.young_modulus]", "[parameters.youngs_modulus]", "youngs_modulus].*did you mean 'young_modulus'"),
        ("[parameters.young_modulus]", "[parameters.tip_mass]", r"nothing uses the table \[parameters.tip_mass\]"),
        ('each = "cable"', "", r"mend \[parameters.initial_displacement\]"),
        ("nominal = 0.45", "nominal = 0.05", "outside its bounds"),
        ("high = 0.499", "high = 0.5", "0.499"),
        ("nominal = 0.42\nlow = 0.0001", "nominal = 0.42\nlow = 0.0", "massless"),
        ('"LogNormal", median = 4e+06', '"LogNormal", median = 4e+02', "prior lies outside the bounds"),
        ('"LogNormal", median = 4e+06', '"LogNormal", mean = 4e+06', "takes median, sigma"),
        ('distribution = "LogNormal"', 'distribution = "Lognormal"', "'Lognormal'; did you mean 'LogNormal'"),
    ],
)
def test_a_mistake_is_named(tmp_path, old, new, message):
    with pytest.raises(InputError, match=message) as caught:
        Robot.load(edited(tmp_path, old, new))
    assert "edited.toml" in str(caught.value)
    assert ": :" not in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_point_mass_sits_at_a_station(tmp_path):
    with pytest.raises(InputError, match="not at a station"):
        Robot.load(edited(tmp_path, "z_m = 0.201", "z_m = 0.2", robot="asl_trunk"))


def test_an_unreadable_file_is_refused(tmp_path):
    path = tmp_path / "binary.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="cannot be read"):
        Robot.load(path)


@pytest.mark.parametrize("name", TRUNKS)
def test_trunk_has_the_volume_of_the_mesh(name):
    body = Robot.load(name).body
    assert body.layer_volume() == pytest.approx(38.9e-6, rel=0.01)
    assert Robot.load(name).density(0.42) == pytest.approx(0.42 / 38.9e-6, rel=1e-3)


@pytest.mark.parametrize("name", ROBOTS)
def test_arrays_fit_the_finite_element_body(name):
    arrays = Robot.load(name).rod_arrays()
    layers = len(arrays["station"]) - 1
    assert np.all(np.diff(arrays["station"]) > 0)
    assert arrays["station"][0] == 0.0
    assert arrays["half_width"].shape == (layers + 1, 2)
    for field in ("axial_area", "torsion_constant", "mass_area"):
        assert arrays[field].shape == (layers,)
    for field in ("bending_moment_area", "mass_moment_area"):
        assert arrays[field].shape == (layers, 2)
    assert all(np.all(value > 0) for field, value in arrays.items() if field != "station")


@pytest.mark.parametrize("name", TRUNKS)
def test_necks_are_softer_than_their_vertebrae(name):
    bending = np.array(Robot.load(name).body.bending_moment_area_m4).mean(1)
    necks, vertebrae = bending[1:-1:2], bending[2::2]
    assert len(necks) == len(vertebrae) == 10
    assert np.all(necks < vertebrae / 3)


def test_sofas_mesh_is_far_stiffer_than_the_converged_solid():
    """Linear tetrahedra lock in the necks: that is a finding about the scene, not about silicone."""
    sofa, solid = (np.array(Robot.load(name).body.bending_moment_area_m4)[1:-1:2].mean() for name in TRUNKS)
    assert sofa > 4 * solid


@pytest.mark.parametrize("name", TRUNKS)
def test_guides_lie_on_stations_and_turn_by_quarters(name):
    robot = Robot.load(name)
    tolerance = {"trunk_sofa": np.deg2rad(0.14), "trunk_physical": 1e-12}[name]  # the scene turns by 1.57 rad
    for index, guides in enumerate(robot.guides()):
        distance = np.abs(guides[:, 2, None] - np.array(robot.body.station_m)).min(1)
        assert np.max(distance) < 1e-6
        angle = np.arctan2(guides[:, 1], guides[:, 0])
        wanted = np.deg2rad(90.0 * (1 + index % 4))
        np.testing.assert_allclose(np.abs(np.exp(1j * angle) - np.exp(1j * wanted)), 0.0, atol=1.01 * tolerance)
        radius = np.hypot(guides[:, 0], guides[:, 1])
        assert radius[0] == pytest.approx(0.01)
        assert np.all(np.diff(radius[::2]) < 0)
    assert robot.anchors()[:, 2] == pytest.approx(0.0)


def test_trunk_sofa_is_the_scene_of_the_paper():
    robot = Robot.load("trunk_sofa")
    nominal = robot.nominal()
    assert nominal["young_modulus"] == 4.5e6
    assert nominal["poisson_ratio"] == 0.45
    assert nominal["trunk_mass"] == 0.42
    assert nominal["rayleigh_mass"] == nominal["rayleigh_stiffness"] == 0.1
    assert robot.initial_state == "rest"
    assert robot.gravity.tolist() == [0.0, -9.81, 0.0]
    assert robot.drive_limits()[:, 1].tolist() == [0.07] * 4 + [0.04] * 4
    assert [len(guides) for guides in robot.guides()] == [20] * 4 + [9] * 4
    assert robot.push.parameters["cube_side"].nominal == 0.035
    assert robot.push.parameters["cube_mass"].nominal == 0.05


def test_trunk_sofas_markers_are_where_the_recording_starts(datasets):
    path = datasets / "sofa_trunk" / "reach_1.csv"
    row = np.loadtxt(path, delimiter=",", skiprows=1, max_rows=1, usecols=range(1, 64))
    recorded = 1e-3 * row.reshape(21, 3)
    assert np.abs(Robot.load("trunk_sofa").marker_points() - recorded).max() < 1e-5


def test_each_parameter_given_per_cable_is_written_out():
    robot = Robot.load("trunk_physical")
    table = robot.parameter_table()
    assert set(robot.initial_displacement_names) <= set(table)
    assert "initial_displacement" not in table
    assert table["initial_displacement_short_7"].unit == "m"
    assert list(robot.nominal()) == list(table)


@pytest.mark.parametrize("name", ROBOTS)
def test_bounds_enclose_nominal_values(name):
    table = Robot.load(name).parameter_table()
    assert all(p.low <= p.nominal <= p.high for p in table.values())
    assert table["poisson_ratio"].high <= 0.499


def test_asl_motors_pull_one_tendon_and_release_the_opposite():
    robot = Robot.load("asl_trunk")
    matrix = robot.channel_matrix({"pulley_radius": 0.02})
    assert matrix.shape == (12, 6)
    np.testing.assert_allclose(matrix.sum(axis=0), 0.0)
    guides = robot.guides()
    for motor in range(6):
        pulled, released = np.flatnonzero(matrix[:, motor] > 0), np.flatnonzero(matrix[:, motor] < 0)
        assert len(pulled) == len(released) == 1
        here, there = guides[pulled[0]][-1], guides[released[0]][-1]
        np.testing.assert_allclose(here[:2], -there[:2], atol=1e-12)
        assert here[2] == there[2]
    ends = [cable.guide_z_m[-1] for cable in robot.cables[::2]]
    assert ends == [0.201, 0.316, 0.106, 0.316, 0.106, 0.201]
    assert robot.gravity @ np.array([0, 0, 1]) == 9.81


def test_asl_tendons_lie_where_the_motors_move_the_disks(datasets):
    """Small motor angles move a motor's own disk towards the tendon it pulls (25 degrees covers the other motors)."""
    pandas = pytest.importorskip("pandas")
    folder = datasets / "asl_trunk"
    observed = pandas.read_csv(folder / "observations_controlled_1.csv.gz")
    angles = observed[[f"phi{k}" for k in range(1, 7)]].to_numpy()
    robot = Robot.load("asl_trunk")
    disk = {0.106: 1, 0.201: 2, 0.316: 3}
    for motor in range(6):
        guide = robot.guides()[2 * motor][-1]
        place = observed[[f"{axis}{disk[round(guide[2], 3)]}" for axis in "xz"]].to_numpy()
        known = np.isfinite(angles).all(1) & np.isfinite(place).all(1)
        slopes = np.linalg.lstsq(np.c_[angles, np.ones(len(angles))][known], place[known], rcond=None)[0][motor]
        cosine = slopes @ guide[:2] / np.linalg.norm(slopes) / np.linalg.norm(guide[:2])
        assert cosine > np.cos(np.deg2rad(25.0))


def test_point_masses_are_lumped_at_their_stations_and_traceable():
    robot = Robot.load("asl_trunk")
    masses = robot.point_masses({"disk_mass_tip": 0.1})
    assert masses.sum() == pytest.approx(0.03 + 0.03 + 0.1)
    assert masses[-1] == 0.1
    slope = jax.grad(lambda mass: robot.point_masses({"disk_mass_tip": mass})[-1])(0.1)
    assert slope == 1.0
    assert np.all(Robot.load("trunk_sofa").point_masses({}) == 0.0)


@pytest.mark.parametrize("name", TRUNKS)
def test_stiffness_grows_with_poissons_ratio(name):
    robot = Robot.load(name)
    np.testing.assert_allclose(robot.stiffness_scale(0.45), 1.0)
    necks = np.array([robot.stiffness_scale(ratio)[1:-1:2] for ratio in (0.4, 0.43, 0.45, 0.47, 0.49)])
    assert np.all(np.diff(necks, axis=0) > 0)
    assert np.all(np.isfinite(jax.jacobian(robot.stiffness_scale)(0.48)))


def test_a_variant_replaces_tables_of_its_base(tmp_path):
    variant, base = Robot.load("trunk_sofa_mesh"), Robot.load("trunk_sofa")
    assert variant.body == base.body
    assert variant.markers == base.markers
    assert variant.cables != base.cables
    np.testing.assert_allclose(variant.guides()[2], base.guides()[2], atol=1e-6)
    np.testing.assert_allclose(variant.anchors()[1], [-0.01, 0.0, 0.0], atol=1e-15)
    path = tmp_path / "circle.toml"
    path.write_text(f'base = "{path}"\n')
    with pytest.raises(InputError, match="is its own base"):
        Robot.load(path)


def test_a_default_prior_may_end_before_the_bounds_do() -> None:
    known = {"unit": "m", "nominal": 0.0, "low": -1.0, "high": 1.0, "description": "a length"}
    table = {"distribution": "TruncatedNormal", "loc": 0.0, "scale": 0.1, "low": 0.0}
    assert Parameter(**known, prior=table).prior == table
    with pytest.raises(ValueError, match="ends before it begins"):
        Parameter(**known, prior=table | {"high": -0.5})
