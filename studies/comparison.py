"""One fit of the comparison with the paper's Table I: a method, a task and a truth, simulated and scored."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.calibration_problem import CalibrationProblem
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference import methods
from rfdropo_bayes.posteriors import central_interval
from studies import rivals  # noqa: F401 - it adds its methods to the table of the package
from studies.replicas import simulated_data, with_measured
from studies.virtual_tasks import TASKS, InferenceTask, draw_truth, excited, task_problem

WIDTH = 4.0  # the paper's error is measured with every search range scaled to [0, 4]
PREDICTED = 64  # draws behind a prediction
ANEW = 20  # draws of a truth until its rollout ends well: contacts of a cube do not always converge

# Row of the table -> registry name and its own options; the budget is added where the method takes one.
ROWS: dict[str, tuple[str, dict[str, Any]]] = {
    "prior": ("", {}),
    "mid-range": ("", {}),
    "UDR": ("udr", {}),
    "BayesSim": ("bayessim", {}),
    "NPDR": ("npdr", {"rounds": 10}),
    "RF-DROPO as published": ("rfdropo", {"mended": False}),
    "RF-DROPO mended": ("rfdropo", {"rollouts_per_candidate": 20}),  # 100, as published, leave few candidates
    "ours": ("smc", {"blocks": 1, "particles": 200}),
    "ours + tension": ("smc", {"blocks": 1, "particles": 200}),
}
RIVALS = ("UDR", "BayesSim", "NPDR", "RF-DROPO as published", "RF-DROPO mended")


def fit(job: Mapping[str, Any]) -> dict[str, Any]:
    """Simulate the data of one truth, infer, and score; a method that cannot is a row with its reason.

    ``job`` has ``task``, ``row``, ``truths`` ("paper" or "off-centre"), ``index``, ``budget``, ``actions``, ``seed``.
    """
    with_tension = task_problem(job["task"], job["actions"], True, False, job["seed"])
    problem = task_problem(job["task"], job["actions"], False, False, job["seed"])
    key = jax.random.key(job["seed"])
    data_key, fit_key = jax.random.split(jax.random.fold_in(key, job["index"] + 10**6 * (job["truths"] == "paper")))
    task = TASKS[job["task"]]
    rng = np.random.default_rng([job["seed"], job["index"]])
    for _ in range(ANEW):
        truth = draw_truth(task, job["truths"], with_tension.names, rng)
        measured = simulated_data(with_tension, truth, data_key)
        if measured is not None:
            break
    else:
        return {"failed": f"none of {ANEW} truths has a rollout that ends well", "truth": truth}
    if job["row"] == "ours + tension":
        replica = with_measured(with_tension, measured)
    else:
        replica = with_measured(problem, {name: measured[name] for name in problem.measured})
    began = time.monotonic()
    try:
        draws, spent = infer(job, replica, fit_key)
    except InputError as error:
        return {"failed": str(error), "truth": truth}
    seconds = time.monotonic() - began
    held = task_problem(job["task"], job["actions"], False, True, job["seed"])
    return {
        "truth": truth,
        **scores(task, draws, truth, excited(task, with_tension, truth)),
        "held_out_mm": held_out_error(held, draws, truth),
        **spent,
        "seconds": seconds,
    }


def infer(
    job: Mapping[str, Any], problem: CalibrationProblem, key: jax.Array
) -> tuple[dict[str, Float[np.ndarray, " n"]], dict[str, Any]]:
    """Draws of the task's parameters by the method of a row, and the ``rollouts`` and ``cautions`` they came with."""
    ranges = TASKS[job["task"]].ranges
    method, options = ROWS[job["row"]]
    if job["row"] == "prior":
        drawn = problem.sample_prior(key, 1000)
        return {name: np.asarray(drawn[name]) for name in ranges}, {"rollouts": 0.0}
    if job["row"] == "mid-range":
        return {name: np.full(10, 0.5 * sum(ends)) for name, ends in ranges.items()}, {"rollouts": 0.0}
    extra: dict[str, Any] = {} if method == "udr" else {"rollouts": job["budget"]}
    if method == "rfdropo":
        extra |= {"parameters": list(ranges), "search": {name: list(ends) for name, ends in ranges.items()}}
    result = methods.run(problem, method, {**options, **extra}, key)
    draws = {name: np.asarray(result.draws[name]).reshape(-1) for name in ranges}
    return draws, {"rollouts": float(result.rollouts), "cautions": [caution.as_dict() for caution in result.cautions]}


def scores(
    task: InferenceTask, draws: Mapping[str, Float[np.ndarray, " n"]], truth: Mapping[str, float], told: Sequence[str]
) -> dict[str, Any]:
    """Errors of a posterior that need no simulation, those of the parameters ``told`` of apart; see reports/table1."""
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
        "mse_excited": float(np.mean(offsets**2, axis=1)[[name in told for name in task.ranges]].sum()),
        "excited": list(told),
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


def misleads(task: InferenceTask, result: Mapping[str, Any]) -> bool:
    """Whether the posterior of a fit says less of its truth than the uniform prior did, by its log score against the
    prior's density; where draws do not vary, whether they miss it."""
    if result["log_score"] is None:
        return not all(result["inside_90"])
    return bool(result["log_score"] < -len(task.ranges) * np.log(WIDTH))


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
