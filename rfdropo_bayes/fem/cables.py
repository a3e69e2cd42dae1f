"""Displacement-driven cables that can pull but not push.

A cable runs straight from a fixed anchor through guide points of the body to the last of them, where it is tied. Its
length may not exceed the commanded one; tension and slack are complementary (Signorini's condition), which after
condensation is a small linear complementarity problem.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.layered import LayeredBody, attach

REGULARISATION = 1e-9
"""Relative compliance added to every cable, so that cables which share one route still have a definite tension."""
FULL_EXCHANGES = 4
"""Exchanges of the whole active set that may pass without progress before single exchanges take over."""
MAX_EXCHANGES = 60


class CableLayout(NamedTuple):
    """Cables of a body; rows of unused guides repeat the last used one. NumPy arrays, fixed for a simulation."""

    anchor: Float[np.ndarray, "cables 3"]  # fixed in space [m]
    guide_node: Int[np.ndarray, "cables guides 8"]
    guide_weight: Float[np.ndarray, "cables guides 8"]
    guide_used: Bool[np.ndarray, "cables guides"]


class Tensions(NamedTuple):
    """Solution of the unilateral cable problem."""

    tension: Float[Array, " cables"]  # [N], never negative
    converged: Bool[Array, ""]


def cable_layout(
    body: LayeredBody, anchors: Float[np.ndarray, "cables 3"], guides: Sequence[Float[np.ndarray, "guides 3"]]
) -> CableLayout:
    """Cables from fixed anchors through guide points on the undeformed body [m]; each may have its own number of
    guides.

    Raises:
        InputError: a cable without guides, or with two successive points at the same place.
    """
    anchors = np.asarray(anchors, dtype=float).reshape(-1, 3)
    if len(anchors) != len(guides):
        raise InputError(f"{len(anchors)} anchors but {len(guides)} lists of guides", where="cables")
    most = max((len(points) for points in guides), default=1)
    nodes, weights = np.zeros((len(guides), most, 8), dtype=int), np.zeros((len(guides), most, 8))
    used = np.zeros((len(guides), most), dtype=bool)
    for cable, points in enumerate(guides):
        points = np.asarray(points, dtype=float).reshape(-1, 3)
        if len(points) == 0:
            raise InputError("no guide point", where=f"cable {cable}", remedy="give the point where it is tied")
        steps = np.linalg.norm(np.diff(np.concatenate([anchors[cable : cable + 1], points]), axis=0), axis=1)
        if not np.all(steps > 1e-9):
            raise InputError("two successive points coincide", where=f"cable {cable}", remedy="remove one of them")
        attached = attach(body, np.concatenate([points, np.repeat(points[-1:], most - len(points), axis=0)]))
        nodes[cable], weights[cable] = attached
        used[cable, : len(points)] = True
    return CableLayout(anchors, nodes, weights, used)


def guide_matrix(layout: CableLayout, nodes: int) -> Float[np.ndarray, "cables guides nodes"]:
    """Weights that turn node positions into guide positions: dense, because small products beat gathers in a batch."""
    cables, guides, _ = layout.guide_node.shape
    matrix = np.zeros((cables, guides, nodes))
    rows, columns = np.indices((cables, guides))
    np.add.at(matrix, (rows[..., None], columns[..., None], layout.guide_node), layout.guide_weight)
    return matrix


def lengths_and_jacobian(
    layout: CableLayout, guides: Float[Array, "cables guides nodes"], position: Float[Array, "nodes 3"]
) -> tuple[Float[Array, " cables"], Float[Array, "cables nodes 3"]]:
    """Cable lengths [m] and their derivatives with respect to the node positions."""
    guided = jnp.einsum("cgn,ni->cgi", guides, position)
    points = jnp.concatenate([jnp.asarray(layout.anchor)[:, None, :], guided], axis=1)
    used = layout.guide_used[..., None]
    segment = jnp.where(used, points[:, 1:] - points[:, :-1], np.array([1.0, 0.0, 0.0]))
    length = jnp.sqrt(jnp.sum(segment**2, axis=-1, keepdims=True))
    direction = jnp.where(used, segment / length, 0.0)
    pull = direction - jnp.concatenate([direction[:, 1:], jnp.zeros_like(direction[:, :1])], axis=1)
    return jnp.sum(jnp.where(used, length, 0.0), axis=(1, 2)), jnp.einsum("cgn,cgi->cni", guides, pull)


def masked_solve(
    matrix: Float[Array, "c c"], right: Float[Array, "c *k"], active: Bool[Array, " c"]
) -> Float[Array, "c *k"]:
    """Solve for the active unknowns, for one right-hand side or several columns; the others are zero."""
    reduced = jnp.where(active[:, None] & active[None, :], matrix, jnp.eye(len(right)))
    rows = active.reshape(-1, *[1] * (right.ndim - 1))
    return jnp.where(rows, jnp.linalg.solve(reduced, jnp.where(rows, right, 0.0)), 0.0)


def _active_set(
    matrix: Float[Array, "c c"], offset: Float[Array, " c"], start: Bool[Array, " c"], usable: Bool[Array, " c"]
) -> tuple[Bool[Array, " c"], Bool[Array, ""]]:
    """Active set of the complementarity problem w = M t + q, by block principal pivoting.

    Exchanging every infeasible index at once is the primal-dual active set method: fast, but it can cycle. After a few
    exchanges without progress only the infeasible index of highest number is exchanged (Murty), which ends for every
    positive definite M (Judice and Pires 1994, Computers & Operations Research 21:587-596). M has unit diagonal here,
    so that t and w share a scale.
    """
    count = len(offset)
    tolerance = 1e-10 * jnp.max(jnp.abs(offset))

    def infeasible(active: Bool[Array, " c"]) -> Bool[Array, " c"]:
        value = masked_solve(matrix, -offset, active)
        slack = matrix @ value + offset
        return usable & jnp.where(active, value < -tolerance, slack < -tolerance)

    def exchange(carry):
        active, wrong, fewest, chances, iteration = carry
        number = jnp.sum(wrong)
        better = number < fewest
        chances = jnp.where(better, FULL_EXCHANGES, chances - 1)
        last = jnp.arange(count) == jnp.max(jnp.where(wrong, jnp.arange(count), -1))
        active = active ^ (wrong & (last | (chances > 0)))
        return active, infeasible(active), jnp.minimum(number, fewest), chances, iteration + 1

    def unfinished(carry):
        return jnp.any(carry[1]) & (carry[4] < MAX_EXCHANGES)

    start = start & usable
    active, wrong, *_ = lax.while_loop(unfinished, exchange, (start, infeasible(start), count + 1, FULL_EXCHANGES, 0))
    return active, ~jnp.any(wrong)


def _usable(diagonal: Float[Array, " c"]) -> Bool[Array, " c"]:
    """Cables that can shorten at all."""
    return diagonal > 1e-12 * jnp.max(diagonal)


def pulling_cables(
    compliance: Float[Array, "c c"], slack: Float[Array, " c"], previous: Float[Array, " c"]
) -> tuple[Bool[Array, " c"], Float[Array, "c c"]]:
    """Which cables pull, as in `unilateral_tensions`, and the compliance [m/N] that determines their tensions."""
    diagonal = jnp.diagonal(compliance)
    usable = _usable(diagonal)
    scale = jnp.where(usable, 1.0 / jnp.sqrt(jnp.where(usable, diagonal, 1.0)), 0.0)
    matrix = compliance * scale[:, None] * scale[None, :] + REGULARISATION * jnp.eye(len(slack))
    active, _ = _active_set(
        lax.stop_gradient(matrix), lax.stop_gradient(slack * scale), lax.stop_gradient(previous) > 0.0, usable
    )
    return active, compliance + REGULARISATION * jnp.diag(diagonal)


def unilateral_tensions(
    compliance: Float[Array, "c c"], slack: Float[Array, " c"], previous: Float[Array, " c"]
) -> Tensions:
    """Tensions T >= 0 complementary to the slack left, ``slack + compliance @ T`` >= 0.

    ``compliance`` [m/N] is symmetric positive semi-definite, ``slack`` [m] the commanded length minus the length the
    cable would have without tension. ``previous`` tensions start the active set. Differentiable given that set.
    """
    diagonal = jnp.diagonal(compliance)
    usable = _usable(diagonal)
    scale = jnp.where(usable, 1.0 / jnp.sqrt(jnp.where(usable, diagonal, 1.0)), 0.0)
    matrix = compliance * scale[:, None] * scale[None, :] + REGULARISATION * jnp.eye(len(slack))
    offset = slack * scale
    active, converged = _active_set(
        lax.stop_gradient(matrix), lax.stop_gradient(offset), lax.stop_gradient(previous) > 0.0, usable
    )
    tension = scale * masked_solve(matrix, -offset, active)
    return Tensions(jnp.maximum(tension, 0.0), converged)
