"""Response of a rod's sections to strains: linear, or by the laws of ``effects``.

The bending law is a symmetric matrix of bending and twist. The fibre law gives every fibre of the section the tangent
stiffness E s of its strain x,

    s = (r - h)^2,  r = sqrt(1 + h^2),  h = 3 c x / 2,

which is 1 - 3 c x to first order and positive at any strain: a polynomial has a strain beyond which the body collapses.
The section's stress in stretch is E A times the integral of s, its bending energy the linear one times s.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfdropo_bayes.fem.components import diagonal, dot, times
from rfdropo_bayes.fem.effects import BendingLaw, BodyEffects, Scalar
from rfdropo_bayes.fem.rod import SHEAR, Rod, shear_ratios


class Inner(NamedTuple):
    """Coefficients of bending within the elements, see ``rod_elements``."""

    arc: Scalar  # a
    shear: Float[Array, "2 ..."]  # c, along x and y
    pressed: Float[Array, "2 ..."]  # c'


class Sections(NamedTuple):
    """Stiffness of the sections of all elements, at rest."""

    stretch: Float[Array, "3 ..."]  # against shear twice, E A [N]
    bending: Float[Array, "3 ..."] | Float[Array, "3 3 ..."]  # E I about x, about y, G J; with a bending law a matrix
    inner: Inner
    fibre: Scalar | None = None  # c of the fibre law; with a bending law


def sections(
    body: Rod, effects: BodyEffects, young_modulus: Scalar, poisson_ratio: Scalar, scale: Float[Array, " elements"]
) -> Sections:
    """Stiffness of the sections of a rod."""
    young = scale * young_modulus
    shear = young / (2.0 * (1.0 + poisson_ratio))
    inner, left = inner_bending(body, poisson_ratio)
    stretch = jnp.stack([*(left * SHEAR * shear * body.axial_area), young * body.axial_area])
    moment = body.bending_moment_area
    bending = jnp.stack([young * moment[:, 1], young * moment[:, 0], shear * body.torsion_constant])
    if effects.bending is None:
        return Sections(stretch, bending, inner)
    root = jnp.sqrt(bending)
    bending = diagonal(bending) + _coupling(effects.bending)[:, :, None] * root[:, None] * root[None]
    return Sections(stretch, bending, inner, jnp.asarray(effects.bending.fibre, dtype=float))


def inner_bending(body: Rod, poisson_ratio: Scalar) -> tuple[Inner, Float[Array, "2 elements"]]:
    """Coefficients of bending within elements, and the share of the stiffness in shear that it leaves."""
    soft = SHEAR / (2.0 * (1.0 + jnp.asarray(poisson_ratio, dtype=float)))
    ratio = jnp.asarray(shear_ratios(body).T) * (soft / SHEAR)
    left, arc = 1.0 / (1.0 + ratio), 1.0 - 1.0 / soft
    pressed = (1.0 - soft) * ratio * left**2
    return Inner(arc, pressed + 0.6 * (ratio * left) ** 2, 0.5 * arc * pressed), left


def _coupling(law: BendingLaw) -> Float[Array, "3 3"]:
    """Change of the moments relative to the geometric means of the stiffnesses."""
    zero = jnp.zeros(())
    rows = [
        [jnp.expm1(-0.5 * law.anisotropy), law.cross_plane, law.twist_x],
        [law.cross_plane, jnp.expm1(0.5 * law.anisotropy), law.twist_y],
        [law.twist_x, law.twist_y, zero],
    ]
    return jnp.stack([jnp.stack([jnp.asarray(value, dtype=float) for value in row]) for row in rows])


def linear(section: Sections, strain: Float[Array, "6 ..."]) -> Float[Array, "6 ..."]:
    """Forces [N] and moments [N m] of the sections without the fibre law."""
    law = section.fibre is not None
    moment = times(section.bending, strain[3:]) if law else section.bending * strain[3:]
    return jnp.concatenate([section.stretch * strain[:3], moment])


class Fibres(NamedTuple):
    """The fibre law at the stretch of a section."""

    tangent: Float[Array, "..."]  # s, relative to the linear section's
    secant: Float[Array, "..."]  # stress in stretch, relative to the linear section's
    change: Float[Array, "..."]  # derivative of s by the stretch


def fibres(c: Scalar, stretch: Float[Array, "..."]) -> Fibres:
    """The fibre law at a stretch."""
    h = 1.5 * c * stretch
    r = jnp.sqrt(1.0 + h**2)
    tangent = (r - h) ** 2
    secant = 1.0 + 2.0 / 3.0 * h * (h - (r**2 + r + 1.0) / (r + 1.0))
    return Fibres(tangent, secant, -3.0 * c * tangent / r)


def answer(section: Sections, strain: Float[Array, "6 ..."]) -> Float[Array, "6 ..."]:
    """Forces [N] and moments [N m] of the sections."""
    result = linear(section, strain)
    if section.fibre is None:
        return result
    law, moment = fibres(section.fibre, strain[2]), times(section.bending[:2, :2], strain[3:5])
    pull = section.stretch[2] * strain[2] * (law.secant - 1.0) + 0.5 * law.change * dot(moment, strain[3:5])
    none = jnp.zeros_like(result[:1])
    return result + jnp.concatenate([none, none, pull[None], (law.tangent - 1.0) * moment, none])


def energy(section: Sections, strain: Float[Array, "6 ..."]) -> Float[Array, "..."]:
    """Energy per length [J/m]."""
    result = 0.5 * dot(linear(section, strain), strain)
    if section.fibre is None:
        return result
    stretch, moment = strain[2], times(section.bending[:2, :2], strain[3:5])
    h = 1.5 * section.fibre * stretch
    small = jnp.abs(h) < 1e-3
    x = jnp.where(small, 1.0, h)
    cubed = x * (2.0 * x**2 + 5.0) * jnp.sqrt(1.0 + x**2) / 8.0 + 0.375 * jnp.arcsinh(x)  # integral of r^3
    exact = 0.5 + x**2 / 6.0 - 2.0 / 3.0 * (cubed - x) / x**2
    share = jnp.where(small, 0.5 - h / 3.0 + h**2 / 6.0, exact)
    bent = 0.5 * (fibres(section.fibre, stretch).tangent - 1.0) * dot(moment, strain[3:5])
    return result + section.stretch[2] * stretch**2 * (share - 0.5) + bent


def slopes(section: Sections, strain: Float[Array, "6 ..."]) -> Sections:
    """Tangent stiffness of the sections. It neglects the coupling of stretch and bending."""
    if section.fibre is None:
        return section
    softer = fibres(section.fibre, strain[2]).tangent - 1.0
    axial = np.array([0.0, 0.0, 1.0]).reshape(3, *[1] * softer.ndim)
    planar = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 0.0]]).reshape(3, 3, *[1] * softer.ndim)
    return section._replace(
        stretch=section.stretch * (1.0 + axial * softer), bending=section.bending * (1.0 + planar * softer)
    )
