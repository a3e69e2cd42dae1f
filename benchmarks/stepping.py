"""Steps per second of sessions, one control period of 5 steps at a time, beside whole rollouts in the same run.

    python benchmarks/stepping.py [--lanes N [N ...]] [--seconds S] [--integrator NAME] [--json FILE]

The trunk of TrunkReach, and that of TrunkPush which presses on its cube, go through commands, drives, body and cameras,
with parameters that differ from lane to lane.
Episodes of 100 solves start anew each time. "Whole" is the compiled engine's batch of rollouts of the same. Rates are
those of the clock on the wall and of processor time, which a busy machine leaves as it is. Memory is that of all lanes'
state. Then what it costs to start all lanes anew: from rest, from an equilibrium, and from one found before.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from rfdropo_bayes.model.assembly import build_simulator
from rfdropo_bayes.model.experiment import SimulatorTable
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.runtime import available_processors
from rfdropo_bayes.simulators.trunk import TrunkSimulator

ROBOT, PERIOD, SOLVES, ACTIONS = "trunk_sofa", 0.05, 5, 20


class Row(NamedTuple):
    """One line of the table."""

    what: str
    scene: str
    precision: str
    threads: int
    lanes: int
    per_second: float
    per_cpu_second: float
    kib_per_lane: float | None


def simulator(
    precision: str, threads: int | None, state: str = "rest", *, push: bool = False, integrator: str = "euler"
) -> TrunkSimulator:
    """The trunk of the paper on the compiled engine, alone or with its cube."""
    options = {"engine": "numba", "precision": precision, "threads": threads, "push": push, "integrator": integrator}
    table = SimulatorTable.model_validate(options)
    built = build_simulator(ModelSpec(Robot.load(ROBOT).with_changes(initial_state=state), simulator=table))
    assert isinstance(built, TrunkSimulator)
    return built


def drawn(lanes: int, push: bool = False) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Parameters and commands [m] of every lane: one of eight cables moves 5 mm in each period."""
    random = np.random.default_rng(0)
    values = {"young_modulus": random.uniform(2e6, 7e6, lanes), "trunk_mass": random.uniform(0.1, 1.0, lanes)}
    moves = np.zeros((lanes, ACTIONS, 8))
    cable, sign = random.integers(8, size=(lanes, ACTIONS)), random.choice([-0.005, 0.005], (lanes, ACTIONS))
    np.put_along_axis(moves, cable[..., None], sign[..., None], axis=2)
    commands = np.clip(np.cumsum(moves, axis=1), 0.0, 0.04)
    if push:  # the lower cables bring the trunk onto the cube
        commands[..., [2, 6]] = np.linspace(0.01, 0.04, ACTIONS)[:, None]
    return values, commands


def rate(run: Callable[[], Any], solves: int, seconds: float) -> tuple[float, float]:
    """Solves per second of wall and of processor time, the best of what fits into some seconds."""
    run()
    wall, cpu, end = 0.0, 0.0, time.perf_counter() + seconds
    while time.perf_counter() < end:
        began, worked = time.perf_counter(), time.process_time()
        run()
        wall = max(wall, solves / (time.perf_counter() - began))
        cpu = max(cpu, solves / (time.process_time() - worked))
    return wall, cpu


def sessions(model: TrunkSimulator, lanes: int, seconds: float) -> tuple[float, float, float]:
    """Rates and memory [KiB per lane] of a session."""
    values, commands = drawn(lanes, model.pushes)
    session = model.session(lanes, PERIOD)

    def episodes() -> None:
        session.reset(np.arange(lanes), values)
        for period in range(ACTIONS):
            session.act(commands[:, period])

    return *rate(episodes, lanes * ACTIONS * SOLVES, seconds), session.nbytes / lanes / 1024


def whole(model: TrunkSimulator, lanes: int, seconds: float) -> tuple[float, float]:
    """Rates of whole rollouts of the same commands."""
    values, commands = drawn(lanes, model.pushes)
    clock = PERIOD * np.arange(ACTIONS + 1)
    grid = [model.commands(clock[:-1], rows, np.zeros(8), clock) for rows in commands]
    stacked = jax.tree.map(lambda *parts: np.stack(parts), *grid)
    rollout = jax.jit(jax.vmap(lambda v, c: model.rollout(v, c).position))
    return rate(lambda: np.asarray(rollout(values, stacked)), lanes * ACTIONS * SOLVES, seconds)


def starts(lanes: int) -> list[str]:
    """Milliseconds that it takes to start all lanes."""
    lines = []
    for state in ("rest", "equilibrium"):
        session = simulator("float32", None, state).session(lanes, PERIOD)
        for attempt in ("to compile", "new parameters", "the same parameters"):
            values = drawn(lanes)[0]
            values["young_modulus"] *= 1.0 if attempt == "to compile" else 1.01
            began = time.perf_counter()
            session.reset(np.arange(lanes), values)
            took = time.perf_counter() - began
            if attempt != "to compile":
                lines.append(f"| {lanes} lanes from {state}, {attempt} | {1e3 * took:.0f} |")
    return lines


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", type=int, nargs="+", default=[128, 256])
    parser.add_argument("--seconds", type=float, default=4.0, help="for each line")
    parser.add_argument("--integrator", choices=["euler", "sdirk2"], default="euler")
    parser.add_argument("--json", type=Path, help="also write the rows here")
    chosen = parser.parse_args()
    rows = []
    for push in (False, True):
        scene = "push" if push else "reach"
        for precision in ("float32", "float64"):
            for threads in sorted({1, available_processors()}):
                model = simulator(precision, threads, push=push, integrator=chosen.integrator)
                for lanes in chosen.lanes:
                    wall, cpu, memory = sessions(model, lanes, chosen.seconds)
                    rows.append(Row("session", scene, precision, threads, lanes, wall, cpu, memory))
                    wall, cpu = whole(model, lanes, chosen.seconds)
                    rows.append(Row("whole", scene, precision, threads, lanes, wall, cpu, None))
    print("| | scene | precision | threads | lanes | steps/s | steps per CPU s | KiB per lane |")
    print("|---|---|---|---|---|---|---|---|")
    for row in rows:
        memory = "" if row.kib_per_lane is None else f"{row.kib_per_lane:.1f}"
        speed = f"{row.per_second:,.0f} | {row.per_cpu_second:,.0f}"
        print(f"| {row.what} | {row.scene} | {row.precision} | {row.threads} | {row.lanes} | {speed} | {memory} |")
    print("\n| start | ms |\n|---|---|")
    print("\n".join(starts(max(chosen.lanes))))
    if chosen.json:
        chosen.json.write_text(json.dumps([row._asdict() for row in rows], indent=1))


if __name__ == "__main__":
    main()
