"""A policy behind simulated drives beside the same policy in simulation, on the same goals.

    python benchmarks/motor_reach.py [DEPLOYMENT.toml] [--episodes N] [--seed K] [--json FILE] [--keep FOLDER]

Every episode is a session of `rfdropo deploy --mode dry-run` in real time: 100 actions from rest, drives, hub and trunk
in processes of their own that outlive it. Goals are drawn from the task's box. The simulation has the trunk's own
parameters and plays the same goals as `rfdropo evaluate` does, without drives and their delays. An episode succeeds
where its last distance is within a threshold; intervals are Wilson's, at 95 %.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from rfdropo_bayes.deployment.bench.simulated_bus import SimulationTable, simulated_drives
from rfdropo_bayes.deployment.bus import BusTable, open_bus
from rfdropo_bayes.deployment.log import read_journal
from rfdropo_bayes.deployment.loop import Phase
from rfdropo_bayes.deployment.sensors import SimulatedMarkers
from rfdropo_bayes.deployment.session import deploy
from rfdropo_bayes.deployment.settings import Deployment, load_deployment
from rfdropo_bayes.policies.episodes import Episodes, Settings
from rfdropo_bayes.policies.evaluation import Case, play
from rfdropo_bayes.policies.onnx_export import ExportedPolicy
from rfdropo_bayes.policies.randomisation import Point
from rfdropo_bayes.policies.tasks import observed_of, task_named
from rfdropo_bayes.policies.vec_env import TrunkVecEnv
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.verbs.simulated_plant import true_simulator

THRESHOLDS = (0.005, 0.01, 0.01525)  # [m]


class KeptOpen(SimulatedMarkers):
    """Markers of a simulation that outlives one session."""

    def close(self) -> None:
        """Stay open."""


def on_drives(settings: Deployment, goals: np.ndarray, folder: Path) -> list[dict[str, Any]]:
    """One session for every goal."""
    sensor = KeptOpen(len(Robot.load(settings.robot).marker_names))
    simulation, hub = settings.simulation, BusTable(interface="hub", channel="127.0.0.1:0")
    table = SimulationTable(
        settings.robot, hub, simulation.plant, simulation.settings, simulation.own_process, sensor.address
    )
    episodes = []
    with simulated_drives(table) as found:
        for number, goal in enumerate(goals):
            out = folder / f"episode_{number:02d}"
            one = settings.model_copy(update={"goal": dict(zip("xyz", map(float, goal), strict=True))})
            outcome = deploy(one, "dry-run", out, bus=open_bus(found), sensor=sensor)
            rows = read_journal(out)[1]
            tip = rows[rows["phase"] == Phase.RUNNING]["position"][:, -1]
            episodes.append(
                {
                    "goal_m": goal.tolist(),
                    "cause": outcome.cause.word,
                    "distance_m": float(np.linalg.norm(tip[-1] - goal)) if outcome.finished else math.inf,
                    "missed": outcome.figures["missed"],
                    "late_p99_s": outcome.figures["lateness_s"]["p99"],
                    "act_p99_s": outcome.figures["act_s"]["p99"],
                }
            )
            said = f"{1e3 * episodes[-1]['distance_m']:6.2f} mm" if outcome.finished else outcome.detail
            print(f"{number:3d} {outcome.cause.word}: {said}", flush=True)
    return episodes


def in_simulation(settings: Deployment, goals: np.ndarray, noise: float) -> np.ndarray:
    """Last distances [m] of the same policy on the same trunk, as `rfdropo evaluate` plays it."""
    assert settings.policy is not None
    policy = ExportedPolicy(Path(settings.policy.file))
    table = dict(settings.simulation.settings)
    experiment = str(table.pop("experiment", ""))
    for name in ("marker_noise", "seed"):
        table.pop(name, None)
    simulator, values = true_simulator(Robot.load(settings.robot), experiment, table)
    layout = policy.layout
    seen, step = observed_of(layout, len(simulator.marker_names)), float(np.max(layout.moves))
    played = Settings(layout.kind, seen, period=layout.period_s, step=step, noise=noise)
    batch = Episodes(simulator, task_named(layout.task), len(goals), Point(values), played)
    batch.layout.require(layout, where="policy")
    cases = [Case(values, tuple(map(float, goal))) for goal in goals]
    return np.array([episode.distance for episode in play(policy.act, TrunkVecEnv(batch), cases)])


def shares(distances: np.ndarray) -> list[str]:
    """Success within each threshold, with Wilson's interval, in per cent."""
    cells = []
    for threshold in THRESHOLDS:
        hits = int(np.sum(distances <= threshold))
        ends = binomtest(hits, len(distances)).proportion_ci(0.95, method="wilson")
        cells.append(f"{100 * hits / len(distances):.0f} [{100 * ends.low:.0f}, {100 * ends.high:.0f}]")
    return cells


def main() -> None:
    """Play, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("deployment", nargs="?", type=Path, default=Path("experiments/motors/reach.toml"))
    parser.add_argument("--episodes", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--keep", type=Path, help="folder for the sessions' logs")
    given = parser.parse_args()
    settings = load_deployment(given.deployment)
    assert settings.policy is not None
    task = task_named(ExportedPolicy(Path(settings.policy.file)).layout.task)
    goals = np.random.default_rng(given.seed).uniform(task.goal_low, task.goal_high, (given.episodes, 3))
    noise = float(settings.simulation.settings.get("marker_noise", 0.0))
    with tempfile.TemporaryDirectory(prefix="rfdropo_") as scratch:
        found = on_drives(settings, goals, given.keep or Path(scratch))
    driven = np.array([episode["distance_m"] for episode in found])
    simulated = in_simulation(settings, goals, noise)
    print(
        f"| {len(goals)} episodes | "
        + " | ".join(f"within {1e3 * t:g} mm [%]" for t in THRESHOLDS)
        + " | median [mm] |"
    )
    print("|---" * (len(THRESHOLDS) + 2) + "|")
    for name, distances in (("behind drives", driven), ("in simulation", simulated)):
        print(f"| {name} | " + " | ".join(shares(distances)) + f" | {1e3 * np.median(distances):.2f} |")
    late, act = (1e3 * np.median([episode[name] for episode in found]) for name in ("late_p99_s", "act_p99_s"))
    print(
        f"\n{sum(episode['missed'] for episode in found)} deadlines missed; lateness p99 {late:.2f} ms, policy p99 "
        f"{act:.2f} ms (medians of episodes); load {os.getloadavg()[0]:.1f}; intervals are Wilson's, 95 %."
    )
    if given.json:
        content = {"episodes": found, "simulated_m": simulated.tolist(), "load": os.getloadavg()[0]}
        given.json.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
