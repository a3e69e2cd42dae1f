"""Loads on a rod that change from step to step: forces on sections, factors on its stiffness and damping, and a change
of gravity.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.fem.dynamics import Prepared, System


class SectionLoads(NamedTuple):
    """Signals; row 0 acts on the initial equilibrium, row k during the k-th step.

    Attributes:
        force: forces on the sections at some stations [N].
        stiffness, damping: logarithms of factors on the stiffness and on both Rayleigh coefficients.
        gravity: added to gravity [m/s2].
        station: indices of the stations that forces act on, each once; not batched.
    """

    force: Float[Any, "*batch row place 3"]
    stiffness: Float[Any, "*batch row"]
    damping: Float[Any, "*batch row"]
    gravity: Float[Any, "*batch row 3"]
    station: tuple[int, ...]


def loaded(
    system: System, prepared: Prepared, loads: SectionLoads, row: Any
) -> tuple[Prepared, Float[Array, "stations 6"]]:
    """The body under one row of loads, and the forces [N] and moments [N m] on its stations."""
    force, stiffness, damping, gravity = (jnp.asarray(part)[row] for part in loads[:4])
    loss = jnp.exp(damping)
    changed = prepared._replace(
        firmness=jnp.exp(stiffness),
        rayleigh_mass=loss * prepared.rayleigh_mass,
        rayleigh_stiffness=loss * prepared.rayleigh_stiffness,
        gravity=prepared.gravity + gravity,
    )
    pushed = jnp.zeros((len(system.body.station), 6)).at[jnp.asarray(loads.station, dtype=int), :3].set(force)
    return changed, pushed
