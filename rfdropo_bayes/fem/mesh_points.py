"""Material points of a mesh and cables through them: weighted sums of the places of nodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from rfdropo_bayes.fem.cables import routed


class NodePoints(NamedTuple):
    """Material points as weighted sums of nodes."""

    node: Int[np.ndarray, "points k"]
    weight: Float[np.ndarray, "points k"]


class NodeCables(NamedTuple):
    """Cables of a mesh; rows of unused guides repeat the last used one. NumPy arrays, fixed for a simulation."""

    anchor: Float[np.ndarray, "cables 3"]  # fixed in space [m]
    guide_node: Int[np.ndarray, "cables guides k"]
    guide_weight: Float[np.ndarray, "cables guides k"]
    guide_used: Bool[np.ndarray, "cables guides"]


def joined(maps: Sequence[NodePoints]) -> NodePoints:
    """The points of all maps, one after the other."""
    width = max(points.node.shape[1] for points in maps)
    padded = [[np.pad(part, ((0, 0), (0, width - part.shape[1]))) for part in points] for points in maps]
    return NodePoints(*(np.concatenate(parts) for parts in zip(*padded, strict=True)))


def node_cables(
    bind: Callable[[Float[np.ndarray, "guides 3"]], NodePoints],
    anchors: Float[np.ndarray, "cables 3"],
    guides: Sequence[Float[np.ndarray, "guides 3"]],
) -> NodeCables:
    """Cables from fixed anchors through guide points of the undeformed body [m], which ``bind`` ties to nodes; errors
    as `routed`."""
    anchors, points, used = routed(anchors, guides)
    bound = bind(points.reshape(-1, 3))
    node, weight = (part.reshape(*used.shape, -1) for part in bound)
    return NodeCables(anchors, node, weight, used)


def routes(cables: NodeCables, rest: Float[np.ndarray, "nodes 3"]) -> list[Float[np.ndarray, "points 3"]]:
    """Anchor and guides of every cable, with the nodes here [m]."""
    parts = zip(*cables, strict=True)
    return [
        np.vstack([anchor, np.einsum("gk,gki->gi", weight, rest[node])[used]]) for anchor, node, weight, used in parts
    ]
