"""A recurrent policy for `transfer.py`: RecurrentPPO of sb3-contrib, which is no part of any extra.

    pip install -c constraints.txt --no-deps sb3-contrib

Legs, learning rate, evaluations and the choice of the best policy are those of `rfdropo train`. The policy stays in
memory: it is neither exported nor saved, and a training that is killed begins anew.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecNormalize

from rfdropo_bayes.policies.evaluation import draw_cases, play
from rfdropo_bayes.policies.ppo import ppo_options
from rfdropo_bayes.policies.training import EVALUATION_SEED, LEAST_SPREAD
from rfdropo_bayes.policies.training_config import TrainingTable
from rfdropo_bayes.policies.vec_env import TrunkVecEnv

UNITS = 64
"""Of each of the two LSTMs, before the usual two layers of 128. With 128 units learning costs 1.6 times as much."""


class Recalling:
    """Most likely actions in the lanes of ``venv``; the state of a lane begins at zero with each of its episodes."""

    def __init__(self, model: Any, normalisation: VecNormalize, venv: TrunkVecEnv) -> None:
        self.model, self.normalisation, self.venv, self.state = model, normalisation, venv, None

    def __call__(self, seen: np.ndarray) -> np.ndarray:
        begins = self.venv.episodes.age == 0
        inputs = self.normalisation.normalize_obs(seen)
        action, self.state = self.model.predict(inputs, self.state, begins, deterministic=True)
        return action


def learnt(venv: TrunkVecEnv, table: TrainingTable, seed: int) -> tuple[Any, VecNormalize, dict[str, Any]]:
    """The policy of the best evaluation, its normalisation, and a row for the ledger."""
    import torch
    from sb3_contrib import RecurrentPPO

    torch.set_num_threads(1)
    gamma = venv.episodes.task.gamma
    given = {"policy_kwargs": {"lstm_hidden_size": UNITS}}
    options = ppo_options(venv.layout.kind, gamma, given, venv.num_envs)
    around = VecNormalize(venv, gamma=gamma, epsilon=LEAST_SPREAD**2)
    model = RecurrentPPO("MlpLstmPolicy", around, seed=seed, device="cpu", **options)
    cases = draw_cases(venv, table.evaluation_episodes, EVALUATION_SEED + seed)
    began, curve = time.process_time(), []
    kept: tuple[Mapping[str, Any], Any] = ({}, None)
    while model.num_timesteps < table.steps:
        model.set_random_seed(int(np.random.SeedSequence([seed, len(curve) + 1]).generate_state(1)[0] % 2**31))
        model.set_env(around, force_reset=True)
        left = table.steps - model.num_timesteps
        rate = model.learning_rate * left / table.steps
        model.lr_schedule = lambda _, rate=rate: rate
        model.learn(min(table.evaluate_every, left), reset_num_timesteps=False)
        episodes = play(Recalling(model, around, venv), venv, cases, EVALUATION_SEED + seed)
        distance = 1e3 * np.array([episode.distance for episode in episodes])
        curve.append(
            {
                "reward": float(np.mean([episode.total for episode in episodes])),
                "median": float(np.median(distance)),
                "q95": float(np.quantile(distance, 0.95)),
            }
        )
        print(model.num_timesteps, curve[-1], f"{time.process_time() - began:.0f} s of a processor", flush=True)
        if curve[-1]["reward"] == max(row["reward"] for row in curve):
            kept, best = (deepcopy(model.policy.state_dict()), deepcopy(around.obs_rms)), curve[-1]
    model.policy.load_state_dict(kept[0])
    around.obs_rms = kept[1]
    home = {key: best[key] for key in ("median", "q95")}
    return model, around, {"home_mm": home, "seconds": round(time.process_time() - began, 1)}
