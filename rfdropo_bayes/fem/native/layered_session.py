"""Sessions of a layered body: lanes that keep their state between calls, so that a body goes on where it stood.

A session runs the kernel of whole rollouts, on blocks of lanes whose parameters and state are its own; scratch belongs
to the threads. Steps taken in several calls give the same bits as in one.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.dynamics import Material
from rfdropo_bayes.fem.native.effect_rows import has_friction
from rfdropo_bayes.fem.native.layered import NativeLayered, NativeRollout, empty_output, in_blocks
from rfdropo_bayes.fem.native.layered_records import Samples
from rfdropo_bayes.fem.native.layered_rollout import Batch, Schedule
from rfdropo_bayes.fem.native.simd import aligned_zeros

KEPT = {
    "Samples": tuple(name for name in Samples._fields if name != "present"),
    "Work": ("position", "velocity", "tension", "branch", "softness", "lost", "failed", "imbalance"),
    "Friction": ("mobilised", "segment"),
}
"""Fields of the kernels' records that outlive a step."""
GIVEN = ("moduli", "density", "damping", "gravity", "layer_scale", "point_mass", "law", "effects", "start")
"""Fields of a batch that an initial state depends on."""
REMEMBERED = 2**26
"""Most memory for equilibria that were found before [bytes]."""


class _Lane(NamedTuple):
    """State of a lane, or of several, and what it shows of it, in the order of `NativeRollout`."""

    state: Float[np.ndarray, "*lane values"]
    position: Float[np.ndarray, "*lane 1 points 3"]
    tension: Float[np.ndarray, "*lane 1 cables"]
    diverged: Bool[np.ndarray, "*lane"]
    cables_converged: Bool[np.ndarray, "*lane"]
    residual: Float[np.ndarray, "*lane"]


class _Place(NamedTuple):
    """Where a field of a record lies in a lane's memory."""

    record: int
    name: str
    first: int
    last: int


def _places(records: tuple[NamedTuple, ...]) -> list[_Place]:
    places, last = [], 0
    for index, record in enumerate(records):
        for name in KEPT.get(type(record).__name__, ()):
            first, last = last, last + len(getattr(record, name))
            places.append(_Place(index, name, first, last))
    return places


class LayeredSession:
    """Lanes of one layered body, each with its own parameters and its own time.

    Args:
        engine: that computes rollouts of the body.
        count: lanes.

    Attributes:
        memory: parameters and state of every lane, ``(block, value, lane of the block)``, in the engine's precision.

    Raises:
        InputError: fewer than one lane.
    """

    def __init__(self, engine: NativeLayered, count: int) -> None:
        if count < 1:
            raise InputError(f"{count} lanes", remedy="use at least one")
        self.engine, self.count = engine, int(count)
        self.memory = np.zeros((0, 0, engine.lanes), engine.dtype)
        self._batch: Batch | None = None  # of the lanes that were started first
        self._rubs = False
        self._places: list[_Place] = []
        self._local = threading.local()
        self._equilibria: OrderedDict[bytes, _Lane] = OrderedDict()

    @property
    def nbytes(self) -> int:
        """Memory of parameters and state of all lanes; scratch, one block a thread, is not counted."""
        return self.memory.nbytes

    def reset(
        self, rows: Int[np.ndarray, " row"], material: Material, *, start: Float[np.ndarray, "row cables"] | None = None
    ) -> NativeRollout:
        """Start some lanes anew; the others do not notice.

        Args:
            rows: lanes.
            material: fields with one entry per row.
            start: cable displacements [m] whose static equilibrium is the initial state; None starts undeformed. An
                equilibrium that was found before is not computed again.

        Returns:
            The initial state, as a rollout of one row.

        Raises:
            InputError: shapes that do not fit, or effects that other lanes of the session do not have.
        """
        rows = np.asarray(rows, dtype=np.intp)
        still = np.zeros((len(rows), 1, self.engine.tables.cables))
        given = {"start": start, "position": None, "tension": None}
        batch, schedule, _ = self.engine.inputs(material, still, given, 0, 1)
        self._admit(batch, has_friction(material.effects))
        keys = [b"".join(_row(getattr(batch, name), row).tobytes() for name in GIVEN) for row in range(len(rows))]
        known = self._equilibria if schedule.static_iterations > 0 else OrderedDict()
        first = {key: row for row, key in reversed(list(enumerate(keys))) if key not in known}
        fresh = self._settled(_taken(batch, list(first.values())), schedule)
        found = {key: known[key] for key in keys if key in known}
        found |= {key: _Lane(*(part[row] for part in fresh)) for row, key in enumerate(first)}
        self._remember(known, found)
        lanes = _Lane(*(np.stack(parts) for parts in zip(*(found[key] for key in keys), strict=True)))
        self.memory[rows // self.engine.lanes, :, rows % self.engine.lanes] = lanes.state
        return NativeRollout(*lanes[1:])

    def advance(self, displacement: Float[np.ndarray, "lane steps cables"], *, stride: int = 1) -> NativeRollout:
        """Take steps to the cable displacements [m] at their ends; recorded before the first, and every ``stride``.

        Raises:
            InputError: a session that was not started, or displacements of another shape.
        """
        engine = self.engine
        if self._batch is None:
            raise InputError("a session that was not started", remedy="reset all lanes first")
        if displacement.ndim != 3 or displacement.shape[::2] != (self.count, engine.tables.cables):
            expected = f"({self.count}, steps, {engine.tables.cables})"
            raise InputError(f"displacement has shape {displacement.shape}, expected {expected}", where="advance")
        steps = displacement.shape[1]
        moves = np.ascontiguousarray(displacement, dtype=engine.dtype).reshape(self.count, -1)
        batch = self._batch._replace(displacement=moves, displacement_pitch=moves.shape[1], count=self.count)
        schedule = engine.schedule(steps, stride)._replace(resumed=1)
        output = empty_output(self.count, 1 + steps // stride, engine.points, engine.tables.cables)

        def block(first: int) -> None:
            engine.run_block(batch, self._records(first // engine.lanes), schedule, output, first)

        in_blocks(block, self.count, engine.lanes, engine.threads)
        return NativeRollout.of(output)

    def save(self) -> Float[np.ndarray, "lane values"]:
        """A copy of parameters and state, one row a lane."""
        return self.memory.transpose(0, 2, 1).reshape(-1, self.memory.shape[1])[: self.count].copy()

    def restore(self, rows: Int[np.ndarray, " row"], state: Float[np.ndarray, "row values"]) -> None:
        """Set lanes to rows of what `save` returned, of this or another session of the same body and effects.

        Raises:
            InputError: a session that was not started, or a state of another body or precision.
        """
        if state.shape[1:] != self.memory.shape[1:2] or state.dtype != self.engine.dtype:
            raise InputError(
                f"a state of {state.shape[1:]} values in {state.dtype}",
                where="restore",
                remedy=f"this session has {self.memory.shape[1]} in {self.engine.dtype}; start it before",
            )
        self.memory[rows // self.engine.lanes, :, rows % self.engine.lanes] = state

    def _admit(self, batch: Batch, rubs: bool) -> None:
        """Lay out the memory for the effects that the first lanes have; later lanes must have the same."""
        if self._batch is None:
            records = self.engine.records(rubs)
            self._places, self._rubs = _places(records), rubs
            blocks = -(-self.count // self.engine.lanes)
            self.memory = aligned_zeros((blocks, self._places[-1].last, self.engine.lanes), self.engine.dtype)
            self._batch = _taken(batch, [0])
        elif rubs != self._rubs or not np.array_equal(batch.present, self._batch.present):
            raise InputError(
                "a lane whose body has other effects than the lanes before",
                where="reset",
                remedy="give every lane the same mechanisms; a null value switches one off",
            )

    def _settled(self, batch: Batch, schedule: Schedule) -> _Lane:
        """The initial states of a batch."""
        engine = self.engine
        output = empty_output(batch.count, 1, engine.points, engine.tables.cables)
        state = np.zeros((batch.count, self.memory.shape[1]), engine.dtype)

        def block(first: int) -> None:
            records = engine.records(self._rubs)
            engine.run_block(batch, records, schedule, output, first)
            there = state[first : first + engine.lanes]
            for place in self._places:
                there[:, place.first : place.last] = getattr(records[place.record], place.name).T[: len(there)]

        in_blocks(block, batch.count, engine.lanes, engine.threads)
        return _Lane(state, *NativeRollout.of(output))

    def _remember(self, known: OrderedDict[bytes, _Lane], found: dict[bytes, _Lane]) -> None:
        """Keep what was found last, as far as the memory set aside for it goes."""
        for key, lane in found.items():
            known[key] = lane
            known.move_to_end(key)
        most = REMEMBERED // (self.memory.shape[1] * self.engine.dtype.itemsize)
        while len(known) > most:
            known.popitem(last=False)

    def _records(self, block: int) -> tuple[NamedTuple, ...]:
        """Scratch of the calling thread around the memory of a block."""
        if not hasattr(self._local, "records"):
            self._local.records = {}
        if block not in self._local.records:
            records = list(self.engine.records(self._rubs))
            for index, record in enumerate(records):
                own = {p.name: self.memory[block, p.first : p.last] for p in self._places if p.record == index}
                records[index] = record._replace(**own)
            # What is present is the same for all blocks, and no lane's own.
            assert self._batch is not None
            records[0] = records[0]._replace(present=self._batch.present)
            self._local.records[block] = tuple(records)
        return self._local.records[block]


def _row(values: np.ndarray, row: int) -> np.ndarray:
    """A row of a field of a batch, one of which may serve all."""
    return values[row if len(values) > 1 else 0]


def _taken(batch: Batch, rows: list[int]) -> Batch:
    """Rows of a batch; fields of which one row serves all stay."""
    fields = {
        name: value[rows] for name, value in batch._asdict().items() if name in GIVEN and len(value) == batch.count
    }
    pitch = batch.start.shape[1] if len(fields.get("start", ())) > 1 else 0
    return batch._replace(**fields, start_pitch=pitch, count=len(rows))
