"""Moments of a layer beyond those of its linear section: cubic stiffening, anisotropy, coupling of planes and of twist.

They act on three rotations of a layer's upper section relative to its lower one, measured in the layer's frame: about
x, about y, and twist. The law has a potential, so what it does to a closed path of deformation is nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfdropo_bayes.fem.effects import BendingLaw, Scalar
from rfdropo_bayes.fem.layered import LayeredBody, rest_layers


class Sections(NamedTuple):
    """Rotational stiffness of every layer, about x, about y and in twist, and what the rotations are."""

    rotation: Float[np.ndarray, "layers 3 dofs"]  # rotations [rad] of a displacement [m]
    stiffness: Float[Array, "layers 3"]  # EI / L, EI / L, GJ / L [N m]
    curvature: Float[np.ndarray, " layers"]  # squared bend of the whole body [rad2] per squared bend of this layer


def section_rotations(body: LayeredBody) -> Float[np.ndarray, "layers 3 dofs"]:
    """Relative rotation of a layer's faces, by least squares over the nodes of each."""
    rest = rest_layers(body).reshape(-1, 2, body.section_nodes, 3)
    x, y = rest[..., 0], rest[..., 1]
    by_x, by_y = x / np.sum(x**2, axis=2, keepdims=True), y / np.sum(y**2, axis=2, keepdims=True)
    weight = np.zeros((len(rest), 3, 2, body.section_nodes, 3))
    weight[:, 0, ..., 2], weight[:, 1, ..., 2] = by_y, -by_x
    weight[:, 2, ..., 0], weight[:, 2, ..., 1] = -by_y / 2.0, by_x / 2.0
    weight[:, :, 0] *= -1.0
    return weight.reshape(len(rest), 3, -1)


def section_areas(body: LayeredBody) -> Float[np.ndarray, "layers 3"]:
    """Rotational stiffness of every layer about x, about y and in twist, per modulus [m3]."""
    area = np.column_stack([body.bending_moment_area[:, ::-1], body.torsion_constant])
    return area / np.diff(body.station)[:, None]


def relative_curvature(body: LayeredBody) -> Float[np.ndarray, " layers"]:
    """Squared bend of the whole body [rad2] per squared bend of a layer, by the layer's share of the compliance.

    Where a uniform moment bends the body by one radian in all, this times the layer's squared bend is one, whatever
    its section.
    """
    area = section_areas(body)
    bend = 1.0 / np.sqrt(area[:, 0] * area[:, 1])
    return (np.sum(bend) / bend) ** 2


def sections(
    body: LayeredBody, young_modulus: Scalar, poisson_ratio: Scalar, scale: Float[Array, " layers"]
) -> Sections:
    """Rotational stiffness of the layers of a body."""
    shear_modulus = young_modulus / (2.0 * (1.0 + poisson_ratio))
    modulus = jnp.stack([jnp.asarray(young_modulus)] * 2 + [jnp.asarray(shear_modulus)])
    stiffness = scale[:, None] * section_areas(body) * modulus
    return Sections(section_rotations(body), stiffness, relative_curvature(body))


def _coupling(law: BendingLaw) -> Float[Array, "3 3"]:
    """Change of the moments relative to the geometric means of the stiffnesses."""
    zero = jnp.zeros(())
    rows = [
        [jnp.expm1(-0.5 * law.anisotropy), law.cross_plane, law.twist_x],
        [law.cross_plane, jnp.expm1(0.5 * law.anisotropy), law.twist_y],
        [law.twist_x, law.twist_y, zero],
    ]
    return jnp.stack([jnp.stack([jnp.asarray(value, dtype=float) for value in row]) for row in rows])


def moments(
    law: BendingLaw, section: Sections, local: Float[Array, "layers dofs"]
) -> tuple[Float[Array, "layers 3"], Float[Array, "layers 3 3"]]:
    """Moments [N m] of the law at a displacement in the layers' frames, and their derivatives by the rotations."""
    angle = jnp.einsum("lij,lj->li", section.rotation, local)
    root = jnp.sqrt(section.stiffness)
    linear = _coupling(law) * root[:, :, None] * root[:, None, :]
    moment = section.stiffness[:, :2] * angle[:, :2]
    scale = law.stiffening * section.curvature / root[:, 0] / root[:, 1]
    energy = jnp.sum(moment * angle[:, :2], axis=1)
    cubic = (scale * energy)[:, None] * moment
    slope = scale[:, None, None] * (
        energy[:, None, None] * section.stiffness[:, :2, None] * jnp.eye(2)
        + 2.0 * moment[:, :, None] * moment[:, None, :]
    )
    total = jnp.einsum("lij,lj->li", linear, angle) + jnp.pad(cubic, ((0, 0), (0, 1)))
    return total, linear + jnp.pad(slope, ((0, 0), (0, 1), (0, 1)))


def potential(law: BendingLaw, section: Sections, local: Float[Array, "layers dofs"]) -> Float[Array, ""]:
    """Energy [J] of the law's moments."""
    angle = jnp.einsum("lij,lj->li", section.rotation, local)
    linear, _ = moments(law._replace(stiffening=0.0), section, local)
    energy = jnp.sum(section.stiffness[:, :2] * angle[:, :2] ** 2, axis=1)
    scale = law.stiffening * section.curvature / jnp.sqrt(section.stiffness[:, 0] * section.stiffness[:, 1])
    return 0.5 * jnp.sum(linear * angle) + 0.25 * jnp.sum(scale * energy**2)
