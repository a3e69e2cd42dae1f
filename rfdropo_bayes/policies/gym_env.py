"""An episode as an environment of Gymnasium."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from rfdropo_bayes.policies.building import make_episodes
from rfdropo_bayes.policies.rendering import picture
from rfdropo_bayes.policies.spaces import spaces_of
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
