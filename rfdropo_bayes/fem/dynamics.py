"""Time steps of a layered corotational body pulled by unilateral cables: one linear solve a stage.

    A d = q (f(x) + M g + f_ext - (r + b) K v - a M v) - q J' T,    A = (1 + q a) M + q (q + b) K,    v1 = v + d

with Rayleigh damping a M + b K, the corotational tangent K, cable Jacobian J = dl/dx and tensions T >= 0 (Baraff and
Witkin 1998). Implicit Euler takes its forces where the step starts, with q = r = h: the linearised step of SOFA's
EulerImplicitSolver. SDIRK2 takes them where the velocity leads, r = 0, see ``integrators``. What taut cables and
layers hold against lateral motion (`cable_strings`, `tension_stiffening`) is implicit too: under opposed cables it
exceeds the body's own stiffness, and steps that leave it out swing. What ``effects`` add is implicit in the same way:
their force, linearised, at the end of the stage. Everything is a pure function of arrays: batch with ``jax.vmap``,
differentiate with ``jax.jvp`` or ``jax.grad``. A ``System`` is static and is closed over, never traced.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rfdropo_bayes.fem import corotational, layered
from rfdropo_bayes.fem.bending_law import Sections, moments, sections
from rfdropo_bayes.fem.blocktridiagonal import BlockTridiagonal, at_stations, multiply, solve
from rfdropo_bayes.fem.cable_friction import slip_problem, slipped, start_slip
from rfdropo_bayes.fem.cable_strings import crossing_weights, string_stiffness
from rfdropo_bayes.fem.cables import CableLayout, guide_matrix, lengths_and_jacobian
from rfdropo_bayes.fem.constrained_step import ConstrainedStep, Pull, Push, Solve, constrained_step, meet
from rfdropo_bayes.fem.effects import BodyEffects, Memory, Scalar
from rfdropo_bayes.fem.integrators import EULER, STAGES, Integrator, Stage
from rfdropo_bayes.fem.layered import LayeredBody
from rfdropo_bayes.fem.pushing import PushGeometry, unchanged, untouched
from rfdropo_bayes.fem.rigid_body import Cube, CubeState
from rfdropo_bayes.fem.surroundings import SectionLoad, section_load
from rfdropo_bayes.fem.tension_stiffening import lateral_stiffening, layer_tension

POISSON_LIMIT = 0.499
"""Larger Poisson ratios are taken as this one: the displacement element has no incompressible limit."""
LOST = 3.0
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
    effects: BodyEffects = BodyEffects()


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
    effects: BodyEffects
    sections: Sections | None  # where the body has a bending law
    firmness: Float[Array, ""] | None = None  # factor on the stiffness in a step, see ``section_loads``


class State(NamedTuple):
    """Mechanical state at one instant."""

    position: Float[Array, "nodes 3"]  # [m]
    velocity: Float[Array, "nodes 3"]  # [m/s]
    tension: Float[Array, " cables"]  # [N]
    memory: Memory = Memory()  # of the effects; see ``remembering``
    cube: CubeState | None = None  # that the body pushes
    touch: Float[Array, "pairs 3"] | None = None  # impulses of the stage before between the pairs that can touch [N s]
    commanded: Float[Array, " cables"] | None = None  # displacements [m]; where a step has several stages


AnyState = TypeVar("AnyState")
"""`State`, or that of another body: position, velocity, tension, cube and touch are there."""


class StepInfo(NamedTuple):
    """How a step went."""

    diverged: Bool[Array, ""]  # the step was not finite, or left the body's surroundings, and was not taken
    converged: Bool[Array, ""]  # whether the impulses of all constraints were found


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
    lumped = (material.point_mass / section)[:, None, None] * jnp.eye(section)
    mass = BlockTridiagonal(
        at_stations(layer_mass[:, :section, :section], layer_mass[:, section:, section:]) + lumped,
        layer_mass[:, section:, :section],
    )
    rest = jnp.asarray(layered.rest_positions(body))
    guides = jnp.asarray(guide_matrix(system.cables, body.nodes))
    weight = multiply(mass, jnp.broadcast_to(material.gravity, (len(body.station), section, 3)))
    bends = material.effects.bending is not None
    rotations = sections(body, material.young_modulus, poisson_ratio, material.stiffness_scale) if bends else None
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
        effects=material.effects,
        sections=rotations,
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


def resistance(
    prepared: Prepared, local: Float[Array, "layers dofs"]
) -> tuple[Float[Array, "layers dofs"], Float[Array, "layers 9 pairs"]]:
    """What every layer resists [N] at a displacement in its frame, and its tangent, packed: elasticity and bending
    law."""
    force = jnp.einsum("lij,lj->li", prepared.stiffness, local)
    if prepared.effects.bending is None or prepared.sections is None:
        return force, prepared.packed
    moment, slope = moments(prepared.effects.bending, prepared.sections, local)
    rotation = prepared.sections.rotation
    added = jnp.einsum("lia,lij,ljb->lab", rotation, slope, rotation)
    return force + jnp.einsum("lia,li->la", rotation, moment), prepared.packed + corotational.pack(added)


def mass_times(system: System, prepared: Prepared, field: Float[Array, "nodes 3"]) -> Float[Array, "nodes 3"]:
    """Consistent mass times a nodal field."""
    return multiply(prepared.mass, field.reshape(len(system.body.station), -1, 3)).reshape(-1, 3)


def section_means(system: System, field: Float[Array, "nodes 3"]) -> Float[Array, "stations 3"]:
    """Mean of a nodal field over the nodes of every station."""
    return jnp.mean(field.reshape(len(system.body.station), -1, 3), axis=1)


def shared(system: System, force: Float[Array, "stations 3"]) -> Float[Array, "nodes 3"]:
    """Forces on sections in equal parts on their nodes."""
    return jnp.repeat(force / system.body.section_nodes, system.body.section_nodes, axis=0)


def with_section_matrix(
    system: System, matrix: BlockTridiagonal, added: Float[Array, "stations 3 3"]
) -> BlockTridiagonal:
    """Add matrices that act on the mean motion of every section."""
    nodes = system.body.section_nodes
    blocks = jax.vmap(lambda part: jnp.kron(jnp.full((nodes, nodes), 1.0 / nodes**2), part))(added)
    return BlockTridiagonal(matrix.diagonal + blocks, matrix.lower)


def remembering(
    system: System,
    prepared: Prepared,
    state: State,
    scene: PushGeometry | None = None,
    integrator: Integrator = "euler",
) -> State:
    """The state with the memory that effects and contacts start from: clock at zero, branches relaxed, no friction.

    A memory that is there is kept. Cables of which it is not said were not pulled.
    """
    effects, memory = prepared.effects, state.memory
    if len(STAGES[integrator]) > 1 and state.commanded is None:
        state = state._replace(commanded=jnp.zeros(len(system.cables.anchor)))
    if scene is not None and state.touch is None:
        state = state._replace(touch=untouched(scene))
    if jax.tree.leaves(memory):
        return state
    if effects.softening_rate is not None:
        memory = memory._replace(clock=jnp.zeros(()))
    if effects.viscoelasticity is not None:
        memory = memory._replace(branch=frames_and_displacements(system, prepared, state.position)[1])
    friction = start_slip(system.cables, effects, state.tension)
    return state._replace(memory=memory._replace(slip=friction.slip, segment=friction.segment))


def strings(
    system: System,
    prepared: Prepared,
    frame: Float[Array, "layers 3 3"],
    position: Float[Array, "nodes 3"],
    tension: Float[Array, " cables"],
    ahead: bool = False,
) -> Float[Array, "layers dofs dofs"]:
    """What taut cables add to the stiffness of every layer in its frame; ``ahead``: see `string_stiffness`."""
    turned = corotational.turned_back(frame, layered.layer_positions(system.body, position))
    weights, nodes = crossing_weights(system.body, system.cables), 2 * system.body.section_nodes
    return string_stiffness(system.body, weights, prepared.gradient, turned.reshape(-1, nodes, 3), tension, ahead)


class _Elastic(NamedTuple):
    """Elastic forces of a stage: those where it is linearised, and how they change to its end."""

    frame: Float[Array, "layers 3 3"]
    resistance: Float[Array, "layers dofs"]  # in the frames, to strain and its rate
    force: Float[Array, "nodes 3"]
    tangent: BlockTridiagonal
    lookahead: Scalar  # [s] times the tangent times the change of velocity is the change of force
    behind: Scalar  # [s] times the tangent times the velocity is what the force lacks


def _gain(prepared: Prepared, length: Scalar) -> tuple[Scalar, Scalar]:
    """Share of its strain that the dashpot of a Prony branch follows in a stage, and stiffness of the branch."""
    viscous = prepared.effects.viscoelasticity
    if viscous is None:
        return jnp.zeros(()), jnp.zeros(())
    share = length / (viscous.time + length)
    return share, viscous.fraction * (1.0 - share)


def within(system: System, prepared: Prepared, state: State, time_step: Scalar, stage: Stage = EULER) -> Memory:
    """Memory of the effects within a stage that starts from a state: the clock at its end, dashpots at its start.

    The strain q of a Prony branch's dashpot follows q' = (u - q) / tau as the velocity follows the forces. In implicit
    Euler its force at the end of a step is gamma K (u - q) with gamma = fraction tau / (tau + h) and q of the start
    (Simo and Hughes 1998, Computational Inelasticity, ch. 10). It follows when the place it follows to is known.
    """
    memory = state.memory
    if memory.branch is not None:
        share = (1.0 + stage.carried) * _gain(prepared, stage.length * time_step)[0]
        local = frames_and_displacements(system, prepared, state.position)[1]
        memory = memory._replace(branch=memory.branch + share * (local - memory.branch))
    if memory.clock is not None:
        memory = memory._replace(clock=memory.clock + stage.elapsed * time_step)
    return memory


def _elastic(system: System, prepared: Prepared, state: State, stage: Stage, time_step: Scalar) -> _Elastic:
    """Elastic force with what viscoelasticity and softening make of it."""
    length, memory = stage.span * time_step, state.memory
    frame, local = frames_and_displacements(system, prepared, state.position)
    force, packed = resistance(prepared, local)
    gain, left = _gain(prepared, stage.length * time_step)[1], jnp.ones(())
    if memory.branch is not None:
        force = force + gain * jnp.einsum("lij,lj->li", prepared.stiffness, local - memory.branch)
    if prepared.effects.softening_rate is not None and memory.clock is not None:
        left = jnp.exp(-prepared.effects.softening_rate * memory.clock)
        force, packed = left * force, left * packed
    if prepared.firmness is not None:
        left, force, packed = prepared.firmness * left, prepared.firmness * force, prepared.firmness * packed
    lookahead = length * (1.0 + gain) + prepared.rayleigh_stiffness
    behind = prepared.rayleigh_stiffness if stage.predicted else lookahead
    taut = strings(system, prepared, frame, state.position, state.tension, stage.predicted)
    tangent = corotational.tangent(packed + length / lookahead * corotational.pack(taut), frame)
    moving = corotational.turned_back(frame, layered.layer_positions(system.body, state.velocity))
    viscous_force = left * behind * jnp.einsum("lij,lj->li", prepared.stiffness, moving)
    acting = force
    if stage.predicted:  # cables hold against motion from here on; the tangent knows nothing of that
        acting = force - behind * length / lookahead * jnp.einsum("lij,lj->li", taut, moving)
    nodal = corotational.internal_force(frame, acting).reshape(-1, 3)
    return _Elastic(frame, force + viscous_force, nodal, tangent, lookahead, behind)


def _surround(
    system: System,
    load: SectionLoad | None,
    matrix: BlockTridiagonal,
    right: Float[Array, "nodes 3"],
    velocity: Float[Array, "stations 3"],
    stage: Stage,
    time_step: Scalar,
) -> tuple[BlockTridiagonal, Float[Array, "nodes 3"]]:
    """Matrix and right-hand side of a stage with the loads on its sections."""
    if load is None:
        return matrix, right
    length, force = stage.span * time_step, load.force
    if not stage.predicted:
        force = force - length * jnp.einsum("sij,sj->si", load.stiffness, velocity)
    added = length * load.damping + length**2 * load.stiffness
    return with_section_matrix(system, matrix, added), right + length * shared(system, force)


def _taut(system: System, prepared: Prepared, state: State, elastic: _Elastic, length: Scalar) -> BlockTridiagonal:
    """What layers in tension hold against lateral motion, times the length of the stage squared."""
    jacobian = lengths_and_jacobian(system.cables, prepared.guides, state.position)[1]
    cable = -jnp.einsum("cni,c->ni", jacobian, state.tension)
    tension = layer_tension(system.body, elastic.resistance, cable, elastic.frame)
    return lateral_stiffening(system.body, elastic.frame, length**2 * tension)


class Linear(NamedTuple):
    """A stage's linear system A d = r without cables, for the change d of the velocity."""

    matrix: BlockTridiagonal
    right: Float[Array, "nodes 3"]


def linearised(
    system: System,
    prepared: Prepared,
    state: State,
    time_step: Scalar,
    external_force: Float[Array, "nodes 3"] | float = 0.0,
    stage: Stage = EULER,
) -> Linear:
    """Linearise the body, its effects and its surroundings about a state, with the memory of the stage."""
    elastic, length = _elastic(system, prepared, state, stage, time_step), stage.span * time_step
    stations = len(system.body.station)
    strained = multiply(elastic.tangent, state.velocity.reshape(stations, -1, 1)).reshape(-1, 3)
    dragged = prepared.rayleigh_mass * mass_times(system, prepared, state.velocity)
    load = prepared.weight + external_force
    right = length * (elastic.force + load - elastic.behind * strained - dragged)
    inertia, elasticity = 1.0 + length * prepared.rayleigh_mass, length * elastic.lookahead
    mass = [jnp.kron(block, jnp.eye(3)) for block in prepared.mass]  # for the three components
    matrix = BlockTridiagonal(*(inertia * m + elasticity * k for m, k in zip(mass, elastic.tangent, strict=True)))
    taut = _taut(system, prepared, state, elastic, length)
    matrix = BlockTridiagonal(*(m + k for m, k in zip(matrix, taut, strict=True)))
    if not stage.predicted:
        right = right - multiply(taut, state.velocity.reshape(stations, -1, 1)).reshape(-1, 3)
    centre, drift = section_means(system, state.position), section_means(system, state.velocity)
    around = section_load(system.body, prepared.effects, centre, drift, steep=stage.predicted)
    matrix, right = _surround(system, around, matrix, right, drift, stage, time_step)
    return Linear(matrix, right)


class Carried(NamedTuple):
    """What the stage before did, with a share of which the motion goes on; nothing before the first stage."""

    velocity: Float[Array, "nodes 3"]  # change in it [m/s]
    sudden: Float[Array, "nodes 3"]  # impacts in it [N s]: no share of them
    twist: Float[Array, "6"] | None  # change of the cube's velocity and spin, without these
    slip: Float[Array, "kinds cables cable_runs"] | None  # change of the friction mobilised


def step(
    system: System,
    prepared: Prepared,
    state: State,
    displacement: Float[Array, " cables"],
    time_step: Scalar,
    external_force: Float[Array, "nodes 3"] | float = 0.0,
    scene: PushGeometry | None = None,
    cube: Cube | None = None,
    integrator: Integrator = "euler",
) -> tuple[State, StepInfo]:
    """One time step to the commanded cable displacements [m] (pull > 0) at its end.

    ``external_force`` [N] acts on the nodes throughout the step. With a ``scene`` and a ``cube`` the body touches them;
    the state says where the cube is. A step that is not finite leaves everything where it was, at rest and without
    tension, and says so: a batch goes on. Where there is a scene, the material has effects with a memory, or a step has
    several stages, the state comes from ``remembering``.
    """
    take = partial(take_stage, system, prepared, time_step=time_step, external=external_force, scene=scene, cube=cube)
    return in_stages(take, state, displacement, STAGES[integrator])


def in_stages(
    take: Callable[[Any, Float[Array, " cables"], Stage, Carried | None], tuple[Any, StepInfo, Carried | None]],
    state: AnyState,
    displacement: Float[Array, " cables"],
    stages: Sequence[Stage],
) -> tuple[AnyState, StepInfo]:
    """A step of any body, given how it takes a stage; commands within the step lie on the way to those at its end."""
    here: Any = state
    start = here.commanded
    if start is None:
        return take(here, displacement, stages[0], None)[:2]
    elapsed, codes, carried = 0.0, StepInfo(jnp.array(False), jnp.array(True)), None
    for stage in stages:
        elapsed += stage.elapsed
        here, info, carried = take(here, start + elapsed * (displacement - start), stage, carried)
        codes = StepInfo(codes.diverged | info.diverged, codes.converged & info.converged)
    return here._replace(commanded=displacement), codes


class StageBegun(NamedTuple):
    """What a stage solves, before its constraints."""

    at: State  # where forces are taken, with the memory of the stage
    push: Push | None
    stage: Stage  # made longer by impacts
    linear: Linear


def begin_stage(
    system: System,
    prepared: Prepared,
    state: State,
    stage: Stage,
    carried: Carried | None,
    *,
    time_step: Scalar,
    external: Float[Array, "nodes 3"] | float = 0.0,
    scene: PushGeometry | None = None,
    cube: Cube | None = None,
) -> StageBegun:
    """Linearise a stage that starts from a state; ``carried`` is of the stage before."""
    at = state._replace(memory=within(system, prepared, state, time_step, stage))
    if stage.predicted:
        at = at._replace(position=state.position + stage.elapsed * time_step * state.velocity)
    push = None
    if scene is not None and cube is not None and state.cube is not None and state.touch is not None:
        around = prepared.gravity, prepared.rayleigh_mass
        change = None if carried is None else carried.twist
        place = at.position, at.velocity, around
        push, stage = meet(scene, cube, state.cube, state.touch, *place, stage, time_step, change)
    linear = linearised(system, prepared, at, time_step, external, stage)
    if carried is not None:
        going = mass_times(system, prepared, carried.velocity) - carried.sudden
        linear = linear._replace(right=linear.right + stage.going * going)
    return StageBegun(at, push, stage, linear)


def take_stage(
    system: System,
    prepared: Prepared,
    state: State,
    displacement: Float[Array, " cables"],
    stage: Stage,
    carried: Carried | None,
    *,
    time_step: Scalar,
    external: Float[Array, "nodes 3"] | float = 0.0,
    scene: PushGeometry | None = None,
    cube: Cube | None = None,
) -> tuple[State, StepInfo, Carried | None]:
    """One stage of a step, see ``fem.integrators``."""
    around: dict[str, Any] = {"time_step": time_step, "external": external, "scene": scene, "cube": cube}
    at, push, stage, (matrix, right) = begin_stage(system, prepared, state, stage, carried, **around)
    length, slip = stage.span * time_step, None
    mobilised, segment = state.memory.slip, state.memory.segment
    if mobilised is not None and segment is not None:
        if carried is not None and carried.slip is not None:
            mobilised = jnp.clip(mobilised + stage.carried * carried.slip, -1.0, 1.0)
        slip = slip_problem(system.cables, prepared.effects, mobilised, segment, prepared.guides, at.position)
    pull = _pull(system, prepared, at, displacement, length)
    found = constrained_step(free_solve(system, matrix), right, at.velocity, pull, stage, time_step, slip, push)
    velocity, tension = at.velocity + found.increment, found.impulses.cable / length
    memory = at.memory
    if slip is not None:
        share, segment = slipped(system.cables, slip, found.impulses.share, tension)
        memory = memory._replace(slip=share, segment=segment)
    position = at.position + length * (found.increment if stage.predicted else velocity)
    moved = State(position, velocity, tension, memory, found.cube, found.touch, state.commanded)
    taken, info = accept(system, prepared, state, moved, found.impulses.converged)
    return taken, info, carried_from(state, taken, found, info) if stage.predicted else None


def carried_from(before: Any, after: Any, found: ConstrainedStep, info: StepInfo) -> Carried:
    """What a stage of any body did that was taken; nothing where it was not."""
    twist = slip = None
    if before.cube is not None and after.cube is not None and found.sudden_twist is not None:
        parts = after.cube.velocity - before.cube.velocity, after.cube.spin - before.cube.spin
        twist = jnp.concatenate(parts) - found.sudden_twist
    if before.memory.slip is not None and after.memory.slip is not None:
        slip = after.memory.slip - before.memory.slip
    changes = Carried(after.velocity - before.velocity, jnp.asarray(found.sudden), twist, slip)
    return jax.tree.map(lambda change: jnp.where(info.diverged, 0.0, change), changes)


def free_solve(system: System, matrix: BlockTridiagonal) -> Solve:
    """Solutions of the matrix's system at the stations that are free."""
    held, stations = system.clamped_stations, len(system.body.station)

    def solved(fields: Float[Array, "columns nodes 3"]) -> Float[Array, "columns nodes 3"]:
        columns = jnp.moveaxis(fields.reshape(len(fields), stations, -1)[:, held:], 0, 2)
        solution = solve(BlockTridiagonal(matrix.diagonal[held:], matrix.lower[held:]), columns)
        full = jnp.concatenate([jnp.zeros((held, *solution.shape[1:])), solution])
        return jnp.moveaxis(full, 2, 0).reshape(fields.shape)

    return solved


def _pull(
    system: System, prepared: Prepared, state: State, displacement: Float[Array, " cables"], length: Scalar
) -> Pull:
    """The cables of a stage to their commanded displacements."""
    reach, jacobian = lengths_and_jacobian(system.cables, prepared.guides, state.position)
    compliance = prepared.effects.cable_compliance
    give = 0.0 if compliance is None else compliance / length**2
    slack = (prepared.rest_length - displacement - reach) / length
    return Pull(jacobian, slack, state.tension * length, give)


def accept(
    system: System, prepared: Prepared, state: State, moved: State, converged: Bool[Array, ""]
) -> tuple[State, StepInfo]:
    """The new state if it is finite and near the body, else the old one at rest."""
    away = layered.layer_positions(system.body, moved.position) - prepared.rest
    return accept_within(LOST * (system.body.station[-1] - system.body.station[0]), away, state, moved, converged)


def accept_within(
    reach: float, away: Float[Array, "..."], state: AnyState, moved: AnyState, converged: Bool[Array, ""]
) -> tuple[AnyState, StepInfo]:
    """The new state of any body if it is finite and no coordinate is ``reach`` away from its place at rest, else the
    old one at rest [m]."""
    old: Any = state
    new: Any = moved
    fine = (jnp.max(jnp.abs(away)) < reach) & jnp.all(jnp.isfinite(new.velocity)) & jnp.all(jnp.isfinite(new.tension))
    cube = None
    if old.cube is not None and new.cube is not None:
        fine = fine & jnp.all(jnp.isfinite(new.cube.position))
        cube = unchanged(old.cube, new.cube, fine)
    velocity, tension, touch = jax.tree.map(jnp.zeros_like, (old.velocity, old.tension, old.touch))
    stopped = old._replace(velocity=velocity, tension=tension, cube=None, touch=touch)
    kept = jax.tree.map(lambda after, before: jnp.where(fine, after, before), new._replace(cube=None), stopped)
    return kept._replace(cube=cube), StepInfo(diverged=~fine, converged=converged | ~fine)
