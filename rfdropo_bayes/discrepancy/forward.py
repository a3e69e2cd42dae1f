"""Rollouts and their derivatives in batches of one size, so that few compilations suffice for an audit."""

from __future__ import annotations

import copy
import time
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.channels.object_pose import OFFSETS
from rfdropo_bayes.bayes.lanes import STEP, Fields, Lanes
from rfdropo_bayes.discrepancy.coordinates import Coordinates
from rfdropo_bayes.discrepancy.deadline import Deadline
from rfdropo_bayes.discrepancy.journal import digest
from rfdropo_bayes.errors import NoLikelihoodError
from rfdropo_bayes.simulators.callbacks import distinct
from rfdropo_bayes.simulators.commands import Commands
from rfdropo_bayes.simulators.protocol import Result

KEPT = 64  # points, at most, of which the last observations are kept

QUATERNIONS = ("object_pose", "orientation")  # fields that differences do not correct
Points = Float[np.ndarray, "n d"]


class Forward:
    """Predicted observations of a set of recordings, as a function of the audit's coordinates.

    Args:
        lanes: the simulator.
        coordinates: map from points to parameters.
        commands: stacked commands of the recordings.
        chosen: names of the simulated recordings.
        rows: number of observations of each; all by default.
        deadline: deadline of the rollouts; none by default.
        start: initial poses (recording, 7) of an object, if its poses are data.
    """

    def __init__(
        self,
        lanes: Lanes,
        coordinates: Coordinates,
        commands: Commands,
        chosen: Mapping[str, int],
        rows: int | None = None,
        deadline: Deadline | None = None,
        start: Float[np.ndarray, "recording 7"] | None = None,
    ) -> None:
        self.deadline = deadline or Deadline()
        self.lanes = lanes
        self.coordinates = coordinates
        own = commands.of(list(chosen.values()))
        observed = own.sample_step[:, :rows]
        last = int(observed.max()) + 1  # an observation may lie between two steps
        self.commands = Commands(own.initial, own.step[:, :last], observed, own.sample_fraction[:, :rows])
        self.recordings = tuple(chosen)
        self.slots = coordinates.slots(self.recordings)
        self.count = len(chosen)
        self.start = np.zeros((self.count, 7)) if start is None else start
        self.rollouts = 0
        self.pace = 0.0  # seconds of the last whole rollout, among different rollouts that fill a call
        self.compiling = 0.0  # seconds that rollouts took to compile
        self.correction: Fields = {}  # added to the observations, see `extrapolated`
        self.times = 0.0  # of the change to the finer simulator, in the correction
        self.forget()

    def forget(self) -> None:
        """Compute again what was observed last: rollouts then do not depend on what was looked up before."""
        self._recent: tuple[dict[bytes, int], Fields, np.ndarray] = ({}, {}, np.zeros(0))

    @cached_property
    def identity(self) -> str:
        """Digest of the simulator, its parameters with their priors, and the commands."""
        own, simulator = self.coordinates, self.lanes.simulator
        values = sorted(own.space.fixed.items()), sorted(own.nominal.items())
        named = (simulator.description, own.names, own.base, *values)
        scale = own.values(np.stack([np.zeros(len(own.names)), np.ones(len(own.names))]))
        prior = (own.prior_mean, own.prior_sd, *own.bounds)
        return digest(
            repr(named),
            self.lanes.difference,
            self.lanes.marker_index,
            scale,
            self.slots,
            self.start,
            self.lanes.fields,
            *prior,
            *map(np.asarray, self.commands[:4]),
            repr(sorted(self.correction)),
            *(self.correction[name] for name in sorted(self.correction)),
        )

    def with_difference(self, step: float) -> Forward:
        """The forward model with another step of derivatives."""
        return self._with(lanes=self.lanes.with_difference(step))

    def extrapolated(self, finer: Forward, x: Float[np.ndarray, " d"], times: float) -> Forward:
        """The forward model without its error in space and time: with ``times`` the change to a finer simulator at a
        point (Richardson's extrapolation). Quaternions are not corrected.
        """
        coarse, fine = self.observe_one(x), finer.observe_one(x)
        scalars = [name for name in self.lanes.fields if name not in QUATERNIONS]
        return self._with(correction={name: times * (fine[name] - coarse[name]) for name in scalars}, times=times)

    @property
    def uncorrected(self) -> Forward:
        """The forward model as the simulator computes it."""
        return self._with(correction={}, times=0.0)

    def corrected(self, shown: Fields) -> Fields:
        """Observations (point, recording, ...) of the simulator with the correction."""
        return {name: part + self.correction[name] if name in self.correction else part for name, part in shown.items()}

    def with_coordinates(self, coordinates: Coordinates) -> Forward:
        """The forward model in other coordinates of the same parameters."""
        return self._with(coordinates=coordinates)

    def _with(self, **parts: Any) -> Forward:
        changed = copy.copy(self)
        changed.__dict__.pop("identity", None)
        changed.__dict__.update(parts)
        changed.forget()
        return changed

    def observe(self, points: Points, rows: int | None = None) -> tuple[Fields, np.ndarray]:
        """Observations of every recording at each point (point, recording, ...), and whether all rollouts succeeded.

        Only the first ``rows`` rows, all by default, are simulated; later rows are meaningless.

        The fields also have ``offset`` [m], the shift of measured against simulated positions, and parameters of
        channels that rollouts do not use.
        """
        points = np.atleast_2d(points)
        places, seen, fine = self._recent
        if all(point.tobytes() in places for point in points):  # an optimisation asks for a value after its slopes
            index = [places[point.tobytes()] for point in points]
            return {name: part[index] for name, part in seen.items()}, fine[index]
        theta = self.coordinates.physical_values(points, self.slots)
        flat, start, commands = self._per_lane(theta, points)
        beside = np.repeat(self._beside(points), self.count, axis=0)
        once, again = distinct([np.tile(np.arange(self.count), len(theta)), flat, beside])
        began = time.monotonic()
        every = self.commands.step.shape[1]
        steps = None if rows is None else min(int(self.commands.sample_step[:, :rows].max()) + 1, every)
        fields, status = self.lanes.roll(flat[once], start[once], commands.of(once), self.deadline.check, steps)
        # A call that is not full is filled with copies, which cost one engine nothing and the other as much as ever.
        if steps is None and len(status) >= self.lanes.width:
            self.pace = (time.monotonic() - began) / (-(-len(status) // self.lanes.width) * self.lanes.width)
        self.rollouts += len(status)
        status, fields = status[again], {name: part[again] for name, part in fields.items()}
        fields = self._as_seen(fields, theta, points)
        fine = status == Result.OK
        for name in self.lanes.fields:
            fine &= np.isfinite(fields[name][:, :rows]).reshape(len(fine), -1).all(axis=1)
        shown = {name: part.reshape(len(points), self.count, *part.shape[1:]) for name, part in fields.items()}
        shown = self.corrected(shown) | {"offset": self._offset(theta), **self.coordinates.gains(points)}
        fine = fine.reshape(len(points), -1).all(axis=1)
        if rows is None and len(points) <= KEPT:
            self._recent = {point.tobytes(): i for i, point in enumerate(points)}, shown, fine
        return shown, fine

    def observe_one(self, point: Float[np.ndarray, " d"]) -> Fields:
        """Observations of every recording at one point.

        Raises:
            NoLikelihoodError: a rollout failed.
        """
        fields, fine = self.observe(point[None])
        if not fine[0]:
            words = "a rollout at the optimum failed"
            raise NoLikelihoodError(words, where="audit", remedy=Result.DIVERGED.remedy)
        return {name: part[0] for name, part in fields.items()}

    def tangents(self, points: Points, directions: Points) -> Fields:
        """Derivatives of `observe` for data fields along a direction at each point; one-sided for one-sided mechanisms
        at null.
        """
        tangent = self.coordinates.physical_tangents(points, directions, self.slots)
        derivatives = self._differences(points, directions)
        return derivatives | {"offset": self._offset(tangent), **self.coordinates.gain_tangents(points, directions)}

    def _differences(self, points: Points, directions: Points) -> Fields:
        """Differences over a step in prior deviations (`Lanes.difference`): to one side if it is small, and at bounds;
        zero if a rollout fails.
        """
        step, (low, high) = self.lanes.difference, self.coordinates.bounds
        size = step / np.maximum(np.abs(directions / self.coordinates.prior_sd).max(axis=1), np.finfo(float).tiny)
        move = size[:, None] * directions
        ahead, behind = (((x >= low) & (x <= high)).all(axis=1) for x in (points + move, points - move))
        behind &= ~ahead | (step > STEP)
        ends = np.concatenate([points - behind[:, None] * move, points + ahead[:, None] * move])
        seen, fine = self.observe(ends)
        usable = fine.reshape(2, -1).all(axis=0) & (ahead | behind)
        share = np.where(usable, 1.0 / (np.maximum(ahead.astype(float) + behind, 1.0) * size), 0.0)
        shown = {}
        for name in self.lanes.fields:
            before, after = np.split(seen[name], 2)
            shown[name] = np.nan_to_num(after - before) * share.reshape(-1, *[1] * (before.ndim - 1))
        return shown

    def _offset(self, theta: np.ndarray) -> np.ndarray:
        offset = np.zeros((*theta.shape[:2], 3))
        for axis, name in enumerate(OFFSETS):
            if name in self.lanes.physical:
                offset[..., axis] = theta[..., self.lanes.physical.index(name)]
        return offset

    def _beside(self, points: Points) -> Float[np.ndarray, "n k"]:
        """Further inputs of a rollout beside the simulator's parameters."""
        return np.zeros((len(points), 0))

    def _as_seen(self, fields: Fields, theta: np.ndarray, points: Points) -> Fields:
        """Measured fields from the observations of rollouts, one row per lane."""
        return fields

    def _per_lane(self, theta: np.ndarray, points: Points) -> tuple[np.ndarray, np.ndarray, Commands]:
        """Parameters (point, recording, physical), starts and commands of each lane."""
        lane = np.tile(np.arange(self.count), len(theta))
        return theta.reshape(-1, theta.shape[-1]), self.start[lane], self.commands.of(lane)
