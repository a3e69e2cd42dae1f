"""A simulator that is a formula, with candidates whose signatures are known, so that a whole audit takes seconds."""

from __future__ import annotations

import types
from dataclasses import replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rfdropo_bayes.bayes.channels import Markers, MotorAngle, Tension, Weighed, WeighedParts
from rfdropo_bayes.bayes.lanes import Lanes
from rfdropo_bayes.bayes.recordings import gather_recordings
from rfdropo_bayes.bayes.repeat_noise import departures_from_mean, mean_of
from rfdropo_bayes.bayes.scopes import build_scopes
from rfdropo_bayes.bayes.trajectory_model import TrajectoryModel
from rfdropo_bayes.data import Measured, Origin, SentCommands, Trajectory
from rfdropo_bayes.discrepancy.audit_problem import AuditProblem
from rfdropo_bayes.discrepancy.candidates import Candidate
from rfdropo_bayes.discrepancy.coordinates import Coordinates
from rfdropo_bayes.discrepancy.extension import Rules
from rfdropo_bayes.discrepancy.measurements import Measurements
from rfdropo_bayes.simulators.commands import commands_on_grid
from rfdropo_bayes.simulators.parameters import ParameterSpec
from rfdropo_bayes.simulators.protocol import Observation

STEP = 0.05
ROWS = 80
NOISE, MEMORY = 5e-4, 0.6
WEIGHTS = np.random.default_rng(7).normal(size=(7, 4, 3)) * 1e-2
FURTHER = 0.03 * np.linalg.qr(np.random.default_rng(8).normal(size=(12, 2)))[0].T.reshape(2, 4, 3)
WIDE = {"distribution": "Normal", "loc": 0.0, "scale": 1.0}


def spec(name: str, low: float = -50.0, prior: dict | None = None, nominal: float = 0.0, grid: tuple = ()):
    return ParameterSpec(name, "-", low, 50.0, nominal, prior or WIDE, name, grid)


BASE = (spec("gain", prior={"distribution": "Normal", "loc": 1.0, "scale": 0.5}), spec("bend"))
CANDIDATES = {
    "play": (spec("play", 0.0, {"distribution": "HalfNormal", "scale": 1.0}),),
    "delay": (spec("delay"),),
    "lag": (spec("lag"),),
    "creep": (
        spec("creep"),
        spec("creep_time", 0.01, {"distribution": "LogNormal", "median": 1.0, "sigma": 1.0}, 1.0, (0.3, 1.0, 3.0)),
    ),
    "imitable": (spec("imitable"),),
    # Nothing reaches the place at null: size and place are tried on a grid, and only the size can be small.
    "wall": (
        spec("wall", 0.0, {"distribution": "HalfNormal", "scale": 1.0}),
        spec("wall_place", nominal=5.0, grid=(0.2, 0.5, 0.8)),
    ),
}


class Toy:
    """Markers that are linear in shapes of the command; ``delay`` and ``lag`` look the same, ``imitable`` is a gain."""

    parameters = (*BASE, *(s for group in CANDIDATES.values() for s in group))
    marker_names = ("m1", "m2", "m3", "m4")
    cable_names = channel_names = ("a", "b")
    lanes = 8
    description = types.MappingProxyType({"time_step_s": STEP, "engine": "toy"})

    def commands(self, time, value, initial, observation_time):
        return commands_on_grid(time, value, initial, observation_time, time_step=STEP, ramp=2 * STEP)

    def rollout(self, parameters, commands, steps=None):
        values = {s.name: jnp.asarray(s.nominal) for s in Toy.parameters} | dict(parameters)
        level = jnp.concatenate([commands.initial[None], commands.step])  # one step a row
        rate = jnp.diff(level, axis=0, prepend=level[:1])
        age = jnp.arange(len(level))[:, None] - jnp.arange(len(level))  # in whole steps, whose signs are sure
        kernel = jnp.where(age >= 0, jnp.exp(-STEP * jnp.abs(age) / values["creep_time"]), 0.0)
        slow = (STEP * kernel @ level[:, 1])[:, None]  # a convolution, which XLA would compute ten times slower
        shapes = (
            (values["gain"] + values["imitable"], level[:, 0]),
            (values["bend"], level[:, 1] ** 2),
            (values["play"], 0.1 * jnp.sign(rate[:, 0])),
            (values["delay"], rate[:, 1]),
            (values["lag"], rate[:, 1]),
            (values["creep"], slow[:, 0]),
            (values["wall"], jnp.maximum(level[:, 0] - values["wall_place"], 0.0)),
        )
        position = sum(
            v * s[:, None, None] * w for (v, s), w in zip(shapes, WEIGHTS[[0, 1, 2, 3, 3, 5, 6]], strict=True)
        )
        return Observation(position, jnp.zeros((len(level), 2)), None, jnp.asarray(0))


class Named:
    """What the record asks of a mechanism."""

    def __init__(self, name: str) -> None:
        self.name, self.cause, self.remedy = name, "a cause", "a remedy"
        self.parameters = EVERY_CANDIDATE[name]


class Pulling(Toy):
    """The toy with cables whose tension grows with the gain; ``drag`` is a friction that tensions alone show."""

    parameters = (*Toy.parameters, spec("drag", 0.0, {"distribution": "HalfNormal", "scale": 1.0}))

    def rollout(self, parameters, commands, steps=None):
        level = jnp.concatenate([commands.initial[None], commands.step])
        moved = jnp.sign(jnp.diff(level, axis=0, prepend=level[:1]))
        tension = 5.0 + parameters["gain"] * level + parameters.get("drag", 0.0) * moved
        return super().rollout(parameters, commands, steps)._replace(tension=tension)


FREE = {"distribution": "Normal", "loc": 0.0, "scale": 20.0}


class Opposed(Toy):
    """The toy with two effects that nearly look the same: ``stretch`` and ``slack`` of opposite signs are a third."""

    added = types.MappingProxyType({"stretch": (spec("stretch", prior=FREE),), "slack": (spec("slack", prior=FREE),)})
    parameters = (*Toy.parameters, *added["stretch"], *added["slack"])

    def rollout(self, parameters, commands, steps=None):
        seen = super().rollout(parameters, commands, steps)
        level = jnp.concatenate([commands.initial[None], commands.step])[:, 1, None, None]
        stretch, slack = (parameters.get(name, 0.0) for name in self.added)
        return seen._replace(
            position=seen.position + level * ((stretch + slack) * FURTHER[0] + 0.02 * (stretch - slack) * FURTHER[1])
        )


class Geared(Toy):
    """The toy with a gain of each of its two cables beside ``radius``, which is a gain of both."""

    added = types.MappingProxyType({"cable_gains": (spec("gain_a"), spec("gain_b"))})
    parameters = (spec("radius"), *Toy.parameters, *added["cable_gains"])

    def rollout(self, parameters, commands, steps=None):
        seen = super().rollout(parameters, commands, steps)
        level = jnp.concatenate([commands.initial[None], commands.step])
        radius, first, second = (parameters.get(name, 0.0) for name in ("radius", "gain_a", "gain_b"))
        turned = (radius + first) * level[:, 0, None, None] * FURTHER[0]
        return seen._replace(position=seen.position + turned + (radius + second) * level[:, 1, None, None] * FURTHER[1])


class Turned(Geared):
    """The toy with cables whose common gain may be named."""

    added = types.MappingProxyType(
        {**Geared.added, "radius": (spec("radius"),), "play": CANDIDATES["play"], "delay": CANDIDATES["delay"]}
    )
    parameters = (*Toy.parameters, spec("radius"), *Geared.added["cable_gains"])


class Stopped(Toy):
    """The toy with a limit that acts from half a deviation of its prior on. Below, it has the effect of rounding."""

    added = types.MappingProxyType({"limit": (spec("limit", 0.0, {"distribution": "HalfNormal", "scale": 1.0}),)})
    parameters = (*Toy.parameters, *added["limit"])

    def rollout(self, parameters, commands, steps=None):
        seen = super().rollout(parameters, commands, steps)
        level = jnp.concatenate([commands.initial[None], commands.step])[:, 1, None, None]
        limit = parameters.get("limit", 0.0)
        size = 0.2 * jnp.maximum(limit - 0.5, 0.0) + 1e-6 * limit
        return seen._replace(position=seen.position + size * level * FURTHER[0])


class Faint(Toy):
    """The toy with two families of eight parameters, one with a grid; no recording can show a parameter by itself."""

    added = types.MappingProxyType(
        {
            "faint": tuple(spec(f"faint_{k}") for k in range(8)),
            "stepped": tuple(spec(f"stepped_{k}", grid=(0.5, 1.0, 2.0)) for k in range(8)),
        }
    )
    parameters = (*Toy.parameters, *added["faint"], *added["stepped"])

    def rollout(self, parameters, commands, steps=None):
        seen = super().rollout(parameters, commands, steps)
        level = jnp.concatenate([commands.initial[None], commands.step])[:, 1, None, None]
        size = 5e-4 * sum(parameters.get(each.name, 0.0) for family in self.added.values() for each in family)
        return seen._replace(position=seen.position + size * level * FURTHER[0])


EVERY_CANDIDATE = {
    **CANDIDATES, "drag": (Pulling.parameters[-1],), **Opposed.added, **Turned.added, **Stopped.added, **Faint.added
}  # fmt: skip


@cache
def compiled(kind: type) -> Any:
    """The rollout of a toy."""
    return jax.jit(lambda truth, commands: kind().rollout(truth, commands))


def recordings(truth: dict, seed: int, toy: Toy | None = None, *, alike: bool = False) -> list[Trajectory]:
    """Three repeats of one command, one of another, six untouched; AR(1) noise, and tensions read to 2 %. Both channels
    move alike where that is asked for."""
    return list(_recordings(tuple(truth.items()), seed, type(toy or Toy()), alike))


@cache
def _recordings(truth: tuple, seed: int, kind: type, alike: bool) -> tuple[Trajectory, ...]:
    rng, pulls = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    toy, time = kind(), STEP * np.arange(ROWS)
    sequences = [rng.uniform(-1, 1, (ROWS // 5, 2)) for _ in range(8)]
    sequences = [s[:, :1].repeat(2, axis=1) for s in sequences] if alike else sequences
    order = [0, 0, 0, *range(1, 8)]
    found = []
    for index, k in enumerate(order):
        clock = 5 * STEP * np.arange(len(sequences[k]))
        commands = toy.commands(clock, sequences[k], np.zeros(2), time)
        noise = np.zeros((ROWS, 4, 3))
        for row in range(ROWS):
            fresh = rng.standard_normal((4, 3))
            noise[row] = MEMORY * noise[row - 1] + np.sqrt(1 - MEMORY**2) * fresh if row else fresh
        shown = compiled(kind)(dict(truth), commands)
        position = np.asarray(shown.position) + NOISE * noise
        read = np.asarray(shown.tension) * (1.0 + 0.02 * pulls.standard_normal((ROWS, 2)))
        found.append(
            Trajectory.build(
                Origin(name=f"r{index}", robot="toy", format="netcdf"),
                SentCommands(
                    command_time=clock, command=sequences[k], command_unit="rad", cable_names=toy.channel_names
                ),
                Measured(
                    time=time,
                    position=position,
                    marker_names=toy.marker_names,
                    tension=read if isinstance(toy, Pulling) else None,
                ),
            )
        )
    return tuple(found)


def measurements(single: np.ndarray, members: tuple[tuple[int, ...], ...]) -> Measurements:
    """Recordings (recording, time, column) of one channel, in groups of repeats."""
    channel = MotorAngle(single, np.ones(single.shape, dtype=bool))
    firsts = [group[0] for group in members]
    count = np.stack([np.full(single.shape[1:], float(len(group))) for group in members])
    joined = replace(channel.of_recordings(firsts), readings=mean_of(channel, members))
    time = np.tile(0.05 * np.arange(single.shape[1]), (len(members), 1))
    names = tuple("abcdefgh"[index] for index in firsts)
    return Measurements(
        names, members, time, (joined,), (channel,), None, count, departures_from_mean(channel, members)
    )


LANES = Lanes(Toy(), np.arange(4))
START = {"gain": 1.0, "bend": 0.0}  # the toy is linear in both: one optimisation finds what a search finds in twenty
COORDINATES: dict = {}  # whose priors are compiled once


def problem(truth: dict, seed: int, without: tuple[str, ...] = ()) -> AuditProblem:
    """A data set of the toy with ``truth`` in it, and a library that lacks ``without``."""
    toy, trajectories = Toy(), recordings(truth, seed)
    gathered = gather_recordings(toy, trajectories)
    space = build_scopes(toy.parameters, {s.name: {} for s in toy.parameters}, {}, gathered.names)
    coordinates = COORDINATES.setdefault(
        gathered.names, Coordinates(space, len(BASE), tuple(s.name for s in toy.parameters))
    )
    model = TrajectoryModel(toy, space, gathered, (Markers.gather(gathered, "repeats"),))
    place = {name: i for i, name in enumerate(space.names)}
    candidates = [
        Candidate(name, tuple(place[s.name] for s in specs), Named(name), name)
        for name, specs in CANDIDATES.items()
        if name not in without
    ]
    rules = Rules(bootstraps=199)
    return AuditProblem(LANES, None, coordinates, model, trajectories[:4], candidates, None, START, rules, seed)


def with_prior(asked: AuditProblem, name: str, prior: dict) -> AuditProblem:
    """The same data set and library under another prior of one parameter."""
    tables = {spec.name: prior if spec.name == name else {} for spec in Toy.parameters}
    space = build_scopes(Toy.parameters, tables, {}, asked.model.recordings.names)
    return replace(asked, coordinates=replace(asked.coordinates, space=space), model=replace(asked.model, scopes=space))


def problem_of_cables(truth: dict, seed: int, tension: bool, weighed: tuple[Weighed, ...] = ()) -> AuditProblem:
    """A data set of the toy with cables, whose tensions are data or not."""
    toy = Pulling()
    asked, trajectories = problem(TRUTH_OF_CABLES, seed), recordings({**TRUTH_OF_CABLES, **truth}, seed, toy)
    gathered = gather_recordings(toy, trajectories)
    space = build_scopes(toy.parameters, {s.name: {} for s in toy.parameters}, {}, gathered.names)
    channels: tuple = (Markers.gather(gathered, "repeats"),)
    channels += (Tension.gather(toy, trajectories, ROWS),) if tension else ()
    channels += (WeighedParts(weighed),) if weighed else ()
    nominal = {s.name: s.nominal for s in toy.parameters}
    coordinates = Coordinates(space, len(BASE), tuple(nominal))
    drag = Candidate("drag", (len(space.names) - 1,), Named("drag"), "drag")
    return replace(
        asked,
        lanes=Lanes(toy, np.arange(4), fields=("position", "tension") if tension else ("position",)),
        coordinates=coordinates,
        model=TrajectoryModel(toy, space, gathered, channels),
        trajectories=trajectories[:4],
        candidates=[*asked.candidates, drag],
    )


TRUTH_OF_CABLES = {"gain": 1.3, "bend": -0.4}


def problem_of(
    toy: Opposed | Geared | Turned | Stopped | Faint, truth: dict, seed: int, base: int = len(BASE)
) -> AuditProblem:
    """A data set of a toy with further candidates, which are all that may be named."""
    asked, trajectories = problem({}, seed), recordings(truth, seed, toy)
    gathered = gather_recordings(toy, trajectories)
    space = build_scopes(toy.parameters, {s.name: {} for s in toy.parameters}, {}, gathered.names)
    nominal = {s.name: s.nominal for s in toy.parameters}
    place = {name: i for i, name in enumerate(space.names)}
    return replace(
        asked,
        lanes=Lanes(toy, np.arange(4)),
        coordinates=Coordinates(space, base, tuple(nominal)),
        model=TrajectoryModel(toy, space, gathered, (Markers.gather(gathered, "repeats"),)),
        trajectories=trajectories[:4],
        candidates=[
            Candidate(name, tuple(place[s.name] for s in specs), Named(name), name) for name, specs in toy.added.items()
        ],
    )
