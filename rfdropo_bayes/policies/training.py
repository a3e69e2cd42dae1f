"""Training in legs: each starts from a checkpoint, so that a killed run continues without a trace.

At the end of a leg the policy is evaluated on the same cases as before, and everything is saved. The next leg begins
with all environments reset and all generators seeded by the run's seed and the leg's number, in the same or a new
process. The learning curve therefore does not depend on interruptions.
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic_core import PydanticSerializationError

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference.progress import Progress
from rfdropo_bayes.interrupts import stop_if_asked_twice
from rfdropo_bayes.policies.evaluation import Case, Episode, draw_cases, peak_tension, play
from rfdropo_bayes.policies.parity import check_exportable
from rfdropo_bayes.policies.ppo import ppo_options
from rfdropo_bayes.policies.training_config import TrainingTable

EVALUATION_SEED = 1_000_003  # evaluations play other episodes than the first of a training
CHECKPOINT, EPISODES = "checkpoints", "episodes.jsonl"
LAST, BEST = "", "best_"  # prefixes of a checkpoint's files
STATE = ("known", "leg", "seconds", "diverged", "redrawn", "curve", "logged")  # keys of a checkpoint's state.json

NO_END = 1e300  # in the place of an infinite distance, for quantiles
LEAST_SPREAD = 0.01
"""Added to the deviations by which observations are divided, in quadrature [m; quaternions: 1]. In training the cube's
height varies by 0.1 mm: divided by that, an error of 2 mm on the robot is an input that no training has seen. Measured
in reports/table2/README.md."""


@dataclass(frozen=True)
class Trained:
    """The policy of the evaluation with the highest reward: the last evaluation need not be the best."""

    model: Any  # model of Stable-Baselines3
    normalisation: Any  # the ``VecNormalize`` around its environments
    # a row for each leg: steps, seconds, mean reward of the evaluation, quantiles of the final distance [m], infinite
    # without an end; episodes whose simulation failed; with tensions, median and maximum of the episodes' largest
    # tension [N], and the number of episodes stopped by the limit
    curve: list[dict[str, float]]
    diverged: int  # training episodes that ended because the simulation failed
    seconds: float  # run time of all legs
    redrawn: int = 0  # number of parameter sets redrawn because no initial state was found

    @property
    def best(self) -> dict[str, float]:
        """The row of the curve that the policy is of."""
        return self.curve[_best_row(self.curve)]

    def act(self, observation: np.ndarray) -> np.ndarray:
        """The policy's most likely action for observations as the environments give them."""
        return self.model.predict(self.normalisation.normalize_obs(observation), deterministic=True)[0]


def train(
    environments: Callable[[int], Any],
    table: TrainingTable,
    out: Path,
    *,
    seed: int,
    gamma: float,
    resume: bool = False,
    fingerprint: Mapping[str, Any] | None = None,
    show: bool | None = None,
) -> Trained:
    """Train a policy.

    Args:
        environments: makes the given number of environments as one ``VecEnv`` with a ``layout``, a ``randomisation``, a
            ``log`` and the count ``redrawn``.
        table: options and budget.
        out: folder for ``log.jsonl``, ``episodes.jsonl`` (start and end of every training episode), TensorBoard's files
            and the checkpoint.
        seed: seed of all random numbers.
        gamma: discount factor of a control period, unless the options have one.
        resume: continue from the checkpoint in ``out``.
        fingerprint: settings, posterior and versions that a checkpoint must match.
        show: progress on stderr; None draws a bar on a terminal, and prints a line now and then elsewhere.

    Raises:
        InputError: an unknown option, or a checkpoint of another run.
    """
    import torch

    torch.set_num_threads(1)  # networks this small are slower on two
    venv = environments(table.environments)
    layout = venv.get_attr("layout")[0]
    options = ppo_options(layout.kind, gamma, table.options, table.environments)
    known = {"table": _plain(table), "seed": seed, **(fingerprint or {})}
    folder = Path(out) / CHECKPOINT
    state = _load_state(folder, known) if resume else None
    model, normalisation = _begin(options, venv, folder, state, out, seed)
    check_exportable(model, normalisation, Trained(model, normalisation, [], 0, 0.0).act, layout)
    cases = draw_cases(venv, table.evaluation_episodes, EVALUATION_SEED + seed)
    state = state or {"known": known, "leg": 0, "seconds": 0.0, "diverged": 0, "redrawn": 0, "curve": [], "logged": 0}
    log = Path(out) / EPISODES
    if log.exists():  # episodes of a leg that a kill has cut short come again
        os.truncate(log, state["logged"])
    with Progress(f"PPO {table.task}", show=show, log=Path(out) / "log.jsonl") as progress:
        while model.num_timesteps < table.steps:
            state = _leg(model, normalisation, venv, cases, table, state, seed, log)
            _save(model, normalisation, folder, state)
            progress.stage(model.num_timesteps / table.steps, **state["curve"][-1])
    if _best_row(state["curve"]) < len(state["curve"]) - 1:
        model, normalisation = _load(venv, folder, BEST)
    return Trained(model, normalisation, state["curve"], state["diverged"], state["seconds"], state["redrawn"])


def _plain(table: TrainingTable) -> dict[str, Any]:
    """The table as stored in a checkpoint."""
    try:
        return table.model_dump(mode="json")
    except PydanticSerializationError as error:
        raise InputError(
            f"a value cannot be stored in a file: {error}",
            where="[training.options]",
            remedy='use numbers, words, lists and tables, such as activation = "relu"',
        ) from None


def _begin(
    options: Mapping[str, Any], venv: Any, folder: Path, state: Mapping[str, Any] | None, out: Path, seed: int
) -> tuple[Any, Any]:
    """A model and its normalisation, new or as they were saved."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize

    tensorboard = str(Path(out) / "tensorboard")
    if state is None:
        variance = LEAST_SPREAD**2  # added to variances
        normalisation = VecNormalize(venv, gamma=options["gamma"], epsilon=variance)
        ours: dict[str, Any] = {"seed": seed, "device": "cpu", "tensorboard_log": tensorboard}
        try:
            return PPO("MlpPolicy", normalisation, **ours, **options), normalisation
        except Exception as error:  # Stable-Baselines3 asserts, and PyTorch and Python raise whatever they raise
            raise InputError(
                f"PPO cannot be made: {error}",
                where="[training.options]",
                remedy="see the options of PPO in the documentation of Stable-Baselines3",
            ) from error
    return _load(venv, folder, LAST, tensorboard)


def _load(venv: Any, folder: Path, which: str, tensorboard: str | None = None) -> tuple[Any, Any]:
    """The last or the best model of a checkpoint, and its normalisation."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize

    normalisation = VecNormalize.load(str(folder / f"{which}normalisation.pkl"), venv)
    path = folder / f"{which}model.zip"
    return PPO.load(path, env=normalisation, device="cpu", tensorboard_log=tensorboard), normalisation


def _best_row(curve: Sequence[Mapping[str, float]]) -> int:
    return int(np.argmax([row["reward"] for row in curve]))


def _leg(
    model: Any,
    normalisation: Any,
    venv: Any,
    cases: Sequence[Case],
    table: TrainingTable,
    state: Mapping[str, Any],
    seed: int,
    log: Path,
) -> dict[str, Any]:
    """Learn until the next evaluation, and evaluate in the same environments. Learning and evaluation each begin with a
    reset of all environments.
    """
    began, redrawn = time.monotonic(), venv.get_attr("redrawn")[0]
    leg = int(state["leg"]) + 1
    model.set_random_seed(int(np.random.SeedSequence([seed, leg]).generate_state(1)[0] % 2**31))
    model.set_env(model.get_env(), force_reset=True)
    venv.set_attr("log", log)
    count = _failures()
    remaining = table.steps - model.num_timesteps
    if table.anneal:
        # Stable-Baselines3's own schedules count from the start of a leg.
        rate = model.learning_rate * remaining / table.steps
        model.lr_schedule = lambda _: rate
    steps = min(table.evaluate_every, remaining)
    model.learn(steps, callback=count, reset_num_timesteps=False, tb_log_name="run", log_interval=1)
    venv.set_attr("log", None)
    policy = Trained(model, normalisation, [], 0, 0.0)
    normalisation.training = False
    episodes = play(policy.act, venv, cases, EVALUATION_SEED + seed)
    normalisation.training = True
    seconds = state["seconds"] + time.monotonic() - began
    row = {"steps": int(model.num_timesteps), "seconds": seconds, **_summary(episodes)}
    for name, value in row.items():
        model.logger.record(f"evaluation/{name}", value)
    model.logger.dump(model.num_timesteps)
    return {
        **state,
        "leg": leg,
        "seconds": seconds,
        "diverged": state["diverged"] + count.failed,
        "redrawn": state["redrawn"] + venv.get_attr("redrawn")[0] - redrawn,
        "curve": [*state["curve"], row],
        "logged": log.stat().st_size if log.exists() else 0,
    }


def _failures() -> Any:
    """A callback that counts failed training episodes, and stops if Ctrl-C was pressed twice.

    Stable-Baselines3 imports are heavy, so that the class is made here.
    """
    from stable_baselines3.common.callbacks import BaseCallback

    class Failures(BaseCallback):
        failed = 0

        def _on_step(self) -> bool:
            stop_if_asked_twice()
            self.failed += sum(bool(info.get("diverged", False)) for info in self.locals["infos"])
            return True

    return Failures()


def _summary(episodes: Sequence[Episode]) -> dict[str, float]:
    distance = np.array([episode.distance for episode in episodes])
    # NumPy returns NaN for a quantile with an infinite neighbour of zero weight.
    quantiles = np.quantile(np.where(np.isfinite(distance), distance, NO_END), [0.05, 0.5, 0.95])
    low, middle, high = np.where(quantiles > 1e-100 * NO_END, np.inf, quantiles)
    pull = peak_tension(episodes)
    return {
        "reward": float(np.mean([episode.total for episode in episodes])),
        "distance_q05": float(low),
        "distance_median": float(middle),
        "distance_q95": float(high),
        "failed": sum(episode.diverged for episode in episodes),
        **({} if pull is None else {f"tension_{name}": value for name, value in pull.items()}),
    }


def _save(model: Any, normalisation: Any, folder: Path, state: Mapping[str, Any]) -> None:
    """Write a checkpoint beside the previous checkpoint, then replace the previous checkpoint, so that a killed process
    leaves one of the two.
    """
    partial = folder.with_name(f"{CHECKPOINT}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        is_best = _best_row(state["curve"]) == len(state["curve"]) - 1
        for which in (LAST, BEST) if is_best else (LAST,):
            model.save(partial / f"{which}model.zip")
            normalisation.save(str(partial / f"{which}normalisation.pkl"))
        if not is_best:
            for path in folder.glob(f"{BEST}*"):
                shutil.copy2(path, partial)
        (partial / "state.json").write_text(json.dumps(state), encoding="utf-8")
    except OSError as error:
        shutil.rmtree(partial, ignore_errors=True)
        raise InputError(
            f"cannot write the checkpoint: {error.strerror}", where=str(folder), remedy="free some space, then --resume"
        ) from None
    old = folder.with_name(f"{CHECKPOINT}.old")
    shutil.rmtree(old, ignore_errors=True)
    if folder.exists():
        os.replace(folder, old)
    os.replace(partial, folder)
    shutil.rmtree(old, ignore_errors=True)


def _load_state(folder: Path, known: Mapping[str, Any]) -> dict[str, Any] | None:
    """Numbers of a checkpoint; InputError if it is damaged, or of other settings.

    A run that was interrupted before its first checkpoint left none: None starts from the beginning.
    """
    old = folder.with_name(f"{CHECKPOINT}.old")
    if not folder.exists() and old.exists():  # killed between the two renames
        os.replace(old, folder)
    if not folder.exists():
        return None
    try:
        state = json.loads((folder / "state.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise InputError(
            "the checkpoint is damaged: it has no readable state.json",
            where=str(folder),
            remedy="start anew: give --overwrite, not --resume",
        ) from None
    files = ("model.zip", "normalisation.pkl")
    absent = [name for name in STATE if name not in state]
    absent += [which + name for which in (LAST, BEST) for name in files if not (folder / (which + name)).exists()]
    if absent:
        raise InputError(
            f"the checkpoint lacks {', '.join(absent)}: it is damaged",
            where=str(folder),
            remedy="start anew: give --overwrite, not --resume",
        )
    before = json.loads(json.dumps(state["known"]))
    now = json.loads(json.dumps(known))
    changed = [name for name in now if name != "table" and now[name] != before.get(name)]
    changed += [name for name in now["table"] if name != "steps" and now["table"][name] != before["table"].get(name)]
    if changed:
        raise InputError(
            f"the checkpoint is of other settings: {', '.join(changed)}",
            where=str(folder),
            remedy="restore them, or leave out --resume",
        )
    return {**state, "known": dict(known)}
