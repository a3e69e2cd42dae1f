"""Algorithms of Stable-Baselines3 by name, their options checked before anything is simulated."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from typing import Any

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.tables import nearest

ALGORITHMS = ("PPO", "A2C", "SAC", "TD3", "DDPG", "DQN")
CONTINUOUS_ONLY, DISCRETE_ONLY = ("SAC", "TD3", "DDPG"), ("DQN",)
ACTOR_CRITIC = ("PPO", "A2C")
"""Whose actor and critic have their own networks and one observation: the critic may see more."""
OURS = ("policy", "env", "seed", "device", "tensorboard_log", "verbose", "_init_setup_model")
"""Arguments that the training sets itself."""
OBJECTS = ("action_noise", "replay_buffer_class", "rollout_buffer_class")
"""Arguments that are Python objects: experiment files and settings of checkpoints cannot hold them."""

LARGEST_BATCH = 512
PPO_DEFAULTS: dict[str, Any] = {"n_steps": 16, "n_epochs": 5, "learning_rate": 7e-4, "gae_lambda": 0.95}
"""For a hundred environments or more at once: short rollouts, large batches."""


def algorithm_class(name: str, kind: str) -> Any:
    """The class of an algorithm that can drive actions of a kind, "discrete" or "continuous".

    Raises:
        InputError: no such algorithm, or one for the other kind of actions.
    """
    if name not in ALGORITHMS:
        remedy = nearest(name.upper(), ALGORITHMS)
        raise InputError(f"unknown algorithm {name!r}", where="[training] algorithm", remedy=remedy)
    wrong = CONTINUOUS_ONLY if kind == "discrete" else DISCRETE_ONLY
    if name in wrong:
        others = ", ".join(other for other in ALGORITHMS if other not in wrong)
        raise InputError(f"{name} cannot drive {kind} actions", where="[training] algorithm", remedy=f"use {others}")
    import stable_baselines3

    return getattr(stable_baselines3, name)


def check_critic(name: str, critic: str) -> None:
    """Raise an InputError if the critic of an algorithm cannot see parameters."""
    if critic == "parameters" and name not in ACTOR_CRITIC:
        raise InputError(
            f"the critic of {name} cannot see parameters",
            where='[training] critic = "parameters"',
            remedy=f'use algorithm = "{ACTOR_CRITIC[0]}" or "{ACTOR_CRITIC[1]}", or leave out critic',
        )


def algorithm_options(
    name: str, kind: str, gamma: float, given: Mapping[str, Any], environments: int = 128
) -> dict[str, Any]:
    """Arguments of an algorithm: the defaults for these tasks, overridden by ``given``.

    Args:
        name: name of the algorithm.
        kind: kind of actions.
        gamma: discount factor of one control period, unless ``given`` has another.
        given: options of the algorithm by Stable-Baselines3's own names; ``net_arch``, ``log_std_init`` and
            ``activation`` (tanh, relu or elu) may stand among them without ``policy_kwargs``.
        environments: number of environments simulated at once; a batch of PPO divides the rows they gather.

    Raises:
        InputError: an option that the algorithm does not have or no file can hold, or another activation.
    """
    known = [p for p in inspect.signature(algorithm_class(name, kind).__init__).parameters if p not in ("self", *OURS)]
    short = ("net_arch", "log_std_init", "activation")
    for option in given:
        if option in OBJECTS and option in known:
            what = f"{option} is an object of Python, which no file can hold"
            raise InputError(what, where="[training.options]", remedy=f"leave out {option}")
        if option not in (*known, *short):
            remedy = nearest(option, [*known, *short])
            raise InputError(f"{name} has no option {option!r}", where="[training.options]", remedy=remedy)
    policy: dict[str, Any] = {"net_arch": [128, 128]}
    if name in ACTOR_CRITIC and kind == "continuous":
        policy["log_std_init"] = -1.0
    own = given.get("policy_kwargs", {})
    if not isinstance(own, Mapping):
        raise InputError("policy_kwargs is not a table", where="[training.options]", remedy="give it keys and values")
    policy |= {**own, **{key: given[key] for key in short if key in given}}
    if "activation" in policy:
        policy["activation_fn"] = _activation(policy.pop("activation"))
    ours = PPO_DEFAULTS if name == "PPO" else {}
    rest = {key: value for key, value in given.items() if key not in (*short, "policy_kwargs")}
    options = {**ours, "gamma": gamma, **rest, "policy_kwargs": policy}
    if name == "PPO" and "batch_size" not in options:
        options["batch_size"] = math.gcd(LARGEST_BATCH, environments * options["n_steps"])
    return options


def _activation(name: str) -> Any:
    from torch import nn

    known = {"tanh": nn.Tanh, "relu": nn.ReLU, "elu": nn.ELU}
    if name not in known:
        raise InputError(f"unknown activation {name!r}", where="[training.options]", remedy=nearest(name, known))
    return known[name]
