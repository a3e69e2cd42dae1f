"""Forces and energies of a rollout: the force of the clamp, contact forces, energies, work and losses.

The equation of motion of a step, with contacts, holds exactly on the free part; its residual on the clamped part is the
clamp's force. For a mesh all forces follow from the states of a rollout, without a new solve; a rod is simulated again
(``stage_balance``).
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem import sections
from rfdropo_bayes.fem.dynamics import Prepared, State, System, momentum, strains, twist_of
from rfdropo_bayes.fem.effects import BodyEffects, Scalar
from rfdropo_bayes.fem.mesh_points import cable_force
from rfdropo_bayes.fem.tetrahedra import (
    TetrahedralMaterial,
    TetrahedralSystem,
    elastic_energy,
    element_rotations,
    lame_constants,
    nodal_force,
)


class Energies(NamedTuple):
    """Energies of one state [J]."""

    kinetic: Float[Array, "..."]
    elastic: Float[Array, "..."]
    gravitational: Float[Array, "..."]  # zero with every node at the origin


def energies(system: System, prepared: Prepared, state: State) -> Energies:
    """Kinetic energy including the sections' spin, elastic energy of the sections, and potential energy. Energies of a
    Prony branch, a wall and stretched cables, and softening, are excluded.
    """
    twist, length = twist_of(state), jnp.asarray(np.diff(system.body.station))
    return Energies(
        kinetic=0.5 * jnp.sum(twist * momentum(prepared, state, twist)),
        elastic=jnp.sum(length * sections.energy(prepared.section, strains(system, prepared, state).T)),
        gravitational=-jnp.sum(prepared.weight * state.position),
    )


class Balance(NamedTuple):
    """Forces and energies of a rollout; rows are states, row 0 is the initial one, forces belong to the step before.

    Work and losses are summed from row 0 on.
    """

    base_force: Float[Array, "rows 3"]  # of the clamp on the body [N]; cables pull on their anchors besides
    base_moment: Float[Array, "rows 3"]  # about the origin of the robot's frame [N m]
    contact_force: Float[Array, "rows 3"]  # of touching bodies on the body [N]
    kinetic_energy: Float[Array, " rows"]  # [J]
    elastic_energy: Float[Array, " rows"]  # [J]
    gravitational_energy: Float[Array, " rows"]  # [J]; zero with every node at the origin
    cable_work: Float[Array, " rows"]  # done by cables and chambers on the body [J]
    contact_work: Float[Array, " rows"]  # done on the body by touching bodies [J]
    damping_loss: Float[Array, " rows"]  # to Rayleigh damping [J]

    @property
    def total_energy(self) -> Float[Array, " rows"]:
        """Kinetic, elastic and gravitational [J]."""
        return self.kinetic_energy + self.elastic_energy + self.gravitational_energy

    @property
    def other_loss(self) -> Float[Array, " rows"]:
        """Other dissipated energy [J]: into the damping of implicit Euler, which vanishes with the time step, and
        into effects that hold or dissipate energy (a Prony branch, softening, a wall, drag, compliant cables)."""
        given = self.cable_work + self.contact_work - self.damping_loss
        return given - (self.total_energy - self.total_energy[0])


UNITS = dict.fromkeys(Balance._fields, "J") | {"base_force": "N", "base_moment": "N m", "contact_force": "N"}


class _Step(NamedTuple):
    """Forces [N] and powers [W] of one step."""

    residual: Float[Array, "nodes 3"]  # residual of the equation of motion
    cable: Float[Array, ""]
    damping: Float[Array, ""]


def check_effects(effects: BodyEffects) -> None:
    """Raise InputError for cables with friction, since the tension then varies along a cable."""
    for name in ("coulomb_friction", "capstan_friction"):
        if getattr(effects, name) is not None:
            raise InputError(
                f"forces and energies are not available with {name.replace('_', ' ')}",
                where="balance",
                remedy="remove the mechanism, or leave out its energies",
            )


def _gathered(
    clamped: Bool[Array, " nodes"],
    position: Float[Array, "rows nodes 3"],
    velocity: Float[Array, "rows nodes 3"],
    steps: _Step,
    stored: Energies,
    time_step: Scalar,
) -> Balance:
    """Sums over the nodes and over time; row k of ``steps`` leads to state k, its forces act at the start of the
    step.
    """
    clamp = jnp.where(clamped[:, None], steps.residual, 0.0)
    touch = (steps.residual - clamp).at[0].set(0.0)  # no step leads to the initial state: it may be about to fall
    start = jnp.concatenate([position[:1], position[:-1]])

    def done(power: Float[Array, " rows"]) -> Float[Array, " rows"]:
        return time_step * jnp.cumsum(power.at[0].set(0.0))

    return Balance(
        base_force=clamp.sum(axis=1),
        base_moment=jnp.cross(start, clamp).sum(axis=1),
        contact_force=touch.sum(axis=1),
        kinetic_energy=stored.kinetic,
        elastic_energy=stored.elastic,
        gravitational_energy=stored.gravitational,
        cable_work=done(steps.cable),
        contact_work=done(jnp.sum(touch * velocity, axis=(1, 2))),
        damping_loss=done(steps.damping),
    )


def _velocities(position: Float[Array, "rows nodes 3"], time_step: Scalar) -> Float[Array, "rows nodes 3"]:
    """Implicit Euler moves x by h v: velocities follow from positions, after a start at rest."""
    return jnp.concatenate([jnp.zeros_like(position[:1]), jnp.diff(position, axis=0) / time_step])


def tetrahedral_balance(
    system: TetrahedralSystem,
    material: TetrahedralMaterial,
    position: Float[Array, "rows nodes 3"],
    tension: Float[Array, "rows cables"],
    time_step: Scalar,
) -> Balance:
    """Forces and energies of a rollout of a tetrahedral body from rest, given its positions and tensions."""
    body, mass = system.body, material.node_mass[:, None]
    velocities = _velocities(position, time_step)
    first, shear = lame_constants(material.young_modulus, material.poisson_ratio)
    lame = first * material.stiffness_scale, shear * material.stiffness_scale

    def one(_: None, at: tuple[Array, ...]) -> tuple[None, tuple[_Step, Energies]]:
        before, slower, after, moving, pulling = at
        turn = element_rotations(body, before)
        viscous = nodal_force(body, turn, moving, 0.0, lame)
        cable = cable_force(system.cables, before, pulling)
        inertia = mass * ((moving - slower) / time_step - material.gravity + material.rayleigh_mass * moving)
        lookahead = time_step + material.rayleigh_stiffness
        elastic = nodal_force(body, turn, before, jnp.asarray(body.rest), lame) + lookahead * viscous
        lost = material.rayleigh_mass * mass * moving - material.rayleigh_stiffness * viscous
        step = _Step(inertia - elastic - cable, jnp.sum(cable * moving), jnp.sum(lost * moving))
        stored = Energies(
            kinetic=0.5 * jnp.sum(mass * moving**2),
            elastic=elastic_energy(body, element_rotations(body, after), after, lame),
            gravitational=-jnp.sum(mass * material.gravity * after),
        )
        return None, (step, stored)

    before = (jnp.concatenate([part[:1], part[:-1]]) for part in (position, velocities))
    steps, stored = lax.scan(one, None, (*before, position, velocities, tension))[1]
    return _gathered(jnp.asarray(body.fixed), position, velocities, steps, stored, time_step)
