"""Static equilibrium under gravity, external forces and cables: where a rollout starts."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rfdropo_bayes.fem import corotational
from rfdropo_bayes.fem.blocktridiagonal import BlockTridiagonal
from rfdropo_bayes.fem.cables import lengths_and_jacobian
from rfdropo_bayes.fem.constrained_step import Pull, constrained_step
from rfdropo_bayes.fem.dynamics import (
    Prepared,
    State,
    System,
    accept,
    frames_and_displacements,
    free_solve,
    resistance,
    section_means,
    shared,
    state_at_rest,
    strings,
    with_section_matrix,
)
from rfdropo_bayes.fem.surroundings import section_load
from rfdropo_bayes.fem.tension_stiffening import lateral_stiffening, layer_tension

ITERATIONS = 60
TOLERANCE = 1e-6
"""Largest force out of balance, relative to the loads, that counts as equilibrium."""
LONGEST_STEP = 0.1
"""No node moves further than this many body lengths in an iteration."""
SMALLEST_RELAXATION = 0.1


class EquilibriumInfo(NamedTuple):
    """How well the body is in equilibrium."""

    residual: Float[Array, ""]  # largest nodal force out of balance / sum of the loads
    converged: Bool[Array, ""]  # residual within TOLERANCE, cable problem solved
    diverged: Bool[Array, ""]


class _Iterate(NamedTuple):
    position: Float[Array, "nodes 3"]
    tension: Float[Array, " cables"]
    increment: Float[Array, "nodes 3"]
    relaxation: Float[Array, ""]


class _Forces(NamedTuple):
    body: Float[Array, "nodes 3"]  # of the body and of what surrounds it
    tangent: BlockTridiagonal
    cable: Float[Array, "nodes 3"]
    length: Float[Array, " cables"]
    jacobian: Float[Array, "cables nodes 3"]


def _forces(system: System, prepared: Prepared, iterate: _Iterate) -> _Forces:
    """Forces of the body and of its cables in the current shape, and the tangent of the former."""
    frame, local = frames_and_displacements(system, prepared, iterate.position)
    local_force, packed = resistance(prepared, local)
    if prepared.firmness is not None:
        local_force, packed = prepared.firmness * local_force, prepared.firmness * packed
    body = corotational.internal_force(frame, local_force).reshape(-1, 3)
    length, jacobian = lengths_and_jacobian(system.cables, prepared.guides, iterate.position)
    cable = -jnp.einsum("cni,c->ni", jacobian, iterate.tension)
    stiffening = lateral_stiffening(system.body, frame, layer_tension(system.body, local_force, cable, frame))
    packed = packed + corotational.pack(strings(system, prepared, frame, iterate.position, iterate.tension))
    tangent = jax.tree.map(jnp.add, corotational.tangent(packed, frame), stiffening)
    centre = section_means(system, iterate.position)
    around = section_load(system.body, prepared.effects, centre, jnp.zeros_like(centre))
    if around is not None:
        body = body + shared(system, around.force)
        tangent = with_section_matrix(system, tangent, around.stiffness)
    return _Forces(body, tangent, cable, length, jacobian)


def static_equilibrium(
    system: System,
    prepared: Prepared,
    displacement: Float[Array, " cables"],
    external_force: Float[Array, "nodes 3"] | float = 0.0,
    iterations: int = ITERATIONS,
) -> tuple[State, EquilibriumInfo]:
    """Body at rest under its weight, the external nodal forces [N] and the commanded cable displacements [m].

    Newton's method with the corotational tangent from the undeformed body. The increments are limited in length, and
    relaxed more whenever two in a row point against each other, which makes soft bodies far from straight converge too.
    A fixed number of iterations, so that both modes of differentiation work. Needs at least one clamped station.
    Cables enter without friction, and what flows has relaxed.
    """
    load = prepared.weight + external_force
    longest = LONGEST_STEP * (system.body.station[-1] - system.body.station[0])
    compliance = prepared.effects.cable_compliance
    give = 0.0 if compliance is None else compliance

    def iterate(current: _Iterate, _: None) -> tuple[_Iterate, Bool[Array, ""]]:
        forces = _forces(system, prepared, current)
        slack = prepared.rest_length - displacement - forces.length
        pull = Pull(forces.jacobian, slack, current.tension, give)
        still = jnp.zeros_like(current.position)
        found = constrained_step(free_solve(system, forces.tangent), forces.body + load, still, pull)
        increment, tension, converged = found.increment, found.impulses.cable, found.impulses.converged
        now, before = lax.stop_gradient((increment, current.increment))
        along = jnp.sum(now * before)
        opposed = along < -0.3 * jnp.sqrt(jnp.sum(now**2) * jnp.sum(before**2))
        relaxation = jnp.clip(current.relaxation * jnp.where(opposed, 0.6, 1.2), SMALLEST_RELAXATION, 1.0)
        scale = jnp.minimum(relaxation, longest / jnp.maximum(jnp.max(jnp.abs(now)), 1e-300))
        return _Iterate(current.position + scale * increment, tension, increment, relaxation), converged

    start = state_at_rest(system)
    first = _Iterate(start.position, start.tension, jnp.zeros_like(start.position), jnp.array(1.0))
    last, solved = lax.scan(iterate, first, None, length=iterations)
    forces = _forces(system, prepared, last)
    unbalanced = (forces.body + forces.cable + load)[system.clamped_stations * system.body.section_nodes :]
    loads = jnp.sum(jnp.abs(load)) + jnp.sum(last.tension)
    residual = jnp.max(jnp.abs(unbalanced)) / jnp.maximum(loads, 1e-300)
    moved = State(last.position, jnp.zeros_like(last.position), last.tension)
    state, info = accept(system, prepared, start, moved, solved[-1])
    converged = (residual < TOLERANCE) & info.converged & ~info.diverged
    return state, EquilibriumInfo(residual, converged, info.diverged)
