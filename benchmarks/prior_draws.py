"""How many of 512 prior draws a step loses, or leaves without the impulses of its constraints, under pulls of 40 mm.

    python benchmarks/prior_draws.py [--integrators NAME ...] [--precisions NAME ...] [--robot NAME] [--draws N]

Every physical parameter is drawn from its default prior, those of the cube and of its contacts included. Commands go by
5 mm every 50 ms for 5 s, within 40 mm; in the pushing task the lower cables bring the trunk onto the cube besides.
"Jumps" pull about half of all cables at once, every 200 ms, by any length up to 40 mm. Tensions are the largest of any
draw.
"""

from __future__ import annotations

import argparse
import time
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.priors import prior_from_table
from rfdropo_bayes.model.assembly import build_simulator
from rfdropo_bayes.model.experiment import SimulatorTable
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.body_engine import cube_arrays
from rfdropo_bayes.simulators.trunk import TrunkSimulator

PERIOD, PERIODS, MOVE, FARTHEST = 0.05, 100, 0.005, 0.04
"""[s] between commands; [m] moved by each, and the longest pull."""
LOWER = [2, 6]
"""Channels of the paper's trunk that bring it onto the cube."""
TASKS = ("reach", "push", "jumps", "pushed jumps")


class Row(NamedTuple):
    """One line of the table."""

    task: str
    integrator: str
    precision: str
    lost: int
    unconverged: int
    tension: float  # largest [N]
    cpu_s: float


def simulator(robot: str, task: str, integrator: str, precision: str, step_ms: float | None) -> TrunkSimulator:
    """The robot of a task on the compiled engine."""
    options: dict[str, Any] = {"engine": "numba", "integrator": integrator, "precision": precision}
    options |= {"push": task.startswith("push")} | ({} if step_ms is None else {"time_step": 1e-3 * step_ms})
    built = build_simulator(ModelSpec(Robot.load(robot), simulator=SimulatorTable.model_validate(options)))
    assert isinstance(built, TrunkSimulator)
    return built


def drawn(model: TrunkSimulator, draws: int) -> dict[str, np.ndarray]:
    """Parameters of every draw."""
    keys = jax.random.split(jax.random.key(0), len(model.parameters))
    return {
        spec.name: np.asarray(prior_from_table(spec, spec.prior, where="prior").sample(key, (draws,)))
        for spec, key in zip(model.parameters, keys, strict=True)
    }


def walk(task: str, channels: int, draws: int) -> Float[np.ndarray, "draw command channel"]:
    """Commands [m] of every draw."""
    random = np.random.default_rng(0)
    if task.endswith("jumps"):
        commands = np.where(
            random.uniform(size=(draws, PERIODS, channels)) < 0.5,
            0.0,
            random.uniform(0.0, FARTHEST, (draws, PERIODS, channels)),
        )
        return np.repeat(commands[:, ::4], 4, axis=1)
    moves = np.zeros((draws, PERIODS, channels))
    cable, sign = random.integers(channels, size=(draws, PERIODS)), random.choice([-MOVE, MOVE], (draws, PERIODS))
    np.put_along_axis(moves, cable[..., None], sign[..., None], axis=2)
    there, commands = np.zeros((draws, channels)), np.zeros_like(moves)
    for k in range(PERIODS):
        there = np.clip(there + moves[:, k], 0.0, FARTHEST)
        commands[:, k] = there
    if task == "push":
        commands[..., LOWER] = np.linspace(0.01, FARTHEST, PERIODS)[:, None]
    return commands


def inputs(model: TrunkSimulator, task: str, draws: int) -> Any:
    """What the engine moves the bodies by."""
    values, clock = drawn(model, draws), PERIOD * np.arange(PERIODS + 1)
    channels = len(model.robot.channel_names)
    grid = [model.commands(clock[:-1], rows, np.zeros(channels), clock) for rows in walk(task, channels, draws)]
    stacked = jax.tree.map(lambda *parts: np.stack(parts), *grid)
    made = jax.jit(jax.vmap(lambda v, c: (*model.inputs(v, c), model.body_inputs(v)[1])))
    return jax.tree.map(np.asarray, made(values, stacked))


def row(robot: str, task: str, integrator: str, precision: str, draws: int, step_ms: float | None) -> Row:
    """One line of the table."""
    model = simulator(robot, task, integrator, precision, step_ms)
    material, start, displacement, cube = inputs(model, task, draws)
    begin = {"start" if model.engine.from_equilibrium else "before": start}
    began = time.process_time()
    found = model.engine.native.rollout(
        material, displacement, **begin, stride=5, cube=None if cube is None else cube_arrays(cube)
    )
    cost = time.process_time() - began
    lost, unconverged = int(found.diverged.sum()), int((~found.converged).sum())
    return Row(task, integrator, precision, lost, unconverged, float(found.tension.max()), cost)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", default="trunk_sofa")
    parser.add_argument("--tasks", nargs="+", default=list(TASKS))
    parser.add_argument("--integrators", nargs="+", default=["euler", "sdirk2"])
    parser.add_argument("--precisions", nargs="+", default=["float64", "float32"])
    parser.add_argument("--draws", type=int, default=512)
    parser.add_argument("--step-ms", type=float, help="the robot's by default")
    chosen = parser.parse_args()
    print("| task | integrator | precision | lost | unconverged | largest tension [N] | CPU s |")
    print("|---|---|---|---|---|---|---|")
    for task in chosen.tasks:
        for integrator in chosen.integrators:
            for precision in chosen.precisions:
                one = row(chosen.robot, task, integrator, precision, chosen.draws, chosen.step_ms)
                cells = [one.task, one.integrator, one.precision, one.lost, one.unconverged]
                print("| " + " | ".join(map(str, cells)) + f" | {one.tension:,.0f} | {one.cpu_s:.1f} |", flush=True)


if __name__ == "__main__":
    main()
