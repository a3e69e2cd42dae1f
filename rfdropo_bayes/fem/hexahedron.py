"""Eight-node hexahedron with incompatible modes: stiffness and consistent mass.

The nine incompatible modes of Wilson, with the gradients of Taylor, Beresford and Wilson (1976), "A non-conforming
element for stress analysis", Int. J. Numer. Meth. Engng 10:1211-1219: taken at the centre and scaled by the Jacobian,
so that distorted elements pass the patch test; the enhanced-strain element of Simo and Rifai (1990) with the same modes
coincides with it. Three enhanced stretches follow, one for every pair of axes and linear in both: without them an
element that is bent more at one end than at the other resists any change of the strain across, and locks as Poisson's
ratio nears 1/2 (Andelfinger and Ramm 1993, Int. J. Numer. Meth. Engng 36:1311-1337). All twelve are condensed in the
reference configuration.

Local nodes are numbered ``iz * 4 + iy * 2 + ix`` (x runs fastest); the degrees of freedom ``node * 3 + axis``.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

CORNERS = np.array([[x, y, z] for z in (-1.0, 1.0) for y in (-1.0, 1.0) for x in (-1.0, 1.0)])
"""Natural coordinates of the eight nodes, (8, 3)."""
GAUSS_POINTS = CORNERS / np.sqrt(3.0)
"""Points of the 2 x 2 x 2 rule, (8, 3); every weight is one."""
# Voigt order xx, yy, zz, xy, yz, zx: the displacement component and the derivative that enter each engineering strain.
_STRAIN_TERMS = ((0, 0, 0), (1, 1, 1), (2, 2, 2), (3, 0, 1), (3, 1, 0), (4, 1, 2), (4, 2, 1), (5, 2, 0), (5, 0, 2))
# Pairs of axes, and with the second of each that along which the enhanced stretch acts. In a section that follows no
# stretch along z it thus changes nothing.
_PAIRS = np.array([[0, 1], [0, 2], [1, 2]])


def shape_functions(points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 8"]:
    """Trilinear shape functions at natural coordinates."""
    return np.prod(1.0 + points[:, None, :] * CORNERS[None], axis=2) / 8.0


def shape_gradients(points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 8 3"]:
    """Gradients of the trilinear shape functions in natural coordinates."""
    factors = 1.0 + points[:, None, :] * CORNERS[None]
    others = np.stack(
        [factors[..., 1] * factors[..., 2], factors[..., 2] * factors[..., 0], factors[..., 0] * factors[..., 1]], -1
    )
    return others * CORNERS[None] / 8.0


def determinant(matrix: Float[Array, "... 3 3"]) -> Float[Array, "..."]:
    """Determinant of 3 x 3 matrices, written out."""
    return jnp.sum(matrix[..., 0, :] * jnp.cross(matrix[..., 1, :], matrix[..., 2, :]), axis=-1)


def cofactor(matrix: Float[Array, "... 3 3"]) -> Float[Array, "... 3 3"]:
    """Cofactors of 3 x 3 matrices, det(F) F^-T: no LAPACK call for a matrix this small."""
    first, second, third = matrix[..., 0, :], matrix[..., 1, :], matrix[..., 2, :]
    return jnp.stack([jnp.cross(second, third), jnp.cross(third, first), jnp.cross(first, second)], axis=-2)


def elasticity(young_modulus: Float[Array, ""], poisson_ratio: Float[Array, ""]) -> Float[Array, "6 6"]:
    """Isotropic stiffness [Pa] in Voigt order xx, yy, zz, xy, yz, zx with engineering shear strains."""
    shear = young_modulus / (2.0 * (1.0 + poisson_ratio))
    lame = young_modulus * poisson_ratio / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))
    volumetric = np.zeros((6, 6))
    volumetric[:3, :3] = 1.0
    return lame * volumetric + shear * np.diag([2.0, 2.0, 2.0, 1.0, 1.0, 1.0])


def sectional_elasticity(young_modulus: Float[Array, ""], poisson_ratio: Float[Array, ""]) -> Float[Array, "6 6"]:
    """Stiffness [Pa] of sections in plane stress that neither resist nor follow stretch along z; order as above.

    E along z, E / (1 - nu^2) with nu times that across in the plane of the section, and the shear modulus.
    """
    shear = young_modulus / (2.0 * (1.0 + poisson_ratio))
    plane = young_modulus / (1.0 - poisson_ratio**2)
    diagonal = jnp.stack([plane, plane, jnp.asarray(young_modulus), shear, shear, shear])
    coupling = np.zeros((6, 6))
    coupling[0, 1] = coupling[1, 0] = 1.0
    return jnp.diag(diagonal) + poisson_ratio * plane * coupling


def _strain_operator(gradient: Float[Array, "point function 3"]) -> Float[Array, "point 6 functions3"]:
    """Engineering strain of displacement functions from their gradients."""
    points, functions, _ = gradient.shape
    operator = jnp.zeros((points, 6, functions, 3))
    for row, component, derivative in _STRAIN_TERMS:
        operator = operator.at[:, row, :, component].set(gradient[:, :, derivative])
    return operator.reshape(points, 6, functions * 3)


def _stretches(inverse: Float[Array, "3 3"]) -> Float[Array, "3 6"]:
    """Engineering strain of the stretch of every pair along the gradient of its second natural coordinate."""
    normal = inverse[:, _PAIRS[:, 1]].T
    normal = normal / jnp.linalg.norm(normal, axis=1, keepdims=True)
    return jnp.concatenate([normal**2, 2.0 * normal * jnp.roll(normal, -1, axis=1)], axis=1)


def elastic_stiffness(coordinates: Float[Array, "8 3"], moduli: Float[Array, "6 6"]) -> Float[Array, "24 24"]:
    """Stiffness [N/m] of one element, its twelve modes condensed; any non-degenerate coordinates [m]."""
    local = shape_gradients(GAUSS_POINTS)
    jacobian = jnp.einsum("gna,nb->gab", local, coordinates)
    volume = determinant(jacobian)
    inverse = jnp.swapaxes(cofactor(jacobian), -1, -2) / volume[:, None, None]
    compatible = _strain_operator(jnp.einsum("gab,gnb->gna", inverse, local))
    centre = shape_gradients(np.zeros((1, 3)))[0].T @ coordinates
    centre_volume = determinant(centre)
    centre_inverse = cofactor(centre).T / centre_volume
    # d(1 - xi_i^2)/d(xi_j) = -2 xi_i delta_ij. With the factor j0 / j the strain of every mode integrates to zero.
    modes = -2.0 * GAUSS_POINTS[:, :, None] * np.eye(3)
    scaled = jnp.einsum("ab,gnb->gna", centre_inverse, modes) * (centre_volume / volume)[:, None, None]
    stretched = jnp.einsum("gp,pk->gkp", GAUSS_POINTS[:, _PAIRS].prod(axis=2), _stretches(centre_inverse))
    stretched = stretched * (centre_volume / volume)[:, None, None]
    incompatible = jnp.concatenate([_strain_operator(scaled), stretched], axis=2)
    stress = moduli * volume[:, None, None]
    regular = jnp.einsum("gik,gij,gjl->kl", compatible, stress, compatible)
    coupling = jnp.einsum("gik,gij,gjl->kl", incompatible, stress, compatible)
    internal = jnp.einsum("gik,gij,gjl->kl", incompatible, stress, incompatible)
    return regular - coupling.T @ jnp.linalg.solve(internal, coupling)


def mass(coordinates: Float[Array, "8 3"]) -> Float[Array, "8 8"]:
    """Consistent mass of one element per unit density [m^3], for each displacement component alike."""
    volume = determinant(jnp.einsum("gna,nb->gab", shape_gradients(GAUSS_POINTS), coordinates))
    functions = shape_functions(GAUSS_POINTS)
    return jnp.einsum("g,ga,gb->ab", volume, functions, functions)
