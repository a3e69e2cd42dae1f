"""The section profiles in the robot files follow from the solid, and the rod answers as the solid does."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from rfdropo_bayes.robots import Robot

pytest.importorskip("skfem", reason="needs scikit-fem")
pytest.importorskip("pypardiso", reason="needs pypardiso")
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))

import section_profile

RATIO = 0.45
MATERIAL = (4.5e6, 0.42 / 38.9e-6)


@pytest.fixture(scope="module")
def mesh(datasets):
    return section_profile.read_mesh(datasets / "sofa_trunk" / "trunk.vtk")


def bar(side: float, length: float):
    """A square bar of tetrahedra along z, clamped up to z = 20 mm."""
    import skfem

    across = np.linspace(-side / 2, side / 2, 5)
    return skfem.MeshTet.init_tensor(across, across, np.linspace(0.0, length, 25))


def test_a_uniform_bar_gets_its_own_section():
    side, length = 0.02, 0.24
    station = np.array([0.0, 0.023, 0.083, 0.143, 0.203, length])
    solid = section_profile.Discretisation("P2").solid(bar(side, length), station, 0.0)
    profile = section_profile.derive_profile(solid, station, equal_node_masses=False)
    middle = slice(2, 4)
    np.testing.assert_allclose(profile["axial_area"][middle], side**2, rtol=1e-3)
    np.testing.assert_allclose(profile["bending_moment_area"][middle], side**4 / 12, rtol=1e-3)
    np.testing.assert_allclose(profile["torsion_constant"][middle], 0.140577 * side**4, rtol=0.01)
    np.testing.assert_allclose(profile["mass_area"], side**2, rtol=0.02)


def test_the_chain_of_beams_is_a_cantilever():
    """Tip at w L^4 / 8 EI and modes at 1.8751 and 4.6941, for a slender beam."""
    station, side = np.linspace(0.0, 2.0, 41), 0.01
    ones = np.ones(40)
    profile = {
        "axial_area": side**2 * ones,
        "bending_moment_area": side**4 / 12 * np.ones((40, 2)),
        "mass_area": side**2 * ones,
    }
    young, density = 1e9, 1000.0
    response = section_profile.rod_response(station, profile, 0.3, young, density)
    here = station[-2]
    weight, rigidity = density * side**2 * 9.81, young * side**4 / 12
    sag = weight * here**2 * (6 * 4.0 - 4 * 2.0 * here + here**2) / (24 * rigidity)
    assert -response.sag_m == pytest.approx(sag, rel=1e-3)
    modes = np.array([1.875104, 4.694091]) ** 2 / 4.0 * np.sqrt(rigidity / (density * side**2)) / (2 * np.pi)
    np.testing.assert_allclose(response.frequency_hz, modes, rtol=1e-3)


@pytest.mark.slow
def test_trunk_sofa_answers_as_sofas_mesh_does(mesh):
    """Profile within its printed digits; sag and two modes within 5 %; SOFA's first mode is the documented 0.81 Hz."""
    body = Robot.load("trunk_sofa").body
    station = np.array(body.station_m)
    solid = section_profile.Discretisation("P1", equal_node_masses=True).solid(mesh, station, RATIO)
    profile = section_profile.derive_profile(solid, station, equal_node_masses=True)
    for name, values in body.arrays().items():
        if name in profile:
            np.testing.assert_allclose(profile[name], values, rtol=2e-3)
    wanted = section_profile.solid_response(solid, station, *MATERIAL)
    found = section_profile.rod_response(station, profile, RATIO, *MATERIAL)
    assert wanted.frequency_hz[0] == pytest.approx(0.81, abs=0.01)
    assert found.sag_m == pytest.approx(wanted.sag_m, rel=0.05)
    np.testing.assert_allclose(found.frequency_hz, wanted.frequency_hz, rtol=0.05)


@pytest.mark.slow
def test_trunk_physical_lies_where_refinement_leads(mesh):
    """Bending stiffness falls under refinement, and the file's extrapolated profile lies below both meshes, near them
    where there is no notch."""
    body = Robot.load("trunk_physical").body
    station, bending = np.array(body.station_m), np.array(body.bending_moment_area_m4).mean(1)
    coarse, finer = (
        section_profile.effective_sections(
            section_profile.Discretisation("P2", necks=passes).solid(mesh, station, RATIO), station
        )["bending_moment_area"].mean(1)
        for passes in (0, 3)
    )
    necks, vertebrae = slice(1, -1, 2), slice(2, -1, 2)
    assert np.all(coarse[necks] > finer[necks])
    assert np.all(finer[necks] > bending[necks])
    assert np.all(finer[necks] < 1.6 * bending[necks])
    np.testing.assert_allclose(finer[vertebrae], bending[vertebrae], rtol=0.1)
