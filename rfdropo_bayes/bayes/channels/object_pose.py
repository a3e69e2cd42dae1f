"""Measured poses of a pushed body: effects of contact that the robot's markers do not show.

The pushed body starts at its first measured pose (`Placing.with_object_at`). Channels are its centre and its rotation
since then.
Model errors of a push are correlated in time, since a body at rest keeps its pose: the noise is an Ornstein-Uhlenbeck
process (`bayes.noise`) with its own sizes and its own correlation time. If the noise of the positions is white, this
noise is also white, and `inference.modes.lasting` weights the rows: noise that lasts for the whole recording would also
absorb a wrong push.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from rfdropo_bayes.bayes.channels.channel import Seen, Series
from rfdropo_bayes.bayes.channels.quaternions import inverse, product, turn_between
from rfdropo_bayes.bayes.noise import Autoregression, Noise, Timeline, draw_noise, timeline, whiten
from rfdropo_bayes.bayes.noise.autoregression import STATED
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.parameters import ParameterSpec

OFFSETS = ("offset_x", "offset_y", "offset_z")  # parameters that shift measured against simulated positions [m]

LEVER = 0.02  # [m] Distance from the centre of the point whose path stands for a turn among the features

OBJECT_NOISE = ParameterSpec(
    "object_noise",
    "m",
    1e-5,
    0.5,
    0.005,
    {"distribution": "LogNormal", "median": 0.005, "sigma": 1.0},
    "standard deviation of one coordinate of the pushed body's centre: model error of a push",
)
OBJECT_TURN_NOISE = ParameterSpec(
    "object_turn_noise",
    "rad",
    1e-4,
    3.0,
    0.1,
    {"distribution": "LogNormal", "median": 0.1, "sigma": 1.0},
    "standard deviation of the pushed body's turn about one axis",
)
OBJECT_CORRELATION_TIME = ParameterSpec(
    "object_correlation_time",
    "s",
    1e-3,
    1e3,
    1.0,
    {"distribution": "LogNormal", "median": 1.0, "sigma": 1.0},
    "time over which the error of the pushed body's pose forgets its sign (Ornstein-Uhlenbeck)",
)


@runtime_checkable
class Placing(Protocol):
    """A simulator whose object can be placed at a measured pose.

    Attributes:
        pushes: whether the simulator has an object.
    """

    pushes: bool

    def with_object_at(self, values: Mapping[str, Any], pose: Any) -> dict[str, Any]:
        """Values with the start of the object taken from a measured pose: centre [m], quaternion (x, y, z, w)."""


@dataclass(frozen=True, kw_only=True)
class ObjectPose(Series):
    """Poses of the pushed body: centre [m] and unit quaternion (x, y, z, w); columns are centre and turn.

    The first pose is the start of the body and is not predicted.
    """

    name: ClassVar[str] = "object_pose"
    linear: ClassVar[bool] = False
    line: Timeline  # rows with a pose and their predecessors, as for a single marker
    time: Float[np.ndarray, "recording time"]  # observation times [s]
    lasting: bool = True  # whether its inferred noise is correlated in time

    @classmethod
    def gather(
        cls, simulator: object, trajectories: Sequence[Trajectory], length: int, lasting: bool = True
    ) -> ObjectPose:
        """Poses of recordings padded to ``length`` rows, under noise that lasts or white noise.

        Raises:
            InputError: a simulator without a body to push, or a recording whose first pose is missing.
        """
        if not isinstance(simulator, Placing) or not simulator.pushes:
            raise InputError(
                "the simulator has no body whose pose could be measured",
                where="[model] object_pose",
                remedy="leave it out, or put the cube before the robot with push = true in [simulator]",
            )
        measured, times, seen_rows = [], [], []
        for trajectory in trajectories:
            pose = np.full((length, 7), np.nan)
            if trajectory.object_pose is not None:
                pose[: len(trajectory.time)] = trajectory.object_pose
            seen = np.isfinite(pose).all(axis=1)
            if not seen[0]:
                raise InputError(
                    "the first row has no pose of the pushed body",
                    where=trajectory.name,
                    remedy="remove [model] object_pose = true, or start at a row in which the body is seen",
                )
            step = trajectory.dataset.attrs["sample_time"]
            tail = trajectory.time[-1] + step * np.arange(1, length - len(trajectory.time) + 1)
            times.append(np.concatenate([trajectory.time, tail]) - trajectory.time[0])
            seen_rows.append(seen)
            measured.append(np.where(seen[:, None], pose, 0.0))
        return cls.of(np.stack(measured), np.stack(seen_rows), np.stack(times), lasting)

    @classmethod
    def of(
        cls,
        pose: Float[np.ndarray, "recording time 7"],
        seen: Bool[np.ndarray, "recording time"],
        time: Float[np.ndarray, "recording time"],
        lasting: bool = True,
    ) -> ObjectPose:
        """Channel of poses at some times [s]; unseen poses do not count."""
        lines = [timeline(clock, rows[:, None]) for clock, rows in zip(time, seen, strict=True)]
        counted = seen.copy()
        counted[:, 0] = False
        line = Timeline(*(np.stack(part) for part in zip(*lines, strict=True)))
        return cls(pose, np.repeat(counted[..., None], 6, axis=-1), line=line, time=time, lasting=lasting)

    def of_recordings(self, index: list[int], rows: int | None = None) -> ObjectPose:
        line = Timeline(*(part[index, :rows] for part in self.line))
        readings, valid = self.readings[index, :rows], self.valid[index, :rows]
        time, known = self.time[index, :rows], self.known_of(index)
        return replace(self, readings=readings, valid=valid, known=known, line=line, time=time)

    @property
    def noise_specs(self) -> tuple[ParameterSpec, ...]:
        return (OBJECT_NOISE, OBJECT_TURN_NOISE, *([OBJECT_CORRELATION_TIME] if self.lasting else []))

    @property
    def independent(self) -> bool:
        return not self.lasting if self.known is None else super().independent

    def expected(self, seen: Seen) -> Float[Any, "recording time 7"]:
        """See `Series.expected`: in the measuring frame."""
        assert seen.observation.object_pose is not None
        return jnp.asarray(seen.observation.object_pose).at[..., :3].add(jnp.asarray(seen.offset)[:, None])

    def deviation(
        self, measured: Float[Any, "recording time 7"], about: Float[Any, "recording time 7"]
    ) -> Float[Any, "recording time 6"]:
        """See `Series.deviation`: way of the centre [m], and the turn [rad]."""
        measured, about = jnp.asarray(measured), jnp.asarray(about)
        turned = turn_between(_turn_since_start(about[..., 3:]), _turn_since_start(measured[..., 3:]))
        errors = jnp.concatenate([measured[..., :3] - about[..., :3], turned], axis=-1)
        # A masked row must not reach the next one, nor make a NaN of a derivative.
        return jnp.where(self.line.valid, errors, 0.0)

    def whiten_inferred(
        self, errors: Float[Any, "recording time 6"], values: Mapping[str, Any]
    ) -> tuple[Float[Any, "recording time 6"], Float[Any, "recording time 6"]]:
        """See `Series.whiten_inferred`: Ornstein-Uhlenbeck processes, or white noise."""
        parts, logarithms = [], []
        for part, spec in ((errors[..., :3], OBJECT_NOISE), (errors[..., 3:], OBJECT_TURN_NOISE)):
            noise = Noise(values[spec.name], values.get(OBJECT_CORRELATION_TIME.name))
            white, scale = jax.vmap(lambda r, line, noise=noise: whiten(r, noise, line))(part[:, :, None], self.line)
            parts.append(white[:, :, 0])
            logarithms.append(jnp.repeat(jnp.log(scale), 3, axis=-1))
        return jnp.where(self.valid, jnp.concatenate(parts, axis=-1), 0.0), jnp.concatenate(logarithms, axis=-1)

    def mean(
        self, readings: Float[np.ndarray, "repeat time 7"], valid: Bool[np.ndarray, "repeat time 6"]
    ) -> Float[np.ndarray, "time 7"]:
        """See `Series.mean`: of quaternions, which have two signs, the sum towards the first, of unit length."""
        seen = np.asarray(valid.any(axis=-1))
        seen[:, 0] = True
        used = np.where(seen[..., None], readings, 0.0)
        same = np.sum(used[..., 3:] * used[:1, :, 3:], axis=-1, keepdims=True) >= 0.0
        turn = np.where(same, used[..., 3:], -used[..., 3:]).sum(axis=0)
        turn = turn / np.maximum(np.linalg.norm(turn, axis=-1, keepdims=True), 1e-12)
        return np.concatenate([used[..., :3].sum(axis=0) / np.maximum(seen.sum(axis=0), 1)[:, None], turn], axis=-1)

    def stated(self, values: Mapping[str, float], step: float) -> Autoregression:
        sizes = np.repeat([values[OBJECT_NOISE.name], values[OBJECT_TURN_NOISE.name]], 3)
        tau = values.get(OBJECT_CORRELATION_TIME.name)
        memory = [] if tau is None else [float(np.exp(-step / tau))]
        return Autoregression(sizes, np.array([1.0, *memory]), STATED, np.inf, step=step)

    @property
    def feature_valid(self) -> Bool[np.ndarray, "recording time feature"]:
        return np.repeat(self.line.valid, 6, axis=-1)

    def features(self, readings: Float[Any, "recording time 7"]) -> Float[Any, "recording time feature"]:
        """See `FeatureChannel`: the centre, and the turn since the start as the way of points at `LEVER`."""
        readings = jnp.asarray(readings)
        turn = _turn_since_start(readings[..., 3:])
        none = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0]), turn.shape)
        return jnp.concatenate([readings[..., :3], LEVER * turn_between(none, turn)], axis=-1)

    def feature_deviation(self, values: Mapping[str, Any]) -> Float[np.ndarray, " feature"]:
        """See `FeatureChannel`: long after the start."""
        if self.known is not None:
            return self.known.scale * np.repeat([1.0, LEVER], 3)
        return np.repeat([values[OBJECT_NOISE.name], LEVER * values[OBJECT_TURN_NOISE.name]], 3)


def offset_of(values: Mapping[str, Any]) -> Float[Array, "3"]:
    """Shift [m] of measured against simulated positions among the values of one rollout."""
    return jnp.stack([jnp.asarray(values.get(name, 0.0), float) for name in OFFSETS])


def draw_object_error(
    key: PRNGKeyArray,
    pose: Float[Array, "time 7"],
    time: Float[Array, " time"],
    values: Mapping[str, Any],
    known: Autoregression | None = None,
) -> Float[Array, "time 7"]:
    """A body's poses with a realisation of the noise of centre and turn; the first row has no noise."""
    error = object_error(key, time, values, known)
    half = 0.5 * jnp.linalg.norm(error[:, 1], axis=1, keepdims=True)
    turn = jnp.concatenate([0.5 * jnp.sinc(half / jnp.pi) * error[:, 1], jnp.cos(half)], axis=1)
    return jnp.concatenate([pose[:, :3] + error[:, 0], product(turn, pose[:, 3:])], axis=1)


def object_error(
    key: PRNGKeyArray, time: Float[Array, " time"], values: Mapping[str, Any], known: Autoregression | None
) -> Float[Array, "time 2 3"]:
    """Noise of centre [m] and turn [rad].

    An Ornstein-Uhlenbeck process less its decaying start is the same process conditioned on starting at zero.
    """
    if known is not None:
        return known.draw_rows(key, len(time), time).at[0].set(0.0).reshape(-1, 2, 3)
    tau = values.get(OBJECT_CORRELATION_TIME.name)
    sizes = jnp.stack([values[OBJECT_NOISE.name], values[OBJECT_TURN_NOISE.name]])
    error = sizes[:, None] * draw_noise(key, time, 2, Noise(jnp.ones(()), tau))
    if tau is None:
        return error.at[0].set(0.0)
    return error - jnp.exp(-(time - time[0]) / tau)[:, None, None] * error[0]


def _turn_since_start(q: Float[Any, "recording time 4"]) -> Float[Any, "recording time 4"]:
    return product(q, inverse(q[:, :1]))
