"""A cube in a stage of the rod that pushes it: rows of the constraint problem, and the effect of their impulses."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.fem.constraints import Contacts
from rfdropo_bayes.fem.effects import Scalar
from rfdropo_bayes.fem.integrators import REBOUND, Stage
from rfdropo_bayes.fem.pushing import PushGeometry, Touch, find_contacts
from rfdropo_bayes.fem.rigid_body import Cube, CubeState, free_twist, inverse_inertia, moved, twist_of


class Push(NamedTuple):
    """A cube in one linear solve."""

    touch: Touch
    cube: Cube
    state: CubeState  # state at which the contacts were found
    twist: Float[Array, "6"]  # velocity and spin at the end of the stage without contacts
    before: Float[Array, "pairs 3"]  # impulses of the stage before, in space [N s]
    wide: Scalar | None = None  # length of the stage, in units of the previous stage's


class PushedRows(NamedTuple):
    """The contacts in the constraint problem of a stage, three rows each."""

    rows: Float[Array, "stations 6 rows"]
    base: Float[Array, " rows"]  # of the relative velocities, the cube's motion without contacts [m/s]
    compliance: Float[Array, "rows rows"]  # of the cube [1/kg]
    contacts: Contacts


class Released(NamedTuple):
    """Effect of the contacts."""

    cube: CubeState
    touch: Float[Array, "pairs 3"]  # impulses of all pairs that can touch, in space [N s]
    sudden: Float[Array, "stations 6"]  # impacts on the body [N s], [N m s]
    sudden_twist: Float[Array, "6"]  # and their change of the cube's velocity and spin


def meet(
    scene: PushGeometry,
    cube: Cube,
    state: CubeState,
    before: Float[Array, "pairs 3"],
    position: Float[Array, "stations 3"],
    orientation: Float[Array, "stations 4"],
    twist: Float[Array, "stations 6"],
    surroundings: tuple[Float[Array, "3"], Scalar],
    stage: Stage,
    time_step: Scalar,
    change: Float[Array, "6"] | None = None,
) -> tuple[Push, Stage]:
    """The cube in a stage that starts from a state, its contacts, and their impulses ``before``; and the stage, which
    impacts lengthen.

    Args:
        position, orientation, twist: state of the body's stations at which the stage takes its forces.
        surroundings: gravity, and the damping of the cube's motion [1/s].
        change: change of the cube's velocity and spin in the previous stage, a share of which is carried on.
    """
    place = state
    if stage.predicted:
        place = moved(state, twist_of(state), stage.elapsed * time_step)
    touch, going, wide = find_contacts(scene, cube, place, position, orientation), state, None
    if change is not None:
        wide = jnp.where(stage.carried > 0.0, _widened(touch, place, twist, stage, time_step), 1.0)
        stage = stage._replace(wide=wide)
        change = stage.going * change
        going = state._replace(velocity=state.velocity + change[:3], spin=state.spin + change[3:])
    after = free_twist(going, *surroundings, stage.span * time_step)
    return Push(touch, cube, place, after, before, wide), stage


def _widened(
    touch: Touch, cube: CubeState, twist: Float[Array, "stations 6"], stage: Stage, time_step: Scalar
) -> Float[Array, ""]:
    """Factor that limits the length of a stage with impacts to the time since the first impact, see
    ``fem.integrators``.
    """
    opening = touch.on_cube[:, 0] @ twist_of(cube) + jnp.einsum("sir,si->r", touch.rows[..., ::3], twist)
    closes = (touch.gap < 0.0) & (opening < 0.0)
    past = jnp.where(closes, touch.gap / jnp.where(closes, opening, 1.0), 0.0)
    length = stage.length * time_step
    longer = jnp.clip(past, length, stage.elapsed * time_step) - length
    return 1.0 + jnp.max(_impact(opening) * longer) / length


def _impact(change: Float[Array, " contacts"]) -> Float[Array, " contacts"]:
    """Degree to which a change of the closing speed [m/s] is an impact, from 0 to 1."""
    return change**2 / (change**2 + REBOUND**2)


def _closing(push: Push, twist: Float[Array, "stations 6"], of_cube: Float[Array, "6"]) -> Float[Array, " contacts"]:
    """Opening speeds of the contacts."""
    return jnp.einsum("sir,si->r", push.touch.rows[..., ::3], twist) + push.touch.on_cube[:, 0] @ of_cube


def pushed_rows(push: Push, stage: Stage, time_step: Scalar, twist: Float[Array, "stations 6"]) -> PushedRows:
    """The contacts of a stage, whose body starts with velocities and spins."""
    before = jnp.einsum("cri,ci->cr", push.touch.frame, push.before[push.touch.pair])
    before = before if push.wide is None else push.wide * before
    opening = push.touch.gap / (stage.span * time_step)
    if stage.predicted:
        opening = opening - _closing(push, twist, twist_of(push.state))
    on_cube, mass = push.touch.on_cube.reshape(-1, 6), inverse_inertia(push.cube)
    contacts = Contacts(opening, push.cube.friction, before)
    return PushedRows(push.touch.rows, on_cube @ push.twist, (on_cube * mass) @ on_cube.T, contacts)


def released(
    push: Push,
    stage: Stage,
    time_step: Scalar,
    before: Float[Array, "stations 6"],
    twist: Float[Array, "stations 6"],
    impulse: Float[Array, "contacts 3"],
) -> Released:
    """Effect of the contacts' impulses in a stage that changed the body's velocities and spins from ``before`` to
    ``twist``.
    """
    on_cube, mass = push.touch.on_cube.reshape(-1, 6), inverse_inertia(push.cube)
    after = push.twist + mass * (on_cube.T @ impulse.ravel())
    moving = after - twist_of(push.state) if stage.predicted else after
    cube = moved(push.state, moving, stage.span * time_step)._replace(velocity=after[:3], spin=after[3:])
    touching = jnp.einsum("cr,cri->ci", impulse, push.touch.frame)
    touching = touching if push.wide is None else touching / push.wide
    touching = jnp.zeros_like(push.before).at[push.touch.pair].set(touching)
    change = _closing(push, twist, after) - _closing(push, before, twist_of(push.state))
    sudden = (_impact(change)[:, None] * impulse).ravel()
    on_body = jnp.einsum("r,sir->si", sudden, push.touch.rows)
    return Released(cube, touching, on_body, mass * (on_cube.T @ sudden))
