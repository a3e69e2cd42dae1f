"""Measured orientations of sections: bending and twist of the body, which positions of few markers hardly determine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfdropo_bayes.bayes.channels.channel import Seen, WhiteSeries
from rfdropo_bayes.bayes.channels.quaternions import of_rotation_vector, product, turn_between
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.parameters import ParameterSpec

ORIENTATION_NOISE = ParameterSpec(
    "orientation_noise",
    "rad",
    1e-5,
    1.0,
    0.01,
    {"distribution": "LogNormal", "median": 0.01, "sigma": 1.0},
    "standard deviation of a measured orientation's turn about one axis; white",
)
FRAME_TURNS = tuple(
    ParameterSpec(
        f"frame_turn_{axis}",
        "rad",
        -3.2,
        3.2,
        0.0,
        {"distribution": "Normal", "loc": 0.0, "scale": 0.05},
        f"turn of the frame that orientations are measured in, along {axis}",
    )
    for axis in "xyz"
)


@dataclass(frozen=True)
class Orientation(WhiteSeries):
    """Orientations of sections, unit quaternions (x, y, z, w) from the base's axes to the section's, side by side;
    columns are three turns [rad] of each section."""

    name: ClassVar[str] = "orientation"
    linear: ClassVar[bool] = False
    size: ClassVar[ParameterSpec] = ORIENTATION_NOISE
    sections: tuple[int, ...] = ()  # indices of the measured sections in the simulator

    @classmethod
    def gather(
        cls, simulator: Any, trajectories: Sequence[Trajectory], length: int, needed: int | None = None
    ) -> Orientation:
        """Orientations of recordings padded to ``length`` rows; only the first ``needed`` recordings must have them.

        Raises:
            InputError: a recording without orientations, other sections in some of them, or sections that the robot
                does not have.
        """
        known, named = tuple(getattr(simulator, "section_names", ())), None
        readings: list[np.ndarray] = []
        valid: list[np.ndarray] = []
        for index, trajectory in enumerate(trajectories):
            if trajectory.orientation is None:
                if needed is not None and index >= needed and readings:
                    readings.append(np.zeros_like(readings[0]))
                    valid.append(np.zeros_like(valid[0]))
                    continue
                remedy = "leave [model] orientation = true out, or record them"
                raise InputError("the recording has no orientations", where=trajectory.name, remedy=remedy)
            names = trajectory.section_names
            unknown = [name for name in names if name not in known]
            if unknown or names != (named or names):
                remedy = f"name sections of the robot's [[orientations]]: {', '.join(known) or 'it has none'}"
                words = f"has orientations of {', '.join(names)}"
                raise InputError(words, where=trajectory.name, remedy=remedy)
            named = names
            pose = np.full((length, len(names), 4), np.nan)
            pose[: len(trajectory.time)] = trajectory.orientation
            seen = np.isfinite(pose).all(axis=-1)
            readings.append(np.where(seen[..., None], pose, [0.0, 0.0, 0.0, 1.0]).reshape(length, -1))
            valid.append(np.repeat(seen, 3, axis=1))
        return cls(np.stack(readings), np.stack(valid), sections=tuple(known.index(name) for name in named or ()))

    @property
    def gain_specs(self) -> tuple[ParameterSpec, ...]:
        return FRAME_TURNS

    def expected(self, seen: Seen) -> Float[Any, "recording time reading"]:
        """See `Series.expected`.

        Raises:
            InputError: a simulator without section orientations.
        """
        simulated = seen.observation.orientation
        if simulated is None:
            raise InputError(
                "the simulator has no section orientations",
                where="[model] orientation",
                remedy="leave it out, or use a body that is a rod",
            )
        turn = jnp.stack([jnp.asarray(seen.values.get(spec.name, 0.0), float) for spec in FRAME_TURNS])
        turned = product(of_rotation_vector(turn), jnp.asarray(simulated)[:, :, list(self.sections)])
        return turned.reshape(*turned.shape[:2], -1)

    def deviation(
        self, measured: Float[Any, "recording time reading"], about: Float[Any, "recording time reading"]
    ) -> Float[Any, "recording time column"]:
        """See `Series.deviation`: turns in the measuring frame [rad]."""
        turns = turn_between(_quaternions(about), _quaternions(measured))
        return turns.reshape(*turns.shape[:2], -1)

    def mean(self, readings: Float[np.ndarray, "repeat time reading"], valid: Any) -> Float[np.ndarray, "time reading"]:
        """See `Series.mean`: of quaternions, which have two signs, the sum towards the first, of unit length."""
        turns = np.asarray(_quaternions(readings))
        used = np.where(np.asarray(valid)[..., ::3, None], turns, 0.0)
        same = np.sum(turns * turns[:1], axis=-1, keepdims=True) >= 0.0
        total = np.where(same, used, -used).sum(axis=0)
        size = np.linalg.norm(total, axis=-1, keepdims=True)
        mean = np.where(size > 0.0, total / np.maximum(size, 1e-12), [0.0, 0.0, 0.0, 1.0])
        return mean.reshape(readings.shape[1:])


def _quaternions(readings: Float[Any, "recording time reading"]) -> Float[Array, "recording time section 4"]:
    readings = jnp.asarray(readings)
    return readings.reshape(*readings.shape[:2], -1, 4)
