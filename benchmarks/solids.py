"""Linear problems of solid hexahedra with the element that the layers are made of, on meshes of bricks."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float, Int
from rfdropo_bayes.fem.hexahedron import elastic_stiffness, elasticity
from scipy.sparse.linalg import spsolve


def bricks(
    counts: tuple[int, int, int], shape: Callable[[np.ndarray], np.ndarray]
) -> tuple[Float[np.ndarray, "nodes 3"], Int[np.ndarray, "elements 8"]]:
    """Nodes and elements of a grid over the unit cube, mapped by ``shape``; x runs fastest, as the element numbers."""
    nx, ny, nz = counts
    axes = [np.linspace(0.0, 1.0, count + 1) for count in counts]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    corner = [((c * (ny + 1)) + b) * (nx + 1) + a for c in range(2) for b in range(2) for a in range(2)]
    k, j, i = np.meshgrid(range(nz), range(ny), range(nx), indexing="ij")
    first = (k * (ny + 1) + j) * (nx + 1) + i
    return shape(np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)), first.ravel()[:, None] + np.array(corner)


def deflection(
    nodes: Float[np.ndarray, "nodes 3"],
    elements: Int[np.ndarray, "elements 8"],
    young: float,
    poisson: float,
    held: Float[np.ndarray, "nodes 3"],
    force: Float[np.ndarray, "nodes 3"],
) -> Float[np.ndarray, "nodes 3"]:
    """Displacement under nodal forces; ``held`` marks the components that are fixed."""
    matrices = jax.jit(jax.vmap(lambda x: elastic_stiffness(x, elasticity(young, poisson))))(
        jnp.asarray(nodes[elements])
    )
    place = (3 * elements[:, :, None] + np.arange(3)).reshape(len(elements), 24)
    rows, columns = np.repeat(place, 24, axis=1).ravel(), np.tile(place, (1, 24)).ravel()
    total = sparse.coo_matrix((np.asarray(matrices).ravel(), (rows, columns)), shape=(nodes.size,) * 2).tocsc()
    free = np.flatnonzero(~held.ravel().astype(bool))
    moved = np.zeros(nodes.size)
    moved[free] = spsolve(total[free][:, free], force.ravel()[free])
    return moved.reshape(-1, 3)


def on_face(
    nodes: Float[np.ndarray, "nodes 3"], face: np.ndarray, counts: tuple[int, int], direction: np.ndarray
) -> Float[np.ndarray, "nodes 3"]:
    """A unit force spread evenly over a face of ``counts`` equal bricks: ``face`` lists its nodes, rows fastest."""
    share = [np.r_[0.5, np.ones(count - 1), 0.5] / count for count in counts]
    force = np.zeros(nodes.shape)
    force[face] = np.outer(share[1], share[0]).ravel()[:, None] * direction
    return force


def macneal_beam(direction: int) -> float:
    """Straight cantilever of MacNeal and Harder, 6 x 0.2 x 0.1, under a unit force at its end (0: along, 1: in plane,
    2: out of plane) or a unit torque (3: the twist)."""
    counts = (48, 8, 4)
    nodes, elements = bricks(counts, lambda u: u * [6.0, 0.2, 0.1])
    face = np.flatnonzero(nodes[:, 0] > 6.0 - 1e-9)
    held = np.tile(nodes[:, :1] < 1e-9, (1, 3))
    if direction < 3:
        force = on_face(nodes, face, counts[1:], np.eye(3)[direction])
        return float(deflection(nodes, elements, 1e7, 0.3, held, force)[face, direction].mean())
    arm = nodes[face] - [6.0, 0.1, 0.05]
    force = np.zeros(nodes.shape)
    # Shear that grows with the distance from the axis; the work of the end's rotation is that of the torque.
    weight = on_face(nodes, face, counts[1:], np.ones(3))[face]
    force[face, 1], force[face, 2] = -arm[:, 2] * weight[:, 1], arm[:, 1] * weight[:, 2]
    force /= np.sum(arm[:, 1] * force[face, 2] - arm[:, 2] * force[face, 1])
    moved = deflection(nodes, elements, 1e7, 0.3, held, force)[face]
    return float(np.sum(arm[:, 1] * moved[:, 2] - arm[:, 2] * moved[:, 1]) / np.sum(arm[:, 1:] ** 2))


def twisted_beam(direction: int) -> float:
    """MacNeal and Harder's beam twisted by 90 degrees, 12 x 1.1 x 0.32, under a unit force in plane (1) or out (2)."""

    def shape(unit: np.ndarray) -> np.ndarray:
        angle = unit[:, 0] * np.pi / 2
        y, z = 1.1 * (unit[:, 1] - 0.5), 0.32 * (unit[:, 2] - 0.5)
        return np.stack(
            [12.0 * unit[:, 0], np.cos(angle) * y - np.sin(angle) * z, np.sin(angle) * y + np.cos(angle) * z], axis=1
        )

    counts = (48, 8, 4)
    nodes, elements = bricks(counts, shape)
    face = np.flatnonzero(nodes[:, 0] > 12.0 - 1e-9)
    held = np.tile(nodes[:, :1] < 1e-9, (1, 3))
    force = on_face(nodes, face, counts[1:], np.eye(3)[direction])
    return float(deflection(nodes, elements, 29e6, 0.22, held, force)[face, direction].mean())


def cook_membrane(height: float, elements_across: int = 32) -> float:
    """Cook's membrane in plane stress, E = 1, Poisson ratio 1/3, unit shear: deflection at (48, ``height``)."""
    counts = (elements_across, elements_across, 1)

    def shape(unit: np.ndarray) -> np.ndarray:
        x = 48.0 * unit[:, 0]
        low, high = 44.0 * unit[:, 0], 44.0 + 16.0 * unit[:, 0]
        return np.stack([x, low + (high - low) * unit[:, 1], unit[:, 2]], axis=1)

    nodes, elements = bricks(counts, shape)
    face = np.flatnonzero(nodes[:, 0] > 48.0 - 1e-9)
    wall = nodes[:, 0] < 1e-9
    held = np.stack([wall, wall, nodes[:, 2] < 1e-9], axis=1)
    force = on_face(nodes, face, counts[1:], np.array([0.0, 1.0, 0.0]))
    moved = deflection(nodes, elements, 1.0, 1.0 / 3.0, held, force)
    corner = (nodes[:, 0] > 48.0 - 1e-9) & (np.abs(nodes[:, 1] - height) < 1e-9)
    return float(moved[corner, 1].mean())
