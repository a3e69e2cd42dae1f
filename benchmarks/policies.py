"""Environment steps per second of the tasks, beside the library's own ceiling on an empty environment in the same run.

    python benchmarks/policies.py [--lanes N [N ...]] [--seconds S] [--learn STEPS] [--integrator NAME] [--json FILE]

"Step" is random actions through the VecEnv, resets included, in single precision: an action takes ten solves with
SDIRK2, five with implicit Euler. "PPO" is training with the settings that policies here are trained with. The empty
environment has the observation and action of TrunkPush and answers with zeros: what it costs is Stable-Baselines3 and
PyTorch alone. Rates are those of the clock on the wall and of processor time, which a busy machine leaves as it is.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from rfdropo_bayes.fem.integrators import Integrator
from rfdropo_bayes.policies.building import make_episodes
from rfdropo_bayes.policies.ppo import ppo_options
from rfdropo_bayes.policies.randomisation import Uniform
from rfdropo_bayes.policies.spaces import spaces_of
from rfdropo_bayes.policies.tasks import EPISODE, task_named
from rfdropo_bayes.policies.vec_env import TrunkVecEnv
from rfdropo_bayes.robots.policy_layout import PolicyLayout

REACH, PUSH, EMPTY = "TrunkReach-v0", "TrunkPush-v0", "empty"
RANGES = {"young_modulus": (4.0e6, 5.0e6), "trunk_mass": (0.38, 0.46)}
WANTED = {REACH: 30_000, PUSH: 12_000}  # steps a second on two idle cores
LEARNT = 2_000_000


class Row(NamedTuple):
    """One line of the table."""

    task: str
    lanes: int
    what: str
    per_second: float
    per_cpu_second: float


class Empty(VecEnv):
    """Zeros, at once; an episode is as long as those of the tasks."""

    def __init__(self, lanes: int, layout: PolicyLayout) -> None:
        observed, acted = spaces_of(layout)
        super().__init__(lanes, observed, acted)
        self.seen, self.age = np.zeros((lanes, layout.size), np.float32), 0
        self.gained = np.zeros(lanes, np.float32)

    def reset(self) -> np.ndarray:
        """Zeros."""
        self.age = 0
        return self.seen

    def step_async(self, actions: np.ndarray) -> None:
        """Nothing."""

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Zeros."""
        self.age = (self.age + 1) % EPISODE
        done = np.full(self.num_envs, self.age == 0)
        ended = {"terminal_observation": self.seen[0], "TimeLimit.truncated": True}
        return self.seen, self.gained, done, [dict(ended) if self.age == 0 else {} for _ in range(self.num_envs)]

    def close(self) -> None:
        """Nothing."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """None of them."""
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Nothing."""

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Nothing."""
        return [None] * self.num_envs

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """In nothing."""
        return [False] * self.num_envs


def environments(task: str, lanes: int, integrator: Integrator) -> VecEnv:
    """The environments of a line."""
    chosen = PUSH if task == EMPTY else task
    settings: dict[str, Any] = {"actions": "continuous", "observed": "full", "precision": "float32"}
    episodes = make_episodes(chosen, lanes, randomisation=Uniform(RANGES), integrator=integrator, **settings)
    return Empty(lanes, episodes.layout) if task == EMPTY else TrunkVecEnv(episodes)


def timed(run: Callable[[], int], seconds: float) -> tuple[float, float]:
    """Steps per second of wall and of processor time, the best of what fits into some seconds."""
    wall, cpu, end = 0.0, 0.0, time.perf_counter() + seconds
    while time.perf_counter() < end or wall == 0.0:
        began, worked = time.perf_counter(), time.process_time()
        steps = run()
        wall = max(wall, steps / (time.perf_counter() - began))
        cpu = max(cpu, steps / (time.process_time() - worked))
    return wall, cpu


def rows_of(task: str, lanes: int, seconds: float, learn: int, integrator: Integrator) -> list[Row]:
    """Stepping, and learning if it is asked for."""
    venv = environments(task, lanes, integrator)
    random = np.random.default_rng(0)
    moves = random.uniform(-1.0, 1.0, (EPISODE, lanes, *venv.action_space.shape)).astype(np.float32)
    venv.seed(0)
    venv.reset()

    def episode() -> int:
        for move in moves:
            venv.step(move)
        return EPISODE * lanes

    episode()  # compiles
    found = [Row(task, lanes, "step", *timed(episode, seconds))]
    if not learn:
        return found
    gamma = task_named(PUSH if task == EMPTY else task).gamma
    model = PPO("MlpPolicy", VecNormalize(venv, gamma=gamma), device="cpu", seed=0,
                **ppo_options("continuous", gamma, {}, lanes))  # fmt: skip
    model.learn(16 * lanes)

    def learning() -> int:
        before = model.num_timesteps
        model.learn(learn, reset_num_timesteps=False)
        return int(model.num_timesteps - before)

    return [*found, Row(task, lanes, "PPO", *timed(learning, 0.0))]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", type=int, nargs="+", default=[128, 256])
    parser.add_argument("--seconds", type=float, default=5.0, help="of stepping, for each line")
    parser.add_argument("--learn", type=int, default=100_000, help="steps of PPO, for each line; 0 leaves it out")
    parser.add_argument("--integrator", choices=["sdirk2", "euler"], default="sdirk2")
    parser.add_argument("--json", type=Path, help="also write the rows here")
    chosen = parser.parse_args()
    torch.set_num_threads(1)  # as the training does
    rows = []
    for lanes in chosen.lanes:
        for task in (EMPTY, REACH, PUSH):
            rows += rows_of(task, lanes, chosen.seconds, chosen.learn, chosen.integrator)
    print("| environment | at once | | steps/s | steps per CPU s | 2 M steps [min] |")
    print("|---|---|---|---|---|---|")
    for row in rows:
        minutes = f"{LEARNT / row.per_second / 60.0:.1f}"
        speed = f"{row.per_second:,.0f} | {row.per_cpu_second:,.0f}"
        print(f"| {row.task} | {row.lanes} | {row.what} | {speed} | {minutes} |")
    print("\nWanted of `step`: " + ", ".join(f"{task} {speed:,}" for task, speed in WANTED.items()) + ".")
    if chosen.json:
        chosen.json.write_text(json.dumps([row._asdict() for row in rows], indent=1))


if __name__ == "__main__":
    main()
