"""A batch of environments whose best policy is known: a point on a line is driven to a goal."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from rfdropo_bayes.policies.randomisation import Randomisation, Uniform
from rfdropo_bayes.robots.policy_layout import ObservationPart, PolicyLayout

STEP = 0.1


def layout(kind: str) -> PolicyLayout:
    return PolicyLayout(
        task="Point-v0",
        period_s=0.1,
        observation=(ObservationPart("position", 1, "m"), ObservationPart("goal", 1, "m")),
        channels=("x",),
        unit="m",
        kind=kind,
        moves=((STEP,),) if kind == "continuous" else ((STEP,), (-STEP,), (0.0,)),
        low=(-2.0,),
        high=(2.0,),
    )


class Points(VecEnv):
    """Points start at 0, their goals lie between -1 and 1, episodes have 20 actions; ``gain`` scales every move.

    A gain above 2 "diverges": the episode ends with a floor reward, as a failed simulation does.
    """

    redrawn = 0
    randomisation: Randomisation = Uniform({"gain": (0.8, 1.2)})

    def __init__(self, count: int, kind: str = "continuous") -> None:
        self.layout = layout(kind)
        space = spaces.Box(-1.0, 1.0, (1,), np.float32) if kind == "continuous" else spaces.Discrete(3)
        super().__init__(count, spaces.Box(-5.0, 5.0, (2,), np.float32), space)
        self.generators = [np.random.default_rng(k) for k in range(count)]
        self.position, self.goal, self.gain = (np.zeros(count) for _ in range(3))
        self.age = np.zeros(count, dtype=int)

    def _start(self, lane: int, options: dict[str, Any]) -> dict[str, Any]:
        drawn = self.generators[lane].uniform(-1.0, 1.0, 2)
        self.goal[lane] = options.get("goal", [drawn[0]])[0]
        self.gain[lane] = options.get("parameters", {}).get("gain", 1.0 + 0.2 * drawn[1])
        self.position[lane], self.age[lane] = 0.0, 0
        return {"parameters": {"gain": float(self.gain[lane])}, "goal": [float(self.goal[lane])]}

    def _seen(self) -> np.ndarray:
        return np.stack([self.position, self.goal], axis=1).astype(np.float32)

    def reset(self) -> np.ndarray:
        for lane, seed in enumerate(self._seeds):
            if seed is not None:
                self.generators[lane] = np.random.default_rng(seed)
        self.reset_infos = [self._start(lane, self._options[lane]) for lane in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return self._seen()

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        self.position += self.gain * self.layout.change(self._actions)[:, 0]
        self.age += 1
        distance = np.abs(self.position - self.goal)
        diverged = self.gain > 2.0
        done = (self.age == 20) | diverged
        infos: list[dict[str, Any]] = [
            {"distance": float(d), "diverged": bool(bad)} for d, bad in zip(distance, diverged, strict=True)
        ]
        seen = self._seen()
        for lane in np.flatnonzero(done):
            infos[lane] |= {"terminal_observation": seen[lane], "TimeLimit.truncated": not diverged[lane]}
            self.reset_infos[lane] = self._start(lane, {})
        return self._seen(), np.where(diverged, -10.0, -distance), done, infos

    def close(self) -> None: ...

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        value = None if attr_name == "render_mode" else getattr(self, attr_name)
        return [value] * (self.num_envs if indices is None else len(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        return [getattr(self, method_name)(*args, **kwargs)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs
