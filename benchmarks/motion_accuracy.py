"""How near engines come to their own converged motion, and what that costs: ours, MuJoCo's links and PyElastica's rod.

    python benchmarks/motion_accuracy.py [--seconds S]

The smooth arm is pulled about at random as in benchmarks/convergence.py. An engine's limit is Richardson's, from the
two finest bodies of a series in which each is twice as fine; orders are log2 of the ratio of successive differences.
The error is the root mean square over time of the tip's distance from the limit. A chain of MuJoCo has the longest step
whose motion is within .02 mm of the shortest step's. Processor time is that of one rollout on one thread, the least of
two. Engines are damped as each can be: their motions are compared with their own limits only.
"""

from __future__ import annotations

import argparse
import itertools
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from convergence import OBSERVED, PERIOD, error, tip, walk
from jaxtyping import Float

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Robot
from studies.engine_study import CENTRE
from studies.mujoco_truth import EngineArm, MuJoCoArm
from studies.pyelastica_truth import PACE, ElasticaArm

ROBOT = "smooth_arm"
ALLOWED = (1.0, 0.1)  # mm
OURS = ((1, 20.0), (1, 10.0), (2, 10.0), (4, 5.0), (8, 5.0))  # elements for each of the robot's own, steps [ms]
FINEST_MS = 2.5  # [ms] of the series that has our limit
LINKS = {5: (1e-3, 5e-4, 2.5e-4), 10: (1e-3, 5e-4, 2.5e-4), 20: (2.5e-4, 1e-4), 40: (5e-5,)}  # steps [s]
ELEMENTS = (5, 10, 20, 40)
Path3 = Float[np.ndarray, "time 3"]


class Setting(NamedTuple):
    """One body of an engine: its name, the path of its tip [m], and the processor time of a rollout [s]."""

    name: str
    path: Path3
    cost: float


def limit_of(series: list[Path3]) -> tuple[Path3, list[float]]:
    """Richardson's limit of bodies each twice as fine, of second order, and the orders that are observed."""
    change = [error(fine, coarse) for coarse, fine in itertools.pairwise(series)]
    orders = [float(np.log2(one / two)) for one, two in itertools.pairwise(change)]
    return series[-1] + (series[-1] - series[-2]) / 3.0, orders


def ours(seconds: float) -> tuple[list[Setting], Path3, list[float]]:
    """The rod, with elements and steps of `OURS`."""
    found = []
    for refine, step in OURS:
        path, cost = tip(ROBOT, "sdirk2", step, None, 1, seconds, refine)
        found.append(Setting(f"rod, {10 * refine} elements, {step:g} ms", path[0], cost))
    finer = [tip(ROBOT, "sdirk2", FINEST_MS, None, 1, seconds, refine)[0][0] for refine in (1, 2, 4, 8)]
    return found, *limit_of(finer)


def recorded(seconds: float) -> Trajectory:
    """The commands of the motion, as a recording whose positions nobody reads."""
    robot = Robot.load(ROBOT)
    clock = OBSERVED * np.arange(1, round(seconds / OBSERVED) + 1)
    (command,) = walk(robot, 1, seconds)
    still = np.broadcast_to([marker.point_m for marker in robot.markers], (len(clock) + 1, len(robot.markers), 3))
    return Trajectory.from_arrays(
        time=np.append(0.0, clock), position=still,
        command=command, command_time=PERIOD * np.arange(len(command)), markers=robot.marker_names,
        channels=robot.channel_names, position_unit="m", command_unit="m", initial_command="zero",
    )  # fmt: skip


def timed(arm: Callable[[], EngineArm], recording: Trajectory, name: str) -> Setting:
    """A rollout of an arm; the first of two compiles."""
    cost = np.inf
    for _ in range(2):
        began = time.process_time()
        path = arm().positions([recording], 0.0)[0, 1:, -1]
        cost = min(cost, time.process_time() - began)
    print(f"{name}: {cost:.3g} s", file=sys.stderr, flush=True)
    return Setting(name, path, cost)


def links(recording: Trajectory) -> Iterator[Setting]:
    """MuJoCo's chains, each with its largest step whose motion is that of the next shorter step."""
    robot, values = Robot.load(ROBOT), {**CENTRE, "rayleigh_stiffness": 0.05}
    for count, steps in LINKS.items():
        tried: list[Setting] = []
        for step in steps:
            try:
                name = f"MuJoCo, {count} links, {1e3 * step:g} ms"
                tried.append(timed(lambda n=count, s=step: MuJoCoArm(robot, values, links=n, step=s), recording, name))
            except InputError:
                print(f"{name} does not hold the motion", file=sys.stderr)
        *longer, finest = tried
        yield next((one for one in longer if error(one.path, finest.path) < 0.02), finest)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=3.0, help="of the motion")
    seconds = parser.parse_args().seconds
    recording, robot = recorded(seconds), Robot.load(ROBOT)
    rods = [
        timed(
            lambda n=count: ElasticaArm(robot, {**CENTRE, "rayleigh_mass": 10.0}, elements=n),
            recording,
            f"PyElastica, {count} elements, {1e3 * PACE / count:g} ms",
        )
        for count in ELEMENTS
    ]
    chains = list(links(recording))
    print("| engine | error [mm] | processor ms of a rollout |\n|---|---|---|")
    series = [ours(seconds), *((peers, *limit_of([peer.path for peer in peers])) for peers in (chains, rods))]
    for settings, limit, orders in series:
        away = {one.name: error(one.path, limit) for one in settings}
        for one in settings:
            print(f"| {one.name} | {away[one.name]:.3f} | {1e3 * one.cost:.3g} |")
        enough = [min((one.cost for one in settings if away[one.name] <= mm), default=None) for mm in ALLOWED]
        words = [
            f"{mm:g} mm: {'not reached' if cost is None else f'{1e3 * cost:.3g} ms'}"
            for mm, cost in zip(ALLOWED, enough, strict=True)
        ]
        name, order = settings[0].name.split(",")[0], ", ".join(f"{o:.2f}" for o in orders)
        print(f"| *{name}* | orders {order} | {'; '.join(words)} |")
    print()
    subprocess.run([sys.executable, str(Path(__file__).parents[1] / "tools/yardstick.py")], check=True)


if __name__ == "__main__":
    main()
