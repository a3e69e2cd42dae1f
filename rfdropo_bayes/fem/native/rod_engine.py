"""The compiled engine for rods: rollouts of a whole batch on CPUs, the same numbers as ``fem.rollouts``.

Samples fill the lanes of vector registers, blocks of lanes are spread over threads. Lanes never mix and a block knows
nothing of the others: a rollout's result does not depend on its batch, on its place in it or on the number of threads.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cache
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.dynamics import Material, System
from rfdropo_bayes.fem.equilibrium import ITERATIONS
from rfdropo_bayes.fem.integrators import STAGES, Integrator, timed_stages
from rfdropo_bayes.fem.native.constraint_problem import SETTLED, SOFTNESS, ConstraintProblem, problem_storage
from rfdropo_bayes.fem.native.contact_records import (
    MISSED,
    ContactRecords,
    Cubes,
    PushOutput,
    cube_rows,
    pairs_of,
    rod_scene,
    touch_storage,
)
from rfdropo_bayes.fem.native.effect_rows import effect_flags, effect_rows, law_rows, load_rows
from rfdropo_bayes.fem.native.kernel_cache import kernel_sources
from rfdropo_bayes.fem.native.lane_blocks import in_blocks
from rfdropo_bayes.fem.native.rod_constraints import Rows, row_storage
from rfdropo_bayes.fem.native.rod_effects import LOADED
from rfdropo_bayes.fem.native.rod_records import (
    KINDS,
    Factors,
    Friction,
    RodSamples,
    RodWork,
    friction_storage,
    runs_of,
)
from rfdropo_bayes.fem.native.rod_rollout import Batch, RodOutput, RodSchedule, compile_rollout, storage
from rfdropo_bayes.fem.native.rod_tables import SIZE, as_kernel_array, rod_tables
from rfdropo_bayes.fem.native.simd import lane_token, native_lanes
from rfdropo_bayes.fem.pushing import PushGeometry
from rfdropo_bayes.fem.rod import PointMap
from rfdropo_bayes.fem.rollouts import Motion
from rfdropo_bayes.fem.section_loads import SectionLoads
from rfdropo_bayes.runtime import available_processors

Precision = Literal["float64", "float32"]
AT_REST = {"float64": (1e-10, 1e-6), "float32": (1e-5, 1e-5)}
"""Increment of a static iteration, over the body's length, and turn [rad], below which a body is at rest: at the start,
and in a row of a quasi-static motion. The remaining error is at most a tenth of it, as convergence is superlinear.
"""

# Limits of convergence, of a missed contact, and of rest, by precision.
_NUMERICS = {name: (SETTLED[name], SOFTNESS[name], MISSED[name], *AT_REST[name]) for name in ("float64", "float32")}


class Run(NamedTuple):
    """Rollouts of a batch: inputs, settings and recorded outputs."""

    batch: Batch
    cubes: Cubes | None
    schedule: RodSchedule
    output: RodOutput | None = None
    poses: PushOutput | None = None

    @property
    def motion(self) -> Motion:
        """The recorded motion."""
        output = self.output
        assert output is not None
        pose = None if self.poses is None else self.poses.pose
        diverged = output.diverged.view(bool) | ~self.commanded
        solved = output.converged.view(bool)
        return Motion(output.position, output.tension, diverged, output.imbalance, solved, pose, solves=output.solves)

    @property
    def commanded(self) -> Bool[np.ndarray, " batch"]:
        """Whether all commands are finite: a cable with a displacement of NaN would count as slack."""
        batch, schedule = self.batch, self.schedule
        known = np.ones(batch.count, dtype=bool)
        moved = batch.drive[: batch.count, : schedule.steps * batch.start.shape[1]]
        for part in (moved,) if schedule.resumed else (moved, batch.start):
            known &= np.isfinite(part.sum(axis=1))
        return known


class Records(NamedTuple):
    """Data of a lane block; None for cables without friction, and without a cube."""

    samples: RodSamples
    factors: Factors
    work: RodWork
    friction: Friction | None
    touch: ContactRecords | None
    rows: Rows
    problem: ConstraintProblem


@cache
def _kernel() -> Callable:
    """The rollout kernel."""
    return compile_rollout(kernel_sources("rod_rollout"))


class NativeRod:
    """Rollouts of one rod with its cables.

    Args:
        system: body, cables, and number of held stations.
        points: the points whose positions are recorded.
        time_step: length of a step [s].
        precision: precision of all arithmetic; parameters, commands and results are float64 in any case.
        threads: lane blocks computed at the same time; None for all processors this process may use.
        lanes: samples side by side; None for the width of a vector register.
        scene: geometry on which the body pushes a cube; None for a body that touches nothing.
        integrator: scheme of a step; with "quasi-static" every step is a row at rest, and the time step is not
            used.

    Raises:
        InputError: unknown precision, a number of threads or lanes that makes no sense, or a scene at rest.
    """

    def __init__(
        self,
        system: System,
        points: PointMap,
        time_step: float,
        *,
        precision: Precision = "float64",
        threads: int | None = None,
        lanes: int | None = None,
        scene: PushGeometry | None = None,
        integrator: Integrator = "euler",
    ) -> None:
        if precision not in _NUMERICS:
            raise InputError(f"unknown precision {precision!r}", remedy=f"use one of {', '.join(_NUMERICS)}")
        if threads is not None and threads < 1:
            raise InputError(
                f"threads = {threads} is less than 1", remedy="use at least one, or None for all processors"
            )
        self.system, self.time_step, self.integrator = system, float(time_step), integrator
        self.precision, self.dtype = precision, np.dtype(precision)
        self.threads = threads or available_processors()
        self.lanes = lanes or native_lanes(self.dtype)
        self.points = len(points.station)
        self.tables = rod_tables(system, points, self.dtype.type)
        self._runs = runs_of(system.cables)
        self._steps: Integrator = "euler" if integrator == "quasi-static" else integrator
        if scene is not None and integrator == "quasi-static":
            raise InputError("quasi-static motion does not allow a cube", remedy="use another integrator")
        self._scene = None if scene is None else rod_scene(scene, self.dtype.type)
        self._token = lane_token(self.lanes)
        self._local = threading.local()

    def rollout(
        self,
        material: Material,
        drive: Float[np.ndarray, "*batch steps drives"],
        *,
        start: Float[np.ndarray, "*batch drives"] | None = None,
        before: Float[np.ndarray, "*batch drives"] | None = None,
        steps: int | None = None,
        stride: int = 1,
        cube: tuple[Float[np.ndarray, "*batch 13"], Float[np.ndarray, "*batch 4"]] | None = None,
        loads: SectionLoads | None = None,
    ) -> Motion:
        """Roll out a batch.

        Args:
            material: fields with a leading batch axis; a field without this axis serves the whole batch.
            drive: displacements of cables [m] and pressures of chambers [Pa] at the end of every step, one sequence for
                all or one per rollout.
            start: drives whose static equilibrium is the initial state, as in
                ``fem.static_equilibrium``; None starts undeformed.
            before: drives before the first step of a body that starts undeformed; zero by default.
                Stages within the step interpolate to its end.
            steps: number of steps to compute; all by default.
            stride: number of steps between recorded states.
            cube: for an engine with a scene: centre [m], unit quaternion (x, y, z, w), velocity [m/s] and spin [rad/s]
                at the start; mass [kg], side [m], radius of gyration [m] and coefficient of friction.
            loads: loads that change from step to step; None without loads.

        Raises:
            InputError: shapes that do not fit, a cube without a scene or a scene without a cube.
        """
        run = self.run_of(material, drive, start, before, steps, stride, cube, loads)
        rubs = material.effects.rubs
        in_blocks(
            lambda first: self.run_block(run, self.records(rubs), first), run.batch.count, self.lanes, self.threads
        )
        return run.motion

    def records(self, rubs: bool) -> Records:
        """Data of a block in the calling thread; ``rubs``: with friction of the cables."""
        kept = self._local.__dict__.setdefault("records", {})
        if rubs not in kept:
            tables, made = self.tables, (self.lanes, self.dtype.type)
            runs = KINDS * self._runs.count if rubs else 0
            pairs = 0 if self._scene is None else pairs_of(self._scene.spheres)
            beside = (runs + 2) // 3 + pairs
            kept[rubs] = Records(
                *storage(tables, *made),
                friction_storage(self._runs, *made) if rubs else None,
                None if self._scene is None else touch_storage(self._scene, *made),
                row_storage(SIZE * tables.stations, beside, tables.panels, *made),
                problem_storage(tables.cables + runs, pairs, *made),
            )
        return kept[rubs]

    def run_block(self, run: Run, records: Records, first: int) -> None:
        """Run one lane block, whose first rollout is ``first``, on `records`."""
        runs = None if records.friction is None else self._runs
        batch, cubes, schedule, output, poses = run
        _kernel()(self.tables, runs, self._scene, batch, cubes, *records, schedule, output, poses, first, self._token)

    def run_of(
        self,
        material: Material,
        drive: np.ndarray,
        start: np.ndarray | None,
        before: np.ndarray | None,
        steps: int | None,
        stride: int,
        cube: tuple[np.ndarray, np.ndarray] | None,
        loads: SectionLoads | None = None,
    ) -> Run:
        """Inputs and outputs of the kernels; arguments as `rollout`."""
        drive = np.asarray(drive, dtype=float)
        drives = self.tables.drives
        if drive.ndim not in (2, 3) or drive.shape[-1] != drives:
            raise InputError(f"drive has shape {drive.shape} for {drives} drives", where="rollout")
        given = before if start is None else start
        begin = np.zeros(drives) if given is None else np.asarray(given, dtype=float)
        if begin.ndim not in (1, 2) or begin.shape[-1] != drives:
            raise InputError(f"start has shape {begin.shape} for {drives} drives", where="rollout")
        moves = drive[None] if drive.ndim == 2 else drive
        moves = moves.reshape(len(moves), moves.shape[1] * drives)
        pushed, place = load_rows(loads)
        batch = self._batch(material, {"start": np.atleast_2d(begin), "drive": moves, "loads": pushed})
        if loads is not None:
            present = batch.present.copy()
            present[LOADED] = 1
            batch = batch._replace(present=present, place=place, places=len(place))
        steps = drive.shape[-2] if steps is None else min(int(steps), drive.shape[-2])
        if (cube is None) != (self._scene is None):
            raise InputError("a scene and a cube must be given together", where="rollout")
        cubes = None if cube is None else cube_rows(*cube, batch.count, self.dtype)
        settling = 0 if start is None else ITERATIONS
        still, stages = self.integrator == "quasi-static", timed_stages(self._steps, self.time_step)
        numbers = _NUMERICS[self.precision]
        schedule = RodSchedule(self.time_step, steps, int(stride), settling, *numbers, *stages, int(still))
        return self.with_output(Run(batch, cubes, schedule))

    def with_output(self, run: Run) -> Run:
        """A run with allocated output."""
        count, records = run.batch.count, 1 + run.schedule.steps // run.schedule.stride
        output = RodOutput(
            np.zeros((count, records, self.points, 3)),
            np.zeros((count, records, self.tables.cables)),
            np.zeros(count, dtype=np.uint8),
            np.zeros(count, dtype=np.uint8),
            np.zeros(count),
            np.zeros(count),
            records,
        )
        poses = None if self._scene is None else PushOutput(np.zeros((count, records, 7)))
        return run._replace(output=output, poses=poses)

    def _batch(self, material: Material, commands: dict[str, np.ndarray]) -> Batch:
        """Parameters and commands in the precision of the kernels."""
        elements = self.tables.stations - 1
        width = {"gravity": (3,), "stiffness_scale": (elements,), "point_mass": (elements + 1,)}
        given, effects = material._asdict(), material.effects
        del given["effects"]
        values = {name: np.asarray(value, dtype=float) for name, value in given.items()}
        sizes = {len(value) for name, value in values.items() if value.ndim > len(width.get(name, ()))}
        sizes |= {len(value) for value in commands.values()}
        count = max(sizes)
        if sizes - {1, count}:
            raise InputError(f"batch axes of lengths {sorted(sizes)}", where="rollout")
        rows = {}
        for name, value in values.items():
            shape = width.get(name, ())
            if value.shape not in (shape, (1, *shape), (count, *shape)):
                raise InputError(f"{name} has shape {value.shape}, expected {(count, *shape)}", where="material")
            rows[name] = np.broadcast_to(value, (count, *shape))
        modulus = rows["young_modulus"]
        shear = modulus / (2.0 * (1.0 + rows["poisson_ratio"]))
        arrays = {
            "moduli": np.stack([modulus, shear, rows["axial_scale"] * modulus], axis=1),
            "density": rows["density"][:, None],
            "damping": np.stack([rows["rayleigh_mass"], rows["rayleigh_stiffness"]], axis=1),
            "gravity": rows["gravity"],
            "scale": rows["stiffness_scale"],
            "point_mass": rows["point_mass"],
            "law": law_rows(effects, self.system.body, modulus, shear, rows["stiffness_scale"]),
            "effects": effect_rows(effects, count, STAGES[self._steps], self.time_step),
            **commands,
        }
        arrays = {name: as_kernel_array(array, self.dtype.type) for name, array in arrays.items()}
        pitches = {f"{name}_pitch": value.shape[1] if len(value) > 1 else 0 for name, value in commands.items()}
        nowhere = np.zeros(1, dtype=np.int64)
        return Batch(**arrays, present=effect_flags(effects), place=nowhere, places=0, count=count, **pitches)
