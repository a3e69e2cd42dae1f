"""Implicit Euler for a layered corotational body pulled by unilateral cables: one linear solve a step.

    A dv = h (f(x) + M g + f_ext - (h + b) K v - a M v) - h J' T,    A = (1 + h a) M + h (h + b) K,    x += h (v + dv)

with Rayleigh damping a M + b K, the corotational tangent K, cable Jacobian J = dl/dx and tensions T >= 0 (Baraff and
Witkin 1998; the same linearised step as SOFA's EulerImplicitSolver). Everything is a pure function of arrays: batch
with ``jax.vmap``, differentiate with ``jax.jvp`` or ``jax.grad``. A ``System`` is static and is closed over, never
traced.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rfdropo_bayes.fem import corotational, layered
from rfdropo_bayes.fem.blocktridiagonal import BlockTridiagonal, multiply, solve
from rfdropo_bayes.fem.cables import CableLayout, guide_matrix, lengths_and_jacobian, unilateral_tensions
from rfdropo_bayes.fem.layered import LayeredBody

Scalar = Float[Array, ""] | float

POISSON_LIMIT = 0.499
"""Larger Poisson ratios are taken as this one: the displacement element has no incompressible limit."""
LOST = 10.0
"""A node further from its place at rest than this many body lengths means that the rollout has diverged."""


class System(NamedTuple):
    """What does not change between rollouts: body, cables, and how many stations are held, from the first one on."""

    body: LayeredBody
    cables: CableLayout
    clamped_stations: int = 1


class Material(NamedTuple):
    """Physical parameters of one rollout."""

    young_modulus: Float[Array, ""]  # [Pa]
    poisson_ratio: Float[Array, ""]
    density: Float[Array, ""]  # [kg/m3]
    rayleigh_mass: Float[Array, ""]  # [1/s]
    rayleigh_stiffness: Float[Array, ""]  # [s]
    gravity: Float[Array, "3"]  # [m/s2]
    stiffness_scale: Float[Array, " layers"]  # factor on the stiffness of each layer
    point_mass: Float[Array, " stations"]  # lumped, in equal parts, on the nodes of each station [kg]


class Prepared(NamedTuple):
    """What is computed once a rollout."""

    stiffness: Float[Array, "layers dofs dofs"]  # of each layer in its own frame [N/m]
    packed: Float[Array, "layers 9 pairs"]  # the same, arranged for the tangent
    mass: BlockTridiagonal  # scalar: section nodes x section nodes blocks [kg]
    weight: Float[Array, "nodes 3"]  # M g [N]
    gravity: Float[Array, "3"]
    rayleigh_mass: Float[Array, ""]
    rayleigh_stiffness: Float[Array, ""]
    gradient: Float[Array, "layers nodes2 3"]
    rest: Float[Array, "layers nodes2 3"]  # node positions at rest, by layer [m]
    guides: Float[Array, "cables guides nodes"]
    rest_length: Float[Array, " cables"]  # cable lengths of the undeformed body [m]


class State(NamedTuple):
    """Mechanical state at one instant."""

    position: Float[Array, "nodes 3"]  # [m]
    velocity: Float[Array, "nodes 3"]  # [m/s]
    tension: Float[Array, " cables"]  # [N]


class StepInfo(NamedTuple):
    """How a step went."""

    diverged: Bool[Array, ""]  # the step was not finite, or left the body's surroundings, and was not taken
    cables_converged: Bool[Array, ""]


def material(
    system: System,
    *,
    young_modulus: Scalar,
    poisson_ratio: Scalar,
    density: Scalar,
    rayleigh_mass: Scalar = 0.0,
    rayleigh_stiffness: Scalar = 0.0,
    gravity: Sequence[float] | np.ndarray | Array = (0.0, 0.0, 0.0),
) -> Material:
    """Material of a body without point masses and with the stiffness of its profile; SI units as in ``Material``."""
    stations = len(system.body.station)
    return Material(
        young_modulus=jnp.asarray(young_modulus, dtype=float),
        poisson_ratio=jnp.asarray(poisson_ratio, dtype=float),
        density=jnp.asarray(density, dtype=float),
        rayleigh_mass=jnp.asarray(rayleigh_mass, dtype=float),
        rayleigh_stiffness=jnp.asarray(rayleigh_stiffness, dtype=float),
        gravity=jnp.asarray(gravity, dtype=float),
        stiffness_scale=jnp.ones(stations - 1),
        point_mass=jnp.zeros(stations),
    )


def without_cables() -> CableLayout:
    """Layout of a body that no cable pulls."""
    none = np.zeros((0, 1, 8))
    return CableLayout(np.zeros((0, 3)), none.astype(int), none, none[..., 0].astype(bool))


def prepare(system: System, material: Material) -> Prepared:
    """Stiffness, mass and loads of a body with the given material: once a rollout."""
    body = system.body
    poisson_ratio = jnp.minimum(material.poisson_ratio, POISSON_LIMIT)
    stiffness = layered.layer_stiffness(body, material.young_modulus, poisson_ratio)
    stiffness = stiffness * material.stiffness_scale[:, None, None]
    section = body.section_nodes
    layer_mass = layered.layer_mass(body) * material.density
    none = jnp.zeros((1, section, section))
    lumped = (material.point_mass / section)[:, None, None] * jnp.eye(section)
    mass = BlockTridiagonal(
        jnp.concatenate([layer_mass[:, :section, :section], none])
        + jnp.concatenate([none, layer_mass[:, section:, section:]])
        + lumped,
        layer_mass[:, section:, :section],
    )
    rest = jnp.asarray(layered.rest_positions(body))
    guides = jnp.asarray(guide_matrix(system.cables, body.nodes))
    weight = multiply(mass, jnp.broadcast_to(material.gravity, (len(body.station), section, 3)))
    return Prepared(
        stiffness=stiffness,
        packed=corotational.pack(stiffness),
        mass=mass,
        weight=weight.reshape(-1, 3),
        gravity=material.gravity,
        rayleigh_mass=material.rayleigh_mass,
        rayleigh_stiffness=material.rayleigh_stiffness,
        gradient=jnp.asarray(layered.centre_gradient(body)),
        rest=jnp.asarray(layered.rest_layers(body)),
        guides=guides,
        rest_length=lengths_and_jacobian(system.cables, guides, rest)[0],
    )


def state_at_rest(system: System) -> State:
    """The undeformed body, not moving, cables without tension."""
    rest = jnp.asarray(layered.rest_positions(system.body))
    return State(rest, jnp.zeros_like(rest), jnp.zeros(len(system.cables.anchor)))


def frames_and_displacements(
    system: System, prepared: Prepared, position: Float[Array, "nodes 3"]
) -> tuple[Float[Array, "layers 3 3"], Float[Array, "layers dofs"]]:
    """Frame of every layer and its displacement in that frame."""
    layers = layered.layer_positions(system.body, position)
    frame = corotational.frames(prepared.gradient, layers)
    return frame, corotational.local_displacement(frame, layers, prepared.rest)


def elastic_force(system: System, prepared: Prepared, position: Float[Array, "nodes 3"]) -> Float[Array, "nodes 3"]:
    """Force [N] of the deformed body on its nodes."""
    frame, displacement = frames_and_displacements(system, prepared, position)
    return corotational.internal_force(prepared.stiffness, frame, displacement).reshape(-1, 3)


def mass_times(system: System, prepared: Prepared, field: Float[Array, "nodes 3"]) -> Float[Array, "nodes 3"]:
    """Consistent mass times a nodal field."""
    return multiply(prepared.mass, field.reshape(len(system.body.station), -1, 3)).reshape(-1, 3)


def _with_axes(mass: BlockTridiagonal) -> BlockTridiagonal:
    """Scalar mass blocks repeated for the three displacement components."""
    return BlockTridiagonal(*(jnp.kron(block, jnp.eye(3)) for block in mass))


def constrained_increment(
    system: System,
    matrix: BlockTridiagonal,
    right: Float[Array, "nodes 3"],
    jacobian: Float[Array, "cables nodes 3"],
    slack: Float[Array, " cables"],
    previous: Float[Array, " cables"],
) -> tuple[Float[Array, "nodes 3"], Float[Array, " cables"], Bool[Array, ""]]:
    """Solve A u = r - J' T with T >= 0 complementary to slack - J u >= 0; u is zero on the clamped stations.

    Returns:
        the increment u (nodes, 3), the tensions, and whether the cable problem was solved.
    """
    held, stations = system.clamped_stations, len(system.body.station)
    cables = len(slack)
    columns = jnp.concatenate([right[None], jacobian]).reshape(1 + cables, stations, -1)[:, held:]
    columns = jnp.moveaxis(columns, 0, 2)
    solution = solve(BlockTridiagonal(matrix.diagonal[held:], matrix.lower[held:]), columns)
    free, response = solution[..., 0], solution[..., 1:]
    converged = jnp.array(True)
    tension = jnp.zeros(0)
    if cables:
        compliance = jnp.einsum("sbc,sbd->cd", columns[..., 1:], response)
        remaining = slack - jnp.einsum("sbc,sb->c", columns[..., 1:], free)
        tension, converged = unilateral_tensions(compliance, remaining, previous)
        free = free - response @ tension
    increment = jnp.concatenate([jnp.zeros((held, free.shape[1])), free])
    return increment.reshape(-1, 3), tension, converged


def step(
    system: System,
    prepared: Prepared,
    state: State,
    displacement: Float[Array, " cables"],
    time_step: Scalar,
    external_force: Float[Array, "nodes 3"] | float = 0.0,
) -> tuple[State, StepInfo]:
    """One implicit Euler step to the commanded cable displacements [m] (pull > 0) at its end.

    ``external_force`` [N] acts on the nodes throughout the step. A step that is not finite leaves the body where it
    was, at rest and without tension, and says so: a batch goes on.
    """
    frame, local = frames_and_displacements(system, prepared, state.position)
    force = corotational.internal_force(prepared.stiffness, frame, local).reshape(-1, 3)
    tangent = corotational.tangent(prepared.packed, frame)
    stations = len(system.body.station)
    damping = time_step + prepared.rayleigh_stiffness
    strained = multiply(tangent, state.velocity.reshape(stations, -1, 1)).reshape(-1, 3)
    dragged = prepared.rayleigh_mass * mass_times(system, prepared, state.velocity)
    right = time_step * (force + prepared.weight + external_force - damping * strained - dragged)
    mass = _with_axes(prepared.mass)
    inertia, elasticity = 1.0 + time_step * prepared.rayleigh_mass, time_step * damping
    matrix = BlockTridiagonal(*(inertia * m + elasticity * k for m, k in zip(mass, tangent, strict=True)))
    length, jacobian = lengths_and_jacobian(system.cables, prepared.guides, state.position)
    moving = jnp.einsum("cni,ni->c", jacobian, state.velocity)
    slack = (prepared.rest_length - displacement - length) / time_step - moving
    change, impulse, converged = constrained_increment(
        system, matrix, right, jacobian, slack, state.tension * time_step
    )
    velocity = state.velocity + change
    moved = State(state.position + time_step * velocity, velocity, impulse / time_step)
    return accept(system, prepared, state, moved, converged)


def accept(
    system: System, prepared: Prepared, state: State, moved: State, converged: Bool[Array, ""]
) -> tuple[State, StepInfo]:
    """The new state if it is finite and near the body, else the old one at rest."""
    reach = LOST * (system.body.station[-1] - system.body.station[0])
    away = jnp.max(jnp.abs(layered.layer_positions(system.body, moved.position) - prepared.rest))
    fine = (away < reach) & jnp.all(jnp.isfinite(moved.velocity)) & jnp.all(jnp.isfinite(moved.tension))
    stopped = State(state.position, jnp.zeros_like(state.velocity), jnp.zeros_like(state.tension))
    kept = State(*(jnp.where(fine, new, old) for new, old in zip(moved, stopped, strict=True)))
    return kept, StepInfo(diverged=~fine, cables_converged=converged | ~fine)
