"""Cables, slip at their guides and contacts of a step as one convex problem, in the manner of SAP.

Impulses g make the relative velocities u = W g + b of their rows, with W the condensed compliance and b the velocities
without them. Every constraint answers its own velocity, g = P(u):

    cable     g = max(-u, 0) / R                                 it pulls and never pushes
    slip      g = h D clip(z - h u / PRESLIDING, -1, 1)          Prandtl's element, see ``fem.cable_friction``
    contact   y = g' + (v - u) / R projected onto the friction cone in the norm of R, with v = (-gap / h, 0, 0) and g'
              the tangential impulse of the step before: friction is a spring that slides, as Prandtl's element is

(Castro, Permenter and Han 2022, IEEE Trans. Robot. 39:1301). R is small against W: it is a numerical softness, not a
material's, and scales with the whole problem. P is the slope of a convex function, so that g is unique and a continuous
function of the inputs. Newton's method with an exact line search finds it from anywhere.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from rfdropo_bayes.fem.cable_friction import PRESLIDING
from rfdropo_bayes.fem.effects import Scalar

CABLE_SOFTNESS = 1e-9
"""R of a cable, relative to its entry on the diagonal of W; in single precision, see ``native.constraint_problem``."""
BETA = 1.0
"""A contact gives way with a period of BETA time steps; see docs/architecture.md for how it was chosen."""
NORMAL_SOFTNESS = BETA**2 / (4.0 * math.pi**2)
"""R of a contact's normal, relative to the mean entry w of its rows on that diagonal, which no turn of the tangents
changes."""
TANGENT_SOFTNESS = 1e-3
"""R of a contact's tangents relative to w: sticking contacts yield once by this share of the motion that friction stops
in a step.
"""
RIGID = 1e-12
"""Share of the largest entry on the diagonal of W below which a row counts as one of parts that cannot move."""
APART = 1e6
"""[m/s] Opening of a contact that exerts nothing."""
ITERATIONS = 60
TOLERANCE = 1e-9
"""Change of the velocities in an iteration, relative to the largest velocity, after which none is left to make."""
HALVINGS = 12
"""Bisections of a line search."""


class Slips(NamedTuple):
    """Friction of cables in their guides, by runs of guides."""

    impulse: Float[Array, " runs"]  # if all of the friction is mobilised [N s]
    mobilised: Float[Array, " runs"]  # share at the start of the step, -1 to 1


class Contacts(NamedTuple):
    """Contacts with three rows each: normal, two tangents."""

    opening: Float[Array, " contacts"]  # gap over the time step [m/s]
    friction: Scalar
    before: Float[Array, "contacts 3"]  # impulses of the previous step, in the rows of this step [N s]


class Problem(NamedTuple):
    """Everything but the free velocities."""

    compliance: Float[Array, "n n"]  # W
    softness: Float[Array, " cables"]  # R; infinite for a cable that nothing can shorten
    slips: Slips
    contacts: Contacts
    normal: Float[Array, " contacts"]  # R
    tangent: Float[Array, " contacts"]
    rigid: Bool[Array, " contacts"]  # of parts that cannot move: they exert nothing
    time_step: Scalar


class Law(NamedTuple):
    """P at a velocity, and minus its derivative G."""

    impulse: Float[Array, " n"]
    line: Float[Array, " lines"]  # of cables and slip
    block: Float[Array, "contacts 3 3"]


def _contact_law(problem: Problem, velocity: Float[Array, "contacts 3"]) -> tuple[Array, Array]:
    """Impulses of contacts at a relative velocity, and minus their derivatives."""
    friction, normal, tangent = problem.contacts.friction, problem.normal, problem.tangent
    opening = jnp.where(problem.rigid, APART, problem.contacts.opening)
    y = (-opening - velocity[:, 0]) / normal
    x = problem.contacts.before[:, 1:] - velocity[:, 1:] / tangent[:, None]
    square = jnp.sum(x**2, axis=1)
    moving = square > 0.0
    size = jnp.sqrt(jnp.where(moving, square, 1.0))
    direction = jnp.where(moving[:, None], x, 0.0) / size[:, None]
    size = jnp.where(moving, size, 0.0)
    hat = friction * tangent / normal
    sticks = size < friction * y
    apart = y <= -hat * size
    grown = 1.0 / (1.0 + friction * hat)
    push = (y + hat * size) * grown
    slide = jnp.concatenate([push[:, None], friction * push[:, None] * direction], axis=1)
    stick = jnp.concatenate([y[:, None], x], axis=1)
    impulse = jnp.where(apart[:, None], 0.0, jnp.where(sticks[:, None], stick, slide))
    along = jnp.concatenate([jnp.ones_like(y)[:, None], friction * direction], axis=1)
    across = jnp.stack([0.0 * y, -direction[:, 1], direction[:, 0]], axis=1)
    turning = friction * push / jnp.where(moving, size * tangent, 1.0)
    sliding = (grown / normal)[:, None, None] * along[:, :, None] * along[:, None, :]
    sliding = sliding + turning[:, None, None] * across[:, :, None] * across[:, None, :]
    firm = jnp.stack([1.0 / normal, 1.0 / tangent, 1.0 / tangent], axis=1)[:, :, None] * jnp.eye(3)
    block = jnp.where(apart[:, None, None], 0.0, jnp.where(sticks[:, None, None], firm, sliding))
    return impulse, block


def answers(problem: Problem, velocity: Float[Array, " n"]) -> Law:
    """Impulse of every row as a function of its velocity."""
    cables, runs = len(problem.softness), len(problem.slips.impulse)
    firmness = jnp.where(velocity[:cables] < 0.0, 1.0 / problem.softness, 0.0)
    follows = problem.time_step / PRESLIDING
    trial = problem.slips.mobilised - follows * velocity[cables : cables + runs]
    share = jnp.clip(trial, -1.0, 1.0)
    rubbing = jnp.where(jnp.abs(trial) < 1.0, follows * problem.slips.impulse, 0.0)
    impulse, block = _contact_law(problem, velocity[cables + runs :].reshape(-1, 3))
    lines = jnp.concatenate([-firmness * velocity[:cables], problem.slips.impulse * share])
    return Law(jnp.concatenate([lines, impulse.ravel()]), jnp.concatenate([firmness, rubbing]), block)


def _newton_step(problem: Problem, law: Law, impulse: Float[Array, " n"]) -> Float[Array, " n"]:
    """d of (I + G W) d = P - g."""
    lines = len(law.line)
    top = law.line[:, None] * problem.compliance[:lines]
    rest = jnp.einsum("cij,cjn->cin", law.block, problem.compliance[lines:].reshape(-1, 3, len(impulse)))
    matrix = jnp.eye(len(impulse)) + jnp.concatenate([top, rest.reshape(-1, len(impulse))])
    return jnp.linalg.solve(matrix, law.impulse - impulse)


def slope_matrix(law: Law) -> Float[Array, "n n"]:
    """G of all rows."""
    lines, contacts = len(law.line), len(law.block)
    whole = jnp.zeros((lines + 3 * contacts, lines + 3 * contacts))
    whole = whole.at[jnp.arange(lines), jnp.arange(lines)].set(law.line)
    place = lines + 3 * np.arange(contacts)[:, None] + np.arange(3)
    return whole.at[place[:, :, None], place[:, None, :]].set(law.block)


def settle(
    problem: Problem, free: Float[Array, " n"], start: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Bool[Array, ""]]:
    """Impulses from any start, and whether the iterations ended in time."""
    compliance = problem.compliance

    def one(carry):
        impulse, _, iteration = carry
        velocity = free + compliance @ impulse
        change = _newton_step(problem, answers(problem, velocity), impulse)
        moving = compliance @ change

        def slope(share):
            wanted = answers(problem, velocity + share * moving).impulse
            return moving @ (impulse + share * change - wanted)

        def halve(_, bounds):
            low, high = bounds
            middle = 0.5 * (low + high)
            ahead = slope(middle) > 0.0
            return jnp.where(ahead, low, middle), jnp.where(ahead, middle, high)

        low, high = lax.fori_loop(0, HALVINGS, halve, (0.0, 1.0))
        largest = jnp.maximum(jnp.max(jnp.abs(free)), jnp.max(jnp.abs(velocity)))
        going = jnp.max(jnp.abs(moving)) > TOLERANCE * largest
        share = jnp.where((slope(1.0) > 0.0) & going, 0.5 * (low + high), 1.0)
        return impulse + share * change, going, iteration + 1

    impulse, going, _ = lax.while_loop(lambda c: c[1] & (c[2] < ITERATIONS), one, (start, jnp.array(True), 0))
    return impulse, ~going


def posed(
    compliance: Float[Array, "n n"],
    cables: int,
    time_step: Scalar,
    slips: Slips | None = None,
    contacts: Contacts | None = None,
) -> Problem:
    """The problem with the softness of its rows."""
    slips = slips or Slips(jnp.zeros(0), jnp.zeros(0))
    contacts = contacts or Contacts(jnp.zeros(0), 0.0, jnp.zeros((0, 3)))
    diagonal = jnp.diagonal(compliance)
    drives, mean = diagonal[:cables], jnp.mean(diagonal[cables + len(slips.impulse) :].reshape(-1, 3), axis=1)
    usable = drives > RIGID * jnp.max(drives, initial=0.0)
    rigid = mean <= RIGID * jnp.max(mean, initial=0.0)
    mean = jnp.where(rigid, 1.0, mean)
    softness = jnp.where(usable, CABLE_SOFTNESS * drives, jnp.inf)
    normal, tangent = NORMAL_SOFTNESS * mean, TANGENT_SOFTNESS * mean
    return Problem(compliance, softness, slips, contacts, normal, tangent, rigid, time_step)
