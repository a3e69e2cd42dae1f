"""Energies of a rod's state, for tests of what steps conserve."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfdropo_bayes.fem import sections
from rfdropo_bayes.fem.dynamics import Prepared, State, System, momentum, strains, twist_of


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
