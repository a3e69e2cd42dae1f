"""A critic that sees the simulator's parameters of the episode, which a robot never shows.

Only the actor is exported, so that the critic may have more inputs (Pinto et al. 2018, "Asymmetric actor critic for
image-based robot learning"). Environments append the parameters to the observation; the actor's network begins with the
numbers before them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from jaxtyping import Float
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.policies.randomisation import Randomisation
from rfdropo_bayes.policies.spaces import FAR

DRAWS, SEED = 512, 0
"""Number and seed of the draws that measure the variation of each parameter; the same in every process."""
LIMIT = 10.0
"""Deviations beyond which a parameter counts as that far: the limit that `VecNormalize` has for observations."""


class VariedParameters(NamedTuple):
    """Parameters that differ between episodes, in the order of the randomisation."""

    names: tuple[str, ...]  # names of the parameters
    # mean, deviation: statistics of `DRAWS` draws [parameter units]
    mean: Float[np.ndarray, " parameter"]
    deviation: Float[np.ndarray, " parameter"]


def varied_parameters(randomisation: Randomisation) -> VariedParameters:
    """Parameters that vary under a randomisation, which a critic sees beside the observation.

    Raises:
        InputError: nothing differs between episodes.
    """
    rng = np.random.default_rng(SEED)
    draws = [randomisation.draw(rng) for _ in range(DRAWS)]
    rows = np.array([[draw[name] for name in randomisation.names] for draw in draws])
    varies = np.ptp(rows, axis=0) > 0.0
    if not varies.any():
        raise InputError(
            "no parameter differs between episodes, so a critic has no parameters to see",
            where='[training] critic = "parameters"',
            remedy='leave out critic, or set randomisation = "posterior", "phi" or "uniform"',
        )
    names = tuple(np.array(randomisation.names)[varies].tolist())
    return VariedParameters(names, rows.mean(axis=0)[varies], rows.std(axis=0)[varies])


class ParametersBeside(VecEnvWrapper):
    """Environments whose observations end with the varied parameters of the episode, in deviations from their mean.

    Args:
        venv: environments with a ``randomisation``, whose ``reset_infos`` hold the ``parameters`` of each lane's
            present episode.

    Attributes:
        varied: the parameters.

    Raises:
        InputError: nothing differs between episodes.
    """

    def __init__(self, venv: VecEnv) -> None:
        self.varied = varied_parameters(venv.get_attr("randomisation")[0])
        size = spaces.flatdim(venv.observation_space) + len(self.varied.names)
        super().__init__(venv, observation_space=spaces.Box(-FAR, FAR, (size,), np.float32))
        self._now = np.zeros((venv.num_envs, len(self.varied.names)), dtype=np.float32)

    def reset(self) -> Float[np.ndarray, "lane size"]:
        """Begin an episode in every lane."""
        seen = self.venv.reset()
        self._look(np.arange(self.num_envs))
        return np.concatenate([seen, self._now], axis=1)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """One action in every lane; a last observation ends with the parameters of the episode that it ends."""
        seen, reward, done, infos = self.venv.step_wait()
        ended = np.flatnonzero(done)
        for lane in ended:
            last = infos[lane]["terminal_observation"]
            infos[lane]["terminal_observation"] = np.concatenate([last, self._now[lane]])
        self._look(ended)
        return np.concatenate([seen, self._now], axis=1), reward, done, infos

    def _look(self, lanes: np.ndarray) -> None:
        """Take in the parameters of episodes that have begun."""
        names, mean, deviation = self.varied
        for lane in lanes:
            drawn = self.venv.unwrapped.reset_infos[lane]["parameters"]
            values = (np.array([drawn[name] for name in names]) - mean) / deviation
            self._now[lane] = np.clip(values, -LIMIT, LIMIT)


class AsymmetricPolicy(ActorCriticPolicy):
    """An actor of the observation, and a critic of the observation and the parameters behind it.

    Args:
        given: spaces and learning rate, as `ActorCriticPolicy` takes them.
        unseen: number of values at the end of an observation that the actor does not see.
        options: options of `ActorCriticPolicy`.
    """

    def __init__(self, *given: Any, unseen: int, **options: Any) -> None:
        self.unseen = unseen
        super().__init__(*given, **options)

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = _Networks(
            self.features_dim, self.unseen, net_arch=self.net_arch, activation_fn=self.activation_fn, device=self.device
        )

    def predict(self, observation: Any, *rest: Any, **options: Any) -> tuple[np.ndarray, Any]:
        """Actions for observations with parameters or without.

        In the place of parameters that are not given stands no number: an actor that saw one would give no action.
        """
        absent = spaces.flatdim(self.observation_space) - observation.shape[-1]
        edges = [(0, 0)] * (observation.ndim - 1) + [(0, absent)]
        return super().predict(np.pad(observation, edges, constant_values=np.nan), *rest, **options)


class _Networks(MlpExtractor):
    """Hidden layers of actor and critic; the actor's layers read only the features before the parameters."""

    def __init__(self, features: int, unseen: int, **options: Any) -> None:
        super().__init__(features, **options)
        actor = MlpExtractor(features - unseen, **options)
        self.seen, self.policy_net, self.latent_dim_pi = features - unseen, actor.policy_net, actor.latent_dim_pi

    def forward_actor(self, features: Any) -> Any:
        """The actor's hidden features."""
        return self.policy_net(features[:, : self.seen])
