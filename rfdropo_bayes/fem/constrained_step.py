"""One linear solve of a body with everything that holds it: cables, friction along them, and contacts."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.fem.cable_friction import Slip
from rfdropo_bayes.fem.constraints import Contacts, Impulses, Slips, solve_constraints
from rfdropo_bayes.fem.effects import Scalar
from rfdropo_bayes.fem.pushing import PushScene, Touch, find_contacts, trunk_rows
from rfdropo_bayes.fem.rigid_body import Cube, CubeState, free_twist, inverse_inertia, moved

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
    state: CubeState
    twist: Float[Array, "6"]  # velocity and spin at the end of the step without contacts
    before: Float[Array, "pairs 3"]  # impulses of the step before, in space [N s]


class ConstrainedStep(NamedTuple):
    """What the constraints made of a linear solve."""

    increment: Float[Array, "nodes 3"]
    impulses: Impulses
    cube: CubeState | None
    touch: Float[Array, "pairs 3"] | None  # impulses of all pairs that can touch, in space [N s]


def meet(
    scene: PushScene,
    cube: Cube,
    state: CubeState,
    before: Float[Array, "pairs 3"],
    position: Float[Array, "nodes 3"],
    gravity: Float[Array, "3"],
    rayleigh_mass: Scalar,
    time_step: Scalar,
) -> Push:
    """The cube at the start of a step, what it touches, and with which impulses it did so ``before``."""
    touch = find_contacts(scene, cube, state, position)
    return Push(touch, cube, state, free_twist(state, gravity, rayleigh_mass, time_step), before)


def constrained_step(
    solve: Solve,
    right: Float[Array, "nodes 3"],
    velocity: Float[Array, "nodes 3"],
    pull: Pull,
    time_step: Scalar,
    slip: Slip | None = None,
    push: Push | None = None,
) -> ConstrainedStep:
    """Solve A dv = r + J' g, with the impulses g of all constraints at the velocities v + dv."""
    rows = [-pull.jacobian]
    slips = contacts = None
    if slip is not None:
        rows.append(slip.pattern)
        slips = Slips(time_step * slip.strength, slip.mobilised)
    if push is not None:
        rows.append(trunk_rows(push.touch, len(right)))
        before = jnp.einsum("cri,ci->cr", push.touch.frame, push.before[push.touch.pair])
        contacts = Contacts(push.touch.gap / time_step, push.cube.friction, before)
    row = jnp.concatenate(rows)
    solution = solve(jnp.concatenate([right[None], row]))
    compliance = jnp.einsum("ani,bni->ab", row, solution[1:])
    free = jnp.einsum("ani,ni->a", row, velocity + solution[0])
    free = free.at[: len(pull.slack)].add(pull.slack)
    if push is not None:
        # The cube takes part in the last rows only.
        on_cube, mass = push.touch.on_cube.reshape(-1, 6), inverse_inertia(push.cube)
        first = len(row) - len(on_cube)
        compliance = compliance.at[first:, first:].add((on_cube * mass) @ on_cube.T)
        free = free.at[first:].add(on_cube @ push.twist)
    found = solve_constraints(
        compliance, free, pull.previous, time_step, give=pull.give, slips=slips, contacts=contacts
    )
    increment = solution[0] + jnp.einsum("a,ani->ni", found.all, solution[1:])
    after = touching = None
    if push is not None:
        twist = push.twist + mass * (on_cube.T @ found.contact.ravel())
        after = moved(push.state, twist, time_step)
        touching = (
            jnp.zeros_like(push.before)
            .at[push.touch.pair]
            .set(jnp.einsum("cr,cri->ci", found.contact, push.touch.frame))
        )
    return ConstrainedStep(increment, found, after, touching)
