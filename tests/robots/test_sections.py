"""Section profiles of shapes against closed forms, and what they make of a beam."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes import fem
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.native.rod_engine import NativeRod
from rfdropo_bayes.fem.section_loads import SectionLoads
from rfdropo_bayes.robots import Cone, Cylinder, Disks, Robot, Tube, known_robots, section_profile

L, R, TIP = 0.2, 0.014, 0.009


def test_a_cylinder():
    body = section_profile([Cylinder(length_m=L, layers=4, radius_m=R)])
    np.testing.assert_allclose(body.station_m, np.linspace(0.0, L, 5))
    np.testing.assert_allclose(body.half_width_m, R)
    for key in ("axial_area_m2", "mass_area_m2"):
        np.testing.assert_allclose(getattr(body, key), np.pi * R**2)
    for key in ("bending_moment_area_m4", "mass_moment_area_m4"):
        np.testing.assert_allclose(getattr(body, key), np.pi * R**4 / 4)
    np.testing.assert_allclose(body.torsion_constant_m4, np.pi * R**4 / 2)
    assert body.volume_m3 == pytest.approx(np.pi * R**2 * L)


@pytest.mark.parametrize("layers", [1, 3])
def test_a_cone(layers):
    """Compliance of a cone in tension and under end moments, its volume, and its second moment of mass."""
    body = section_profile([Cone(length_m=L, layers=layers, radius_m=(R, TIP))])
    thickness = np.diff(body.station_m)
    assert np.sum(thickness / body.axial_area_m2) == pytest.approx(L / (np.pi * R * TIP))
    bending = 4 * L * (R**2 + R * TIP + TIP**2) / (3 * np.pi * R**3 * TIP**3)
    moment = np.array(body.bending_moment_area_m4)
    np.testing.assert_allclose(np.sum(thickness[:, None] / moment, axis=0), bending)
    assert np.sum(thickness / body.torsion_constant_m4) == pytest.approx(bending / 2)
    assert body.volume_m3 == pytest.approx(np.pi * L * (R**2 + R * TIP + TIP**2) / 3)
    fourth = np.pi * L * (R**5 - TIP**5) / (20 * (R - TIP))
    np.testing.assert_allclose(np.sum(thickness[:, None] * body.mass_moment_area_m4, axis=0), fourth)
    np.testing.assert_allclose(np.array(body.half_width_m)[:, 0], np.linspace(R, TIP, layers + 1))


def test_a_tube_that_tapers_inside_and_out():
    """With the same taper inside and out all areas are those of the cone times one factor."""
    hollow = 0.6
    cone = section_profile([Cone(length_m=L, layers=3, radius_m=(R, TIP))])
    tube = section_profile([Tube(length_m=L, layers=3, radius_m=(R, TIP), inner_radius_m=(hollow * R, hollow * TIP))])
    for key, power in (("axial_area_m2", 2), ("mass_area_m2", 2), ("torsion_constant_m4", 4)):
        np.testing.assert_allclose(getattr(tube, key), (1 - hollow**power) * np.array(getattr(cone, key)))
    straight = section_profile([Tube(length_m=L, layers=2, radius_m=R, inner_radius_m=TIP)])
    np.testing.assert_allclose(straight.bending_moment_area_m4, np.pi * (R**4 - TIP**4) / 4)
    np.testing.assert_allclose(straight.torsion_constant_m4, np.pi * (R**4 - TIP**4) / 2)


def test_disks_on_a_backbone():
    disks = Disks(
        length_m=L, disks=5, radius_m=R, thickness_m=0.01, backbone_radius_m=0.003, modulus_ratio=7, density_ratio=2
    )
    body = section_profile([disks])
    np.testing.assert_allclose(np.diff(body.station_m), [0.03, 0.01] * 5)
    np.testing.assert_allclose(body.half_width_m, R)
    thin, wide = np.pi * 0.003**2, np.pi * R**2
    np.testing.assert_allclose(body.axial_area_m2, [thin, 7 * wide] * 5)
    np.testing.assert_allclose(body.mass_area_m2, [thin, 2 * wide] * 5)
    np.testing.assert_allclose(body.torsion_constant_m4, [np.pi * 0.003**4 / 2, 7 * np.pi * R**4 / 2] * 5)
    assert body.volume_m3 == pytest.approx(5 * (0.03 * thin + 0.02 * wide))
    np.testing.assert_allclose(body.stiffness_scale(0.3), 1.0)


def test_sections_follow_each_other():
    body = section_profile(
        [
            Cylinder(length_m=0.1, layers=2, radius_m=0.01),
            Tube(length_m=0.05, layers=1, radius_m=0.02, inner_radius_m=0.015),
        ]
    )
    np.testing.assert_allclose(body.station_m, [0.0, 0.05, 0.1, 0.15])
    np.testing.assert_allclose(np.array(body.half_width_m)[:, 0], [0.01, 0.01, 0.02, 0.02])


def test_a_force_at_the_tip_bends_disks_as_a_stepped_beam():
    """Euler and Bernoulli's deflection, integral of F (L - z)^2 / E I; short steps of a slender beam, 2 %."""
    young, force, length = 1e6, 1e-4, 0.2
    body = section_profile([Disks(length_m=length, disks=5, radius_m=0.01, thickness_m=0.01, backbone_radius_m=0.003)])
    rod = fem.profile_rod(**body.arrays())
    system, end = fem.System(rod, fem.without_cables()), fem.attach(rod, np.array([[0.0, 0.0, length]]))
    material = fem.material(system, young_modulus=young, poisson_ratio=0.45, density=1.0, gravity=(0.0, 0.0, 0.0))
    none, rows = np.zeros((1, 2)), np.tile([force, 0.0, 0.0], (1, 2, 1, 1))
    loads = SectionLoads(rows, none, none, np.zeros((1, 2, 3)), (len(body.station_m) - 1,))
    rest = NativeRod(system, end, 0.01, threads=1, integrator="quasi-static")
    found = rest.rollout(material, np.zeros((1, 1, 0)), loads=loads)
    assert found.converged.all()
    tip = found.position[0, -1, 0, 0]
    z = np.array(body.station_m)
    steps = (length - z[:-1]) ** 3 - (length - z[1:]) ** 3
    expected = np.sum(force * steps / (3 * young * np.array(body.bending_moment_area_m4)[:, 0]))
    assert tip == pytest.approx(expected, rel=0.02)


def _robot(tmp_path, section: str):
    """The bundled arm with its profile replaced by sections."""
    text = known_robots()["smooth_arm"].read_text(encoding="utf-8")
    head, _, rest = text.partition("[body]")
    path = tmp_path / "own.toml"
    path.write_text(head + section + rest[rest.index("[[markers]]") :], encoding="utf-8")
    return Robot.load(path)


CONE = '[[body.section]]\nshape = "cone"\nlength_m = 0.2\nlayers = 10\nradius_m = [0.014, 0.009]\n\n'


def test_a_robot_file_may_state_shapes(tmp_path):
    """The bundled arm's areas are those in the middle of each layer: a cone's to second order in its taper."""
    own, bundled = _robot(tmp_path, CONE), Robot.load("smooth_arm")
    np.testing.assert_allclose(own.body.axial_area_m2, bundled.body.axial_area_m2, rtol=2e-3)
    np.testing.assert_allclose(own.body.torsion_constant_m4, bundled.body.torsion_constant_m4, rtol=5e-3)


@pytest.mark.parametrize(
    ("section", "message"),
    [
        (CONE.replace('"cone"', '"coned"'), "coned"),
        (CONE.replace("radius_m", "radius"), r"unknown key 'section.0.radius'; did you mean 'radius_m'"),
        (CONE.replace("layers = 10\n", ""), r"'section.0.layers' is missing"),
        (CONE.replace("body.section", "body.sections"), r"'sections'; did you mean 'section'"),
        (CONE + "[body]\nvolume_m3 = 1.0\n\n", r"unknown key 'volume_m3'"),
        (
            '[[body.section]]\nshape = "tube"\nlength_m = 0.2\nlayers = 3\nradius_m = 0.01\ninner_radius_m = 0.01\n\n',
            "inner_radius_m is not less",
        ),
        (
            '[[body.section]]\nshape = "disks"\nlength_m = 0.02\ndisks = 3\nradius_m = 0.01\nthickness_m = 0.01\n'
            "backbone_radius_m = 0.001\n\n",
            "leave no backbone",
        ),
    ],
)
def test_shapes_that_make_no_body_are_refused(tmp_path, section, message):
    with pytest.raises(InputError, match=message) as caught:
        _robot(tmp_path, section)
    assert "own.toml" in str(caught.value)
