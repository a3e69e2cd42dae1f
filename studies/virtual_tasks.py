"""The two tasks of the paper's Table I: what is inferred, within which ranges, and from which motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.calibration_problem import CalibrationProblem
from rfdropo_bayes.data import Measured, Origin, SentCommands, Trajectory
from rfdropo_bayes.model.assembly import build_model, build_problem, build_robot_simulator
from rfdropo_bayes.model.experiment import CommandsTable, SimulatorTable
from rfdropo_bayes.model.model_spec import DataChannels, ModelSpec
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator
from rfdropo_bayes.verbs.simulate import random_walk

POSITION_NOISE, CORRELATION, TENSION_NOISE = 5e-4, 0.3, 0.01  # m; from row to row; share of the reading
TURN_NOISE = 0.02  # rad, of a cube seen by markers some 25 mm from its centre
SAMPLE_TIME = 0.05  # s
CORRELATION_TIME = -SAMPLE_TIME / float(np.log(CORRELATION))
CENTRAL = 0.5  # share of each range that off-centre truths stay out of
WALKS = 32  # random walks of which a task with a cube takes the one that pushes it farthest
PUSHED = 0.005  # m that a cube must move to tell of its mass and friction

NOISE = {
    "observation_noise": POSITION_NOISE,
    "noise_correlation_time": CORRELATION_TIME,
    "tension_noise": TENSION_NOISE,
}
"""Values of the noise parameters that data are simulated with."""

Commands = tuple[Float[np.ndarray, " command"], Float[np.ndarray, "command channel"]]


@dataclass(frozen=True)
class InferenceTask:
    """What is inferred: ranges and the paper's truth, in SI units, and how the cables are moved.

    Attributes:
        robot: name of the robot.
        ranges: of the parameters that are inferred, by name.
        truth: the paper's.
        step: of one cable in one action [m].
        high: most that a cable is pulled [m].
        cube: parameters that only a push tells of; none for a trunk alone.
    """

    robot: str
    ranges: Mapping[str, tuple[float, float]]
    truth: Mapping[str, float]
    step: float = 0.005
    high: float = 0.04
    cube: tuple[str, ...] = ()


REACH = {"trunk_mass": (0.005, 1.0), "poisson_ratio": (0.4, 0.499), "young_modulus": (2e6, 7e6)}
REACH_TRUTH = {"trunk_mass": 0.42, "poisson_ratio": 0.45, "young_modulus": 4.5e6}

TASKS = {
    "TrunkReach": InferenceTask("trunk_sofa", REACH, REACH_TRUTH),
    "TrunkPush": InferenceTask(
        "trunk_sofa",
        REACH | {"cube_mass": (0.005, 1.0), "friction": (0.01, 1.0)},
        REACH_TRUTH | {"cube_mass": 0.05, "friction": 0.3},
        cube=("cube_mass", "friction"),
    ),
}


@lru_cache(maxsize=8)
def task_problem(task: str, actions: int, tension: bool, held_out: bool, seed: int) -> CalibrationProblem:
    """The inference problem of a task, around data that are yet to be simulated.

    Args:
        task: key of `TASKS`.
        actions: moves of one cable by the task's step, one per row.
        tension: whether tensions are data.
        held_out: commands that no fit sees.
        seed: of the commands.
    """
    spec = _spec(TASKS[task], tension)
    simulator = build_robot_simulator(spec)
    commands = _commands(task, actions, held_out, seed)
    return build_problem(build_model(spec, simulator, [_blank(simulator, commands, actions, tension)]))


def draw_truth(task: InferenceTask, kind: str, names: tuple[str, ...], rng: np.random.Generator) -> dict[str, float]:
    """The paper's truth, or one in the outer quarters of all ranges (``kind`` "off-centre"); noise as the benchmark
    fixes it. Of parameters that a task adds to another's it draws last, so that tasks share what they share."""
    chosen = dict(task.truth)
    if kind == "off-centre":
        for name, (low, high) in task.ranges.items():
            side, place = rng.integers(2), rng.uniform(0.0, 0.5 * (1.0 - CENTRAL))
            chosen[name] = low + (high - low) * (1.0 - place if side else place)
    return {name: float({**chosen, **NOISE}[name]) for name in names}


def excited(task: InferenceTask, problem: CalibrationProblem, truth: Mapping[str, float]) -> tuple[str, ...]:
    """Parameters that the motion of a truth tells of: those of a cube only where it is pushed."""
    if not task.cube:
        return tuple(task.ranges)
    seen = problem.observe({name: jnp.array([truth[name]]) for name in problem.names})
    way = _ways(np.asarray(seen.object_pose))[0, 0]
    return tuple(name for name in task.ranges if name not in task.cube or way > PUSHED)


def _spec(task: InferenceTask, tension: bool) -> ModelSpec:
    priors = {name: {"distribution": "Uniform", "low": low, "high": high} for name, (low, high) in task.ranges.items()}
    noise = {"observation_noise": POSITION_NOISE, "noise_correlation_time": 0.04}
    noise |= {"tension_noise": TENSION_NOISE} if tension else {}
    # The noise of a cube's pose is known: three parameters less to infer, which say nothing of the simulator.
    known = {
        "object_noise": POSITION_NOISE,
        "object_turn_noise": TURN_NOISE,
        "object_correlation_time": CORRELATION_TIME,
    }
    sizes = {name: {"distribution": "LogNormal", "median": size, "sigma": 0.5} for name, size in noise.items()}
    return ModelSpec(
        Robot.load(task.robot),
        named=task.robot,
        simulator=SimulatorTable(push=bool(task.cube)),
        noise="ar1",
        channels=DataChannels(tension=tension, object_pose=bool(task.cube)),
        fixed=known if task.cube else {},
        priors=priors | sizes,
    )


@lru_cache(maxsize=8)
def _commands(task: str, actions: int, held_out: bool, seed: int) -> Commands:
    """A random walk; where there is a cube, the one of several that pushes it farthest in the middle of all ranges."""
    chosen, rng = TASKS[task], np.random.default_rng([seed, int(held_out)])
    table = CommandsTable(
        duration=actions * SAMPLE_TIME,
        interval=SAMPLE_TIME,
        step=chosen.step,
        low=0.0,
        high=chosen.high,
        sample_time=SAMPLE_TIME,
        recordings=["data"],
    )
    channels = len(Robot.load(chosen.robot).channels.names)
    walks = [random_walk(table, channels, rng) for _ in range(WALKS if chosen.cube else 1)]
    if len(walks) == 1:
        return walks[0]
    spec = _spec(chosen, False)
    simulator = build_robot_simulator(spec)
    recordings = [_blank(simulator, walk, actions, False, f"walk_{i}") for i, walk in enumerate(walks)]
    problem = build_problem(build_model(spec, simulator, recordings))
    middle = {name: 0.5 * sum(ends) for name, ends in chosen.ranges.items()} | NOISE
    seen = problem.observe({name: jnp.array([middle[name]]) for name in problem.names})
    return walks[int(np.argmax(np.nan_to_num(_ways(np.asarray(seen.object_pose))[0])))]


def _ways(pose: Float[np.ndarray, "n recording time 7"]) -> Float[np.ndarray, "n recording"]:
    """How far a cube has come [m]."""
    return np.linalg.norm(pose[:, :, -1, :3] - pose[:, :, 0, :3], axis=-1)


def _blank(
    simulator: RobotSimulator, commands: Commands, actions: int, tension: bool, name: str = "data"
) -> Trajectory:
    """A recording of commands, with the robot at rest and the cube where it starts throughout."""
    time = SAMPLE_TIME * np.arange(actions + 1)
    command_time, command = commands
    pose = None
    if simulator.pushes:
        start = [next(s.nominal for s in simulator.parameters if s.name == f"cube_{axis}") for axis in "xyz"]
        pose = np.tile([*start, 0.0, 0.0, 0.0, 1.0], (len(time), 1))
    return Trajectory.build(
        Origin(name=name, robot=simulator.robot.name, format="netcdf", synthetic=True),
        SentCommands(
            command_time=command_time,
            command=command,
            command_unit=simulator.robot.command_unit,
            cable_names=simulator.channel_names,
        ),
        Measured(
            time=time,
            position=np.tile(simulator.robot.marker_points(), (len(time), 1, 1)),
            marker_names=simulator.marker_names,
            tension=np.ones((len(time), len(simulator.channel_names))) if tension else None,
            object_pose=pose,
        ),
    )
