"""A policy behind simulated drives beside the same policy in simulation, on the same episodes; resumable.

    python benchmarks/motor_reach.py [DEPLOYMENT.toml] [--episodes N] [--seed K] [--json FILE] [--keep FOLDER]
        [--stronger FACTOR] [--set KEY=VALUE]

Every episode is a session of `rfdropo deploy --mode dry-run` in real time: the policy's 100 actions from rest, with
drives, hub and robot in processes of their own that are started anew. Where a cube is to be pushed, it is put down
before the drives are powered, as an episode of the task begins, and motion capture sees it with the markers' noise.

The simulation has the robot's own parameters and plays the same episodes as `rfdropo evaluate` does, without drives and
their delays: those that `rfdropo evaluate` plays of the experiment file of the robot. It plays them a second time with
other noise, to show how far two plays of one episode differ by noise alone, and a third time with commands that come a
cycle later: a set-point is sent in the cycle after the one that saw the markers.

Distances are those after the last action, of the tip, or of the cube along its plate: behind drives as motion capture
saw them, in simulation the true ones. An episode succeeds where its distance is within a threshold; one that a fault
stopped fails at all of them. Simulations stop nothing: `--stronger` deploys motors of so many times the torque and
tension, to see how a policy does that asks too much of the robot's own. Intervals are Wilson's, at 95 %. A FILE of the
same policy, episodes, seed and motors is gone on with.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.stats import binomtest

from rfdropo_bayes.deployment.causes import Cause
from rfdropo_bayes.deployment.log import read_journal
from rfdropo_bayes.deployment.loop import Phase
from rfdropo_bayes.deployment.session import Outcome, deploy
from rfdropo_bayes.deployment.settings import Deployment, load_deployment
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import write_json, write_text
from rfdropo_bayes.model.experiment_file import describe
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.policies.episodes import Episodes, Settings
from rfdropo_bayes.policies.evaluation import EVALUATION_SEED, Case, draw_cases, play
from rfdropo_bayes.policies.onnx_export import ExportedPolicy
from rfdropo_bayes.policies.randomisation import Layers, Point, Uniform
from rfdropo_bayes.policies.tasks import Task, distance_to, observed_of, task_named
from rfdropo_bayes.policies.training_config import TrainingTable
from rfdropo_bayes.policies.vec_env import TrunkVecEnv
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.verbs.simulated_plant import true_simulator

THRESHOLDS = (0.005, 0.01, 0.01525)  # [m]
OTHER = 1  # seed of the noise of the second play
SIMULATED = {
    "in simulation": "simulated_m",
    "in simulation, other noise": "other_noise_m",
    "in simulation, commands a cycle later": "later_m",
}


class Simulated:
    """The deployment's robot in simulation, with the episodes that are drawn for it.

    Args:
        settings: of the deployment.
        episodes: how many.
        seed: of what they begin with, and of the noise, as for `rfdropo evaluate`.
        later: further dead time of commands [s].
    """

    def __init__(self, settings: Deployment, episodes: int, seed: int, later: float = 0.0) -> None:
        assert settings.policy is not None
        self._policy, self._seed = ExportedPolicy(Path(settings.policy.file)), seed
        layout, table = self._policy.layout, dict(settings.simulation.settings)
        experiment, noise = str(table.pop("experiment", "")), float(table.pop("marker_noise", 0.0))
        table.pop("seed", None)
        self.task: Task = task_named(layout.task)
        training = (Model.read(Path(experiment)).settings.training if experiment else None) or TrainingTable()
        if training.goals is not None:
            self.task = replace(self.task, goal_low=training.goals[0], goal_high=training.goals[1])
        self.start = dict(training.start) if self.task.push else {}
        robot = Robot.load(settings.robot)
        simulator, values = true_simulator(robot, experiment, table)
        if later:
            timing = simulator.robot.command
            timing = timing.model_copy(update={"dead_time_s": timing.dead_time_s + later})
            simulator, values = true_simulator(robot, experiment, table, simulator.robot.with_changes(command=timing))
        seen, step = observed_of(layout, len(simulator.marker_names)), np.max(layout.moves, axis=0).tolist()
        played = Settings(layout.kind, seen, layout.period_s, step, noise)
        drawn = Layers((Point(values), Uniform(self.start)), "point")
        batch = Episodes(simulator, self.task, episodes, drawn, played)
        batch.layout.require(layout, where="policy")
        self._lanes = TrunkVecEnv(batch)
        self.cases: list[Case] = draw_cases(self._lanes, episodes, EVALUATION_SEED + seed)

    def distances(self, other_noise: int = 0) -> list[float]:
        """Last distances [m]."""
        found = play(self._policy.act, self._lanes, self.cases, self._seed + other_noise)
        return [episode.distance for episode in found]


def on_drives(settings: Deployment, task: Task, case: Case, start: Sequence[str], folder: Path) -> dict[str, Any]:
    """One episode behind drives, as a session in this folder."""
    placed = settings.simulation.settings | {name: case.parameters[name] for name in start}
    changes: dict[str, Any] = {
        "goal": dict(zip("xyz", case.goal, strict=True)),
        "simulation": settings.simulation.model_copy(update={"settings": placed}),
    }
    outcome = deploy(settings.model_copy(update=changes), "dry-run", folder)
    late, act = outcome.figures["lateness_s"], outcome.figures["act_s"]
    return {
        "goal_m": list(case.goal),
        "start": {name: case.parameters[name] for name in start},
        "cause": outcome.cause.word,
        "detail": outcome.detail,
        "distance_m": last_distance(outcome, task, np.array(case.goal), settings),
        "cycles": outcome.figures["cycles"],
        "missed": outcome.figures["missed"],
        "late_p99_s": late["p99"],
        "late_max_s": late["max"],
        "act_p99_s": act["p99"],
        **followed(folder),
    }


def last_distance(outcome: Outcome, task: Task, goal: Float[np.ndarray, "3"], settings: Deployment) -> float | None:
    """Distance [m] when the last action has been in force for its whole period; None where a fault came before."""
    rows = read_journal(outcome.folder)[1]
    rows = rows[rows["phase"] == Phase.RUNNING]
    last = round(settings.duration_s * settings.rate_hz)
    if not outcome.finished or len(rows) <= last:
        return None
    place = rows["object_pose"][last, :3] if task.push else rows["position"][last, -1]
    return float(distance_to(task, place[None], goal[None])[0])


def followed(folder: Path) -> dict[str, float]:
    """How long the policy had the drives [s]; how far commands were from what it asked for, and drives from set-points,
    at most [m]; share of tensions below the least, which hold set-points back; and the range of tensions."""
    header, rows = read_journal(folder)
    rows = rows[rows["phase"] == Phase.RUNNING]
    if not len(rows):
        return {"lasted_s": 0.0}
    asked = rows["asked"] - rows["command"]
    # A set-point is where to be at the next SYNC.
    behind = rows["length"][1:] - rows["set_point"][:-1]
    least = np.array([motor["tension_limit_n"][0] for motor in header["robot"]["motors"]])
    return {
        "lasted_s": float(rows["time"][-1] - rows["time"][0]),
        "cut_m": float(np.abs(asked).max()),
        "behind_m": float(np.abs(behind).max()),
        "slack_share": float(np.mean(rows["tension"] < least)),
        "least_tension_n": float(rows["tension"].min()),
        "most_tension_n": float(rows["tension"].max()),
    }


def shares(distances: Float[np.ndarray, " episode"]) -> list[str]:
    """Success within each threshold, with Wilson's interval, in per cent."""
    cells = []
    for threshold in THRESHOLDS:
        hits = int(np.sum(distances <= threshold))
        ends = binomtest(hits, len(distances)).proportion_ci(0.95, method="wilson")
        cells.append(f"{100 * hits / len(distances):.0f} [{100 * ends.low:.0f}, {100 * ends.high:.0f}]")
    return cells


def table(content: dict[str, Any]) -> str:
    """Success, medians of differences episode by episode, where drives were not stopped, and punctuality."""
    found = content["episodes"]
    count = len(found)
    rows = {name: np.array(content[key][:count]) for name, key in SIMULATED.items()}
    first = rows["in simulation"]
    driven = np.array([math.inf if one["distance_m"] is None else one["distance_m"] for one in found])
    ended = np.isfinite(driven)
    heads = [f"{count} episodes", *(f"within {1e3 * t:g} mm [%]" for t in THRESHOLDS), "median [mm]"]
    heads += ["farther than in simulation [mm]", "apart from it [mm]", "apart from the drives [mm]"]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for name, distances in (*rows.items(), ("behind drives", driven)):
        middle = np.median(distances)
        cells = [name, *shares(distances), f"{1e3 * middle:.2f}" if np.isfinite(middle) else "-"]
        if ended.any():
            apart, from_drives = 1e3 * (distances[ended] - first[ended]), 1e3 * np.abs(distances[ended] - driven[ended])
            compared = [np.median(apart), np.median(np.abs(apart)), np.median(from_drives)]
            cells += [f"{value:.2f}" for value in compared]
        else:
            cells += ["-", "-", "-"]
        lines.append(f"| {' | '.join(cells)} |")
    missed, cycles = ([one[name] for one in found] for name in ("missed", "cycles"))
    late, most, act = (
        1e3 * np.array([one[name] for one in found]) for name in ("late_p99_s", "late_max_s", "act_p99_s")
    )
    lines += [
        "",
        f"{sum(missed)} deadlines missed in {np.count_nonzero(missed)} episodes, of {sum(cycles)} cycles; lateness p99 "
        f"{np.median(late):.2f} ms, policy p99 {np.median(act):.2f} ms (medians of episodes), latest cycle "
        f"{most.max():.1f} ms. Load {min(content['load']):.1f} to {max(content['load']):.1f}. Intervals are Wilson's, "
        "95 %.",
    ]
    for cause in sorted({one["cause"] for one in found if one["distance_m"] is None}):
        halted = [one for one in found if one["cause"] == cause]
        after = [one["lasted_s"] for one in halted]
        words = f"stopped: {cause}, after {min(after):.2f} to {max(after):.2f} s; the first: {halted[0]['detail']}"
        lines += ["", f"{len(halted)} of {count} sessions {words}."]
    return "\n".join(lines) + "\n"


def with_stronger(settings: Deployment, factor: float, folder: Path) -> Deployment:
    """The deployment of a robot whose motors have so many times the torque; its file is written to a folder."""
    robot = Robot.load(settings.robot)
    motors = [
        {
            **motor.model_dump(),
            "rated_torque_n_m": factor * motor.rated_torque_n_m,
            "tension_limit_n": (motor.tension_limit_n[0], factor * motor.tension_limit_n[1]),
        }
        for motor in robot.motors
    ]
    path = folder / "robot.toml"
    write_text(path, describe(robot.with_changes(motors=motors).model_dump(mode="json", exclude_none=True)))
    return settings.model_copy(update={"robot": str(path)})


def ledger(path: Path | None, made: dict[str, Any]) -> dict[str, Any]:
    """What a file has of the same study, else nothing yet.

    Raises:
        InputError: a file of another study.
    """
    if path is None or not path.exists():
        return {**made, "load": [], "episodes": []}
    known: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    for name, value in made.items():
        if known.get(name) != value:
            raise InputError(f"is of another {name}", where=str(path), remedy="give another file, or remove this one")
    return known


def main() -> None:
    """Play what is left, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("deployment", nargs="?", type=Path, default=Path("experiments/motors/reach.toml"))
    parser.add_argument("--episodes", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--stronger", type=float, default=1.0, help="motors of so many times the torque")
    parser.add_argument("--set", action="append", default=[], dest="overrides", help="an entry of the deployment file")
    parser.add_argument("--keep", type=Path, help="folder for the sessions' logs")
    given = parser.parse_args()
    settings = load_deployment(given.deployment, given.overrides)
    assert settings.policy is not None
    simulated = Simulated(settings, given.episodes, given.seed)
    later = Simulated(settings, given.episodes, given.seed, 1.0 / settings.rate_hz)
    made = {
        "policy_sha256": hashlib.sha256(Path(settings.policy.file).read_bytes()).hexdigest(),
        "seed": given.seed,
        "stronger": given.stronger,
        "simulated_m": [round(distance, 9) for distance in simulated.distances()],
        "other_noise_m": [round(distance, 9) for distance in simulated.distances(OTHER)],
        "later_m": [round(distance, 9) for distance in later.distances()],
    }
    content = ledger(given.json, made)
    with tempfile.TemporaryDirectory(prefix="rfdropo_") as scratch:
        if given.stronger != 1.0:
            settings = with_stronger(settings, given.stronger, Path(scratch))
        for number in range(len(content["episodes"]), given.episodes):
            folder = (given.keep or Path(scratch)) / f"episode_{number:02d}"
            episode = on_drives(settings, simulated.task, simulated.cases[number], list(simulated.start), folder)
            if episode["cause"] == Cause.EMERGENCY_STOP.word:
                sys.exit(f"episode {number}: {episode['detail']}; it is played again when the study goes on")
            content["episodes"].append(episode)
            content["load"].append(round(os.getloadavg()[0], 1))
            said = episode["detail"] if episode["distance_m"] is None else f"{1e3 * episode['distance_m']:6.2f} mm"
            print(
                f"{number:3d} {episode['cause']}: {said}; in simulation {1e3 * made['simulated_m'][number]:6.2f} mm",
                flush=True,
            )
            if given.json:
                write_json(given.json, content)
    print(table(content))


if __name__ == "__main__":
    main()
