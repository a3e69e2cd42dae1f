"""``python -m studies sbc``: is the method calibrated for this experiment's robot, commands and priors?"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from rfdropo_bayes.bayes.calibration_problem import CalibrationProblem
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import write_json
from rfdropo_bayes.inference.methods import make_config
from rfdropo_bayes.inference.progress import Progress
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.run_folder import COMMANDS, LOG, RunKind, hashes, run_folder
from rfdropo_bayes.verbs.calibrate import inference_options
from studies import rivals, sbc  # noqa: F401 - rivals adds its methods to the table of the package
from studies.replicas import simulated_data, with_measured

COMMANDS["sbc"] = RunKind(("sbc.json", "sbc.jsonl"), resumable=True)

MOST_FAILURES = 100


def run_check(
    model: Model, out: Path, *, datasets: int = 200, resume: bool = False, overwrite: bool = False
) -> dict[str, Any]:
    """Check the experiment's method on data simulated from its own prior at its own commands and times.

    Writes ``sbc.json`` and, while it runs, ``sbc.jsonl`` with one line per data set.

    Returns:
        the content of ``sbc.json``.

    Raises:
        InputError: bad input, or a prior that hardly ever gives a rollout that ends well.
    """
    chosen, fitted = model.settings, model.recordings("fit")
    problem = model.problem(fitted)
    options = inference_options(chosen.inference)
    make_config(chosen.inference.method, options)
    settings: dict[str, Any] = {"tables": model.tables(), "folder": model.folder, "data": hashes(fitted)}
    with run_folder(out, "sbc", **settings, resume=resume, overwrite=overwrite) as out:
        with Progress("sbc", show=None, log=out / LOG) as progress:
            found = sbc.calibrate(
                problem,
                lambda key: simulate_data_set(problem, key),
                chosen.inference.method,
                options,
                jax.random.key(chosen.seed),
                datasets,
                log=out / "sbc.jsonl",
                resume=resume,
                progress=progress,
            )
        content = {
            **found.as_dict(),
            "method": chosen.inference.method,
            "options": options,
            "seed": chosen.seed,
            "robot": model.spec.named,
            "simulator": model.simulator.description,
        }
        write_json(out / "sbc.json", content)
    return content


def simulate_data_set(
    problem: CalibrationProblem, key: PRNGKeyArray
) -> tuple[dict[str, float], CalibrationProblem, int]:
    """A truth from the prior whose rollout ends well, the problem with data simulated from it, and failures before."""
    for failed in range(MOST_FAILURES):
        truth_key, noise_key = jax.random.split(jax.random.fold_in(key, failed))
        truth = {name: float(np.asarray(column)[0]) for name, column in problem.sample_prior(truth_key, 1).items()}
        measured = simulated_data(problem, truth, noise_key)
        if measured is not None:
            return truth, with_measured(problem, measured), failed
    raise InputError(
        f"none of {MOST_FAILURES} prior draws gives a rollout that ends well",
        where="[model.priors]",
        remedy="narrow the priors to parameters that the simulator can handle",
    )
