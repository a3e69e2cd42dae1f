"""Energies of a state."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.fem.bending_law import potential
from rfdropo_bayes.fem.dynamics import Prepared, State, System, frames_and_displacements, mass_times


class Energies(NamedTuple):
    """Energies of one state [J]."""

    kinetic: Float[Array, "..."]
    elastic: Float[Array, "..."]
    gravitational: Float[Array, "..."]  # zero with every node at the origin

    @property
    def total(self) -> Float[Array, "..."]:
        """Their sum."""
        return self.kinetic + self.elastic + self.gravitational


def energies(system: System, prepared: Prepared, state: State) -> Energies:
    """Kinetic energy v'Mv/2, elastic energy d'Kd/2 in the layers' frames with that of a bending law, and gravity's
    -x'Mg. What a Prony branch, a wall and stretched cables hold is left out, and softening too."""
    _, local = frames_and_displacements(system, prepared, state.position)
    elastic = 0.5 * jnp.einsum("li,lij,lj->", local, prepared.stiffness, local)
    if prepared.effects.bending is not None and prepared.sections is not None:
        elastic = elastic + potential(prepared.effects.bending, prepared.sections, local)
    return Energies(
        kinetic=0.5 * jnp.sum(state.velocity * mass_times(system, prepared, state.velocity)),
        elastic=elastic,
        gravitational=-jnp.sum(prepared.weight * state.position),
    )
