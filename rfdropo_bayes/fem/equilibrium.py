"""Static equilibrium under gravity, external forces and cables: the start of a rollout, and quasi-static motion.

Newton's method with the constraints of a step and its tangent, and with the forces that turn with the sections, in
leading order. Stresses in the matrix are linear in the increments: in a thin rod the second order of a rotation is a
large force along the axis (Magisano, Leonetti and Garcea 2017, "How to improve efficiency and robustness of the Newton
method in geometrically non-linear structural problem discretized via displacement-based finite elements"). Increments
that shrink slowly are prolonged by Aitken's rule. Mobilised friction of the cables continues from the
previous state, so that it depends on the path. Derivatives are of the equations at the solution, with all terms.

Moments turn with the sections only if the body has cables, which balance the moments of the sections. Another moment
is of a load. A moment that is fixed in space has no symmetric tangent, and the tangent's symmetric part has no factor
as soon as the moment bends the body by more than half a turn.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from rfdropo_bayes.fem.cable_friction import PRESLIDING, Slip, slip_problem, slip_rows, slipped
from rfdropo_bayes.fem.cables import threads
from rfdropo_bayes.fem.chambers import thrust
from rfdropo_bayes.fem.components import turned
from rfdropo_bayes.fem.constraints import Slips
from rfdropo_bayes.fem.derivatives import pushed_forward
from rfdropo_bayes.fem.dynamics import (
    LOST,
    Prepared,
    State,
    StepInfo,
    System,
    accept,
    displaced,
    stage_body,
    state_at_rest,
)
from rfdropo_bayes.fem.effects import Scalar
from rfdropo_bayes.fem.integrators import Stage
from rfdropo_bayes.fem.rod_elements import Six
from rfdropo_bayes.fem.stage_solve import Bonds, StageBody, Way, all_rows, linearised, solved_stage, stresses

ITERATIONS = 60
SETTLED, ROW_SETTLED = 1e-10, 1e-6
"""Largest motion in the last iteration, in body lengths and radians: of the start of a rollout, and of a row of
quasi-static motion."""
LONGEST_STEP = 0.1
"""No station moves further than this many body lengths in an iteration."""
WIDEST_TURN = 0.5
"""No section turns further [rad] in an iteration."""
SLOWER = 0.5
"""Share of the next way that a body goes whose increments do not shrink."""
NEAR = 0.1
"""Increments below this many body lengths follow Aitken's rule."""
SHORTEST, FARTHEST = 0.3, 10.0
"""Least and greatest share of an increment by that rule."""
STEADY = 0.8
"""Cosine between successive increments above which growing ones lead away from an unstable equilibrium."""
LEAST, FIRMER, EASED = 10.0, 4.0, 0.25
"""Least share of the mass in a matrix that has no solution without, over E I / m L^3; its factor if that is too little,
and its factor after an increment far from rest."""
HOPELESS = 1e9
"""A share of the mass beyond this many times the least: the body is lost."""
CALM = 0.01
"""Increments above this many body lengths are far from rest."""
TINY = 1e-300
NO_TIME = Stage(0.0, 1.0, 0.0, True)
"""A stage whose "velocities" are the motion itself."""


class EquilibriumInfo(NamedTuple):
    """Quality of an equilibrium."""

    residual: Float[Array, ""]  # largest force on a station out of balance / sum of the loads
    converged: Bool[Array, ""]  # the body came to rest, cable problem solved
    diverged: Bool[Array, ""]
    iterations: Float[Array, ""]  # linear solves


class Task(NamedTuple):
    """Inputs of an equilibrium."""

    prepared: Prepared
    start: State  # start of the iterations; the slip of cables counts from it
    drive: Float[Array, " drives"]
    external: Float[Array, "stations 6"]
    slip: Slip | None
    moves: Float[Array, ""]  # 0 for a body that missed an earlier equilibrium, which stays where it is


class Equilibrium(NamedTuple):
    """An equilibrium."""

    position: Float[Array, "stations 3"]
    orientation: Float[Array, "stations 4"]
    impulse: Float[Array, " rows"]  # tensions, and forces of friction [N]
    solved: Float[Array, ""]  # 1 if the body came to rest and the last constraint problem was solved
    iterations: Float[Array, ""]
    softness: Float[Array, " cables"]  # of the constraints [m/N]


class _Iterate(NamedTuple):
    place: State
    impulse: Float[Array, " rows"]
    turning: Six  # forces and moments that turn with the sections in the matrix
    shift: Float[Array, ""]  # share of the mass in the matrix [1/s2]
    largest: Float[Array, ""]  # increment of the iteration before, over the body's length
    increment: Float[Array, "6 stations"]  # and all of it, in body lengths and radians
    pace: Float[Array, ""]  # share of it that was gone; 0 if the matrix has changed its kind since
    moving: Bool[Array, ""]
    solved: Float[Array, ""]
    iterations: Float[Array, ""]
    softness: Float[Array, " cables"]


def _body(system: System, task: Task, place: State, shift: Scalar = 0.0) -> StageBody:
    """The body with a share of its inertia and without anything that time does to it."""
    prepared = task.prepared
    timeless = prepared._replace(effects=prepared.effects._replace(drag=None, viscoelasticity=None))
    still = place._replace(velocity=jnp.zeros_like(place.velocity), spin=jnp.zeros_like(place.spin))
    pressure = system.split(task.drive)[1]
    body = stage_body(system, timeless, still, 1.0, task.external, NO_TIME, pressure=pressure)
    none = jnp.zeros(())
    light = body._replace(mass=shift * body.mass, inertia=shift * body.inertia)
    return light._replace(lookahead=jnp.ones(()), behind=none, loss=none, gain=None, branch=None)


def _bonds(system: System, task: Task, place: State, previous: Float[Array, " cables"]) -> Bonds:
    compliance = task.prepared.effects.cable_compliance
    bonds = Bonds(
        thread=threads(system.cables),
        reach=task.prepared.rest_length - system.split(task.drive)[0],
        previous=previous,
        give=jnp.zeros(()) if compliance is None else jnp.asarray(compliance, dtype=float),
        follows=jnp.ones(()),
    )
    if task.slip is None:
        return bonds
    rows, length = slip_rows(system.cables, task.slip, place.position, place.orientation)
    before = slip_rows(system.cables, task.slip, task.start.position, task.start.orientation)[1]
    slips = Slips(task.slip.strength, task.slip.mobilised)
    weight = jnp.zeros((len(length), len(length)))
    return bonds._replace(rows=rows, base=length - before, compliance=weight, slips=slips)


def _least_shift(system: System, prepared: Prepared) -> Float[Array, ""]:
    """Least share of the mass in the matrix, about the square of the first frequency [1/s2]."""
    bending = prepared.section.bending
    about_x = bending[0] if bending.ndim == prepared.section.stretch.ndim else bending[0, 0]
    flexible = jnp.sum(jnp.asarray(np.diff(system.body.station)) / about_x)
    return LEAST / (flexible * (jnp.sum(prepared.mass) + TINY) * system.body.length**2)


def _pace(current: _Iterate, increment: Float[Array, "6 stations"]) -> Float[Array, ""]:
    """Share of an increment by Aitken's rule in the form of Irons and Tuck (1969, Int. J. Numer. Methods Eng. 1:275):
    from the change that the last increment, and the share of it that was gone, made to the next."""
    before = current.increment
    square, along, own = (jnp.sum(a * b) for a, b in ((before, before), (before, increment), (increment, increment)))
    share = current.pace * (square - along) / jnp.maximum(square - 2.0 * along + own, TINY)
    away = (along > square) & (along**2 > STEADY**2 * square * own)
    return jnp.where(away, FARTHEST, jnp.clip(share, SHORTEST, FARTHEST))


def _find(system: System, iterations: int, bound: float, task: Task) -> Equilibrium:
    """Newton's method. Increments are limited in length, and halved if they do not shrink; near the end see `_pace`.

    A matrix without a solution, as near a loss of stability, is tried again with a share of the mass: a body then goes
    a step in time without damping. The share grows until there is a solution, and gets less far from rest. The
    increments to come are no more than a geometric series that goes on as the last two did. A body without friction
    that does not come to rest starts once more, undeformed.
    """
    way, cables = Way(system.clamped_stations, True, system.cables), len(system.cables.anchor)
    none, scales = jnp.zeros((6, len(task.start.position))), np.array([[system.body.length]] * 3 + [[1.0]] * 3)
    turns = jnp.asarray([[1.0]] * 3 + [[float(cables > 0)]] * 3)

    def one(current: _Iterate) -> _Iterate:
        bonds = _bonds(system, task, current.place, current.impulse[:cables])
        body = _body(system, task, current.place, current.shift)
        solution, softness = solved_stage(way, body._replace(turning=current.turning), bonds)
        count = current.iterations + 1.0
        again = ~jnp.isfinite(jnp.sum(solution.change**2)) & (current.shift < HOPELESS * least)
        increment = solution.change / scales
        far, wide = jnp.max(jnp.abs(increment[:3])), jnp.max(jnp.abs(increment[3:]))
        size = jnp.maximum(far, wide)
        grown = size > current.largest
        limit = jnp.minimum(LONGEST_STEP / jnp.maximum(far, TINY), WIDEST_TURN / jnp.maximum(wide, TINY))
        paced = (current.pace > 0.0) & (size < NEAR)
        plain = jnp.where(grown, SLOWER, 1.0) * jnp.minimum(limit, 1.0)
        share = jnp.where(paced, jnp.minimum(limit, _pace(current, increment)), plain)
        remaining = jnp.where(grown | ~jnp.isfinite(current.largest), size, size**2 / (current.largest - size))
        remaining = jnp.where(share > 1.0, share * size, remaining)
        turning = current.turning + share * (turns * stresses(body, solution.change) - current.turning)
        shift = jnp.where(size > CALM, EASED, 1.0) * current.shift
        pace = jnp.where(shift < current.shift, 0.0, share)
        place = displaced(current.place, share * solution.change.T)
        rest = remaining > bound, solution.converged, count, softness
        taken = _Iterate(place, solution.impulse, turning, shift, size, increment, pace, *rest)
        more = jnp.maximum(FIRMER * current.shift, least)
        waiting = current._replace(shift=more, pace=none[0, 0], iterations=count)
        return jax.tree.map(lambda old, new: jnp.where(again, old, new), waiting, taken)

    runs = 0 if task.slip is None else len(task.slip.strength)
    impulse = jnp.concatenate([task.start.tension, jnp.zeros(runs)])
    turning, least = turns * stresses(_body(system, task, task.start), none), _least_shift(system, task.prepared)
    rest = task.moves > 0.5, task.moves, jnp.zeros(()), jnp.zeros(cables)
    first = _Iterate(task.start, impulse, turning, none[0, 0], jnp.array(jnp.inf), none, none[0, 0], *rest)
    upright = state_at_rest(system)
    undeformed = first._replace(
        place=task.start._replace(position=upright.position, orientation=upright.orientation),
        impulse=jnp.zeros_like(impulse),
        turning=jax.tree.map(jnp.zeros_like, turning),
    )

    def attempt(number: Array, current: _Iterate) -> _Iterate:
        away = current.place.position - upright.position
        near = (jnp.max(jnp.abs(away)) < LOST * system.body.length) & jnp.all(jnp.isfinite(current.place.orientation))
        again = (number > 0) & (task.moves > 0.5) & (current.moving | (current.solved < 0.5) | ~near)
        new = undeformed._replace(iterations=current.iterations)
        begun = jax.tree.map(lambda one, other: jnp.where(again, one, other), new, current)
        return lax.while_loop(lambda c: c.moving & (c.iterations < begun.iterations + iterations), one, begun)

    last = lax.fori_loop(0, 2 if task.slip is None else 1, attempt, first)
    return Equilibrium(
        last.place.position,
        last.place.orientation,
        last.impulse,
        jnp.where(last.moving, 0.0, last.solved),
        last.iterations,
        last.softness,
    )


def _unbalanced(
    system: System,
    task: Task,
    equilibrium: Equilibrium,
    change: Float[Array, "stations 6"],
    impulse: Float[Array, " rows"],
) -> tuple[Float[Array, "6 free"], Float[Array, " rows"]]:
    """Residuals of forces and constraints near an equilibrium."""
    place = displaced(task.start._replace(position=equilibrium.position, orientation=equilibrium.orientation), change)
    body, cables = _body(system, task, place), len(equilibrium.softness)
    bonds = _bonds(system, task, place, equilibrium.impulse[:cables])
    way = Way(system.clamped_stations, True, system.cables)
    line = linearised(way, body, bonds.thread, bonds.previous)
    rows, reached = all_rows(way, body, bonds, line.course)
    forces = line.right + jnp.einsum("sir,r->is", rows, impulse)
    tension = impulse[:cables]
    slack = bonds.reach - reached + (bonds.give + equilibrium.softness) * tension
    lacking = jnp.where(equilibrium.impulse[:cables] > 0.0, slack, tension)
    if task.slip is not None and bonds.base is not None:
        share = jnp.clip(task.slip.mobilised - bonds.base / PRESLIDING, -1.0, 1.0)
        lacking = jnp.concatenate([lacking, impulse[cables:] - task.slip.strength * share])
    return forces[:, system.clamped_stations :], lacking


def _balanced(system: System, iterations: int, bound: float, task: Task) -> Equilibrium:
    """The equilibrium, with derivatives by the implicit function theorem."""

    @jax.custom_jvp
    def solution(task: Task) -> Equilibrium:
        return _find(system, iterations, bound, task)

    def rule(primals: Any, tangents: Any) -> tuple[Equilibrium, Equilibrium]:
        equilibrium = lax.stop_gradient(_find(system, iterations, bound, *primals))
        clamped, stations = system.clamped_stations, len(equilibrium.position)
        free = 6 * (stations - clamped)

        def lacking(task: Task, unknown: Float[Array, " unknowns"]) -> Float[Array, " unknowns"]:
            change = jnp.concatenate([jnp.zeros((clamped, 6)), unknown[:free].reshape(-1, 6)])
            forces, rows = _unbalanced(system, task, equilibrium, change, unknown[free:])
            return jnp.concatenate([forces.T.ravel(), rows])

        at = jnp.concatenate([jnp.zeros(free), equilibrium.impulse])
        slope = lax.stop_gradient(jax.jacfwd(partial(lacking, *primals))(at))
        missing = pushed_forward(lambda task: lacking(task, at), primals, tangents)
        change = jnp.linalg.solve(slope, -missing)
        moved = jnp.concatenate([jnp.zeros((clamped, 6)), change[:free].reshape(-1, 6)])
        turning = jax.jvp(
            lambda a: turned(equilibrium.orientation.T, a).T, (jnp.zeros((3, stations)),), (moved[:, 3:].T,)
        )[1]
        return equilibrium, Equilibrium(
            moved[:, :3], turning, change[free:], *jax.tree.map(jnp.zeros_like, (equilibrium[3:]))
        )

    solution.defjvp(rule, symbolic_zeros=True)
    return solution(task)


def settled(
    system: System,
    prepared: Prepared,
    state: State,
    drive: Float[Array, " drives"],
    external_force: Float[Array, "stations 6"] | float = 0.0,
    iterations: int = ITERATIONS,
    bound: float = ROW_SETTLED,
    moves: Bool[Array, ""] | bool = True,
) -> tuple[State, EquilibriumInfo]:
    """The equilibrium of a state under drives (see `System`), forces [N] and moments [N m] on the stations: one row of
    quasi-static motion. Iterations end when one moves the body by less than ``bound``, in body lengths and radians.

    Friction of the cables continues from the state's memory; viscoelastic effects have relaxed. Needs a clamped
    station.
    """
    memory, slip = state.memory, None
    if memory.slip is not None and memory.segment is not None:
        slip = slip_problem(
            system.cables, prepared.effects, memory.slip, memory.segment, state.position, state.orientation
        )
    external = jnp.broadcast_to(jnp.asarray(external_force, dtype=float), (len(state.position), 6))
    task = Task(
        prepared,
        state._replace(memory=memory._replace(slip=None, segment=None)),
        drive,
        external,
        slip,
        jnp.asarray(moves, float),
    )
    equilibrium = _balanced(system, iterations, bound, task)
    cables, unknown = len(system.cables.anchor), jnp.zeros((len(state.position), 6))
    forces = _unbalanced(system, task, equilibrium, unknown, equilibrium.impulse)[0]
    loads = jnp.sum(jnp.abs(prepared.weight)) + jnp.sum(jnp.abs(external)) + jnp.sum(jnp.abs(equilibrium.impulse))
    if system.chambers is not None:
        loads = loads + thrust(system.chambers, drive[cables:])
    residual = lax.stop_gradient(jnp.max(jnp.abs(forces[:3]), initial=0.0) / jnp.maximum(loads, 1e-300))
    tension = jnp.maximum(equilibrium.impulse[:cables], 0.0)
    if slip is not None:
        strength = jnp.where(slip.strength > 0.0, slip.strength, 1.0)
        shares, segment = slipped(system.cables, slip, equilibrium.impulse[cables:] / strength, tension)
        memory = memory._replace(slip=shares, segment=segment)
    none = jnp.zeros_like(state.velocity)
    moved = state._replace(
        position=equilibrium.position,
        orientation=equilibrium.orientation,
        velocity=none,
        spin=none,
        tension=tension,
        memory=memory,
    )
    taken, info = accept(system, state, moved, equilibrium.solved > 0.5)
    converged = info.converged & ~info.diverged
    return taken, EquilibriumInfo(residual, converged, info.diverged, equilibrium.iterations)


def static_equilibrium(
    system: System,
    prepared: Prepared,
    drive: Float[Array, " drives"],
    external_force: Float[Array, "stations 6"] | float = 0.0,
    iterations: int = ITERATIONS,
) -> tuple[State, EquilibriumInfo]:
    """Body at rest under its weight, forces [N] and moments [N m] on the stations, and drives (see `System`), from the
    undeformed body; see `settled`. Cables enter without friction."""
    return settled(system, prepared, state_at_rest(system), drive, external_force, iterations, SETTLED)


def quasi_static_step(
    system: System,
    prepared: Prepared,
    state: State,
    drive: Float[Array, " drives"],
    external_force: Float[Array, "stations 6"] | float = 0.0,
    before: StepInfo | None = None,
) -> tuple[State, StepInfo]:
    """A row of quasi-static motion, in place of ``dynamics.step``. A body without an equilibrium in an earlier row
    (``before``) is not moved, and its rollout counts as failed.
    """
    moves = True if before is None else before.converged & ~before.diverged
    moved, info = settled(system, prepared, state, drive, external_force, moves=moves)
    return moved, StepInfo(info.diverged, info.converged)
