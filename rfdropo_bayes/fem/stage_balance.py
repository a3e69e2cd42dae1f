"""Forces and energies of rollouts of a rod, which are simulated again, stage by stage.

Over a step of two stages the momentum changes by all impulses of the second stage and by the first stage's times 1 +
going (``fem.integrators``), without the share of its impacts that is not carried on. With the same weights the
velocities at the ends of the stages add up to the displacement, so that work is summed by stages.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rfdropo_bayes.fem.balance import Balance, Energies, check_effects, energies
from rfdropo_bayes.fem.cables import courses, station_rows, threads
from rfdropo_bayes.fem.components import dot, rotation
from rfdropo_bayes.fem.dynamics import (
    Prepared,
    StageBegun,
    State,
    System,
    begin_stage,
    remembering,
    stage_body,
    take_stage,
    twist_of,
)
from rfdropo_bayes.fem.effects import Scalar
from rfdropo_bayes.fem.integrators import STAGES, Integrator
from rfdropo_bayes.fem.pushing import PushGeometry
from rfdropo_bayes.fem.rigid_body import Cube
from rfdropo_bayes.fem.rod_elements import strain_rates
from rfdropo_bayes.fem.sections import linear
from rfdropo_bayes.fem.stage_solve import Way, inertia_times, linearised, matrix_times


class _Done(NamedTuple):
    """Impulses [N s], [N m s] and work [J] of a stage, or of a step."""

    residual: Float[Array, "stations 6"]  # of holding and touching bodies
    contact_work: Float[Array, ""]
    pulled: Float[Array, ""]  # work of cables and chambers
    lost: Float[Array, ""]  # to Rayleigh damping


class _Reached(NamedTuple):
    """End state of a step, and its effects."""

    position: Float[Array, "stations 3"]
    done: _Done
    stored: Energies


def cable_wrench(system: System, state: State, tension: Float[Array, " cables"]) -> Float[Array, "stations 6"]:
    """Forces [N] and moments [N m] of the cables on the stations."""
    thread = threads(system.cables)
    course = courses(system.cables, thread, state.position.T, rotation(state.orientation.T))
    rows = station_rows(system.cables, thread, course.lever, course.pull, len(state.position))
    return -jnp.einsum("sic,c->si", rows, tension)


def _done(system: System, prepared: Prepared, before: State, after: State, begun: StageBegun, length: Scalar) -> _Done:
    """Effects of a stage of this length [s]."""
    body, twist = begun.body, twist_of(after)
    way = Way(system.clamped_stations, begun.stage.predicted, system.cables)
    line = linearised(way, body, threads(system.cables), begun.at.tension)
    cable = length * cable_wrench(system, begun.at, after.tension)
    change = (twist - twist_of(before)).T
    residual = (matrix_times(body, line, change) - line.right).T - cable
    rates = strain_rates(line.elements, twist.T)
    viscous = jnp.sum(body.length * dot(rates, linear(line.slope, rates)))
    dragged = jnp.sum(twist.T * inertia_times(body, line.frame, twist.T))
    pulled = jnp.sum(cable * twist)
    if body.blown is not None:
        pulled = pulled + length * jnp.sum(body.length * dot(body.blown, rates))
    lost = length * (body.loss * dragged + prepared.rayleigh_stiffness * viscous)
    return _Done(residual, jnp.sum(residual * twist), pulled, lost)


def _step(
    system: System,
    prepared: Prepared,
    before: State,
    drive: Float[Array, " drives"],
    integrator: Integrator,
    around: dict[str, Any],
) -> tuple[State, _Reached]:
    """One step to the drives at its end."""
    start = drive if before.commanded is None else before.commanded
    here, elapsed, carried, done = before, 0.0, None, None
    for stage in STAGES[integrator]:
        elapsed += stage.elapsed
        given = start + elapsed * (drive - start)
        begun = begin_stage(system, prepared, here, stage, carried, system.split(given)[1], **around)
        if carried is not None and done is not None:
            going = begun.stage.going
            impact, velocity = going * carried.sudden, twist_of(here)
            done = jax.tree.map(lambda part, share=1.0 + going: share * part, done)
            done = done._replace(
                residual=done.residual - impact, contact_work=done.contact_work - jnp.sum(impact * velocity)
            )
        after, _, following = take_stage(system, prepared, here, given, stage, carried, **around)
        own = _done(system, prepared, here, after, begun, begun.stage.span * around["time_step"])
        done = own if done is None else jax.tree.map(jnp.add, done, own)
        here, carried = after, following
    if before.commanded is not None:
        here = here._replace(commanded=drive)
    assert done is not None
    return here, _Reached(here.position, done, energies(system, prepared, here))


def stepped_balance(
    system: System,
    prepared: Prepared,
    state: State,
    drive: Float[Array, "steps drives"],
    time_step: Scalar,
    integrator: Integrator,
    scene: PushGeometry | None = None,
    cube: Cube | None = None,
) -> Balance:
    """Forces and energies of a rollout of a rod.

    Args:
        state: initial state, with the drives before the first step.
        drive: drives at the end of every step.
        integrator: scheme of a step.
        scene, cube: bodies in contact.

    Raises:
        InputError: cables with friction.
    """
    check_effects(prepared.effects)
    around: dict[str, Any] = {"time_step": time_step, "scene": scene, "cube": cube}
    first = remembering(system, prepared, state, scene, integrator)
    reached = lax.scan(lambda before, to: _step(system, prepared, before, to, integrator, around), first, drive)[1]
    begun = jnp.zeros(system.drives) if first.commanded is None else first.commanded
    body = stage_body(system, prepared, first, time_step, pressure=system.split(begun)[1])
    way = Way(system.clamped_stations, True, system.cables)
    right = linearised(way, body, threads(system.cables), first.tension).right
    still = -right.T / time_step - cable_wrench(system, first, first.tension)
    clamped = (jnp.arange(len(still)) < system.clamped_stations)[:, None]
    acting = jnp.concatenate([still[None], reached.done.residual / time_step])
    clamp = jnp.where(clamped, acting, 0.0)
    touch = (acting - clamp).at[0].set(0.0)  # no step leads to the initial state: it may be about to fall
    stored = jax.tree.map(
        lambda row, rows: jnp.concatenate([row[None], rows]), energies(system, prepared, first), reached.stored
    )

    def summed(work: Float[Array, " steps"]) -> Float[Array, " rows"]:
        return jnp.concatenate([jnp.zeros(1), jnp.cumsum(work)])

    position = jnp.concatenate([first.position[None], reached.position])
    return Balance(
        base_force=clamp[..., :3].sum(axis=1),
        base_moment=(jnp.cross(position, clamp[..., :3]) + clamp[..., 3:]).sum(axis=1),
        contact_force=touch[..., :3].sum(axis=1),
        kinetic_energy=stored.kinetic,
        elastic_energy=stored.elastic,
        gravitational_energy=stored.gravitational,
        cable_work=summed(reached.done.pulled),
        contact_work=summed(reached.done.contact_work),
        damping_loss=summed(reached.done.lost),
    )
