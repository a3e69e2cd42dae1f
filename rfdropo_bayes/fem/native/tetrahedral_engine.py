"""Whole rollouts of a tetrahedral body on a CPU: samples packed into SIMD lanes, lane blocks spread over threads."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.cable_drive import DriveLimits
from rfdropo_bayes.fem.dynamics import LOST
from rfdropo_bayes.fem.integrators import Integrator, timed_stages
from rfdropo_bayes.fem.mesh_points import NodeCables, NodePoints, routes
from rfdropo_bayes.fem.native import tetrahedral_rollout as kernels
from rfdropo_bayes.fem.native.block_cholesky import BlockPattern, analyse, block_slot, elimination_order
from rfdropo_bayes.fem.native.constraint_problem import SETTLED, SOFTNESS, ConstraintProblem, problem_storage
from rfdropo_bayes.fem.native.contact_records import (
    ContactRecords,
    PushOutput,
    cube_rows,
    mesh_scene,
    pairs_of,
    touch_storage,
)
from rfdropo_bayes.fem.native.kernel_cache import kernel_sources
from rfdropo_bayes.fem.native.lane_blocks import in_blocks
from rfdropo_bayes.fem.native.rod_constraints import Rows, row_storage
from rfdropo_bayes.fem.native.simd import aligned_zeros, lane_token, native_lanes
from rfdropo_bayes.fem.native.tetrahedral import Mesh, TetrahedralSamples, TetrahedralWork
from rfdropo_bayes.fem.pushing import PushGeometry
from rfdropo_bayes.fem.rollouts import Motion
from rfdropo_bayes.fem.tetrahedra import POISSON_LIMIT, TetrahedralBody
from rfdropo_bayes.runtime import available_processors


class TetrahedralEngine:
    """A body, its cables and its recorded points, prepared for rollouts in one precision.

    Args:
        dtype: ``numpy.float64`` or ``numpy.float32``.
        threads: number of lane blocks at a time; results do not depend on it.
        scene: geometry on which the body pushes a cube; None for a body that touches nothing.
        integrator: scheme of a step; SOFA's drive limits, which apply per step, need "euler".
    """

    def __init__(
        self,
        body: TetrahedralBody,
        cables: NodeCables,
        limits: DriveLimits,
        points: NodePoints,
        *,
        dtype: type = np.float64,
        threads: int | None = None,
        scene: PushGeometry | None = None,
        integrator: Integrator = "euler",
    ) -> None:
        self.integrator: Integrator = integrator
        self.body, self.dtype, self.points = body, np.dtype(dtype), points
        self._kernel = _kernel()  # here, so that threads do not make one each
        self.lanes = native_lanes(dtype)
        self.threads = threads or available_processors()
        self._order, self._number = _numbering(body)
        self._rest = body.rest[self._order].astype(self.dtype).ravel()
        self._reach = LOST * float(np.ptp(body.rest, axis=0).max())
        self._pattern = _pattern(body, self._number, len(cables.anchor))
        # Elements in the order in which the factorisation needs them: their blocks are then still in cache.
        self._elements = np.argsort(self._number[body.element].min(axis=1), kind="stable")
        self._mesh = _mesh(body, self._elements, self._number, self._pattern, self.dtype)
        self._cables = _cables(cables, limits, body, self._number, self.dtype)
        self._nodes = np.ascontiguousarray(self._number[points.node], dtype=np.int32)
        self._weights = np.ascontiguousarray(points.weight, dtype=self.dtype)
        self._scene = None if scene is None else mesh_scene(scene, self._number, self.dtype.type)

    def rollouts(
        self,
        parameters: Mapping[str, np.ndarray],
        commands: Float[np.ndarray, "*samples steps cables"],
        *,
        time_step: float,
        stride: int = 1,
        cube: tuple[Float[np.ndarray, "*samples 13"], Float[np.ndarray, "*samples 4"]] | None = None,
    ) -> Motion:
        """Rollouts from rest through the commanded displacements [m] of every step, recorded every ``stride`` steps.

        ``parameters`` holds, with a leading axis of samples: ``young_modulus`` [Pa], ``poisson_ratio``, ``node_mass``
        (nodes) [kg], ``rayleigh_mass`` [1/s], ``rayleigh_stiffness`` [s], ``gravity`` (3) [m/s2], and optionally
        ``stiffness_scale`` (elements). ``cube`` as in ``NativeRod.rollout``.

        Raises:
            InputError: shapes that do not fit, a cube without a scene or a scene without a cube.
        """
        samples = len(parameters["young_modulus"])
        commands = np.broadcast_to(commands, (samples, *commands.shape[-2:]))
        if (cube is None) != (self._scene is None):
            raise InputError("a scene and a cube must be given together", where="rollouts")
        cubes = poses = None
        if cube is not None:
            cubes = cube_rows(*cube, samples, self.dtype)
            poses = PushOutput(np.zeros((samples, 1 + commands.shape[1] // stride, 7)))
        rows, points = commands.shape[1] // stride, len(self._nodes)
        result = Motion(
            np.zeros((samples, 1 + rows, points, 3)),
            np.zeros((samples, 1 + rows, commands.shape[2])),
            np.zeros(samples, dtype=bool),
            np.zeros(samples),
            np.ones(samples, dtype=bool),
            None if poses is None else poses.pose,
        )
        result.position[:, 0] = np.einsum("pk,pki->pi", self.points.weight, self.body.rest[self.points.node])

        def run(first: int) -> None:
            lane, kept = np.minimum(np.arange(first, first + self.lanes), samples - 1), slice(first, first + self.lanes)
            inputs = self._samples({name: np.asarray(value)[lane] for name, value in parameters.items()})
            displacement, work = self._lanes_last(commands[lane]), self._work()
            sizes = (rows, points, 3, self.lanes), (rows, commands.shape[2], self.lanes)
            output = kernels.TetrahedralOutput(
                self._nodes, self._weights, *(aligned_zeros(size, self.dtype) for size in sizes)
            )
            single = self.dtype.itemsize == 4
            numbers = SETTLED[self.dtype.name], SOFTNESS[self.dtype.name]
            stages = timed_stages(self.integrator, time_step)
            schedule = kernels.TetrahedralSchedule(float(time_step), stride, *numbers, self._reach, single, *stages)
            self._kernel(
                self._pattern, self._mesh, self._cables, self._scene, self._rest, displacement, cubes, inputs, work,
                *self._constraints(), schedule, output, poses, first, samples, lane_token(self.lanes),
            )  # fmt: skip
            count = min(self.lanes, samples - first)
            result.position[kept, 1:] = np.moveaxis(output.position, 3, 0)[:count]
            result.tension[kept, 1:] = np.moveaxis(output.tension, 2, 0)[:count]
            result.diverged[kept] = work.lost[0, :count] > 0.0
            result.converged[kept] = ~(work.unsolved[0, :count] > 0.0)

        in_blocks(run, samples, self.lanes, self.threads)
        # A cable whose displacement is no number would count as slack.
        result.diverged[...] |= ~np.isfinite(commands.sum(axis=(1, 2)))
        return result

    def _constraints(self) -> tuple[ContactRecords | None, Rows, ConstraintProblem, Int[np.ndarray, " free"]]:
        """Contacts, their rows, the problem of a step, and the nodes that contacts reach, of one lane block."""
        cables, kind, free, spheres = len(self._cables.limit), self.dtype.type, self._mesh.free, 0
        if self._scene is not None:
            spheres = self._scene.spheres
        pairs = pairs_of(spheres) if spheres else 0
        return (
            touch_storage(self._scene, self.lanes, kind) if self._scene is not None else None,
            row_storage(3 * free, 2 * spheres, self._pattern.border, self.lanes, kind),
            problem_storage(cables, pairs, self.lanes, kind),
            np.zeros(free, dtype=np.int64),
        )

    def _lanes_last(self, values: np.ndarray) -> np.ndarray:
        """Aligned copy in the engine's precision with the sample axis last."""
        moved = np.moveaxis(values, 0, -1)
        copy = aligned_zeros(moved.shape, self.dtype)
        copy[...] = moved
        return copy

    def _samples(self, values: Mapping[str, np.ndarray]) -> TetrahedralSamples:
        young, poisson = np.asarray(values["young_modulus"]), np.minimum(values["poisson_ratio"], POISSON_LIMIT)
        shear = young / (2.0 * (1.0 + poisson))
        scale = values.get("stiffness_scale", np.ones((self.lanes, len(self.body.element))))
        return TetrahedralSamples(
            self._lanes_last((2.0 * shear * poisson / (1.0 - 2.0 * poisson))[:, None]),
            self._lanes_last(shear[:, None]),
            self._lanes_last(scale[:, self._elements]),
            self._lanes_last(values["node_mass"][:, self._order]),
            self._lanes_last(values["rayleigh_mass"][:, None]),
            self._lanes_last(values["rayleigh_stiffness"][:, None]),
            self._lanes_last(values["gravity"]),
        )

    def _work(self) -> TetrahedralWork:
        nodes, free, rows = len(self.body.rest), self._mesh.free, 3 * self._pattern.border
        cables = len(self._cables.limit)
        sizes = {
            "position": 3 * nodes, "velocity": 3 * nodes, "begun": 3 * nodes, "moving": 3 * nodes,
            "before": 3 * nodes, "sudden": 3 * nodes, "force": 3 * nodes, "pivot": 6 * nodes,
            "lower": 9 * len(self._pattern.row) + 9, "solution": 3 * free, "condensed": rows * rows, "weight": rows,
            "slack": cables, "tension": cables, "measured": cables,
            "load": 9 * self._pattern.border * free,
            "commanded": cables, "target": cables, "accepted": 1, "lost": 1,
            "unsolved": 1, "wide": 1, "narrow": 1, "going": 1, "axes": 9, "turned": 12,
        }  # fmt: skip
        work = TetrahedralWork(**{name: aligned_zeros((size, self.lanes), self.dtype) for name, size in sizes.items()})
        work.position[...] = self._rest[:, None]
        return work


@cache
def _kernel() -> Callable:
    """The rollout kernel."""
    return kernels.compile_rollout(kernel_sources("tetrahedral_rollout"))


def _numbering(body: TetrahedralBody) -> tuple[Int[np.ndarray, " nodes"], Int[np.ndarray, " nodes"]]:
    """Nodes in elimination order, held nodes last, and the place of every node in that order."""
    free = np.flatnonzero(~body.fixed)
    order = np.concatenate(
        [free[elimination_order(_adjacency(body)[free][:, free].tocsr())], np.flatnonzero(body.fixed)]
    )
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.arange(len(order))
    return order, number


def _adjacency(body: TetrahedralBody) -> sparse.csr_matrix:
    """Which nodes share an element."""
    rows, columns = np.repeat(body.element, 4, axis=1).ravel(), np.tile(body.element, (1, 4)).ravel()
    matrix = sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(len(body.rest),) * 2)
    matrix.setdiag(0.0)
    matrix.eliminate_zeros()
    matrix.data[:] = 1.0
    return matrix


def _pattern(body: TetrahedralBody, number: np.ndarray, cables: int) -> BlockPattern:
    order = np.argsort(number)
    free = order[: np.sum(~body.fixed)]
    return analyse(_adjacency(body)[free][:, free].tocsr(), border=(3 + cables) // 3)


def _mesh(
    body: TetrahedralBody, elements: np.ndarray, number: np.ndarray, pattern: BlockPattern, dtype: np.dtype
) -> Mesh:
    free, dump = int(np.sum(~body.fixed)), len(pattern.row)
    corner, frame = body.element[elements], body.rest_frame[elements]
    ascending = np.argsort(number[corner], axis=1)
    sorted_corner = np.take_along_axis(corner, ascending, axis=1)
    gradient = np.take_along_axis(body.gradient[elements], ascending[:, :, None], axis=1)
    edge = body.rest[sorted_corner[:, 1:]] - body.rest[sorted_corner[:, :1]]
    node = number[sorted_corner]
    pairs = [(a, b) for b in range(3) for a in range(b + 1, 4)]
    slot = [[block_slot(pattern, nodes[a], nodes[b]) if nodes[a] < free else dump for a, b in pairs] for nodes in node]
    return Mesh(
        node.astype(np.int32),
        number[corner[:, :3]].astype(np.int32),
        np.einsum("eij,eaj->eai", frame, gradient).astype(dtype),
        np.einsum("eij,eaj->eai", frame, edge).astype(dtype),
        body.volume[elements].astype(dtype),
        np.array(slot, dtype=np.int32),
        free,
        body.frames == "polar",
    )


def _cables(
    layout: NodeCables, limits: DriveLimits, body: TetrahedralBody, number: np.ndarray, dtype: np.dtype
) -> kernels.Cables:
    first, node, weight = [0], [], []
    legs = [np.linalg.norm(np.diff(route, axis=0), axis=1) for route in routes(layout, body.rest)]
    segment = [np.concatenate([[0.0], lengths]) for lengths in legs]
    for cable, used in enumerate(layout.guide_used):
        guides = layout.guide_node[cable, used], layout.guide_weight[cable, used]
        node.append(np.concatenate([guides[0][:1] * 0, guides[0]]))
        weight.append(np.concatenate([guides[1][:1] * 0.0, guides[1]]))
        first.append(first[-1] + len(node[-1]))
    width = max([int(np.max(np.nonzero(w)[1])) + 1 for w in weight if np.any(w)], default=1)
    shape = (0, layout.guide_node.shape[2])
    return kernels.Cables(
        np.array(first, dtype=np.int32),
        np.ascontiguousarray(number[np.concatenate([np.zeros(shape, dtype=int), *node])][:, :width], dtype=np.int32),
        np.ascontiguousarray(np.concatenate([np.zeros(shape), *weight])[:, :width], dtype=dtype),
        layout.anchor.astype(dtype),
        np.concatenate([np.zeros(0), *segment]).astype(dtype),
        np.ascontiguousarray(limits.displacement, dtype=dtype),
        float(limits.rate),
    )
