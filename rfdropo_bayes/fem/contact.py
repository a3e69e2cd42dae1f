"""Contacts with Coulomb friction, condensed to the contact points and solved by projected Gauss-Seidel.

Everything is on the level of velocities. With W the condensed compliance, p the impulses and b what the velocities
would be without them, the relative velocity u = W p + b of a contact obeys

    0 <= p_n  perpendicular to  u_n + gap / h >= 0,    |p_t| <= mu p_n,  p_t opposite to u_t where it slides,

which keeps the gap open at the end of the step (Moreau 1988; the scheme of SOFA's GenericConstraintSolver, Duriez et
al. 2006, IEEE TVCG 12:36). Unilateral cables stand beside the contacts in W; those that pull are eliminated exactly
before the sweeps, which then converge as if there were contacts only.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rfdropo_bayes.fem.cables import masked_solve, pulling_cables, unilateral_tensions

Scalar = Float[Array, ""] | float

SWEEPS = 100
"""Gauss-Seidel sweeps over all contacts between two choices of the cables that pull."""
CABLE_CHOICES = 3
REGULARISATION = 1e-12
"""Compliance added to every contact, relative to the largest: some lie between parts that cannot move."""
TOLERANCE = 1e-3
"""Relative error of the impulses up to which a step counts as solved."""


class Impulses(NamedTuple):
    """What a step's constraints exert."""

    cable: Float[Array, " cables"]  # [N s], never negative
    contact: Float[Array, "contacts 3"]  # [N s]: along the normal, never negative, and two tangents
    converged: Bool[Array, ""]
    cables_converged: Bool[Array, ""]


def contact_frame(normal: Float[Array, "contacts 3"]) -> Float[Array, "contacts 3 3"]:
    """Rows: the normal, and two tangents; the first is across the axis that the normal is furthest from."""
    axis = jnp.eye(3)[jnp.argmin(jnp.abs(normal), axis=1)]
    first = jnp.cross(normal, axis)
    first = first / jnp.linalg.norm(first, axis=1, keepdims=True)
    return jnp.stack([normal, first, jnp.cross(normal, first)], axis=1)


def distance_to_box(
    points: Float[Array, "points 3"], centre: Float[Array, "3"], turn: Float[Array, "3 3"], side: Scalar
) -> tuple[Float[Array, " points"], Float[Array, "points 3"]]:
    """Signed distance [m] of points to a cube's surface, negative inside, and its gradient: the outward normal.

    Inside, the nearest face counts.
    """
    local = (points - centre) @ turn
    beyond = jnp.abs(local) - 0.5 * side
    outside = jnp.maximum(beyond, 0.0)
    square = jnp.sum(outside**2, axis=1)
    far = square > 0.0
    length = jnp.sqrt(jnp.where(far, square, 1.0))
    deepest = jnp.eye(3)[jnp.argmax(beyond, axis=1)]
    direction = jnp.where(far[:, None], outside / length[:, None], deepest) * jnp.where(local < 0.0, -1.0, 1.0)
    return jnp.where(far, length, jnp.max(beyond, axis=1)), direction @ turn.T


def _project(normal: Array, tangent: Float[Array, "2"], friction: Scalar) -> Float[Array, "2"]:
    """The tangential impulse, shortened to the friction cone."""
    square = jnp.sum(tangent**2)
    limit = friction * normal
    beyond = square > limit**2
    return jnp.where(beyond, tangent * limit / jnp.sqrt(jnp.where(beyond, square, 1.0)), tangent)


def _updated(
    compliance: Float[Array, "n n"], free: Float[Array, " n"], impulse: Float[Array, " n"], at: Array, friction: Scalar
) -> Float[Array, "3"]:
    """Impulse of the contact whose rows begin at ``at``, given all others: its normal first, then its tangents."""
    rows = lax.dynamic_slice(compliance, (at, 0), (3, compliance.shape[1]))
    block = lax.dynamic_slice(rows, (0, at), (3, 3))
    old = lax.dynamic_slice(impulse, (at,), (3,))
    velocity = rows @ impulse + lax.dynamic_slice(free, (at,), (3,))
    normal = jnp.maximum(old[0] - velocity[0] / block[0, 0], 0.0)
    sliding = velocity[1:] + block[1:, 0] * (normal - old[0])
    tangent = old[1:] - sliding * 2.0 / (block[1, 1] + block[2, 2])
    return jnp.concatenate([normal[None], _project(normal, tangent, friction)])


def gauss_seidel(
    compliance: Float[Array, "n n"],
    free: Float[Array, " n"],
    start: Float[Array, " n"],
    friction: Scalar,
    sweeps: int = SWEEPS,
) -> Float[Array, " n"]:
    """Impulses [N s] after a fixed number of sweeps over contacts of three rows each."""
    contacts = len(free) // 3

    def one(impulse: Array, index: Array) -> tuple[Array, None]:
        at = 3 * (index % contacts)
        return lax.dynamic_update_slice(impulse, _updated(compliance, free, impulse, at, friction), (at,)), None

    return lax.scan(one, start, jnp.arange(sweeps * contacts))[0]


def contact_error(
    compliance: Float[Array, "n n"], free: Float[Array, " n"], impulse: Float[Array, " n"], friction: Scalar
) -> Float[Array, ""]:
    """Largest change that a contact's own law would make to its impulse, over the largest impulse."""
    at = 3 * jnp.arange(len(free) // 3)
    wanted = jax.vmap(lambda a: _updated(compliance, free, impulse, a, friction))(at)
    largest = jnp.max(jnp.abs(impulse))
    return jnp.max(jnp.abs(wanted - impulse.reshape(-1, 3))) / jnp.where(largest > 0.0, largest, 1.0)


def solve_constraints(
    compliance: Float[Array, "n n"],
    free: Float[Array, " n"],
    cables: int,
    friction: Scalar,
    previous: Float[Array, " cables"],
) -> Impulses:
    """Impulses of unilateral cables (the first rows) and of contacts (three rows each, normal first).

    Args:
        compliance: symmetric condensed compliance W [1/kg].
        free: relative velocities without impulses [m/s]: the rate at which a cable may still shorten, and of a contact
            gap / h plus the rate at which it opens.
        previous: impulses of the cables in the step before; they start the choice of those that pull.
    """
    own = compliance[cables:, cables:]
    own = own + REGULARISATION * jnp.max(jnp.diagonal(own)) * jnp.eye(len(own))
    start = jnp.zeros(len(own))
    if not cables:
        impulse = gauss_seidel(own, free, start, friction, CABLE_CHOICES * SWEEPS)
        error = contact_error(own, free, impulse, friction)
        return Impulses(previous, impulse.reshape(-1, 3), error <= TOLERANCE, jnp.array(True))
    across, among, rate = compliance[:cables, cables:], compliance[:cables, :cables], free[:cables]

    def choice(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        impulse, tension = carry
        pulling, matrix = pulling_cables(among, rate + across @ impulse, tension)
        held = masked_solve(matrix, jnp.concatenate([across, rate[:, None]], axis=1), pulling)
        reduced, reduced_free = own - across.T @ held[:, :-1], free[cables:] - across.T @ held[:, -1]
        impulse = gauss_seidel(reduced, reduced_free, impulse, friction)
        return (impulse, jnp.maximum(-held[:, -1] - held[:, :-1] @ impulse, 0.0)), None

    impulse, tension = lax.scan(choice, (start, previous), None, length=CABLE_CHOICES)[0]
    tension, cables_converged = unilateral_tensions(among, rate + across @ impulse, tension)
    error = contact_error(own, free[cables:] + across.T @ tension, impulse, friction)
    return Impulses(tension, impulse.reshape(-1, 3), error <= TOLERANCE, cables_converged)
