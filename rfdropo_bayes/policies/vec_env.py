"""Episodes as a ``VecEnv`` of Stable-Baselines3: lanes that end are begun again in the same step."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from rfdropo_bayes.policies.episodes import Episodes, EpisodeStep
from rfdropo_bayes.policies.randomisation import Randomisation
from rfdropo_bayes.policies.rendering import picture
from rfdropo_bayes.policies.spaces import spaces_of


class TrunkVecEnv(VecEnv):
    """Many environments in one call of the simulator.

    Args:
        episodes: the lanes.
        log: file for one JSON line per finished episode, with its start and end. The start, as an option of a
            reset, begins the episode again.

    The info of every step holds ``distance`` [m], ``diverged``, ``tension`` [N], the largest since the step before, and
    ``stopped``, whether it was beyond the limit; at the end of an episode also ``terminal_observation``,
    ``TimeLimit.truncated``, ``episode`` (r: sum of rewards, l: actions), and its start: ``parameters`` and ``goal``.
    ``reset_infos`` holds the start of each lane's present episode.
    """

    def __init__(self, episodes: Episodes, log: Path | None = None) -> None:
        self.episodes, self.log = episodes, log
        self.layout = episodes.layout
        observed, acted = spaces_of(episodes.layout)
        self.total = np.zeros(episodes.lanes)
        super().__init__(episodes.lanes, observed, acted)
        self._actions: np.ndarray = np.zeros(0)

    @property
    def redrawn(self) -> int:
        """Parameter sets for which no initial state was found, and others drawn."""
        return self.episodes.redrawn

    @property
    def randomisation(self) -> Randomisation:
        """Source of the parameters of episodes."""
        return self.episodes.randomisation

    def reset(self) -> np.ndarray:
        """Begin an episode in every lane, with the seeds and options that were set."""
        for lane, seed in enumerate(self._seeds):
            if seed is not None:
                self.episodes.seed(lane, seed)
        seen = self.episodes.reset(np.arange(self.num_envs), self._options)
        self._reset_seeds()
        self._reset_options()
        self.total[:] = 0.0
        self.reset_infos = [self.episodes.begun_with(lane) for lane in range(self.num_envs)]
        return seen

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """One action in every lane; lanes whose episode ends show the first observation of the next."""
        step = self.episodes.act(self._actions)
        self.total += step.reward
        done = step.terminated | step.truncated
        told = {name: getattr(step, name).tolist() for name in ("distance", "diverged", "tension", "stopped")}
        infos: list[dict[str, Any]] = [
            {name: values[lane] for name, values in told.items()} for lane in range(self.num_envs)
        ]
        seen = step.observation
        ended = np.flatnonzero(done)
        if len(ended):
            seen = seen.copy()
            self._finish(ended, step, infos)
            seen[ended] = self.episodes.reset(ended)
            self.total[ended] = 0.0
            for lane in ended:
                self.reset_infos[lane] = self.episodes.begun_with(int(lane))
        return seen, step.reward.astype(np.float32), done, infos

    def _finish(self, ended: np.ndarray, step: EpisodeStep, infos: list[dict[str, Any]]) -> None:
        """Write the ends of episodes to their infos and to the log."""
        lines = []
        for lane in ended:
            length, total = int(self.episodes.age[lane]), float(self.total[lane])
            infos[lane] |= {
                "terminal_observation": step.observation[lane],
                "TimeLimit.truncated": bool(step.truncated[lane]),
                "episode": {"r": total, "l": length},
                **self.reset_infos[lane],
            }
            ending = {name: infos[lane][name] for name in ("distance", "diverged", "stopped")} | {"reward": total}
            lines.append(json.dumps({"lane": int(lane), **self.reset_infos[lane], **ending, "actions": length}))
        if self.log is not None:
            with self.log.open("a", encoding="utf-8") as file:
                file.write("\n".join(lines) + "\n")

    def close(self) -> None:
        """Nothing to give back."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute, the same for all lanes."""
        value = "rgb_array" if attr_name == "render_mode" else getattr(self, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of all lanes."""
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of all lanes."""
        result = getattr(self, method_name)(*method_args, **method_kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Lanes have no wrappers."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        """A picture of every lane."""
        return [picture(self.episodes, lane) for lane in range(self.num_envs)]
