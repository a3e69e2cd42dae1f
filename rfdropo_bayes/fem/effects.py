"""Physics beyond a linear elastic body with frictionless inextensible cables; every effect is absent unless given.

An effect that is given runs with whatever value it has. At its null value an effect changes nothing, and is
differentiable. An effect that is not given (None) costs nothing: it is no part of the traced program.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
from jaxtyping import Array, Float

Scalar = Float[Array, ""] | float


class BendingLaw(NamedTuple):
    """Moments of a section in response to bending and twist, beyond its profile; null 0 for all."""

    fibre: Scalar = 0.0  # c: stiffness E (1 - 3 c x) at small strains x; -1 St. Venant-Kirchhoff, 2/3 rubber
    anisotropy: Scalar = 0.0  # ln of EI in the xz plane over EI in the yz plane; their product stays
    cross_plane: Scalar = 0.0  # EI_xy / sqrt(EI_x EI_y)
    twist_x: Scalar = 0.0  # coupling of twist and rotation about x, relative to sqrt(EI GJ)
    twist_y: Scalar = 0.0  # and about y


class Viscoelasticity(NamedTuple):
    """One Prony branch beside the elastic body: E(t) = E (1 + fraction exp(-t / time)); null fraction 0."""

    fraction: Scalar
    time: Scalar  # [s]


class Wall(NamedTuple):
    """A plane along z that stops the axis; null stiffness 0."""

    stiffness: Scalar  # force per depth and length of the body [N/m2]
    distance: Scalar  # of the plane from the body's axis at rest [m]
    azimuth: Scalar  # direction of its outward normal, from x towards y [rad]


class BodyEffects(NamedTuple):
    """Effects of one rollout; None if absent."""

    bending: BendingLaw | None = None
    viscoelasticity: Viscoelasticity | None = None
    softening_rate: Scalar | None = None  # [1/s]: every modulus follows exp(-rate t) from the start of the rollout
    drag: Scalar | None = None  # [kg/m3]: force per length = -drag * width * |v| v
    wall: Wall | None = None
    cable_compliance: Scalar | None = None  # [m/N] of every cable, in series with its drive
    coulomb_friction: Scalar | None = None  # [N] of every guide, along the cable
    capstan_friction: Scalar | None = None  # coefficient of friction of every guide

    @property
    def present(self) -> bool:
        """Whether any effect is given."""
        return bool(jax.tree.leaves(self))

    @property
    def rubs(self) -> bool:
        """Whether cables have friction in guides, which adds rows to the problem of every step, also at size zero."""
        return self.coulomb_friction is not None or self.capstan_friction is not None


class Memory(NamedTuple):
    """Memory of the present effects from step to step."""

    clock: Float[Array, ""] | None = None  # [s] since the start
    branch: Float[Array, "elements 6"] | None = None  # strains of the Prony branch's dashpot
    slip: Float[Array, "kinds cables cable_runs"] | None = None  # share of the friction mobilised, -1 to 1
    segment: Float[Array, "cables guides"] | None = None  # tension in front of every guide [N]
