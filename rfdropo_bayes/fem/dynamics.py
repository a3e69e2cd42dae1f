"""Time steps of a rod pulled by unilateral cables: one linear solve a stage.

    A d = q (f(x) + m g + f_ext - r K v - a M v - gyro) + q J' T,    A = (1 + q a) M + q (q + b) K,    v1 = v + d

for velocities and spins, with lumped mass and rotary inertia M, Rayleigh damping a M + b K, the tangent K of the
elements (``rod_elements``), cable Jacobian J and tensions T >= 0. Implicit Euler takes its forces at the start of the
step, with q = h and r = h + b; SDIRK2 at the position predicted by the velocity, r = b, see ``integrators``. Forces of
``effects`` are implicit in the same way: linearised at the end of the stage. Everything is a pure function of arrays:
batch with ``jax.vmap``, differentiate with ``jax.jvp`` or ``jax.grad`` (``stage_solve``). A ``System`` is static and is
closed over, never traced.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from rfdropo_bayes.fem import rod_elements
from rfdropo_bayes.fem.cable_friction import PRESLIDING, Slip, slip_problem, slip_rows, slipped, start_slip
from rfdropo_bayes.fem.cables import CableLayout, rest_lengths, threads
from rfdropo_bayes.fem.chambers import Layout, inflation
from rfdropo_bayes.fem.components import rotation, turned
from rfdropo_bayes.fem.constraints import Slips
from rfdropo_bayes.fem.effects import BodyEffects, Memory, Scalar
from rfdropo_bayes.fem.integrators import EULER, STAGES, Integrator, Stage
from rfdropo_bayes.fem.push_rows import Push, meet, pushed_rows, released
from rfdropo_bayes.fem.pushing import PushGeometry, unchanged, untouched
from rfdropo_bayes.fem.rigid_body import Cube, CubeState
from rfdropo_bayes.fem.rod import Rod, inertia_per_density
from rfdropo_bayes.fem.sections import Sections, sections
from rfdropo_bayes.fem.stage_solve import Bonds, StageBody, Way, solve_stage
from rfdropo_bayes.fem.surroundings import section_load

LOST = 3.0
"""A station further from its place at rest than this many body lengths means that the rollout has diverged."""


class System(NamedTuple):
    """Constants of all rollouts: body, cables, number of clamped stations (the first ones), and chambers.

    Its drives are the displacements of the cables [m], then the pressures of the chambers [Pa].
    """

    body: Rod
    cables: CableLayout
    clamped_stations: int = 1
    chambers: Layout | None = None

    @property
    def drives(self) -> int:
        """Number of cables and chambers."""
        return len(self.cables.anchor) + (0 if self.chambers is None else len(self.chambers))

    def split(self, drive: Float[Array, " drives"]) -> tuple[Float[Array, " cables"], Float[Array, " chambers"] | None]:
        """Displacements of the cables [m], and pressures of the chambers [Pa]; None without chambers."""
        cables = len(self.cables.anchor)
        return drive[:cables], None if self.chambers is None else drive[cables:]


class Material(NamedTuple):
    """Physical parameters of one rollout."""

    young_modulus: Float[Array, ""]  # [Pa]
    poisson_ratio: Float[Array, ""]
    density: Float[Array, ""]  # [kg/m3]
    rayleigh_mass: Float[Array, ""]  # [1/s]
    rayleigh_stiffness: Float[Array, ""]  # [s]
    gravity: Float[Array, "3"]  # [m/s2]
    stiffness_scale: Float[Array, " elements"]  # factor on the stiffness of each element
    point_mass: Float[Array, " stations"]  # lumped at each station [kg]
    axial_scale: Scalar = 1.0  # factor on the stiffness in tension of every element; bending keeps its own
    effects: BodyEffects = BodyEffects()


class Prepared(NamedTuple):
    """Quantities computed once per rollout."""

    section: Sections
    mass: Float[Array, " stations"]  # [kg]
    inertia: Float[Array, "stations 3"]  # about the axes of the sections [kg m2]
    gravity: Float[Array, "3"]
    rayleigh_mass: Float[Array, ""]
    rayleigh_stiffness: Float[Array, ""]
    rest_length: Float[Array, " cables"]  # cable lengths of the undeformed body [m]
    effects: BodyEffects
    firmness: Float[Array, ""] | None = None  # factor on the stiffness in a step, see ``section_loads``

    @property
    def weight(self) -> Float[Array, "stations 3"]:
        """[N]."""
        return self.mass[:, None] * self.gravity


class State(NamedTuple):
    """Mechanical state at one instant."""

    position: Float[Array, "stations 3"]  # of the centre line [m]
    orientation: Float[Array, "stations 4"]  # unit quaternions (w, x, y, z) of the sections
    velocity: Float[Array, "stations 3"]  # [m/s]
    spin: Float[Array, "stations 3"]  # [rad/s], in space
    tension: Float[Array, " cables"]  # [N]
    memory: Memory = Memory()  # of the effects; see ``remembering``
    cube: CubeState | None = None  # that the body pushes
    touch: Float[Array, "pairs 3"] | None = None  # impulses of the stage before between the pairs that can touch [N s]
    commanded: Float[Array, " drives"] | None = None  # drives; if a step has several stages


class StepInfo(NamedTuple):
    """Diagnostics of a step."""

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
    none, guides, piece = np.zeros((0, 1, 2)), np.zeros((0, 1)), np.zeros((0, 1, 1))
    arm, used = np.zeros((0, 1, 2, 3)), guides.astype(bool)
    return CableLayout(np.zeros((0, 3)), none.astype(int), none, arm, used, guides, piece.astype(int), piece, piece)


def prepare(system: System, material: Material) -> Prepared:
    """Stiffness, mass and loads of a body with the given material: once a rollout."""
    body, effects = system.body, material.effects
    section = sections(body, effects, material.young_modulus, material.poisson_ratio, material.stiffness_scale)
    section = section._replace(stretch=section.stretch.at[2].multiply(material.axial_scale))
    volume, moment = inertia_per_density(body)
    return Prepared(
        section=section,
        mass=material.density * volume + material.point_mass,
        inertia=material.density * moment,
        gravity=material.gravity,
        rayleigh_mass=material.rayleigh_mass,
        rayleigh_stiffness=material.rayleigh_stiffness,
        rest_length=jnp.asarray(rest_lengths(system.cables, body)),
        effects=effects,
    )


def state_at_rest(system: System) -> State:
    """The undeformed body, not moving, cables without tension."""
    station = jnp.asarray(system.body.station)
    none = jnp.zeros((len(station), 3))
    upright = jnp.zeros((len(station), 4)).at[:, 0].set(1.0)
    return State(none.at[:, 2].set(station), upright, none, none, jnp.zeros(len(system.cables.anchor)))


def strains(system: System, prepared: Prepared, state: State) -> Float[Array, "elements 6"]:
    """Strains of all elements: shear (2), stretch; curvature (2) and twist [1/m]."""
    length = jnp.asarray(np.diff(system.body.station))
    return rod_elements.shape(length, state.position.T, state.orientation.T, prepared.section.inner).strain.T


def twist_of(state: State) -> Float[Array, "stations 6"]:
    """Velocities and spins."""
    return jnp.concatenate([state.velocity, state.spin], axis=1)


def momentum(prepared: Prepared, state: State, twist: Float[Array, "stations 6"]) -> Float[Array, "stations 6"]:
    """Momentum, and spin about each station, at these velocities and spins."""
    frame = rotation(state.orientation.T)
    turning = jnp.einsum("ijs,sj,kjs,sk->si", frame, prepared.inertia, frame, twist[:, 3:])
    return jnp.concatenate([prepared.mass[:, None] * twist[:, :3], turning], axis=1)


def displaced(state: State, way: Float[Array, "stations 6"]) -> State:
    """The state with its stations moved and turned by vectors in space [m], [rad]."""
    orientation = turned(state.orientation.T, way[:, 3:].T).T
    return state._replace(position=state.position + way[:, :3], orientation=orientation)


def remembering(
    system: System,
    prepared: Prepared,
    state: State,
    scene: PushGeometry | None = None,
    integrator: Integrator = "euler",
) -> State:
    """The state with the memory that effects and contacts start from: clock at zero, branches relaxed, no friction.

    A memory that is there is kept. Drives that are not given are zero.
    """
    effects, memory = prepared.effects, state.memory
    if len(STAGES[integrator]) > 1 and state.commanded is None:
        state = state._replace(commanded=jnp.zeros(system.drives))
    if scene is not None and state.touch is None:
        state = state._replace(touch=untouched(scene))
    if jax.tree.leaves(memory):
        return state
    if effects.softening_rate is not None:
        memory = memory._replace(clock=jnp.zeros(()))
    if effects.viscoelasticity is not None:
        memory = memory._replace(branch=strains(system, prepared, state))
    friction = start_slip(system.cables, effects, state.tension)
    return state._replace(memory=memory._replace(slip=friction.slip, segment=friction.segment))


class Carried(NamedTuple):
    """Changes in the previous stage, a share of which is carried on; zero before the first stage."""

    velocity: Float[Array, "stations 6"]  # change of velocities and spins in it
    sudden: Float[Array, "stations 6"]  # impacts in it [N s], [N m s]: no share of them
    twist: Float[Array, "6"] | None  # change of the cube's velocity and spin, without these
    slip: Float[Array, "kinds cables cable_runs"] | None  # change of the friction mobilised


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
    (Simo and Hughes 1998, Computational Inelasticity, ch. 10). It is updated once u is known.
    """
    memory = state.memory
    if memory.branch is not None:
        share = (1.0 + stage.carried) * _gain(prepared, stage.length * time_step)[0]
        memory = memory._replace(branch=memory.branch + share * (strains(system, prepared, state) - memory.branch))
    if memory.clock is not None:
        memory = memory._replace(clock=memory.clock + stage.elapsed * time_step)
    return memory


def firm(prepared: Prepared, memory: Memory) -> Sections:
    """The sections with their stiffness after softening and ``section_loads``."""
    section, stiffness = prepared.section, None
    if prepared.effects.softening_rate is not None and memory.clock is not None:
        stiffness = jnp.exp(-prepared.effects.softening_rate * memory.clock)
    if prepared.firmness is not None:
        stiffness = prepared.firmness if stiffness is None else stiffness * prepared.firmness
    if stiffness is None:
        return section
    return section._replace(stretch=stiffness * section.stretch, bending=stiffness * section.bending)


def stage_body(
    system: System,
    prepared: Prepared,
    state: State,
    time_step: Scalar,
    external: Float[Array, "stations 6"] | float = 0.0,
    stage: Stage = EULER,
    carried: Carried | None = None,
    pressure: Float[Array, " chambers"] | None = None,
) -> StageBody:
    """The system that a stage linearises: the body, its effects and its surroundings at a state, with the memory of the
    stage.
    """
    length, memory = stage.span * time_step, state.memory
    gain = _gain(prepared, stage.length * time_step)[1]
    lookahead = length * (1.0 + gain) + prepared.rayleigh_stiffness
    load = jnp.pad(prepared.weight, ((0, 0), (0, 3))) + external
    added = None
    around = section_load(system.body, prepared.effects, state.position, state.velocity, steep=stage.predicted)
    if around is not None:
        force = around.force
        if not stage.predicted:
            force = force - length * jnp.einsum("sij,sj->si", around.stiffness, state.velocity)
        load = load + jnp.pad(force, ((0, 0), (0, 3)))
        added = jnp.moveaxis(length * around.damping + length**2 * around.stiffness, 0, -1)
    going = None
    if carried is not None:
        going = (stage.going * (momentum(prepared, state, carried.velocity) - carried.sudden)).T
    return StageBody(
        length=jnp.asarray(np.diff(system.body.station)),
        section=firm(prepared, memory),
        mass=prepared.mass,
        inertia=prepared.inertia.T,
        position=state.position.T,
        orientation=state.orientation.T,
        twist=twist_of(state).T,
        load=load.T,
        span=jnp.asarray(length, dtype=float),
        lookahead=lookahead,
        behind=prepared.rayleigh_stiffness if stage.predicted else lookahead,
        loss=prepared.rayleigh_mass,
        carried=going,
        added=added,
        gain=None if memory.branch is None else gain,
        branch=None if memory.branch is None else memory.branch.T,
        blown=None if system.chambers is None or pressure is None else inflation(system.chambers, pressure),
    )


def step(
    system: System,
    prepared: Prepared,
    state: State,
    drive: Float[Array, " drives"],
    time_step: Scalar,
    external_force: Float[Array, "stations 6"] | float = 0.0,
    scene: PushGeometry | None = None,
    cube: Cube | None = None,
    integrator: Integrator = "euler",
) -> tuple[State, StepInfo]:
    """One time step to the commanded cable displacements [m] (pull > 0) and pressures [Pa] at its end.

    ``external_force`` are forces [N] and moments [N m] on the stations throughout the step. With a ``scene`` and a
    ``cube`` the body touches them; the state has the cube's pose. A step that is not finite keeps the old positions, at
    rest and without tension, and is reported, so that a batch continues. With a scene, effects that have a memory, or
    several stages a step, the state comes from ``remembering``.
    """
    take = partial(take_stage, system, prepared, time_step=time_step, external=external_force, scene=scene, cube=cube)
    return in_stages(take, state, drive, STAGES[integrator])


def in_stages(
    take: Callable[[State, Float[Array, " drives"], Stage, Carried | None], tuple[State, StepInfo, Carried | None]],
    state: State,
    drive: Float[Array, " drives"],
    stages: Sequence[Stage],
) -> tuple[State, StepInfo]:
    """A step made of stages; commands within the step are interpolated to the commands at its end.

    Several stages are one loop, compiled once: nothing is carried into the first.
    """
    if len(stages) == 1:
        return take(state, drive, stages[0], None)[:2]
    start = jnp.zeros_like(drive) if state.commanded is None else state.commanded

    def one(
        before: tuple[State, StepInfo, Carried], timed: Float[Array, "4"]
    ) -> tuple[tuple[State, StepInfo, Carried], None]:
        here, codes, carried = before
        elapsed, length, share, until = timed
        stage = Stage(elapsed, length, share, stages[0].predicted)
        moved, info, done = take(here, start + until * (drive - start), stage, carried)
        assert done is not None
        return (moved, StepInfo(codes.diverged | info.diverged, codes.converged & info.converged), done), None

    times = np.array([[stage.elapsed, stage.length, stage.carried] for stage in stages])
    times = np.concatenate([times, np.cumsum(times[:, :1], axis=0)], axis=1)
    codes = StepInfo(jnp.array(False), jnp.array(True))
    (after, codes, _), _ = lax.scan(one, (state, codes, _nothing_carried(state)), jnp.asarray(times))
    return after._replace(commanded=drive), codes


def _nothing_carried(state: State) -> Carried:
    none = jnp.zeros((len(state.position), 6))
    twist = None if state.cube is None else jnp.zeros(6)
    slip = None if state.memory.slip is None else jnp.zeros_like(state.memory.slip)
    return Carried(none, none, twist, slip)


class StageBegun(NamedTuple):
    """The linear system of a stage, before its constraints."""

    at: State  # state at which forces are taken, with the memory of the stage
    push: Push | None
    stage: Stage  # made longer by impacts
    body: StageBody


def begin_stage(
    system: System,
    prepared: Prepared,
    state: State,
    stage: Stage,
    carried: Carried | None,
    pressure: Float[Array, " chambers"] | None,
    *,
    time_step: Scalar,
    external: Float[Array, "stations 6"] | float = 0.0,
    scene: PushGeometry | None = None,
    cube: Cube | None = None,
) -> StageBegun:
    """Evaluate the forces of a stage that starts from a state; ``carried`` is from the previous stage."""
    at = state._replace(memory=within(system, prepared, state, time_step, stage))
    if stage.predicted:
        at = displaced(at, stage.elapsed * time_step * twist_of(state))
    push = None
    if scene is not None and cube is not None and state.cube is not None and state.touch is not None:
        around = prepared.gravity, prepared.rayleigh_mass
        change = None if carried is None else carried.twist
        place = at.position, at.orientation, twist_of(at), around
        push, stage = meet(scene, cube, state.cube, state.touch, *place, stage, time_step, change)
    body = stage_body(system, prepared, at, time_step, external, stage, carried, pressure)
    return StageBegun(at, push, stage, body)


def take_stage(
    system: System,
    prepared: Prepared,
    state: State,
    drive: Float[Array, " drives"],
    stage: Stage,
    carried: Carried | None,
    *,
    time_step: Scalar,
    external: Float[Array, "stations 6"] | float = 0.0,
    scene: PushGeometry | None = None,
    cube: Cube | None = None,
) -> tuple[State, StepInfo, Carried | None]:
    """One stage of a step, see ``fem.integrators``."""
    around: dict[str, Any] = {"time_step": time_step, "external": external, "scene": scene, "cube": cube}
    displacement, pressure = system.split(drive)
    at, push, stage, body = begin_stage(system, prepared, state, stage, carried, pressure, **around)
    length, slip = stage.span * time_step, None
    mobilised, segment = state.memory.slip, state.memory.segment
    if mobilised is not None and segment is not None:
        if carried is not None and carried.slip is not None:
            mobilised = jnp.clip(mobilised + stage.carried * carried.slip, -1.0, 1.0)
        slip = slip_problem(system.cables, prepared.effects, mobilised, segment, at.position, at.orientation)
    bonds = _bonds(system, prepared, at, displacement, stage, time_step, slip, push)
    way = Way(system.clamped_stations, stage.predicted, system.cables)
    solution = solve_stage(way, body, bonds)
    change, cables = solution.change.T, len(system.cables.anchor)
    twist = twist_of(at) + change
    tension = jnp.maximum(solution.impulse[:cables], 0.0) / length
    memory = at.memory
    if slip is not None:
        share = end_shares(slip, bonds, twist)
        shares, segment = slipped(system.cables, slip, share, tension)
        memory = memory._replace(slip=shares, segment=segment)
    moved = displaced(at, length * (change if stage.predicted else twist))
    moved = moved._replace(velocity=twist[:, :3], spin=twist[:, 3:], tension=tension, memory=memory)
    sudden, sudden_twist = jnp.zeros_like(twist), None
    if push is not None:
        touched = solution.impulse[-3 * len(push.touch.gap) :].reshape(-1, 3)
        done = released(push, stage, time_step, twist_of(at), twist, touched)
        moved = moved._replace(cube=done.cube, touch=done.touch)
        sudden, sudden_twist = done.sudden, done.sudden_twist
    taken, info = accept(system, state, moved, solution.converged > 0.5)
    return taken, info, _carried_from(state, taken, sudden, sudden_twist, info) if stage.predicted else None


def end_shares(slip: Slip, bonds: Bonds, twist: Float[Array, "stations 6"]) -> Float[Array, " runs"]:
    """Share of the friction that is mobilised at the end of a stage."""
    assert bonds.rows is not None
    runs = len(slip.strength)
    sliding = jnp.einsum("sir,si->r", bonds.rows[..., :runs], twist)
    return jnp.clip(slip.mobilised - bonds.follows / PRESLIDING * sliding, -1.0, 1.0)


def _bonds(
    system: System,
    prepared: Prepared,
    at: State,
    displacement: Float[Array, " cables"],
    stage: Stage,
    time_step: Scalar,
    slip: Slip | None,
    push: Push | None,
) -> Bonds:
    """The constraints of a stage."""
    length, compliance = stage.span * time_step, prepared.effects.cable_compliance
    bonds = Bonds(
        thread=threads(system.cables),
        reach=prepared.rest_length - displacement,
        previous=at.tension * length,
        give=jnp.zeros(()) if compliance is None else jnp.asarray(compliance, dtype=float),
        follows=jnp.asarray(stage.length * time_step, dtype=float),
    )
    if slip is None and push is None:
        return bonds
    rows, base, weight, contacts, slips = [], [], jnp.zeros((0, 0)), None, None
    if slip is not None:
        rows.append(slip_rows(system.cables, slip, at.position, at.orientation)[0])
        base.append(jnp.zeros(len(slip.strength)))
        slips = Slips(length * slip.strength, slip.mobilised)
        weight = jnp.zeros((len(slip.strength), len(slip.strength)))
    if push is not None:
        touching = pushed_rows(push, stage, time_step, twist_of(at))
        rows.append(touching.rows)
        base.append(touching.base)
        weight = jax.scipy.linalg.block_diag(weight, touching.compliance)
        contacts = touching.contacts
    whole = jnp.concatenate(rows, axis=2), jnp.concatenate(base)
    return bonds._replace(rows=whole[0], base=whole[1], compliance=weight, slips=slips, contacts=contacts)


def _carried_from(
    before: State,
    after: State,
    sudden: Float[Array, "stations 6"],
    sudden_twist: Float[Array, "6"] | None,
    info: StepInfo,
) -> Carried:
    """Changes of an accepted stage; zero if it was rejected."""
    twist = slip = None
    if before.cube is not None and after.cube is not None and sudden_twist is not None:
        parts = after.cube.velocity - before.cube.velocity, after.cube.spin - before.cube.spin
        twist = jnp.concatenate(parts) - sudden_twist
    if before.memory.slip is not None and after.memory.slip is not None:
        slip = after.memory.slip - before.memory.slip
    changes = Carried(twist_of(after) - twist_of(before), sudden, twist, slip)
    return jax.tree.map(lambda change: jnp.where(info.diverged, 0.0, change), changes)


def accept(system: System, state: State, moved: State, converged: Bool[Array, ""]) -> tuple[State, StepInfo]:
    """The new state if it is finite and near the body, else the old state at rest."""
    station = jnp.asarray(system.body.station)
    away = moved.position - jnp.zeros_like(moved.position).at[:, 2].set(station)
    fine = jnp.max(jnp.abs(away)) < LOST * system.body.length
    for part in (moved.velocity, moved.spin, moved.orientation, moved.tension):
        fine = fine & jnp.all(jnp.isfinite(part))
    cube = None
    if state.cube is not None and moved.cube is not None:
        fine = fine & jnp.all(jnp.isfinite(moved.cube.position))
        cube = unchanged(state.cube, moved.cube, fine)
    still = jax.tree.map(jnp.zeros_like, (state.velocity, state.spin, state.tension, state.touch))
    stopped = state._replace(velocity=still[0], spin=still[1], tension=still[2], cube=None, touch=still[3])
    kept = jax.tree.map(lambda after, before: jnp.where(fine, after, before), moved._replace(cube=None), stopped)
    return kept._replace(cube=cube), StepInfo(diverged=~fine, converged=converged | ~fine)
