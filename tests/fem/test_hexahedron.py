"""The element alone: patch test, rigid motion, mass, derivative."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rfdropo_bayes import fem  # noqa: F401  (switches JAX to float64)
from rfdropo_bayes.fem import hexahedron


@jax.jit
def stiffness(coordinates, young, poisson):
    """Of an isotropic element."""
    return hexahedron.elastic_stiffness(coordinates, hexahedron.elasticity(young, poisson))


BOX = 0.5 * hexahedron.CORNERS * np.array([1.0, 1.4, 0.6])


def distorted(seed: int) -> np.ndarray:
    """A box whose corners are moved by up to 30 % of its edges."""
    return BOX + np.random.default_rng(seed).uniform(-0.15, 0.15, (8, 3)) * np.ptp(BOX, axis=0)


def patch() -> tuple[np.ndarray, np.ndarray]:
    """Node coordinates and elements of MacNeal and Harder's patch: a unit cube around one skew hexahedron."""
    inner = np.array(
        [
            [0.249, 0.342, 0.192],
            [0.826, 0.288, 0.288],
            [0.273, 0.750, 0.230],
            [0.850, 0.649, 0.263],
            [0.320, 0.186, 0.643],
            [0.677, 0.305, 0.683],
            [0.165, 0.745, 0.702],
            [0.788, 0.693, 0.644],
        ]
    )
    nodes = np.concatenate([(hexahedron.CORNERS + 1.0) / 2.0, inner])
    faces = [(axis, side) for axis in range(3) for side in (-1.0, 1.0)]
    elements = [np.arange(8, 16)]
    for axis, side in faces:
        element = np.zeros(8, dtype=int)
        for corner, natural in enumerate(hexahedron.CORNERS):
            # The corner of the cube or of the inner hexahedron, whichever lies further along the face's normal.
            outer = natural[axis] == side
            target = natural.copy()
            target[axis] = side
            element[corner] = int(np.flatnonzero((target == hexahedron.CORNERS).all(axis=1))[0]) + (0 if outer else 8)
        elements.append(element)
    return nodes, np.array(elements)


def test_patch_of_distorted_elements_carries_constant_strain():
    nodes, elements = patch()
    matrix = np.zeros((48, 48))
    for element in elements:
        dofs = (3 * element[:, None] + np.arange(3)).ravel()
        matrix[np.ix_(dofs, dofs)] += np.asarray(stiffness(jnp.asarray(nodes[element]), 1e6, 0.3))
    gradient = np.array([[1.0, 0.5, 0.2], [0.3, -0.4, 0.1], [-0.2, 0.6, 0.8]]) * 1e-3
    exact = (nodes @ gradient.T).ravel()
    outer, inner = np.arange(24), np.arange(24, 48)
    found = np.linalg.solve(matrix[np.ix_(inner, inner)], -matrix[np.ix_(inner, outer)] @ exact[outer])
    np.testing.assert_allclose(found, exact[inner], atol=1e-12 * np.abs(exact).max())
    strain = 0.5 * (gradient + gradient.T)
    lame, shear = 1e6 * 0.3 / (1.3 * 0.4), 1e6 / 2.6
    energy = 0.5 * exact @ matrix @ exact
    assert energy == pytest.approx(0.5 * lame * np.trace(strain) ** 2 + shear * np.sum(strain**2), rel=1e-12)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), poisson=st.floats(0.0, 0.499))
def test_six_rigid_motions_and_no_other_are_free_of_force(seed, poisson):
    coordinates = distorted(seed)
    matrix = np.asarray(stiffness(jnp.asarray(coordinates), 1.0, poisson))
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12 * np.abs(matrix).max())
    translations = np.tile(np.eye(3), (8, 1)).T
    rotations = np.array([np.cross(axis, coordinates).ravel() for axis in np.eye(3)])
    for motion in (*translations, *rotations):
        assert np.abs(matrix @ motion).max() < 1e-11 * np.abs(matrix).max()
    values = np.linalg.eigvalsh(matrix)
    assert values[6] > 1e6 * np.abs(values[:6]).max()


def test_pure_bending_of_one_box_is_exact():
    """The displacement of pure bending, lateral contraction included, costs E I kappa^2 L / 2."""
    x, y, z = BOX.T
    poisson, curvature = 0.45, 0.1
    bent = np.stack(
        [0.5 * curvature * (z**2 + poisson * (x**2 - y**2)), poisson * curvature * x * y, -curvature * x * z]
    )
    energy = 0.5 * bent.T.ravel() @ np.asarray(stiffness(jnp.asarray(BOX), 1.0, poisson)) @ bent.T.ravel()
    assert energy == pytest.approx(0.5 * 1.0**3 * 1.4 / 12.0 * 0.6 * curvature**2, rel=1e-12)


def test_mass_is_the_volume_and_its_second_moment():
    matrix = np.asarray(hexahedron.mass(jnp.asarray(BOX)))
    assert matrix.sum() == pytest.approx(1.4 * 0.6, rel=1e-14)
    assert BOX[:, 0] @ matrix @ BOX[:, 0] == pytest.approx(1.4 * 0.6 / 12.0, rel=1e-13)


def test_derivatives_against_differences():
    coordinates, direction = distorted(3), np.random.default_rng(0).normal(size=24)

    def energy(young, poisson):
        return direction @ stiffness(jnp.asarray(coordinates), young, poisson) @ direction

    by_young, by_poisson = map(float, jax.jit(jax.grad(energy, (0, 1)))(2.0, 0.45))
    value = jax.jit(energy)
    assert by_young == pytest.approx(float(value(1.0, 0.45)), rel=1e-12)
    assert by_poisson == pytest.approx(float(value(2.0, 0.45 + 1e-5) - value(2.0, 0.45 - 1e-5)) / 2e-5, rel=1e-7)
