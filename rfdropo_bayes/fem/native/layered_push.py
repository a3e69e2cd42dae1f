"""Rollouts of a layered body that pushes a cube, on CPUs: the same numbers as ``fem.layered_pushing``."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from rfdropo_bayes.fem.dynamics import Material, System
from rfdropo_bayes.fem.layered import PointMap, rest_positions
from rfdropo_bayes.fem.layered_pushing import check_effects
from rfdropo_bayes.fem.native.contact_records import (
    MISSED,
    SETTLED,
    TRUNK_MOST,
    PushOutput,
    Scene,
    Touch,
    cube_rows,
    scene_tables,
    touch_storage,
)
from rfdropo_bayes.fem.native.contact_step import add_forces, add_missed, press, start_contacts
from rfdropo_bayes.fem.native.cube_motion import finish_cubes, record_cubes, start_cubes, take_cube_step
from rfdropo_bayes.fem.native.kernel_sources import kernel_sources
from rfdropo_bayes.fem.native.layered import NativeLayered, NativeRollout, Precision, in_blocks
from rfdropo_bayes.fem.native.layered_rollout import begin_step, finish_rollouts, settle
from rfdropo_bayes.fem.native.layered_step import condense_increment, refine_increment, take_step
from rfdropo_bayes.fem.native.section_modes import border_panels
from rfdropo_bayes.fem.native.simd import addresses, kernel, whole
from rfdropo_bayes.fem.pushing import PushScene


class NativePush(NamedTuple):
    """Recorded motion of a batch; row 0 is the initial state."""

    body: NativeRollout
    pose: Float[np.ndarray, "batch rows 7"]  # of the cube: centre [m] and unit quaternion (x, y, z, w)
    contacts_converged: Bool[np.ndarray, " batch"]


@kernel
def _take(tables, scene, samples, factors, touch, work, panels, schedule, token):
    """Refine the step's solution, and move body and cube."""
    for lane in range(len(token) if schedule.refinements > 0 else 0):
        add_forces(scene, touch, panels, work.field, lane, len(token))
    for _ in range(schedule.refinements):
        refine_increment(tables, samples, factors, work, token)
    take_step(tables, work, schedule.time_step, token)
    for lane in range(len(token)):
        take_cube_step(touch, work.accepted, work.lost, schedule.time_step, lane, len(token))


def compile_rollout(sources: str) -> Callable:
    """The kernel of one lane block; ``sources``, a digest of the kernels' sources, is part of the key it is cached
    under."""

    @whole
    def rollout(
        tables, scene, batch, cubes, samples, factors, work, touch, schedule, settled, missed, output, poses, first,
        token,
    ):  # fmt: skip
        _ = sources
        tables, scene, batch, cubes = addresses(tables), addresses(scene), addresses(batch), addresses(cubes)
        samples, factors, work, touch = addresses(samples), addresses(factors), addresses(work), addresses(touch)
        output, poses = addresses(output), addresses(poses)
        rate, count, lanes = 1.0 / schedule.time_step, batch.count, len(token)
        settle(tables, batch, samples, factors, work, schedule, first, token)
        start_cubes(cubes, count, touch, first, token)
        step = 0
        while begin_step(tables, batch, samples, factors, work, schedule, output, step, first, token):
            if step % schedule.stride == 0:
                record_cubes(touch, poses, output.records, step // schedule.stride, first, count, token)
            condense_increment(tables, samples, factors, work, rate, schedule, token)
            candidates = start_contacts(scene, samples, touch, work, tables.cables, schedule.time_step, token)
            panels, solves, again = 0, 0, True
            while again:
                panels = press(tables, scene, touch, work, candidates, schedule, settled, token)
                solves += 1
                again = add_missed(scene, touch, work, candidates, solves, schedule.time_step, missed, lanes)
            _take(tables, scene, samples, factors, touch, work, panels, schedule, token)
            step += 1
        if schedule.steps % schedule.stride == 0:
            record_cubes(touch, poses, output.records, schedule.steps // schedule.stride, first, count, token)
        finish_rollouts(work, output, first, count, token)
        finish_cubes(touch, poses, first, count, token)

    return rollout


@cache
def _kernel() -> Callable:
    """The rollout kernel."""
    return compile_rollout(kernel_sources("layered_push"))


class NativeLayeredPush(NativeLayered):
    """Rollouts of one layered body that pushes a cube on a plate; arguments as `NativeLayered`, and the scene."""

    def __init__(
        self,
        system: System,
        points: PointMap,
        scene: PushScene,
        time_step: float,
        *,
        precision: Precision = "float64",
        threads: int | None = None,
        lanes: int | None = None,
    ) -> None:
        super().__init__(system, points, time_step, precision=precision, threads=threads, lanes=lanes)
        rest = rest_positions(system.body)
        shape = np.asarray(self.tables.shape, dtype=float)
        self._scene: Scene = scene_tables(scene, shape, np.arange(len(rest)), rest, self.dtype.type)

    def push(
        self,
        material: Material,
        displacement: Float[np.ndarray, "*batch steps cables"],
        state: Float[np.ndarray, "*batch 13"],
        values: Float[np.ndarray, "*batch 4"],
        *,
        start: Float[np.ndarray, "*batch cables"] | None = None,
        steps: int | None = None,
    ) -> NativePush:
        """Roll out a batch; ``material``, ``displacement``, ``start`` and ``steps`` as in `NativeLayered.rollout`.

        Args:
            state: of the cube at the start: centre [m], unit quaternion (x, y, z, w), velocity [m/s], spin [rad/s].
            values: mass [kg], side [m] and radius of gyration [m] of the cube, coefficient of friction.

        Raises:
            InputError: shapes that do not fit, or effects of the cables.
        """
        check_effects(material.effects)
        given = {"start": start, "position": None, "tension": None}
        batch, schedule, output = self.inputs(material, displacement, given, steps, 1)
        cubes = cube_rows(state, values, batch.count, self.dtype)
        poses = PushOutput(np.zeros((batch.count, output.records, 7)), np.zeros(batch.count, dtype=np.uint8))
        kernel, settled, missed = _kernel(), SETTLED[self.precision], MISSED[self.precision]

        def block(first: int) -> None:
            samples, factors, work = self._storage()
            kernel(
                self.tables, self._scene, batch, cubes, samples, factors, work, self._touch(), schedule, settled,
                missed, output, poses, first, self._token,
            )  # fmt: skip

        in_blocks(block, batch.count, self.lanes, self.threads)
        codes = output.diverged.view(bool), output.cables_converged.view(bool)
        body = NativeRollout(output.position, output.tension, *codes, output.residual)
        return NativePush(body, poses.pose, poses.converged.view(bool))

    def _touch(self) -> Touch:
        """Contacts of the calling thread."""
        if not hasattr(self._local, "touch"):
            tables, panels = self.tables, border_panels(self.tables.cables)
            border = 9 * tables.stations * TRUNK_MOST * tables.modes
            self._local.touch = touch_storage(border, panels, tables.cables, self.lanes, self.dtype.type)
        return self._local.touch
