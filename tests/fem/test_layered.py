"""Layers of a body: the section profile is met exactly, mass, points."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes import fem
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem import layered

YOUNG, POISSON = 2.0e6, 0.45
AREA = np.array([300e-6, 60e-6, 500e-6])
MOMENT = np.array([[9e-9, 5e-9], [0.4e-9, 0.7e-9], [30e-9, 30e-9]])
TORSION = np.array([10e-9, 0.5e-9, 55e-9])
MASS_AREA = np.array([350e-6, 200e-6, 520e-6])
MASS_MOMENT = np.array([[12e-9, 10e-9], [3e-9, 4e-9], [33e-9, 31e-9]])


def profile(nodes_across: int) -> fem.LayeredBody:
    """Three layers of very different, unequal-sided sections on a tapering set of nodes."""
    return fem.profile_body(
        station=np.array([0.0, 0.01, 0.014, 0.03]),
        half_width=np.array([[0.012, 0.01], [0.011, 0.01], [0.009, 0.009], [0.007, 0.006]]),
        axial_area=AREA,
        bending_moment_area=MOMENT,
        torsion_constant=TORSION,
        mass_area=MASS_AREA,
        mass_moment_area=MASS_MOMENT,
        nodes_across=nodes_across,
    )


def forced(matrix: np.ndarray, load: np.ndarray) -> np.ndarray:
    """Displacement of a free layer under a self-balanced load, rigid motion left out."""
    return np.linalg.pinv(matrix, rcond=1e-9) @ load


@pytest.fixture(scope="module", params=[2, 3])
def layers(request):
    """Body, rest positions by layer and stiffness, for four and nine nodes a station."""
    body = profile(request.param)
    matrices = jax.jit(lambda: layered.layer_stiffness(body, jnp.asarray(YOUNG), jnp.asarray(POISSON)))()
    return body, layered.rest_layers(body), np.asarray(matrices)


def condensed(matrix: np.ndarray, axial: np.ndarray) -> tuple[float, np.ndarray]:
    """Energy and axial nodal forces of a layer with its axial displacements given and the lateral ones free."""
    index = np.arange(len(matrix))
    held, free = index[2::3], np.delete(index, index[2::3])
    lateral = forced(matrix[np.ix_(free, free)], -matrix[np.ix_(free, held)] @ axial)
    force = matrix[np.ix_(held, held)] @ axial + matrix[np.ix_(held, free)] @ lateral
    return 0.5 * axial @ force, force


def test_layer_has_the_axial_stiffness_of_its_profile(layers):
    body, rest, matrices = layers
    for layer, length in enumerate(np.diff(body.station)):
        energy, force = condensed(matrices[layer], rest[layer, :, 2] / length)
        assert energy == pytest.approx(0.5 * YOUNG * AREA[layer] / length, rel=1e-9)
        assert force[body.section_nodes :].sum() == pytest.approx(YOUNG * AREA[layer] / length, rel=1e-9)


@pytest.mark.parametrize("axis", [0, 1])
def test_layer_has_the_bending_stiffness_of_its_profile(layers, axis):
    """The faces turn against each other by one radian and may contract sideways: the end moment is E I / L."""
    body, rest, matrices = layers
    for layer, length in enumerate(np.diff(body.station)):
        middle = rest[layer, :, 2].mean()
        axial = rest[layer, :, axis] * (rest[layer, :, 2] - middle) / length
        energy, force = condensed(matrices[layer], axial)
        assert energy == pytest.approx(0.5 * YOUNG * MOMENT[layer, axis] / length, rel=1e-9)
        upper = slice(body.section_nodes, None)
        moment = force[upper] @ rest[layer, upper, axis]
        assert moment == pytest.approx(YOUNG * MOMENT[layer, axis] / length, rel=1e-9)


def test_layer_twists_by_torque_times_length_over_torsional_stiffness(layers):
    """A self-balanced torque on the two faces; the twist is read from the work it does."""
    body, rest, matrices = layers
    shear = YOUNG / (2.0 * (1.0 + POISSON))
    for layer, length in enumerate(np.diff(body.station)):
        twist = layered.free_twist(body)[layer]
        reaction = matrices[layer] @ twist
        forces = reaction.reshape(-1, 3)[body.section_nodes :]
        place = rest[layer, body.section_nodes :]
        torque = np.sum(place[:, 0] * forces[:, 1] - place[:, 1] * forces[:, 0])
        assert torque == pytest.approx(shear * TORSION[layer] / length, rel=1e-9)
        angle = forced(matrices[layer], reaction) @ reaction / torque
        assert angle == pytest.approx(torque * length / (shear * TORSION[layer]), rel=1e-8)


def test_layer_is_free_of_force_in_rigid_motion_and_stiff_otherwise(layers):
    _, rest, matrices = layers
    for layer, matrix in enumerate(matrices):
        for axis in np.eye(3):
            assert np.abs(matrix @ np.cross(axis, rest[layer]).ravel()).max() < 1e-10 * np.abs(matrix).max()
            assert np.abs(matrix @ np.tile(axis, len(rest[layer]))).max() < 1e-10 * np.abs(matrix).max()
        values = np.linalg.eigvalsh(matrix)
        assert values[6] > 1e3 * np.abs(values[:6]).max()


def test_mass_and_rotary_inertia_are_those_of_the_profile(layers):
    body, rest, _ = layers
    mass = np.asarray(layered.layer_mass(body))
    length = np.diff(body.station)
    np.testing.assert_allclose(mass.sum(axis=(1, 2)), MASS_AREA * length, rtol=1e-12)
    for layer in range(3):
        for axis in range(2):
            place = rest[layer, :, axis]
            assert place @ mass[layer] @ place == pytest.approx(MASS_MOMENT[layer, axis] * length[layer], rel=1e-12)


@pytest.mark.parametrize(("half_x", "half_y"), [(1.0, 1.0), (2.0, 1.0), (1.0, 10.0)])
def test_torsion_constant_of_solid_rectangles(half_x, half_y):
    """Timoshenko and Goodier, table of art. 109: J = k b t^3."""
    coefficient = {1.0: 0.140577, 2.0: 0.229, 10.0: 0.312}[max(half_x, half_y) / min(half_x, half_y)]
    wide, thin = 2.0 * max(half_x, half_y), 2.0 * min(half_x, half_y)
    assert fem.solid_torsion_constant(half_x, half_y) == pytest.approx(coefficient * wide * thin**3, rel=2e-3)


@pytest.mark.parametrize("nodes_across", [2, 3])
def test_attached_points_follow_any_affine_motion(nodes_across):
    """Points inside, beside the square of nodes, on the stations and beyond the ends."""
    body = profile(nodes_across)
    rng = np.random.default_rng(1)
    points = rng.uniform([-0.02, -0.02, -0.002], [0.02, 0.02, 0.032], (40, 3))
    points[:4, 2] = body.station
    attached = fem.attach(body, points)
    rest = jnp.asarray(fem.rest_positions(body))
    np.testing.assert_allclose(fem.point_positions(attached, rest), points, atol=1e-16)
    gradient, shift = rng.normal(size=(3, 3)), rng.normal(size=3)
    moved = fem.point_positions(attached, rest @ gradient.T + shift)
    np.testing.assert_allclose(moved, points @ gradient.T + shift, rtol=1e-12, atol=1e-13)


def test_spread_forces_do_the_work_of_the_point_forces():
    body = profile(3)
    attached = fem.attach(body, np.array([[0.001, 0.002, 0.012], [-0.004, 0.0, 0.03]]))
    rng = np.random.default_rng(2)
    force, motion = jnp.asarray(rng.normal(size=(2, 3))), jnp.asarray(rng.normal(size=(body.nodes, 3)))
    spread = fem.spread_forces(attached, force, body.nodes)
    work = jnp.sum(force * fem.point_positions(attached, motion))
    assert float(jnp.sum(spread * motion)) == pytest.approx(float(work), rel=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"station": np.array([0.0, 0.01, 0.01, 0.03])}, "increasing"),
        ({"axial_area": AREA[:2]}, "axial_area"),
        ({"torsion_constant": -TORSION}, "not positive"),
        ({"half_width": np.full((4, 2), np.nan)}, "half_width"),
        ({"nodes_across": 1}, "nodes_across"),
    ],
)
def test_impossible_bodies_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        fem.profile_body(**{**profile(2)._asdict(), **change})
