"""One fit of the comparison with the paper's Table I: a method, a task and a truth, simulated and scored."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.calibration import CalibrationProblem
from rfdropo_bayes.bayes.replicas import simulated_data
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference import methods
from rfdropo_bayes.posteriors import central_interval
from rfdropo_bayes.robots import load_robot
from rfdropo_bayes.workflow.assembly import build_model, build_problem, build_simulator
from rfdropo_bayes.workflow.commands import random_walk
from rfdropo_bayes.workflow.experiment import CommandsTable, Experiment

WIDTH = 4.0  # the paper's error is measured with every search range scaled to [0, 4]
POSITION_NOISE, CORRELATION, TENSION_NOISE = 5e-4, 0.3, 0.01  # m; from row to row; share of the reading
SAMPLE_TIME = 0.05  # s
PREDICTED = 64  # draws behind a prediction
CENTRAL = 0.5  # share of each range that off-centre truths stay out of


@dataclass(frozen=True)
class Task:
    """What is inferred: ranges and the paper's truth, in SI units, and how the cables are moved."""

    robot: str
    ranges: Mapping[str, tuple[float, float]]
    truth: Mapping[str, float]
    step: float
    high: float


TASKS = {
    "TrunkReach": Task(
        "trunk_sofa",
        {"trunk_mass": (0.005, 1.0), "poisson_ratio": (0.4, 0.499), "young_modulus": (2e6, 7e6)},
        {"trunk_mass": 0.42, "poisson_ratio": 0.45, "young_modulus": 4.5e6},
        step=0.005,
        high=0.04,
    ),
}

# Row of the table -> registry name and its own options; the budget is added where the method takes one.
ROWS: dict[str, tuple[str, dict[str, Any]]] = {
    "prior": ("", {}),
    "mid-range": ("", {}),
    "UDR": ("udr", {}),
    "BayesSim": ("bayessim", {}),
    "NPDR": ("npdr", {"rounds": 10}),
    "RF-DROPO as published": ("rfdropo", {"mended": False}),
    "RF-DROPO mended": ("rfdropo", {"horizon": "full"}),
    "ours": ("smc", {"blocks": 1, "particles": 200}),
    "ours + tension": ("smc", {"blocks": 1, "particles": 200}),
}
RIVALS = ("UDR", "BayesSim", "NPDR", "RF-DROPO as published", "RF-DROPO mended")


@lru_cache(maxsize=4)
def task_problem(task: str, actions: int, tension: bool, held_out: bool, seed: int) -> CalibrationProblem:
    """The inference problem of a task, around data that are yet to be simulated.

    Args:
        task: key of `TASKS`.
        actions: moves of one cable by the task's step, one per row.
        tension: whether tensions are data.
        held_out: commands that no fit sees.
        seed: of the commands.
    """
    chosen = TASKS[task]
    priors = {
        name: {"distribution": "Uniform", "low": low, "high": high} for name, (low, high) in chosen.ranges.items()
    }
    experiment = Experiment.model_validate(
        {
            "robot": chosen.robot,
            "simulator": {"precision": "float64", "threads": None},
            "model": {
                "noise": "ar1",
                "tension": tension,
                "priors": {
                    **priors,
                    "observation_noise": {"distribution": "LogNormal", "median": POSITION_NOISE, "sigma": 0.5},
                    "noise_correlation_time": {"distribution": "LogNormal", "median": 0.04, "sigma": 0.5},
                    **(
                        {"tension_noise": {"distribution": "LogNormal", "median": 0.01, "sigma": 0.5}}
                        if tension
                        else {}
                    ),
                },
            },
        }
    )
    robot = load_robot(chosen.robot)
    simulator = build_simulator(experiment, robot)
    table = CommandsTable(
        duration=actions * SAMPLE_TIME,
        interval=SAMPLE_TIME,
        step=chosen.step,
        low=0.0,
        high=chosen.high,
        sample_time=SAMPLE_TIME,
        recordings=["data"],
    )
    rng = np.random.default_rng([seed, int(held_out)])
    command_time, command = random_walk(table, len(simulator.channel_names), rng)
    time = SAMPLE_TIME * np.arange(actions + 1)
    data = Trajectory.build(
        name="data",
        robot=chosen.robot,
        format="netcdf",
        time=time,
        position=np.tile(robot.marker_points(), (len(time), 1, 1)),
        command_time=command_time,
        command=command,
        command_unit=robot.command_unit,
        marker_names=simulator.marker_names,
        cable_names=simulator.channel_names,
        tension=np.ones((len(time), len(simulator.channel_names))) if tension else None,
        synthetic=True,
    )
    return build_problem(build_model(experiment, simulator, [data]))


def fit(job: Mapping[str, Any]) -> dict[str, Any]:
    """Simulate the data of one truth, infer, and score; a method that cannot is a row with its reason.

    ``job`` has ``task``, ``row``, ``truths`` ("paper" or "off-centre"), ``index``, ``budget``, ``actions``, ``seed``.
    """
    with_tension = task_problem(job["task"], job["actions"], True, False, job["seed"])
    problem = task_problem(job["task"], job["actions"], False, False, job["seed"])
    key = jax.random.key(job["seed"])
    data_key, fit_key = jax.random.split(jax.random.fold_in(key, job["index"] + 10**6 * (job["truths"] == "paper")))
    truth = draw_truth(job, with_tension, np.random.default_rng([job["seed"], job["index"]]))
    measured = simulated_data(with_tension, truth, data_key)
    if measured is None:
        return {"failed": "the rollout of the truth did not end well", "truth": truth}
    if job["row"] == "ours + tension":
        replica = with_tension.with_measured(measured)
    else:
        replica = problem.with_measured(measured._replace(tension=None))
    began = time.monotonic()
    try:
        draws, rollouts = infer(job, replica, fit_key)
    except InputError as error:
        return {"failed": str(error), "truth": truth}
    seconds = time.monotonic() - began
    held = task_problem(job["task"], job["actions"], False, True, job["seed"])
    return {
        "truth": truth,
        **scores(TASKS[job["task"]], draws, truth),
        "held_out_mm": held_out_error(held, draws, truth),
        "rollouts": rollouts,
        "seconds": seconds,
    }


def draw_truth(job: Mapping[str, Any], problem: CalibrationProblem, rng: np.random.Generator) -> dict[str, float]:
    """The paper's truth, or one in the outer halves of all ranges; noise as the benchmark fixes it."""
    task = TASKS[job["task"]]
    chosen = dict(task.truth)
    if job["truths"] == "off-centre":
        for name, (low, high) in task.ranges.items():
            side, place = rng.integers(2), rng.uniform(0.0, 0.5 * (1.0 - CENTRAL))
            chosen[name] = low + (high - low) * (1.0 - place if side else place)
    noise = {
        "observation_noise": POSITION_NOISE,
        "noise_correlation_time": -SAMPLE_TIME / float(np.log(CORRELATION)),
        "tension_noise": TENSION_NOISE,
    }
    return {name: float({**chosen, **noise}[name]) for name in problem.names}


def infer(
    job: Mapping[str, Any], problem: CalibrationProblem, key: jax.Array
) -> tuple[dict[str, Float[np.ndarray, " n"]], float]:
    """Draws of the task's parameters by the method of a row, and the rollouts it took."""
    ranges = TASKS[job["task"]].ranges
    method, options = ROWS[job["row"]]
    if job["row"] == "prior":
        drawn = problem.sample_prior(key, 1000)
        return {name: np.asarray(drawn[name]) for name in ranges}, 0.0
    if job["row"] == "mid-range":
        return {name: np.full(10, 0.5 * sum(ends)) for name, ends in ranges.items()}, 0.0
    extra: dict[str, Any] = {} if method == "udr" else {"rollouts": job["budget"]}
    if method == "rfdropo":
        extra |= {"parameters": list(ranges), "search": {name: list(ends) for name, ends in ranges.items()}}
    result = methods.run(problem, method, {**options, **extra}, key)
    return {name: np.asarray(result.draws[name]).reshape(-1) for name in ranges}, float(result.rollouts)


def scores(task: Task, draws: Mapping[str, Float[np.ndarray, " n"]], truth: Mapping[str, float]) -> dict[str, Any]:
    """Errors of a posterior that need no simulation; see reports/table1."""
    scale = {name: WIDTH / (high - low) for name, (low, high) in task.ranges.items()}
    offsets = np.stack([(np.asarray(draws[name]) - truth[name]) * scale[name] for name in task.ranges])
    inside = []
    for name in task.ranges:
        low, high = central_interval(np.asarray(draws[name]))
        inside.append(bool(low <= truth[name] <= high))
    ratio = np.log(np.asarray(draws["young_modulus"]) / np.asarray(draws["trunk_mass"]))
    true_ratio = np.log(truth["young_modulus"] / truth["trunk_mass"])
    poisson = float(np.mean(draws["poisson_ratio"])) / truth["poisson_ratio"] - 1.0
    return {
        "mse": float(np.mean(offsets**2, axis=1).sum()),
        "ratio_error_percent": 100.0 * abs(float(np.expm1(np.mean(ratio) - true_ratio))),
        "poisson_error_percent": 100.0 * abs(poisson),
        "inside_90": inside,
        "log_score": _log_score(offsets),
    }


def _log_score(offsets: Float[np.ndarray, "d n"]) -> float | None:
    """Log density at the truth of a normal with the draws' moments, in the scaled units; None for a point."""
    mean, covariance = offsets.mean(axis=1), np.cov(offsets)
    if not np.all(np.diag(covariance) > 0.0):
        return None
    covariance = covariance + 1e-8 * np.eye(len(mean))
    white = np.linalg.solve(np.linalg.cholesky(covariance), mean)
    return float(-0.5 * white @ white - 0.5 * np.linalg.slogdet(2.0 * np.pi * covariance)[1])


def held_out_error(
    problem: CalibrationProblem, draws: Mapping[str, Float[np.ndarray, " n"]], truth: Mapping[str, float]
) -> float | None:
    """Root mean square distance [mm] of the last marker between the mean prediction and the true motion, without noise,
    under commands that no fit saw; None if no predicted rollout ends well."""
    size = len(next(iter(draws.values())))
    index = np.linspace(0, size - 1, min(size, PREDICTED)).round().astype(int)
    count = len(index) + 1
    batch = {name: np.full(count, truth[name]) for name in problem.names}
    for name, column in draws.items():
        batch[name][:-1] = np.asarray(column)[index]
    seen = problem.observe(jax.tree.map(jax.numpy.asarray, batch))
    position, status = np.asarray(seen.position), np.asarray(seen.status)
    good = status[:-1] == 0
    if not good.any() or status[-1] != 0:
        return None
    error = position[:-1][good, 0, :, -1].mean(axis=0) - position[-1, 0, :, -1]
    return float(1e3 * np.sqrt(np.mean(np.sum(error**2, axis=-1))))
