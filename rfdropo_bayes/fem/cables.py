"""Displacement-driven cables that can pull but not push.

A cable runs straight from a fixed anchor through guide points of the body to the last of them, where it is tied. Its
length may not exceed the commanded one; tension and slack are complementary (Signorini's condition, which
``fem.constraints`` solves).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.layered import LayeredBody, PointMap, attach


class CableLayout(NamedTuple):
    """Cables of a body; rows of unused guides repeat the last used one. NumPy arrays, fixed for a simulation."""

    anchor: Float[np.ndarray, "cables 3"]  # fixed in space [m]
    guide_node: Int[np.ndarray, "cables guides 8"]
    guide_weight: Float[np.ndarray, "cables guides 8"]
    guide_used: Bool[np.ndarray, "cables guides"]


def cable_layout(
    body: LayeredBody, anchors: Float[np.ndarray, "cables 3"], guides: Sequence[Float[np.ndarray, "guides 3"]]
) -> CableLayout:
    """Cables of a layered body; see `routed`."""
    return routed(partial(attach, body), anchors, guides)


def routed(
    bind: Callable[[Float[np.ndarray, "guides 3"]], PointMap],
    anchors: Float[np.ndarray, "cables 3"],
    guides: Sequence[Float[np.ndarray, "guides 3"]],
) -> CableLayout:
    """Cables from fixed anchors through guide points of the undeformed body [m]; each may have its own number of
    guides. ``bind`` ties points to the body's nodes.

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
        nodes[cable], weights[cable] = bind(
            np.concatenate([points, np.repeat(points[-1:], most - len(points), axis=0)])
        )
        used[cable, : len(points)] = True
    return CableLayout(anchors, nodes, weights, used)


def routes(layout: CableLayout, rest: Float[np.ndarray, "nodes 3"]) -> list[Float[np.ndarray, "points 3"]]:
    """Anchor and guides of every cable, with the nodes here [m]."""
    parts = zip(*layout, strict=True)
    return [
        np.vstack([anchor, np.einsum("gk,gki->gi", weight, rest[node])[used]]) for anchor, node, weight, used in parts
    ]


def guide_matrix(layout: CableLayout, nodes: int) -> Float[np.ndarray, "cables guides nodes"]:
    """Weights that turn node positions into guide positions: dense, because small products beat gathers in a batch."""
    cables, guides, _ = layout.guide_node.shape
    matrix = np.zeros((cables, guides, nodes))
    rows, columns = np.indices((cables, guides))
    np.add.at(matrix, (rows[..., None], columns[..., None], layout.guide_node), layout.guide_weight)
    return matrix


def segments(
    layout: CableLayout, guides: Float[Array, "cables guides nodes"], position: Float[Array, "nodes 3"]
) -> tuple[Float[Array, "cables guides 1"], Float[Array, "cables guides 3"]]:
    """Distance [m] from the point before to each guide, and the unit vector; zero where unused."""
    guided = jnp.einsum("cgn,ni->cgi", guides, position)
    points = jnp.concatenate([jnp.asarray(layout.anchor)[:, None, :], guided], axis=1)
    used = layout.guide_used[..., None]
    segment = jnp.where(used, points[:, 1:] - points[:, :-1], np.array([1.0, 0.0, 0.0]))
    length = jnp.sqrt(jnp.sum(segment**2, axis=-1, keepdims=True))
    return jnp.where(used, length, 0.0), jnp.where(used, segment / length, 0.0)


def lengths_and_jacobian(
    layout: CableLayout, guides: Float[Array, "cables guides nodes"], position: Float[Array, "nodes 3"]
) -> tuple[Float[Array, " cables"], Float[Array, "cables nodes 3"]]:
    """Cable lengths [m] and their derivatives with respect to the node positions."""
    length, direction = segments(layout, guides, position)
    pull = direction - jnp.concatenate([direction[:, 1:], jnp.zeros_like(direction[:, :1])], axis=1)
    return jnp.sum(length, axis=(1, 2)), jnp.einsum("cgn,cgi->cni", guides, pull)
