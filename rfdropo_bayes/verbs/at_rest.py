"""Marker positions of a robot at rest under many commands at once, without rollouts, in milliseconds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfdropo_bayes.data import Trajectory, shared_markers
from rfdropo_bayes.model.assembly import build_robot_simulator, expand_groups
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.robots.robot import Robot
from rfdropo_bayes.simulators.body_engine import QUASI_STATIC, Backend
from rfdropo_bayes.simulators.commands import Commands
from rfdropo_bayes.simulators.mechanisms import MemorylessActuation, SensingMechanism, motions_of
from rfdropo_bayes.simulators.robot_simulator import EQUILIBRIUM_TOLERANCE
from rfdropo_bayes.simulators.trunk import TrunkSimulator, assemble
from rfdropo_bayes.verbs.command_lag import JUST_BEFORE

MOVING = ("time_step", "integrator")  # keys of [simulator] that a body at rest does not have


class Rows(NamedTuple):
    """Rows of recordings: sent commands, and seen marker positions."""

    command: Float[np.ndarray, "row channel"]
    position: Float[np.ndarray, "row marker 3"]  # [m], NaN if a marker was not seen
    time: Float[np.ndarray, " row"]  # [s] in its recording

    def of(self, index: np.ndarray) -> Rows:
        """A subset of the rows."""
        return Rows(*(part[index] for part in self))


def rows_of(recordings: Sequence[Trajectory], markers: Sequence[str], late: float = 0.0) -> Rows:
    """All rows of recordings, with the commands in force a delay [s] earlier."""
    names = shared_markers(recordings, markers)
    parts = []
    for run in recordings:
        index = [run.marker_names.index(name) for name in names]
        seen = np.where(run.position_mask[:, index, None], run.position[:, index], np.nan)
        parts.append(Rows(run.command_at(run.time - late), seen, run.time))
    return Rows(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def spread_rows(rows: Rows, most: int) -> np.ndarray:
    """Indices of at most ``most`` rows with a seen marker, in order: one half random, the other half with commands
    farthest from all chosen rows.
    """
    usable = np.flatnonzero(np.isfinite(rows.position).all(axis=2).any(axis=1))
    if len(usable) <= most:
        return usable
    random = np.random.default_rng(0)
    chosen = list(random.choice(len(usable), most // 2, replace=False))
    command = rows.command[usable]
    scale = command.std(axis=0)
    command = command / np.where(scale > 0.0, scale, 1.0)
    near = np.full(len(usable), np.inf)
    for k in chosen:
        near = np.minimum(near, np.sum((command - command[k]) ** 2, axis=1))
    while len(chosen) < most:
        k = int(np.argmax(near))
        chosen.append(k)
        near = np.minimum(near, np.sum((command - command[k]) ** 2, axis=1))
        near[chosen] = -1.0
    return usable[np.sort(chosen)]


def resting(spec: ModelSpec) -> RestingRobot:
    """The rod of a model's robot at rest, with its mechanisms without memory.

    Raises:
        InputError: a black box.
    """
    still = {"body": "rod", "tetrahedra": None, "motion": QUASI_STATIC, "precision": "float64", "push": False}
    table = spec.simulator.model_copy(update=still | dict.fromkeys(MOVING))
    simulator = build_robot_simulator(replace(spec, simulator=table))
    assert isinstance(simulator, TrunkSimulator)
    kept = tuple(mechanism for mechanism in simulator.mechanisms if without_memory(mechanism))
    simulator = replace(simulator, mechanisms=kept).with_backend(Backend("numba"))
    return RestingRobot(simulator, shown=tuple(simulator.marker_names), fixed=_fixed(spec, simulator))


def without_memory(mechanism: Any) -> bool:
    """Whether a mechanism acts on a row by itself, and on a body at rest."""
    acts = mechanism.stage == "body" or isinstance(mechanism, MemorylessActuation | SensingMechanism)
    return acts and QUASI_STATIC in motions_of(mechanism)


def _fixed(spec: ModelSpec, simulator: TrunkSimulator) -> dict[str, float]:
    """Fixed parameter values of a model, if its simulator has the parameters."""
    known = [each.name for each in simulator.parameters]
    given = expand_groups(spec.fixed, simulator.parameters)
    return {name: float(value) for name, value in given.items() if name in known}


class RestingRobot:
    """A robot in which every row of commands is an equilibrium of its own.

    Args:
        simulator: simulator of a rod at rest, with mechanisms without memory.
        shown: the predicted markers, in this order.
        fixed: fixed parameter values; others are nominal.
    """

    def __init__(self, simulator: TrunkSimulator, shown: tuple[str, ...], fixed: Mapping[str, float]) -> None:
        self.simulator, self.shown, self.fixed = simulator, shown, dict(fixed)

    def showing(self, markers: Sequence[str]) -> RestingRobot:
        """The same robot with predictions of these markers alone."""
        return RestingRobot(self.simulator, tuple(markers), self.fixed)

    def as_robot(self, robot: Robot) -> RestingRobot:
        """The same body, parameters and drives, with cables and chambers of another robot; nothing is recompiled."""
        own = self.simulator
        assembly = assemble(robot, own.discretisation)
        changed = replace(own, robot=robot, assembly=assembly, engine=replace(own.engine, body=assembly))
        copy = RestingRobot(changed, self.shown, self.fixed)
        copy.__dict__ |= {"_inputs": self._inputs, "_measured": self._measured}
        return copy

    def markers(
        self, command: Float[np.ndarray, "row channel"], values: Mapping[str, Float[np.ndarray, " set"]] | None = None
    ) -> Float[np.ndarray, "set row marker 3"]:
        """Measured positions of markers [m] under each command, for each set of values; other parameters are fixed or
        nominal.

        NaN if no equilibrium was found.
        """
        given = {name: np.atleast_1d(np.asarray(value, float)) for name, value in (values or {}).items()}
        count = len(next(iter(given.values()))) if given else 1
        nominal = {spec.name: spec.nominal for spec in self.simulator.parameters} | self.fixed
        every = {name: np.full(count, value) for name, value in nominal.items()} | given
        rows = len(command)
        material, start = self._inputs(every, np.asarray(command, float))
        material = jax.tree.map(lambda part: np.repeat(np.asarray(part), rows, axis=0), material)
        cables = start.shape[-1]
        flat = np.asarray(start).reshape(count * rows, cables)
        moved = self.simulator.engine.native.rollout(material, np.zeros((1, cables)), start=flat, steps=0)
        position = moved.position[:, 0, : self.simulator.shown].reshape(count, rows, -1, 3)
        bad = (moved.diverged | (moved.imbalance > EQUILIBRIUM_TOLERANCE)).reshape(count, rows)
        seen = np.asarray(self._measured(every, position))
        chosen = [self.simulator.marker_names.index(name) for name in self.shown]
        return np.where(bad[:, :, None, None], np.nan, seen)[:, :, chosen]

    @cached_property
    def _inputs(self) -> Any:
        """Material and cable displacements of sets of values."""
        own = self.simulator

        def start(values: Any, row: Any) -> Any:
            still = Commands(row, jnp.zeros((0, len(row))), jnp.zeros(0, int), jnp.zeros(0))
            initial = own.actuated(values, still, own.time_step)[0]
            return own.exerted(values, own.unwound(values, initial).level)

        def inputs(values: Any, command: Any) -> Any:
            whole = own.complete(values)
            return own.material(whole), jax.vmap(lambda row: start(whole, row))(command)

        return jax.jit(jax.vmap(inputs, in_axes=(0, None)))

    @cached_property
    def _measured(self) -> Any:
        """Measured from true positions, row by row."""
        own = self.simulator

        def measured(values: Any, position: Any) -> Any:
            whole, at = own.complete(values), jnp.zeros(1)
            return jax.vmap(lambda row: own.measured(whole, row[None], at)[0])(position)

        return jax.jit(jax.vmap(measured))


BLOCKS, BLOCK = 5, 24
"""Stretches of rows that stand for a recording at rest, and rows of each: neighbours are found from each other."""


def blocks_of(run: Trajectory) -> Trajectory:
    """Some rows of a recording at rest, in stretches; each row under the command that its pose is simulated under."""
    count = len(run.time)
    if count <= BLOCKS * BLOCK:
        return run
    first = np.linspace(0, count - BLOCK, BLOCKS).astype(int)
    rows = (first[:, None] + np.arange(BLOCK)).ravel()
    time = run.time[rows]
    command = run.command_at(time - JUST_BEFORE)
    gaps = np.diff(time)
    clock = np.append(0.0, np.cumsum(np.minimum(gaps, 2.0 * np.median(gaps))))  # no clock runs from stretch to stretch
    sent, when = run.dataset["command"], run.dataset["command_time"]
    dataset = run.dataset.isel(time=rows).drop_dims("command_time").assign_coords(time=clock)
    dataset = dataset.assign_coords(command_time=(when.dims, 0.5 * (clock[1:] + clock[:-1]), when.attrs))
    dataset["command"] = (sent.dims, command[1:], sent.attrs)
    dataset["initial_command"] = dataset["initial_command"].copy(data=command[0])
    return Trajectory(dataset)
