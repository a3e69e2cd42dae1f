"""Sessions of a rod: lanes that keep their state between calls, so that a body continues from its state.

A session runs the kernel of whole rollouts, on blocks of lanes whose parameters and state are its own; scratch belongs
to the threads. Steps taken in several calls give the same bits as in one.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from operator import itemgetter
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.dynamics import Material
from rfdropo_bayes.fem.native.contact_records import Cubes
from rfdropo_bayes.fem.native.effect_rows import load_rows
from rfdropo_bayes.fem.native.lane_blocks import in_blocks
from rfdropo_bayes.fem.native.rod_effects import LOADED
from rfdropo_bayes.fem.native.rod_engine import NativeRod, Records, Run
from rfdropo_bayes.fem.native.rod_records import RodSamples
from rfdropo_bayes.fem.native.rod_tables import as_kernel_array
from rfdropo_bayes.fem.native.simd import aligned_zeros
from rfdropo_bayes.fem.rollouts import Motion
from rfdropo_bayes.fem.section_loads import SectionLoads

KEPT = {
    "samples": tuple(name for name in RodSamples._fields if name != "present"),
    "work": ("turn", "frame", "velocity", "tension", "commanded", "branch", "softness", "lost", "failed", "imbalance"),
    "friction": ("mobilised", "segment"),
    "touch": ("cube", "values", "memory"),
}
"""Fields of the kernels' records that outlive a step."""
GIVEN = ("moduli", "density", "damping", "gravity", "scale", "point_mass", "law", "effects", "start", "loads")
"""Fields of a batch that an initial state depends on."""
PITCHED = ("start", "loads")
"""Fields of which one row may serve all lanes."""
REMEMBERED = 2**26
"""Most memory for equilibria that were found before [bytes]."""


class _Place(NamedTuple):
    """Location of a record's field in a lane's memory."""

    record: str
    name: str
    first: int
    last: int


GRAVITY = 3
"""Last values of a lane's memory: gravity without the changes from step to step [m/s2]."""


def _places(records: Records) -> list[_Place]:
    places, last = [], 0
    for record, names in KEPT.items():
        if getattr(records, record) is not None:
            for name in names:
                first, last = last, last + len(getattr(getattr(records, record), name))
                places.append(_Place(record, name, first, last))
    return places


class RodSession:
    """Lanes of one rod, each with its own parameters and its own time.

    Args:
        engine: engine of the body's rollouts.
        count: lanes.

    Attributes:
        memory: parameters and state of every lane, ``(block, value, lane of the block)``, in the engine's precision.

    Raises:
        InputError: fewer than one lane.
    """

    def __init__(self, engine: NativeRod, count: int) -> None:
        if count < 1:
            raise InputError(f"the number of lanes is {count}", remedy="use at least one")
        self.engine, self.count = engine, int(count)
        self.memory = np.zeros((0, 0, engine.lanes), engine.dtype)
        self._run: Run | None = None  # of the lane that was started first
        self._rubs = False
        self._places: list[_Place] = []
        self._local = threading.local()
        self._equilibria: OrderedDict[bytes, _SessionLane] = OrderedDict()

    def reset(
        self,
        rows: Int[np.ndarray, " row"],
        material: Material,
        *,
        start: Float[np.ndarray, "row drives"] | None = None,
        before: Float[np.ndarray, "row drives"] | None = None,
        cube: tuple[Float[np.ndarray, "row 13"], Float[np.ndarray, "row 4"]] | None = None,
        loads: SectionLoads | None = None,
    ) -> Motion:
        """Start some lanes anew; the others do not notice.

        Args:
            rows: lanes.
            material: fields with one entry per row.
            start: drives whose static equilibrium is the initial state; None starts undeformed. An
                equilibrium that was found before is not computed again.
            before: see `NativeRod.rollout`.
            cube: for an engine with a scene, see `NativeRod.rollout`.
            loads: loads on the initial state, in one row. Lanes are always given loads, or never.

        Returns:
            The initial state, as a rollout of one row.

        Raises:
            InputError: shapes that do not fit, or effects that other lanes of the session do not have.
        """
        rows = np.asarray(rows, dtype=np.intp)
        still = np.zeros((len(rows), 1, self.engine.tables.drives))
        run = self.engine.run_of(material, still, start, before, 0, 1, cube, loads)
        self._admit(run, material.effects.rubs)
        lanes = self._recalled(run) if run.schedule.static_iterations > 0 else self._settled(run)
        pose = None
        if run.cubes is not None:
            lanes, pose = self._with_cubes(lanes, run.cubes), np.asarray(run.cubes.state[:, None, :7], float)
        self.memory[rows // self.engine.lanes, :, rows % self.engine.lanes] = lanes.state
        return lanes.motion._replace(pose=pose)

    def advance(
        self, drive: Float[np.ndarray, "lane steps drives"], *, stride: int = 1, loads: SectionLoads | None = None
    ) -> Motion:
        """Take steps to the drives at their ends, under the loads of each step; recorded before the
        first, and every ``stride``.

        Raises:
            InputError: a session that was not started, drives of another shape, or loads in some calls
                only: a session has loads in every call, also in reset, or in none.
        """
        engine = self.engine
        if self._run is None:
            raise InputError("the session was not started", remedy="reset all lanes first")
        if drive.ndim != 3 or drive.shape[::2] != (self.count, engine.tables.drives):
            expected = f"({self.count}, steps, {engine.tables.drives})"
            raise InputError(f"drive has shape {drive.shape}, expected {expected}", where="advance")
        moves = as_kernel_array(np.asarray(drive, float).reshape(self.count, -1), engine.dtype.type)
        batch = self._run.batch._replace(drive=moves, drive_pitch=moves.shape[1], count=self.count)
        if bool(batch.present[LOADED]) != (loads is not None):
            raise InputError(
                "loads must be given in every call of a session", where="advance", remedy="also give them to reset"
            )
        if loads is not None:
            rows = load_rows(loads)[0].astype(engine.dtype)
            acting = np.concatenate([rows[:, : rows.shape[1] // drive.shape[1]], rows], axis=1)
            gravity = np.ascontiguousarray(self.memory[:, -GRAVITY:].transpose(0, 2, 1)).reshape(-1, GRAVITY)
            batch = batch._replace(loads=acting, loads_pitch=acting.shape[1], gravity=gravity[: self.count])
        schedule = self._run.schedule._replace(steps=drive.shape[1], stride=stride, resumed=1)
        run = engine.with_output(self._run._replace(batch=batch, schedule=schedule))

        def block(first: int) -> None:
            engine.run_block(run, self._records(first // engine.lanes), first)

        in_blocks(block, self.count, engine.lanes, engine.threads)
        return run.motion

    def save(self) -> Float[np.ndarray, "lane values"]:
        """A copy of parameters and state, one row a lane."""
        return self.memory.transpose(0, 2, 1).reshape(-1, self.memory.shape[1])[: self.count].copy()

    def restore(self, rows: Int[np.ndarray, " row"], state: Float[np.ndarray, "row values"]) -> None:
        """Set lanes to rows that `save` returned, in this session or in another session of the same body and effects.

        Raises:
            InputError: a session that was not started, or a state of another body or precision.
        """
        if state.shape[1:] != self.memory.shape[1:2] or state.dtype != self.engine.dtype:
            raise InputError(
                f"the state has {state.shape[1:]} values in {state.dtype}",
                where="restore",
                remedy=f"this session has {self.memory.shape[1]} in {self.engine.dtype}; start it before",
            )
        self.memory[rows // self.engine.lanes, :, rows % self.engine.lanes] = state

    def _admit(self, run: Run, rubs: bool) -> None:
        """Lay out the memory for the effects that the first lanes have; later lanes must have the same."""
        if self._run is None:
            self._places, self._rubs = _places(self.engine.records(rubs)), rubs
            blocks = -(-self.count // self.engine.lanes)
            values = self._places[-1].last + GRAVITY
            self.memory = aligned_zeros((blocks, values, self.engine.lanes), self.engine.dtype)
            self._run = _taken(run, [0])
        elif rubs != self._rubs or not np.array_equal(run.batch.present, self._run.batch.present):
            raise InputError(
                "a lane has other body effects than earlier lanes",
                where="reset",
                remedy="give every lane the same mechanisms; a null value switches one off",
            )

    def _settled(self, run: Run) -> _SessionLane:
        """The initial states of a batch."""
        engine, count = self.engine, run.batch.count
        run = engine.with_output(run)
        state = np.zeros((count, self.memory.shape[1]), engine.dtype)

        def block(first: int) -> None:
            records = engine.records(self._rubs)
            engine.run_block(run, records, first)
            there = state[first : first + engine.lanes]
            for place in self._places:
                part = getattr(getattr(records, place.record), place.name)
                there[:, place.first : place.last] = part.T[: len(there)]
            there[:, -GRAVITY:] = run.batch.gravity[first : first + engine.lanes]

        in_blocks(block, count, engine.lanes, engine.threads)
        return _SessionLane(state, run.motion._replace(pose=None))

    def _with_cubes(self, lanes: _SessionLane, cubes: Cubes) -> _SessionLane:
        """Lanes with cubes at the start: a settled body in the cache may have had other cubes."""
        fields = {"cube": cubes.state, "values": cubes.values, "memory": 0.0}
        for place in self._places:
            if place.record == "touch":
                lanes.state[:, place.first : place.last] = fields[place.name]
        return lanes

    def _recalled(self, run: Run) -> _SessionLane:
        """The equilibria of a batch; those found before are not computed again, within the reserved memory."""
        known, rows = self._equilibria, range(run.batch.count)
        keys = [b"".join(_row(getattr(run.batch, n), row).tobytes() for n in GIVEN) for row in rows]
        first = {key: row for row, key in reversed(list(enumerate(keys))) if key not in known}
        fresh = self._settled(_taken(run, list(first.values())))
        found = {key: known[key] for key in keys if key in known}
        found |= {key: jax.tree.map(itemgetter(row), fresh) for row, key in enumerate(first)}
        for key, lane in found.items():
            known[key] = lane
            known.move_to_end(key)
        most = REMEMBERED // (self.memory.shape[1] * self.engine.dtype.itemsize)
        while len(known) > most:
            known.popitem(last=False)
        return jax.tree.map(lambda *parts: np.stack(parts), *(found[key] for key in keys))

    def _records(self, block: int) -> Records:
        """Scratch of the calling thread around the memory of a block."""
        if not hasattr(self._local, "records"):
            self._local.records = {}
        if block not in self._local.records:
            assert self._run is not None
            records = self.engine.records(self._rubs)
            own: dict[str, dict[str, np.ndarray]] = {place.record: {} for place in self._places}
            for place in self._places:
                own[place.record][place.name] = self.memory[block, place.first : place.last]
            # Flags of present effects are the same for all blocks and lanes.
            own["samples"]["present"] = self._run.batch.present
            parts = {name: getattr(records, name)._replace(**fields) for name, fields in own.items()}
            self._local.records[block] = records._replace(**parts)
        return self._local.records[block]


class _SessionLane(NamedTuple):
    """State of a lane, or of several, and its recorded motion."""

    state: Float[np.ndarray, "*lane values"]
    motion: Motion


def _row(values: np.ndarray, row: int) -> np.ndarray:
    """A row of a field of a batch, one of which may serve all."""
    return values[row if len(values) > 1 else 0]


def _taken(run: Run, rows: list[int]) -> Run:
    """Rows of a run; fields of which one row serves all stay."""
    batch, cubes = run.batch, run.cubes
    fields = {
        name: value[rows] for name, value in batch._asdict().items() if name in GIVEN and len(value) == batch.count
    }
    pitches = {f"{name}_pitch": fields[name].shape[1] if len(rows) > 1 else 0 for name in PITCHED if name in fields}
    cubes = None if cubes is None else Cubes(*(part[rows] for part in cubes))
    return run._replace(batch=batch._replace(**fields, **pitches, count=len(rows)), cubes=cubes)
