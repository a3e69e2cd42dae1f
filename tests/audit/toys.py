"""A simulator that is a formula, with candidates whose signatures are known, so that a whole audit takes seconds."""

from __future__ import annotations

import types

import jax.numpy as jnp
import numpy as np

from rfdropo_bayes.audit.candidates import Candidate
from rfdropo_bayes.audit.coordinates import Coordinates
from rfdropo_bayes.audit.extension import Rules
from rfdropo_bayes.audit.forward import Lanes
from rfdropo_bayes.audit.pipeline import Question
from rfdropo_bayes.bayes.recordings import gather_recordings
from rfdropo_bayes.bayes.space import build_space
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.simulators.commands import commands_on_grid
from rfdropo_bayes.simulators.parameters import ParameterSpec
from rfdropo_bayes.simulators.protocol import Observation

STEP = 0.05
ROWS = 80
NOISE, MEMORY = 5e-4, 0.6
WEIGHTS = np.random.default_rng(7).normal(size=(7, 4, 3)) * 1e-2
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
        time = STEP * jnp.arange(len(level))
        kernel = jnp.exp(-time / values["creep_time"])
        slow = jnp.stack([jnp.convolve(level[:, 1], kernel)[: len(level)] * STEP], axis=1)
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
        self.name, self.cause, self.remedy, self.parameters = name, "a cause", "a remedy", CANDIDATES[name]


def recordings(truth: dict, seed: int) -> list[Trajectory]:
    """Three repeats of one command, one of another, six untouched; AR(1) noise."""
    rng = np.random.default_rng(seed)
    toy, time = Toy(), STEP * np.arange(ROWS)
    sequences = [rng.uniform(-1, 1, (ROWS // 5, 2)) for _ in range(8)]
    order = [0, 0, 0, *range(1, 8)]
    found = []
    for index, k in enumerate(order):
        clock = 5 * STEP * np.arange(len(sequences[k]))
        commands = toy.commands(clock, sequences[k], np.zeros(2), time)
        noise = np.zeros((ROWS, 4, 3))
        for row in range(ROWS):
            fresh = rng.standard_normal((4, 3))
            noise[row] = MEMORY * noise[row - 1] + np.sqrt(1 - MEMORY**2) * fresh if row else fresh
        position = np.asarray(toy.rollout(truth, commands).position) + NOISE * noise
        found.append(
            Trajectory.build(
                name=f"r{index}",
                robot="toy",
                format="netcdf",
                time=time,
                position=position,
                command_time=clock,
                command=sequences[k],
                command_unit="rad",
                marker_names=toy.marker_names,
                cable_names=toy.channel_names,
            )
        )
    return found


LANES = Lanes(Toy(), np.arange(4))


def question(truth: dict, seed: int, without: tuple[str, ...] = ()) -> Question:
    """A data set of the toy with ``truth`` in it, and a library that lacks ``without``."""
    toy, trajectories = Toy(), recordings(truth, seed)
    gathered = gather_recordings(toy, trajectories)
    space = build_space(toy.parameters, {s.name: {} for s in toy.parameters}, {}, gathered.names)
    coordinates = Coordinates(
        space, len(BASE), tuple(s.name for s in toy.parameters), {s.name: s.nominal for s in toy.parameters}, {}
    )
    place = {name: i for i, name in enumerate(space.names)}
    candidates = [
        Candidate(name, tuple(place[s.name] for s in specs), Named(name), name)
        for name, specs in CANDIDATES.items()
        if name not in without
    ]
    rules = Rules(bootstraps=199)
    return Question(LANES, None, coordinates, gathered, trajectories[:4], candidates, None, None, rules, seed)
