"""Closed forms and coordinates that the compiled engine starts from."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.fem import hexahedron, layered
from rfdropo_bayes.fem.native.layer_moduli import box_mass, box_moduli, layer_moduli, layer_volume
from rfdropo_bayes.fem.native.section_modes import BLOCK_ENTRIES, block_pairs, section_modes

RATIOS = (-0.3, 0.0, 0.3, 0.499)


def tapered_body(nodes_across: int, sectional: bool = False) -> layered.LayeredBody:
    """Three layers with nothing in common."""
    return layered.profile_body(
        station=np.array([0.0, 0.01, 0.024, 0.031]),
        half_width=np.array([[0.012, 0.01], [0.011, 0.012], [0.01, 0.009], [0.007, 0.009]]),
        axial_area=np.array([4e-4, 3e-4, 2e-4]),
        bending_moment_area=np.array([[2e-8, 1e-8], [1e-8, 1e-8], [3e-9, 8e-9]]),
        torsion_constant=np.array([2e-8, 1.7e-8, 6e-9]),
        mass_area=np.array([5e-4, 3e-4, 2e-4]),
        mass_moment_area=np.array([[2e-8, 3e-8], [1e-8, 2e-8], [3e-9, 8e-9]]),
        nodes_across=nodes_across,
        sectional=sectional,
    )


def moduli(poisson_ratio: float, sectional: bool = False) -> np.ndarray:
    """lambda, or that of Young in a sectional body, mu and 2 lambda mu / (lambda + 2 mu) for a unit Young modulus."""
    shear = 0.5 / (1.0 + poisson_ratio)
    lame = 2.0 * shear * poisson_ratio / (1.0 - 2.0 * poisson_ratio)
    return np.array([1.0 if sectional else lame, shear, 2.0 * lame * shear / (lame + 2.0 * shear)])


@pytest.mark.parametrize("poisson_ratio", RATIOS)
def test_box_stiffness_is_that_of_the_integrated_element(poisson_ratio):
    """Families of a box against the element with its nine condensed modes, and the same for the mass."""
    half = np.array([[0.7, 1.1, 0.4], [2.0, 0.1, 1.0]])
    found = np.einsum("p,p...->...", moduli(poisson_ratio), box_moduli(half)).reshape(2, 24, 24)
    for box, stiffness, mass in zip(half, found, box_mass(half), strict=True):
        corners = jnp.asarray(box * hexahedron.CORNERS)
        law = hexahedron.elasticity(jnp.asarray(1.0), jnp.asarray(poisson_ratio))
        expected = np.asarray(hexahedron.elastic_stiffness(corners, law))
        np.testing.assert_allclose(stiffness, expected, rtol=0.0, atol=1e-13 * np.abs(expected).max())
        np.testing.assert_allclose(mass, np.asarray(hexahedron.mass(corners)), rtol=1e-13)


@pytest.mark.parametrize("sectional", [False, True])
@pytest.mark.parametrize("nodes_across", [2, 3])
def test_layers_are_linear_in_three_moduli(nodes_across, sectional):
    """Stiffness and mass of layers against the reference, torsion constant included."""
    body = tapered_body(nodes_across, sectional)
    dofs = 6 * nodes_across**2
    integrate = jax.jit(lambda ratio: layered.layer_stiffness(body, jnp.asarray(1.0), ratio))
    for poisson_ratio in RATIOS:
        found = np.einsum("p,p...->...", moduli(poisson_ratio, sectional), layer_moduli(body)).reshape(3, dofs, dofs)
        expected = np.asarray(integrate(poisson_ratio))
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=2e-13 * np.abs(expected).max())
    np.testing.assert_allclose(layer_volume(body), layered.layer_mass(body), rtol=0.0, atol=1e-20)


@pytest.mark.parametrize("nodes_across", [2, 3, 4])
def test_section_modes_leave_few_entries(nodes_across):
    """Outside the listed entries the stiffness in section modes is zero; the modes are orthogonal."""
    body = tapered_body(nodes_across)
    shape, parity = section_modes(nodes_across)
    modes = len(parity)
    square = shape.T @ shape
    np.testing.assert_allclose(square, np.diag(np.diag(square)), atol=1e-12)
    faces = np.kron(np.eye(2), shape)
    stiffness = np.einsum("am,plaibj,bn->plminj", faces, layer_moduli(body), faces).sum(axis=(0, 1))
    largest = np.abs(stiffness).max()
    kept = 0
    for row_face, m, column_face, n in block_pairs(modes):
        block = stiffness[row_face * modes + m, :, column_face * modes + n, :].copy()
        for entry in BLOCK_ENTRIES[parity[m] ^ parity[n]]:
            block[entry] = 0.0
            kept += 1
        assert np.abs(block).max() < 1e-12 * largest
    assert kept < 0.3 * (6 * modes) * (6 * modes + 1) / 2
