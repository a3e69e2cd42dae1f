"""Time steps of a corotational tetrahedral body pulled by unilateral cables: the reference engine, in JAX.

The step is that of ``fem.dynamics``, with nodal masses and the drive limits of ``fem.drives``. With implicit Euler,
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
from rfdropo_bayes.fem.cable_drive import DriveLimits
from rfdropo_bayes.fem.cables import CableLayout, guide_matrix, lengths_and_jacobian
from rfdropo_bayes.fem.constrained_step import Pull, constrained_step, meet
from rfdropo_bayes.fem.dynamics import LOST, Carried, StepInfo, accept_within, carried_from, in_stages
from rfdropo_bayes.fem.effects import Memory
from rfdropo_bayes.fem.integrators import EULER, STAGES, Integrator, Stage
from rfdropo_bayes.fem.layered import PointMap
from rfdropo_bayes.fem.levels import LevelMatrix, Levels, node_levels
from rfdropo_bayes.fem.pushing import PushGeometry, untouched
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
    """Mechanical state at one instant, and the cable displacements measured where the stage before took its forces."""

    position: Float[Array, "nodes 3"]  # [m]
    velocity: Float[Array, "nodes 3"]  # [m/s]
    tension: Float[Array, " cables"]  # [N]
    measured: Float[Array, " cables"]  # [m]
    cube: CubeState | None = None  # that the body pushes
    touch: Float[Array, "pairs 3"] | None = None  # impulses of the stage before between the pairs that can touch [N s]
    commanded: Float[Array, " cables"] | None = None  # displacements [m]; where a step has several stages
    memory: Memory = Memory()  # of effects: there are none


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
    system: TetrahedralSystem,
    material: TetrahedralMaterial,
    state: TetrahedralState,
    time_step: float,
    stage: Stage = EULER,
) -> tuple[LevelMatrix, Float[Array, "nodes 3"]]:
    """Matrix A and right-hand side of a stage's linear system without cables, A d = r, about a state."""
    body, levels, length = system.body, system.levels, stage.span * time_step
    first, shear = lame_constants(material.young_modulus, material.poisson_ratio)
    lame = first * material.stiffness_scale, shear * material.stiffness_scale
    turn = element_rotations(body, state.position)
    lookahead = length + material.rayleigh_stiffness
    behind = material.rayleigh_stiffness if stage.predicted else lookahead
    force = nodal_force(body, turn, state.position, jnp.asarray(body.rest), lame)
    force = force + behind * nodal_force(body, turn, state.velocity, 0.0, lame)
    mass = material.node_mass[:, None]
    right = length * (force + mass * (material.gravity - material.rayleigh_mass * state.velocity))
    inertia = (1.0 + length * material.rayleigh_mass) * material.node_mass
    matrix = level_systems.assemble(
        levels, body.element, length * lookahead * element_tangents(body, turn, lame), inertia
    )
    return matrix, right


def step(
    system: TetrahedralSystem,
    material: TetrahedralMaterial,
    state: TetrahedralState,
    displacement: Float[Array, " cables"],
    time_step: float,
    scene: PushGeometry | None = None,
    cube: Cube | None = None,
    integrator: Integrator = "euler",
) -> tuple[TetrahedralState, StepInfo]:
    """One time step to the commanded cable displacements [m] at its end; with ``scene``, ``cube`` and ``integrator`` as
    in ``fem.dynamics.step``."""
    take = partial(_take_stage, system, material, time_step=time_step, scene=scene, cube=cube)
    return in_stages(take, state, displacement, STAGES[integrator])


def _take_stage(
    system: TetrahedralSystem,
    material: TetrahedralMaterial,
    state: TetrahedralState,
    displacement: Float[Array, " cables"],
    stage: Stage,
    carried: Carried | None,
    *,
    time_step: float,
    scene: PushGeometry | None,
    cube: Cube | None,
) -> tuple[TetrahedralState, StepInfo, Carried | None]:
    """One stage of a step, see ``fem.integrators``."""
    levels, at, push = system.levels, state, None
    if stage.predicted:
        at = at._replace(position=state.position + stage.elapsed * time_step * state.velocity)
    if scene is not None and cube is not None and state.cube is not None and state.touch is not None:
        around = material.gravity, material.rayleigh_mass
        change = None if carried is None else carried.twist
        place = at.position, at.velocity, around
        push, stage = meet(scene, cube, state.cube, state.touch, *place, stage, time_step, change)
    length = stage.span * time_step
    matrix, right = linearised(system, material, at, time_step, stage)
    if carried is not None:
        right = right + stage.going * (material.node_mass[:, None] * carried.velocity - carried.sudden)
    reach, jacobian = lengths_and_jacobian(system.cables, jnp.asarray(system.guides), at.position)
    shortening = jnp.asarray(system.rest_length) - reach
    slack = (shortening - system.limits.apply(displacement, state.measured)) / length

    def solved(fields: Float[Array, "columns nodes 3"]) -> Float[Array, "columns nodes 3"]:
        columns = fields[:, levels.order].reshape(len(fields), -1).T
        solution = level_systems.solve(matrix, columns).T.reshape(len(fields), -1, 3)
        return jnp.zeros_like(fields).at[:, levels.order].set(solution)

    pull = Pull(jacobian, slack, state.tension * length)
    found = constrained_step(solved, right, state.velocity, pull, stage, time_step, push=push)
    velocity = state.velocity + found.increment
    tension = found.impulses.cable / length
    position = at.position + length * (found.increment if stage.predicted else velocity)
    moved = TetrahedralState(position, velocity, tension, shortening, found.cube, found.touch, state.commanded)
    far = LOST * float(np.ptp(system.body.rest, axis=0).max())
    taken, info = accept_within(far, moved.position - system.body.rest, state, moved, found.impulses.converged)
    return taken, info, carried_from(state, taken, found, info) if stage.predicted else None


def simulate(
    system: TetrahedralSystem,
    material: TetrahedralMaterial,
    state: TetrahedralState,
    displacement: Float[Array, "rows substeps cables"],
    time_step: float,
    points: PointMap,
    scene: PushGeometry | None = None,
    cube: Cube | None = None,
    horizon: Int[Array, ""] | int | None = None,
    integrator: Integrator = "euler",
) -> Rollout:
    """Rollout through the commanded cable displacements [m] of every step; as ``fem.simulate``."""
    if scene is not None and state.touch is None:
        state = state._replace(touch=untouched(scene))
    if len(STAGES[integrator]) > 1 and state.commanded is None:
        state = state._replace(commanded=jnp.zeros(len(system.rest_length)))
    return roll(
        partial(step, system, material, time_step=time_step, scene=scene, cube=cube, integrator=integrator),
        state,
        displacement,
        points,
        horizon,
    )
