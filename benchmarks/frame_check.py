"""How often `rfdropo check` doubts the frame of a recording that is in the right one.

    python benchmarks/frame_check.py [--robots NAME ...] [--draws N] [--seconds S]

Every recording is simulated with parameters of its own, drawn from the robot's default priors, and 0.5 mm of noise; the
check compares it with the nominal model, as it compares measured ones. Commands go by 5 mm every 50 ms, of all channels
in turn or of one alone. Each recording is judged by itself; a check judges up to five together.
"""

from __future__ import annotations

import argparse
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from convergence import PERIOD, walk
from prior_draws import drawn

from rfdropo_bayes.model.assembly import build_simulator
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.trunk import TrunkSimulator
from rfdropo_bayes.verbs.motion_direction import AGREEING, Direction, Paths, direction_doubt, direction_of

ROBOTS = ("trunk_sofa", "trunk_physical", "smooth_arm", "asl_trunk", "motor_trunk")
NOISE = 5e-4  # [m]


def directions(name: str, draws: int, seconds: float, *, alone: bool) -> tuple[list[Direction], int]:
    """Of every recording of a robot; and how many rollouts did not end well. ``alone``: one channel moves."""
    robot = Robot.load(name)
    model = build_simulator(ModelSpec(robot))
    assert isinstance(model, TrunkSimulator)
    commands, clock = walk(robot, draws, seconds), PERIOD * np.arange(round(seconds / PERIOD) + 1)
    if alone:
        for k, own in enumerate(commands):
            moving = np.arange(own.shape[1]) == k % own.shape[1]
            own[:] = np.where(moving, walk_of_one(own), 0.0)
    grid = [model.commands(clock[:-1], rows, np.zeros(rows.shape[1]), clock) for rows in commands]
    stacked = jax.tree.map(lambda *parts: np.stack(parts), *grid)
    steps = jnp.max(jnp.asarray(stacked.sample_step)) + 1
    rollouts = jax.jit(jax.vmap(model.rollout, in_axes=(0, 0, None)))
    same = {key: np.full(draws, value) for key, value in model.complete({}).items()}
    values: dict[str, Any] = {**same, **drawn(model, draws)}
    nominal, other = rollouts(same, stacked, steps), rollouts(values, stacked, steps)
    fine = (np.asarray(nominal.status) == 0) & (np.asarray(other.status) == 0)
    noise = NOISE * np.random.default_rng(1).normal(size=other.position.shape)
    measured, seen = np.asarray(other.position) + noise, np.ones(noise.shape[1:3], dtype=bool)
    found = [direction_of([Paths(np.asarray(nominal.position)[k], measured[k], seen)]) for k in np.flatnonzero(fine)]
    return found, int((~fine).sum())


def walk_of_one(commands: np.ndarray) -> np.ndarray:
    """The way of the channel that moves most, for one channel alone."""
    return commands[:, [int(np.argmax(np.ptp(commands, axis=0)))]]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS))
    parser.add_argument("--draws", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=3.0)
    chosen = parser.parse_args()
    print("| robot | moving | recordings | lost | said to be turned | said to be mirrored | agreement below 0.8 |")
    print("|---|---|---|---|---|---|---|")
    for name in chosen.robots:
        for alone in (False, True):
            found, lost = directions(name, chosen.draws, chosen.seconds, alone=alone)
            doubts = [direction_doubt(each, None) or "" for each in found]
            mirrored, said = sum("mirror" in doubt for doubt in doubts), sum(map(bool, doubts))
            weak = sum(each.agreement < AGREEING for each in found)
            moving = "one channel" if alone else "all channels"
            cells = [name, moving, len(found), lost, said - mirrored, mirrored, weak]
            print("| " + " | ".join(map(str, cells)) + " |", flush=True)


if __name__ == "__main__":
    main()
