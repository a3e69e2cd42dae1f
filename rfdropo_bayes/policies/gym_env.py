"""Episodes as Gymnasium's environments: one, or many with ``gymnasium.make_vec``."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from rfdropo_bayes.policies.episodes import make_episodes, spaces_of
from rfdropo_bayes.policies.rendering import picture
from rfdropo_bayes.policies.tasks import PERIOD


class TrunkEnv(gymnasium.Env):
    """A task of the paper as one environment.

    Args:
        task: name of a task, such as ``"TrunkReach-v0"``.
        render_mode: ``"rgb_array"`` or None.
        options: see `make_episodes`.

    ``reset`` takes the options ``parameters`` and ``goal``; its info holds both.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": round(1.0 / PERIOD)}  # noqa: RUF012

    def __init__(self, task: str, render_mode: str | None = None, **options: Any) -> None:
        self.episodes = make_episodes(task, 1, **options)
        self.layout = self.episodes.layout
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self.layout.period_s)}
        self.observation_space, self.action_space = spaces_of(self.layout)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        if seed is not None:
            self.episodes.seed(0, seed)
        seen = self.episodes.reset([0], [options or {}])
        return seen[0], self.episodes.begun_with(0)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        step = self.episodes.act(np.asarray(action)[None])
        info = {
            "distance": float(step.distance[0]),
            "diverged": bool(step.diverged[0]),
            "tension": float(step.tension[0]),
            "stopped": bool(step.stopped[0]),
        }
        return (step.observation[0], float(step.reward[0]), bool(step.terminated[0]), bool(step.truncated[0]), info)

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """A picture of trunk, cables, cube and goal, (height, width, 3)."""
        return picture(self.episodes, 0) if self.render_mode == "rgb_array" else None


class TrunkVectorEnv(VectorEnv):
    """Many environments of a task in one call of the simulator; a lane that ends is begun again in the same step."""

    metadata: dict[str, Any] = {**TrunkEnv.metadata, "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, task: str, num_envs: int = 1, render_mode: str | None = None, **options: Any) -> None:
        self.episodes = make_episodes(task, num_envs, **options)
        self.layout = self.episodes.layout
        self.num_envs, self.render_mode = num_envs, render_mode
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self.layout.period_s)}
        self.single_observation_space, self.single_action_space = spaces_of(self.layout)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode in every lane; the options hold for all of them."""
        super().reset(seed=seed if isinstance(seed, int) else None)
        seeds = seed if isinstance(seed, list) else [None if seed is None else seed + k for k in range(self.num_envs)]
        for lane, own in enumerate(seeds):
            if own is not None:
                self.episodes.seed(lane, own)
        seen = self.episodes.reset(np.arange(self.num_envs), [options or {}] * self.num_envs)
        return seen, self._begun()

    def _begun(self) -> dict[str, np.ndarray]:
        """Parameters and goals of the episodes in all lanes."""
        parameters = np.empty(self.num_envs, dtype=object)
        parameters[:] = [dict(values) for values in self.episodes.parameters]
        return {"parameters": parameters, "goal": self.episodes.goal.copy()}

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One action in every lane. If an episode ends, ``final_obs`` and ``final_info`` describe it; ``parameters``
        and ``goal`` describe its successor.
        """
        step = self.episodes.act(np.asarray(actions))
        info: dict[str, Any] = {name: getattr(step, name) for name in ("distance", "diverged", "tension", "stopped")}
        seen = step.observation
        ended = np.flatnonzero(step.terminated | step.truncated)
        if len(ended):
            final = np.full(self.num_envs, None, dtype=object)
            for lane in ended:
                final[lane] = seen[lane].copy()
            done = step.terminated | step.truncated
            info |= {
                "final_obs": final,
                "_final_obs": done,
                "final_info": {**info, **self._begun()},
                "_final_info": done,
            }
            seen = seen.copy()
            seen[ended] = self.episodes.reset(ended)
            info |= {**self._begun(), "_parameters": done, "_goal": done}
        return seen, step.reward, step.terminated, step.truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture of every lane."""
        if self.render_mode != "rgb_array":
            return None
        return tuple(picture(self.episodes, lane) for lane in range(self.num_envs))
