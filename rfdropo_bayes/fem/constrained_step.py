"""One linear solve of a body with everything that holds it: cables, friction along them, and contacts."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.fem.cable_friction import Slip
from rfdropo_bayes.fem.constraints import Contacts, Impulses, Slips, solve_constraints
from rfdropo_bayes.fem.effects import Scalar
from rfdropo_bayes.fem.integrators import EULER, REBOUND, Stage
from rfdropo_bayes.fem.pushing import PushGeometry, Touch, find_contacts, trunk_rows
from rfdropo_bayes.fem.rigid_body import Cube, CubeState, free_twist, inverse_inertia, moved, twist_of

Solve = Callable[[Float[Array, "columns nodes 3"]], Float[Array, "columns nodes 3"]]
"""A^-1 times fields, zero where the body is held."""


class Pull(NamedTuple):
    """The cables in one linear solve."""

    jacobian: Float[Array, "cables nodes 3"]  # dl/dx
    slack: Float[Array, " cables"]  # what is left of the commanded lengths, over the time step [m/s]
    previous: Float[Array, " cables"]  # impulses that the iterations start from [N s]
    give: Scalar = 0.0  # of every cable's slack per impulse


class Push(NamedTuple):
    """A cube in one linear solve."""

    touch: Touch
    cube: Cube
    state: CubeState  # where the contacts were looked for
    twist: Float[Array, "6"]  # velocity and spin at the end of the stage without contacts
    before: Float[Array, "pairs 3"]  # impulses of the stage before, in space [N s]
    wide: Scalar | None = None  # length of the stage, in those of the stage before


class ConstrainedStep(NamedTuple):
    """What the constraints made of a linear solve."""

    increment: Float[Array, "nodes 3"]
    impulses: Impulses
    cube: CubeState | None
    touch: Float[Array, "pairs 3"] | None  # impulses of all pairs that can touch, in space [N s]
    sudden: Float[Array, "nodes 3"]  # impacts on the body [N s]
    sudden_twist: Float[Array, "6"] | None = None  # and what that changes the cube's velocity and spin by


def meet(
    scene: PushGeometry,
    cube: Cube,
    state: CubeState,
    before: Float[Array, "pairs 3"],
    position: Float[Array, "nodes 3"],
    velocity: Float[Array, "nodes 3"],
    surroundings: tuple[Float[Array, "3"], Scalar],
    stage: Stage,
    time_step: Scalar,
    change: Float[Array, "6"] | None = None,
) -> tuple[Push, Stage]:
    """The cube in a stage that starts from a state, what it touches, and with which impulses it did so ``before``; and
    the stage, which impacts make longer.

    Args:
        position, velocity: of the body's nodes where the stage takes its forces.
        surroundings: gravity, and the damping of the cube's motion [1/s].
        change: of the cube's velocity and spin in the stage before, a share of which is carried on.
    """
    place = state
    if stage.predicted:
        place = moved(state, twist_of(state), stage.elapsed * time_step)
    touch, going, wide = find_contacts(scene, cube, place, position), state, None
    if change is not None:
        wide = _widened(touch, place, velocity, stage, time_step)
        stage = stage._replace(wide=wide)
        change = stage.going * change
        going = state._replace(velocity=state.velocity + change[:3], spin=state.spin + change[3:])
    twist = free_twist(going, *surroundings, stage.span * time_step)
    return Push(touch, cube, place, twist, before, wide), stage


def _widened(
    touch: Touch, cube: CubeState, velocity: Float[Array, "nodes 3"], stage: Stage, time_step: Scalar
) -> Float[Array, ""]:
    """How much longer a stage is for its impacts: as long as the first of them is past, see ``fem.integrators``."""
    corners = len(touch.gap) - len(touch.trunk_node)
    centre = jnp.einsum("ck,cki->ci", touch.trunk_weight[:, 0], velocity[touch.trunk_node])
    opening = touch.on_cube[:, 0] @ twist_of(cube)
    opening = opening.at[corners:].add(jnp.sum(touch.frame[corners:, 0] * centre, axis=1))
    closes = (touch.gap < 0.0) & (opening < 0.0)
    past = jnp.where(closes, touch.gap / jnp.where(closes, opening, 1.0), 0.0)
    length = stage.length * time_step
    longer = jnp.clip(past, length, stage.elapsed * time_step) - length
    return 1.0 + jnp.max(_impact(opening) * longer) / length


def _impact(change: Float[Array, " contacts"]) -> Float[Array, " contacts"]:
    """How much of an impact a change of the closing speed [m/s] is, from 0 to 1."""
    return change**2 / (change**2 + REBOUND**2)


def constrained_step(
    solve: Solve,
    right: Float[Array, "nodes 3"],
    velocity: Float[Array, "nodes 3"],
    pull: Pull,
    stage: Stage = EULER,
    time_step: Scalar = 1.0,
    slip: Slip | None = None,
    push: Push | None = None,
) -> ConstrainedStep:
    """Solve A d = r + J' g of a stage, with the impulses g of all constraints at the velocities v + d."""
    length, predicted = stage.span * time_step, stage.predicted

    rows = [-pull.jacobian]
    slips = contacts = None
    if slip is not None:
        rows.append(slip.pattern)
        slips = Slips(length * slip.strength, slip.mobilised)
    if push is not None:
        rows.append(trunk_rows(push.touch, len(right)))
        before = jnp.einsum("cri,ci->cr", push.touch.frame, push.before[push.touch.pair])
        before = before if push.wide is None else push.wide * before
        contacts = Contacts(push.touch.gap / length, push.cube.friction, before)
    row = jnp.concatenate(rows)
    solution = solve(jnp.concatenate([right[None], row]))
    compliance = jnp.einsum("ani,bni->ab", row, solution[1:])
    free = jnp.einsum("ani,ni->a", row, velocity + solution[0])
    free = free.at[: len(pull.slack)].add(pull.slack)
    met = jnp.einsum("ani,ni->a", row, velocity)
    if predicted:
        free = free.at[: len(pull.slack)].add(-met[: len(pull.slack)])
    if push is not None and contacts is not None:
        # The cube takes part in the last rows only.
        on_cube, mass = push.touch.on_cube.reshape(-1, 6), inverse_inertia(push.cube)
        first = len(row) - len(on_cube)
        compliance = compliance.at[first:, first:].add((on_cube * mass) @ on_cube.T)
        free = free.at[first:].add(on_cube @ push.twist)
        met = (met[first:] + on_cube @ twist_of(push.state))[::3]
        if predicted:
            contacts = contacts._replace(opening=contacts.opening - met)
    follows = stage.length * time_step
    found = solve_constraints(compliance, free, pull.previous, follows, give=pull.give, slips=slips, contacts=contacts)
    increment = solution[0] + jnp.einsum("a,ani->ni", found.all, solution[1:])
    if push is None or contacts is None:
        return ConstrainedStep(increment, found, None, None, jnp.zeros_like(right))
    twist = push.twist + mass * (on_cube.T @ found.contact.ravel())
    moving = twist - twist_of(push.state) if predicted else twist
    after = moved(push.state, moving, length)._replace(velocity=twist[:3], spin=twist[3:])
    touching = jnp.einsum("cr,cri->ci", found.contact, push.touch.frame)
    touching = touching if push.wide is None else touching / push.wide
    touching = jnp.zeros_like(push.before).at[push.touch.pair].set(touching)
    left = jnp.einsum("ani,ni->a", row[first::3], velocity + increment) + on_cube[::3] @ twist
    sudden = (_impact(left - met)[:, None] * found.contact).ravel()
    on_body = jnp.einsum("a,ani->ni", sudden, row[first:])
    return ConstrainedStep(increment, found, after, touching, on_body, mass * (on_cube.T @ sudden))
