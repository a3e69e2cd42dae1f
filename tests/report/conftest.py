"""A small run with a closed form: the markers follow two commands through a lag, linear but for one cubic term."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.data import Measured, Origin, SentCommands, Trajectory, group_repeats, noise_floor
from rfdropo_bayes.posteriors import ParameterInfo, PosteriorRecord, ProductOfPowers, RecordingPrediction, Scope
from rfdropo_bayes.report import RecordingFacts, RunFacts, baseline_errors, software_versions

STEP = 0.1
MARKERS = ("middle", "tip")
LAG = 0.3
NOISE = 0.0005


def response(command: np.ndarray, gain: float) -> np.ndarray:
    """Marker positions [m] of shape (time, marker, 3) for commands of shape (time, 2) [m]."""
    state = np.zeros(2)
    rows = []
    for now in command:
        state = state + STEP / (STEP + LAG) * (now - state)
        rows.append(state)
    bend = gain * (np.array(rows) - 60.0 * np.array(rows) ** 3)
    shape = np.array([0.3, 1.0])[:, None]
    x, y = bend[:, None, :, None].transpose(2, 0, 1, 3)
    z = np.array([0.09, 0.18])[:, None] - 2.0 * (x**2 + y**2) * shape
    return np.concatenate([x * shape, y * shape, z], axis=-1)


def commands(rng: np.random.Generator, rows: int, *, hold: bool) -> np.ndarray:
    """Cumulative random steps of 5 mm, one every 0.2 s; held from a third of the way on if asked for."""
    moves = rng.choice([-0.005, 0.0, 0.005], size=(rows, 2)) * (np.arange(rows) % 2 == 0)[:, None]
    if hold:
        moves[rows // 3 :] = 0.0
    return np.clip(np.cumsum(moves, axis=0), -0.03, 0.03)


def recording(
    name: str, command: np.ndarray, rng: np.random.Generator, *, gain: float = 2.0, faults: int = 0
) -> Trajectory:
    rows = len(command)
    position = response(command, gain) + NOISE * rng.normal(size=(rows, 2, 3))
    mask = np.ones((rows, 2), dtype=bool)
    mask[rng.choice(np.arange(5, rows), faults, replace=False), 1] = False
    time = STEP * np.arange(rows)
    return Trajectory.build(
        Origin(name=name, robot="toy", format="csv", synthetic=True),
        SentCommands(command_time=time, command=command, command_unit="m", cable_names=("a", "b")),
        Measured(time=time, position=position, marker_names=MARKERS, position_mask=mask),
    )


@dataclass
class Run:
    fit: list[Trajectory]
    test: list[Trajectory]
    record: PosteriorRecord
    facts: RunFacts


INFOS = (
    ParameterInfo(
        "young_modulus",
        "Pa",
        1e5,
        5e7,
        {"distribution": "LogNormal", "median": 4.5e6, "sigma": 0.5},
        "stiffness of the silicone",
    ),
    ParameterInfo(
        "density", "kg/m3", 10.0, 1e5, {"distribution": "LogNormal", "median": 1080.0, "sigma": 0.5}, "of the silicone"
    ),
    ParameterInfo(
        "poisson_ratio", "-", 0.1, 0.49, {"distribution": "Uniform", "low": 0.4, "high": 0.49}, "lateral contraction"
    ),
    ParameterInfo(
        "rayleigh_stiffness", "s", 0.0, 10.0, {"distribution": "HalfNormal", "scale": 0.1}, "damping of fast modes"
    ),
    ParameterInfo(
        "sigma", "m", 1e-5, 0.1, {"distribution": "LogNormal", "median": 1e-3, "sigma": 1.0}, "observation noise"
    ),
)


def make_run(rng: np.random.Generator, *, draws: int = 400, rows: int = 90) -> Run:
    """Posterior with an E / density ridge, a parameter at its bound, three fit recordings, two repeated test ones."""
    held = commands(rng, rows, hold=True)
    fit = [recording(f"fit_{i}", commands(rng, rows, hold=False), rng, faults=4 * i) for i in range(2)]
    fit.append(recording("fit_hold", held, rng))
    again = commands(rng, rows, hold=True)
    test = [recording(f"test_{i}", again, rng) for i in range(2)]

    scale = rng.normal(0.0, 0.45, (2, draws))
    posterior = {
        "young_modulus": 4.4e6 * np.exp(scale + 0.004 * rng.normal(size=(2, draws))),
        "density": 1050.0 * np.exp(scale + 0.004 * rng.normal(size=(2, draws))),
        "poisson_ratio": 0.45 + 0.004 * rng.normal(size=(2, draws)),
        "rayleigh_stiffness": 0.004 * np.abs(rng.normal(size=(2, draws))),
        "sigma": 5e-4 * np.exp(0.02 * rng.normal(size=(2, draws))),
    }
    prior = {
        "young_modulus": 4.5e6 * np.exp(0.5 * rng.normal(size=1000)),
        "density": 1080.0 * np.exp(0.5 * rng.normal(size=1000)),
        "poisson_ratio": rng.uniform(0.4, 0.49, 1000),
        "rayleigh_stiffness": 0.1 * np.abs(rng.normal(size=1000)),
        "sigma": 1e-3 * np.exp(rng.normal(size=1000)),
    }
    infos = list(INFOS)
    for trajectory in fit:
        normal = {"distribution": "Normal", "loc": 0.0, "scale": 0.01}
        infos.append(ParameterInfo("offset_x", "m", prior=normal, scope=Scope(trajectory.name)))
        name = infos[-1].name
        posterior[name] = 0.002 * rng.normal() + 3e-4 * rng.normal(size=(2, draws))
        prior[name] = 0.01 * rng.normal(size=1000)
    groups = {i: g for g, members in enumerate(group_repeats(fit + test)) for i in members if len(members) > 1}
    recordings = tuple(
        _prediction(t, "fit" if i < len(fit) else "test", groups.get(i, -1), rng) for i, t in enumerate(fit + test)
    )
    trace = [
        {"replicate": r, "horizon": h, "progress": h - 0.5, "ess": 0.5, "acceptance": 0.3, "log_evidence": 3.0 * h + r}
        for r in range(2)
        for h in (5, 15, 40, 90)
    ]
    blocks = [{"first_row": 1, "last_row": 5, "log_score": 60.0, "sd": 0.3}]
    blocks.append({"first_row": 6, "last_row": 90, "log_score": 800.0, "sd": 1.0})
    record = PosteriorRecord(tuple(infos), posterior, prior, recordings, trace=trace, block_scores=blocks)
    record = record.with_derived([ProductOfPowers("specific_stiffness", "m2/s2", {"young_modulus": 1, "density": -1})])
    facts = RunFacts(
        title="Toy trunk",
        robot="toy",
        method="smc",
        engine="closed form",
        status="done",
        seed=7,
        rollouts=12345.0,
        seconds=83.0,
        evaluations=20000,
        log_evidence=(2712.4, float("nan")),
        excluded={"diverged": 12},
        cautions=[Caution(Code.AT_BOUND, "rayleigh_stiffness sits on its lower bound")],
        recordings=[
            RecordingFacts.of_trajectory(t, role) for role, group in (("fit", fit), ("test", test)) for t in group
        ],
        model={"mechanisms": "none", "noise": "white", "time_step": "0.01 s"},
        baselines=baseline_errors(fit, test),
        noise_floor=noise_floor(test),
        versions=software_versions(),
        details={"particles": 500},
    )
    return Run(fit, test, record, facts)


def _prediction(trajectory: Trajectory, split: str, group: int, rng: np.random.Generator) -> RecordingPrediction:
    """What a simulator with a gain that is 2 % uncertain and 1 % off would predict."""
    gains = 2.02 * (1.0 + 0.02 * rng.normal(size=60))
    clean = np.stack([response(trajectory.command, gain) for gain in gains])
    return RecordingPrediction(
        trajectory.name,
        split,
        trajectory.time,
        trajectory.marker_names,
        trajectory.position,
        trajectory.position_mask,
        clean + NOISE * rng.normal(size=clean.shape),
        mean=clean.mean(axis=0),
        repeat_group=group,
    )


@pytest.fixture(scope="session")
def run() -> Run:
    """Two chains, five recordings, everything a report can hold."""
    return make_run(np.random.default_rng(0))


@pytest.fixture(scope="session")
def toy() -> SimpleNamespace:
    """What further recordings are made with."""
    return SimpleNamespace(STEP=STEP, MARKERS=MARKERS, commands=commands, recording=recording)
