"""Options of the training algorithm, PPO of Stable-Baselines3, checked before anything is simulated."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from typing import Any

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.tables import nearest

# Arguments that a training sets itself.
OURS = ("self", "policy", "env", "seed", "device", "tensorboard_log", "verbose", "_init_setup_model")
OBJECTS = ("rollout_buffer_class",)  # objects of Python, which no file can hold


SHORT = ("net_arch", "log_std_init", "activation")  # options that need no ``policy_kwargs``
LARGEST_BATCH = 512


DEFAULTS: dict[str, Any] = {"n_steps": 16, "n_epochs": 5, "learning_rate": 7e-4, "gae_lambda": 0.95}
"""For a hundred environments or more at once: short rollouts, large batches."""


def ppo_options(kind: str, gamma: float, given: Mapping[str, Any], environments: int = 128) -> dict[str, Any]:
    """Arguments of Stable-Baselines3's PPO: defaults for these tasks, replaced by ``given``.

    Args:
        kind: kind of actions, "discrete" or "continuous".
        gamma: discount factor of one control period, unless ``given`` has another.
        given: options under Stable-Baselines3's own names, and `SHORT`; an activation is tanh, relu or elu.
        environments: number of environments simulated at once; a batch divides the rows they gather.

    Raises:
        InputError: an option that PPO does not have or no file can hold, or another activation.
    """
    from stable_baselines3 import PPO

    known = [name for name in inspect.signature(PPO.__init__).parameters if name not in OURS]
    for option in given:
        if option in OBJECTS:
            what = f"{option} is an object of Python, which no file can hold"
            raise InputError(what, where="[training.options]", remedy=f"leave out {option}")
        if option not in (*known, *SHORT):
            remedy = nearest(option, [*known, *SHORT])
            raise InputError(f"PPO has no option {option!r}", where="[training.options]", remedy=remedy)
    own = given.get("policy_kwargs", {})
    if not isinstance(own, Mapping):
        raise InputError("policy_kwargs is not a table", where="[training.options]", remedy="give it keys and values")
    policy: dict[str, Any] = {"net_arch": [128, 128], **({"log_std_init": -1.0} if kind == "continuous" else {})}
    policy |= {**own, **{key: given[key] for key in SHORT if key in given}}
    if "activation" in policy:
        policy["activation_fn"] = _activation(policy.pop("activation"))
    rest = {key: value for key, value in given.items() if key not in (*SHORT, "policy_kwargs")}
    options = {**DEFAULTS, "gamma": gamma, **rest, "policy_kwargs": policy}
    options.setdefault("batch_size", math.gcd(LARGEST_BATCH, environments * options["n_steps"]))
    return options


def _activation(name: str) -> Any:
    from torch import nn

    known = {"tanh": nn.Tanh, "relu": nn.ReLU, "elu": nn.ELU}
    if name not in known:
        raise InputError(f"unknown activation {name!r}", where="[training.options]", remedy=nearest(name, known))
    return known[name]
