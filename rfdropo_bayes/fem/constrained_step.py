"""One linear solve of a body with everything that holds it: cables, friction along them, and contacts."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.fem.cable_friction import Slip
from rfdropo_bayes.fem.constraints import Contacts, Impulses, Slips, solve_constraints
from rfdropo_bayes.fem.effects import Scalar
from rfdropo_bayes.fem.integrators import Stage
from rfdropo_bayes.fem.pushing import PushScene, Touch, find_contacts, trunk_rows
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


class ConstrainedStep(NamedTuple):
    """What the constraints made of a linear solve."""

    increment: Float[Array, "nodes 3"]
    impulses: Impulses
    cube: CubeState | None
    touch: Float[Array, "pairs 3"] | None  # impulses of all pairs that can touch, in space [N s]
    sudden: Float[Array, "nodes 3"] | float = 0.0  # what contacts exert beyond their impulses before [N s]
    sudden_twist: Float[Array, "6"] | None = None  # and what that changes the cube's velocity and spin by


def meet(
    scene: PushScene,
    cube: Cube,
    state: CubeState,
    before: Float[Array, "pairs 3"],
    position: Float[Array, "nodes 3"],
    gravity: Float[Array, "3"],
    rayleigh_mass: Scalar,
    stage: Stage,
    time_step: Scalar,
    carried: Float[Array, "6"] | None = None,
) -> Push:
    """The cube in a stage that starts from a state, what it touches, and with which impulses it did so ``before``.

    ``carried`` is the change of its velocity and spin with which its motion goes on.
    """
    length, place = stage.length * time_step, state
    if stage.predicted:
        place = moved(state, twist_of(state), stage.elapsed * time_step)
    touch = find_contacts(scene, cube, place, position)
    going = state
    if carried is not None:
        going = state._replace(velocity=state.velocity + carried[:3], spin=state.spin + carried[3:])
    return Push(touch, cube, place, free_twist(going, gravity, rayleigh_mass, length), before)


def _sudden(impulse: Float[Array, "contacts 3"], before: Float[Array, "contacts 3"]) -> Float[Array, "contacts 3"]:
    """Impulses of contacts as far as they exceed those before along the normal."""
    normal = impulse[:, 0]
    lasting = jnp.clip(before[:, 0] / jnp.where(normal > 0.0, normal, 1.0), 0.0, 1.0)
    return (1.0 - lasting)[:, None] * impulse


def constrained_step(
    solve: Solve,
    right: Float[Array, "nodes 3"],
    velocity: Float[Array, "nodes 3"],
    pull: Pull,
    length: Scalar,
    slip: Slip | None = None,
    push: Push | None = None,
    predicted: bool = False,
) -> ConstrainedStep:
    """Solve A d = r + J' g, with the impulses g of all constraints at the velocities v + d.

    ``length`` [s] is how far positions move with d; where they are ``predicted``, they have moved with v already.
    """
    rows = [-pull.jacobian]
    slips = contacts = None
    if slip is not None:
        rows.append(slip.pattern)
        slips = Slips(length * slip.strength, slip.mobilised)
    if push is not None:
        rows.append(trunk_rows(push.touch, len(right)))
        before = jnp.einsum("cri,ci->cr", push.touch.frame, push.before[push.touch.pair])
        contacts = Contacts(push.touch.gap / length, push.cube.friction, before)
    row = jnp.concatenate(rows)
    solution = solve(jnp.concatenate([right[None], row]))
    compliance = jnp.einsum("ani,bni->ab", row, solution[1:])
    free = jnp.einsum("ani,ni->a", row, velocity + solution[0])
    free = free.at[: len(pull.slack)].add(pull.slack)
    met = jnp.einsum("ani,ni->a", row, velocity) if predicted else None
    if met is not None:
        free = free.at[: len(pull.slack)].add(-met[: len(pull.slack)])
    if push is not None and contacts is not None:
        # The cube takes part in the last rows only.
        on_cube, mass = push.touch.on_cube.reshape(-1, 6), inverse_inertia(push.cube)
        first = len(row) - len(on_cube)
        compliance = compliance.at[first:, first:].add((on_cube * mass) @ on_cube.T)
        free = free.at[first:].add(on_cube @ push.twist)
        if met is not None:
            closed = (met[first:] + on_cube @ twist_of(push.state))[::3]
            contacts = contacts._replace(opening=contacts.opening - closed)
    found = solve_constraints(compliance, free, pull.previous, length, give=pull.give, slips=slips, contacts=contacts)
    increment = solution[0] + jnp.einsum("a,ani->ni", found.all, solution[1:])
    if push is None or contacts is None:
        return ConstrainedStep(increment, found, None, None, jnp.zeros_like(right))
    twist = push.twist + mass * (on_cube.T @ found.contact.ravel())
    moving = twist - twist_of(push.state) if predicted else twist
    after = moved(push.state, moving, length)._replace(velocity=twist[:3], spin=twist[3:])
    touching = jnp.einsum("cr,cri->ci", found.contact, push.touch.frame)
    touching = jnp.zeros_like(push.before).at[push.touch.pair].set(touching)
    sudden = _sudden(found.contact, contacts.before).ravel()
    on_body = jnp.einsum("a,ani->ni", sudden, row[first:])
    return ConstrainedStep(increment, found, after, touching, on_body, mass * (on_cube.T @ sudden))
