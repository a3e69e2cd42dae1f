"""Implicit Euler for a corotational tetrahedral body pulled by unilateral cables: the reference engine, in JAX.

The step is that of ``fem.dynamics``, with nodal masses and the drive limits of ``fem.drives``. With
``frames="edges"``, equal node masses and a start from rest it reproduces SOFA's EulerImplicitSolver,
TetrahedronFEMForceField ("large"), UniformMass and CableConstraint under FreeMotionAnimationLoop to the digits that
SOFA's recordings hold.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rfdropo_bayes.fem import levels as level_systems
from rfdropo_bayes.fem.cables import CableLayout, guide_matrix, lengths_and_jacobian
from rfdropo_bayes.fem.constrained_step import Pull, constrained_step, meet
from rfdropo_bayes.fem.drives import DriveLimits
from rfdropo_bayes.fem.dynamics import LOST, StepInfo, accept_within
from rfdropo_bayes.fem.layered import PointMap
from rfdropo_bayes.fem.levels import LevelMatrix, Levels, node_levels
from rfdropo_bayes.fem.pushing import PushScene, untouched
from rfdropo_bayes.fem.rigid_body import Cube, CubeState
from rfdropo_bayes.fem.rollouts import Rollout, roll
from rfdropo_bayes.fem.tetrahedra import (
    TetrahedralBody,
    element_rotations,
    element_tangents,
    lame_constants,
    nodal_force,
)


class TetrahedralSystem(NamedTuple):
    """What does not change between rollouts; static, never traced."""

    body: TetrahedralBody
    levels: Levels
    cables: CableLayout
    limits: DriveLimits
    guides: Float[np.ndarray, "cables guides nodes"]
    rest_length: Float[np.ndarray, " cables"]


class TetrahedralMaterial(NamedTuple):
    """Physical parameters of one rollout."""

    young_modulus: Float[Array, ""]  # [Pa]
    poisson_ratio: Float[Array, ""]
    node_mass: Float[Array, " nodes"]  # [kg]
    rayleigh_mass: Float[Array, ""]  # [1/s]
    rayleigh_stiffness: Float[Array, ""]  # [s]
    gravity: Float[Array, "3"]  # [m/s2]
    stiffness_scale: Float[Array, " elements"]  # factor on the stiffness of each element


class TetrahedralState(NamedTuple):
    """Mechanical state at one instant, and the cable displacements measured at the start of the step before."""

    position: Float[Array, "nodes 3"]  # [m]
    velocity: Float[Array, "nodes 3"]  # [m/s]
    tension: Float[Array, " cables"]  # [N]
    measured: Float[Array, " cables"]  # [m]
    cube: CubeState | None = None  # that the body pushes
    touch: Float[Array, "pairs 3"] | None = None  # impulses of the step before between the pairs that can touch [N s]


def tetrahedral_system(body: TetrahedralBody, cables: CableLayout, limits: DriveLimits) -> TetrahedralSystem:
    """Prepare a body and its cables.

    Raises:
        InputError: parts of the mesh that hang on no held node.
    """
    guides = guide_matrix(cables, len(body.rest))
    rest_length = np.asarray(lengths_and_jacobian(cables, jnp.asarray(guides), jnp.asarray(body.rest))[0])
    return TetrahedralSystem(body, node_levels(body.element, body.fixed), cables, limits, guides, rest_length)


def state_at_rest(system: TetrahedralSystem) -> TetrahedralState:
    """The undeformed body, not moving, cables without tension."""
    rest, none = jnp.asarray(system.body.rest), jnp.zeros(len(system.rest_length))
    return TetrahedralState(rest, jnp.zeros_like(rest), none, none)


def linearised(
    system: TetrahedralSystem, material: TetrahedralMaterial, state: TetrahedralState, time_step: float
) -> tuple[LevelMatrix, Float[Array, "nodes 3"]]:
    """Matrix A and right-hand side of a step's linear system without cables, A dv = r."""
    body, levels = system.body, system.levels
    first, shear = lame_constants(material.young_modulus, material.poisson_ratio)
    lame = first * material.stiffness_scale, shear * material.stiffness_scale
    turn = element_rotations(body, state.position)
    lookahead = time_step + material.rayleigh_stiffness
    force = nodal_force(body, turn, state.position, jnp.asarray(body.rest), lame)
    force = force + lookahead * nodal_force(body, turn, state.velocity, 0.0, lame)
    mass = material.node_mass[:, None]
    right = time_step * (force + mass * (material.gravity - material.rayleigh_mass * state.velocity))
    inertia = (1.0 + time_step * material.rayleigh_mass) * material.node_mass
    matrix = level_systems.assemble(
        levels, body.element, time_step * lookahead * element_tangents(body, turn, lame), inertia
    )
    return matrix, right


def step(
    system: TetrahedralSystem,
    material: TetrahedralMaterial,
    state: TetrahedralState,
    displacement: Float[Array, " cables"],
    time_step: float,
    scene: PushScene | None = None,
    cube: Cube | None = None,
) -> tuple[TetrahedralState, StepInfo]:
    """One implicit Euler step to the commanded cable displacements [m]; with ``scene`` and ``cube`` as in
    ``fem.dynamics.step``."""
    levels = system.levels
    matrix, right = linearised(system, material, state, time_step)
    length, jacobian = lengths_and_jacobian(system.cables, jnp.asarray(system.guides), state.position)
    shortening = jnp.asarray(system.rest_length) - length
    slack = (shortening - system.limits.apply(displacement, state.measured)) / time_step

    def solved(fields: Float[Array, "columns nodes 3"]) -> Float[Array, "columns nodes 3"]:
        columns = fields[:, levels.order].reshape(len(fields), -1).T
        solution = level_systems.solve(matrix, columns).T.reshape(len(fields), -1, 3)
        return jnp.zeros_like(fields).at[:, levels.order].set(solution)

    push = None
    if scene is not None and cube is not None and state.cube is not None and state.touch is not None:
        surroundings = state.position, material.gravity, material.rayleigh_mass
        push = meet(scene, cube, state.cube, state.touch, *surroundings, time_step)
    pull = Pull(jacobian, slack, state.tension * time_step)
    found = constrained_step(solved, right, state.velocity, pull, time_step, push=push)
    velocity = state.velocity + found.increment
    tension = found.impulses.cable / time_step
    position = state.position + time_step * velocity
    moved = TetrahedralState(position, velocity, tension, shortening, found.cube, found.touch)
    reach = LOST * float(np.ptp(system.body.rest, axis=0).max())
    return accept_within(reach, moved.position - system.body.rest, state, moved, found.impulses.converged)


def simulate(
    system: TetrahedralSystem,
    material: TetrahedralMaterial,
    state: TetrahedralState,
    displacement: Float[Array, "rows substeps cables"],
    time_step: float,
    points: PointMap,
    scene: PushScene | None = None,
    cube: Cube | None = None,
    horizon: Int[Array, ""] | int | None = None,
) -> Rollout:
    """Rollout through the commanded cable displacements [m] of every step; as ``fem.simulate``."""
    if scene is not None and state.touch is None:
        state = state._replace(touch=untouched(scene))
    return roll(
        partial(step, system, material, time_step=time_step, scene=scene, cube=cube),
        state,
        displacement,
        points,
        horizon,
    )
