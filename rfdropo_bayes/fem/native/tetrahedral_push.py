"""Rollouts of a tetrahedral body that pushes a cube, on CPUs: the same numbers as ``fem.tetrahedral_pushing``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from rfdropo_bayes.fem.cables import CableLayout
from rfdropo_bayes.fem.contact import CABLE_CHOICES, SWEEPS
from rfdropo_bayes.fem.drives import DriveLimits
from rfdropo_bayes.fem.layered import PointMap
from rfdropo_bayes.fem.native.block_cholesky import condense_rows, extend_border
from rfdropo_bayes.fem.native.contact_choice import choose_all, place_chosen
from rfdropo_bayes.fem.native.contact_problem import (
    cube_compliance,
    judge_contacts,
    open_contacts,
    solve_contacts,
    stop_cube,
    sweep,
    trunk_compliance,
)
from rfdropo_bayes.fem.native.contact_records import (
    SETTLED,
    TRUNK_MOST,
    PushOutput,
    cube_rows,
    scene_tables,
    touch_storage,
)
from rfdropo_bayes.fem.native.cube_motion import (
    find_candidates,
    finish_cubes,
    record_cubes,
    start_cubes,
    take_cube_step,
)
from rfdropo_bayes.fem.native.kernel_sources import kernel_sources
from rfdropo_bayes.fem.native.simd import addresses, fill, fma, kernel, lane_token, load, store, whole
from rfdropo_bayes.fem.native.tetrahedral_engine import Rollouts, TetrahedralEngine
from rfdropo_bayes.fem.native.tetrahedral_rollout import (
    accept,
    condense_step,
    correct,
    find_tensions,
    mark_unsolved,
    record_body,
    substitute,
    unbalance,
)
from rfdropo_bayes.fem.pushing import RESTING, PushScene
from rfdropo_bayes.fem.tetrahedra import TetrahedralBody


class PushRollouts(NamedTuple):
    """Recorded motion of a batch."""

    body: Rollouts
    pose: Float[np.ndarray, "samples rows 7"]  # of the cube: centre [m] and unit quaternion (x, y, z, w)
    contacts_converged: Bool[np.ndarray, " samples"]


@kernel
def _trunk_rows(scene, touch, panels, free, reached, velocity, lane, lanes):
    """Rows of the trunk's contacts in one lane into ``border``, and the columns that they reach."""
    for panel in range(panels):
        contact, p = RESTING + panel, int(touch.point[panel * lanes + lane])
        if p < 0:
            continue
        for k in range(scene.first[p], scene.first[p + 1]):
            place, weight = scene.place[k], scene.weight[k]
            node = place // 3
            if node < free:
                reached[node] = 1
            t = 9 * (panels * node + panel)
            for r in range(3):
                f, moving = 3 * (3 * contact + r), 0.0
                for i in range(3):
                    share = weight * touch.frame[(f + i) * lanes + lane]
                    if node < free:
                        touch.border[(t + 3 * r + i) * lanes + lane] += share
                    moving += share * velocity[(place + i) * lanes + lane]
                touch.moving[(3 * contact + r) * lanes + lane] += moving


@kernel
def _condense_contacts(pattern, scene, touch, work, panels, free, reached, cables, time_step, token):
    """Rows of the contacts, and these times A^-1 times each other, the cables and the right-hand side."""
    zero, lanes = fill(0.0, touch.border, token), len(token)
    for i in range(9 * panels * free):
        store(touch.border, i, zero)
    for i in range(3 * (RESTING + panels)):
        store(touch.moving, i, zero)
    for node in range(free):
        reached[node] = 0
    for lane in range(lanes):
        _trunk_rows(scene, touch, panels, free, reached, work.velocity, lane, lanes)
    if panels == 0:
        return
    others = pattern.border
    extend_border(pattern, work.pivot, work.lower, touch.border, panels, reached, free, token)
    condense_rows(pattern, touch.own, touch.border, panels, touch.border, panels, True, reached, free, token)
    condense_rows(pattern, touch.across, touch.border, panels, work.lower, others, False, reached, free, token)
    for i in range(3 * panels):
        t, row = 9 * (i // 3 * others) + i % 3, 3 * RESTING + i
        store(touch.moving, row, load(touch.moving, row, token) + load(touch.across, t, token))
        for c in range(cables):
            entry = load(touch.across, t + 9 * ((c + 1) // 3) + 3 * ((c + 1) % 3), token)
            store(touch.pull, row * cables + c, time_step * entry)


@kernel
def _add_impulses(pattern, touch, work, panels, free, reached, token):
    """Add the contacts' impulses to the right-hand side of the back substitution."""
    for column in range(free):
        if reached[column] == 0:
            continue
        t = 9 * (pattern.first[column + 1] - pattern.border)
        for m in range(3):
            value = load(work.lower, t + m, token)
            for i in range(3 * panels):
                row = load(touch.border, 9 * panels * column + 3 * i + m, token)
                value = fma(load(touch.impulse, 3 * RESTING + i, token), row, value)
            store(work.lower, t + m, value)


@kernel
def _add_forces(pattern, scene, touch, work, panels, free, lane, lanes):
    """Add the contacts' impulses of one lane to border row 0."""
    for panel in range(panels):
        contact, p = RESTING + panel, int(touch.point[panel * lanes + lane])
        if p < 0:
            continue
        for k in range(scene.first[p], scene.first[p + 1]):
            node, weight = scene.place[k] // 3, scene.weight[k]
            if node < free:
                t = 9 * (pattern.first[node + 1] - pattern.border)
                for r in range(3):
                    impulse = weight * touch.impulse[(3 * contact + r) * lanes + lane]
                    for i in range(3):
                        push = impulse * touch.frame[(3 * (3 * contact + r) + i) * lanes + lane]
                        work.lower[(t + i) * lanes + lane] += push


@kernel
def _touch_step(pattern, scene, samples, touch, work, free, cables, reached, schedule, settled, token):
    """Tensions and impulses between the factorisation and the back substitution of a step; returns how many contacts
    the trunk takes part in."""
    time_step, tolerance = schedule.time_step, schedule.tolerance
    candidates = find_candidates(scene, work.position, samples.gravity, samples.rayleigh_mass, touch, time_step, token)
    for lane in range(len(token)):
        choose_all(touch, candidates, lane, len(token))
    panels = place_chosen(touch, candidates, time_step, len(token))
    contacts = RESTING + panels
    _condense_contacts(pattern, scene, touch, work, panels, free, reached, cables, time_step, token)
    cube_compliance(touch, contacts, token)
    if panels == 0:
        open_contacts(touch, contacts, token)
        find_tensions(cables, work, tolerance, token)
        store(touch.going, 0, fill(1.0, touch.cube, token))
        sweep(touch, touch.matrix, touch.free, contacts, CABLE_CHOICES * SWEEPS, settled, token)
    else:
        trunk_compliance(touch, contacts, 1.0, token)
        open_contacts(touch, contacts, token)
        found = solve_contacts(touch, work, cables, contacts, tolerance, settled, token)
        mark_unsolved(cables, work, found, token)
        _add_impulses(pattern, touch, work, panels, free, reached, token)
    judge_contacts(touch, work, cables, contacts, token)
    stop_cube(touch, contacts, token)
    return panels


def compile_rollout(sources: str) -> Callable:
    """The kernel of one lane block; ``sources``, a digest of the kernels' sources, is part of the key it is cached
    under. As ``tetrahedral_rollout.compile_rollout``, with cubes."""

    @whole
    def rollout(
        pattern, mesh, cables, scene, rest, commands, cubes, samples, work, touch, reached, schedule, settled, output,
        poses, first, count, token,
    ):  # fmt: skip
        _ = sources
        scene, cubes, touch, poses = addresses(scene), addresses(cubes), addresses(touch), addresses(poses)
        bare, bare_pattern, bare_samples = addresses(work), addresses(pattern), addresses(samples)
        drives, time_step, records = len(cables.limit), schedule.time_step, 1 + commands.shape[0] // schedule.stride
        start_cubes(cubes, count, touch, first, token)
        record_cubes(touch, poses, records, 0, first, count, token)
        for step in range(commands.shape[0]):
            condense_step(pattern, mesh, cables, commands[step], samples, work, schedule, token)
            panels = _touch_step(
                bare_pattern, scene, bare_samples, touch, bare, mesh.free, drives, reached, schedule, settled, token
            )
            substitute(pattern, mesh, work, work.tension, drives, time_step, token)
            if schedule.refined:
                unbalance(pattern, mesh, samples, work, drives, time_step, token)
                for lane in range(len(token)):
                    _add_forces(bare_pattern, scene, touch, bare, panels, mesh.free, lane, len(token))
                correct(pattern, mesh, work, drives, time_step, token)
            accept(rest, drives, work, schedule, token)
            for lane in range(len(token)):
                take_cube_step(touch, bare.accepted, bare.lost, time_step, lane, len(token))
            if (step + 1) % schedule.stride == 0:
                row = (step + 1) // schedule.stride
                record_body(work, output, row - 1, token)
                record_cubes(touch, poses, records, row, first, count, token)
        finish_cubes(touch, poses, first, count, token)

    return rollout


@cache
def _kernel() -> Callable:
    """The rollout kernel."""
    return compile_rollout(kernel_sources("tetrahedral_push"))


class TetrahedralPushEngine(TetrahedralEngine):
    """A body that pushes a cube, prepared for rollouts in one precision; arguments as `TetrahedralEngine`, and the
    scene."""

    def __init__(
        self,
        body: TetrahedralBody,
        cables: CableLayout,
        limits: DriveLimits,
        points: PointMap,
        scene: PushScene,
        *,
        dtype: type = np.float64,
        lanes: int | None = None,
        threads: int | None = None,
    ) -> None:
        super().__init__(body, cables, limits, points, dtype=dtype, lanes=lanes, threads=threads)
        self._push_kernel = _kernel()
        self._scene = scene_tables(scene, np.ones((1, 1)), self._number, body.rest, self.dtype.type)

    def push(
        self,
        parameters: Mapping[str, np.ndarray],
        commands: Float[np.ndarray, "*samples steps cables"],
        state: Float[np.ndarray, "*samples 13"],
        values: Float[np.ndarray, "*samples 4"],
        *,
        time_step: float,
    ) -> PushRollouts:
        """Rollouts from rest, recorded every step; ``parameters`` and ``commands`` as in `TetrahedralEngine.rollouts`,
        ``state`` and ``values`` of the cubes as in ``NativeLayeredPush.push``.

        Raises:
            InputError: shapes that do not fit.
        """
        samples = len(parameters["young_modulus"])
        commands = np.broadcast_to(commands, (samples, *commands.shape[-2:]))
        cubes = cube_rows(state, values, samples, self.dtype)
        poses = PushOutput(np.zeros((samples, 1 + commands.shape[1], 7)), np.zeros(samples, dtype=np.uint8))
        settled = SETTLED[self.dtype.name]

        def kernel_of(lane: Int[np.ndarray, " lanes"]) -> Callable:
            touch = self._touch()
            reached = np.zeros(self._mesh.free, dtype=np.int64)

            def run(displacement, inputs, work, schedule, output) -> None:
                self._push_kernel(
                    self._pattern, self._mesh, self._cables, self._scene, self._rest, displacement, cubes, inputs,
                    work, touch, reached, schedule, settled, output, poses, int(lane[0]), samples,
                    lane_token(self.lanes),
                )  # fmt: skip

            return run

        body = self._rolled(kernel_of, parameters, commands, time_step, 1)
        return PushRollouts(body, poses.pose, poses.converged.view(bool))

    def _touch(self):
        border = 9 * self._mesh.free * TRUNK_MOST
        cables = len(self._cables.limit)
        return touch_storage(border, self._pattern.border, cables, self.lanes, self.dtype.type)
