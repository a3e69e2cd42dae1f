"""Constraints of a step solved on their own, as `fem.stage_solve` solves them within a step."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rfdropo_bayes.fem.cable_friction import PRESLIDING
from rfdropo_bayes.fem.constraints import Contacts, Slips, posed, settle
from rfdropo_bayes.fem.effects import Scalar


class Impulses(NamedTuple):
    """Impulses [N s], in the order of their rows."""

    all: Float[Array, " n"]
    cable: Float[Array, " cables"]
    share: Float[Array, " runs"]  # of the cables' friction that is mobilised at the end of the step
    slip: Float[Array, " runs"]
    contact: Float[Array, "contacts 3"]  # along the normal, and two tangents
    converged: Bool[Array, ""]


def solve_constraints(
    compliance: Float[Array, "n n"],
    free: Float[Array, " n"],
    previous: Float[Array, " cables"],
    time_step: Scalar,
    slips: Slips | None = None,
    contacts: Contacts | None = None,
) -> Impulses:
    """Impulses of cables, slip and contacts, from velocities ``free`` [m/s] without them and the cables' impulses
    before."""
    problem, cables = posed(compliance, len(previous), time_step, slips, contacts), len(previous)
    lines = cables + len(problem.slips.impulse)
    start = jnp.concatenate([previous, jnp.zeros(lines - cables), problem.contacts.before.ravel()])
    found, converged = settle(problem, free, start)
    velocity = free + compliance @ found
    share = problem.slips.mobilised - time_step / PRESLIDING * velocity[cables:lines]
    return Impulses(
        found,
        jnp.maximum(found[:cables], 0.0),
        jnp.clip(share, -1.0, 1.0),
        found[cables:lines],
        found[lines:].reshape(-1, 3),
        converged,
    )
