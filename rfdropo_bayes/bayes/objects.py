"""Measured poses of a pushed body: where contact took it, which the markers on the robot do not tell.

The body starts where its first pose shows it (`Placing.with_object_at`), and what is measured of it are its centre and
its turn since then. What the model misses of a push lasts, since a body at rest stays where it was left: the noise is
an Ornstein-Uhlenbeck process (`bayes.noise`) with its own sizes and its own correlation time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from rfdropo_bayes.bayes.noise import Noise, Timeline, draw_noise, timeline, whiten
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.parameters import ParameterSpec

OFFSETS = ("offset_x", "offset_y", "offset_z")
"""Parameters that shift what is measured against what is simulated [m]."""

LEVER = 0.02
"""[m] A turn counts among features as the way of points so far from the centre."""

OBJECT_NOISE = ParameterSpec(
    "object_noise",
    "m",
    1e-5,
    0.5,
    0.005,
    {"distribution": "LogNormal", "median": 0.005, "sigma": 1.0},
    "standard deviation of one coordinate of the pushed body's centre: what the model misses of a push",
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
    """A simulator whose object can be put where it was measured."""

    def with_object_at(self, values: Mapping[str, Any], pose: Any) -> dict[str, Any]:
        """Values with the start of the object taken from a measured pose: centre [m], quaternion (x, y, z, w)."""


class ObjectData(NamedTuple):
    """Measured poses of all recordings, padded like their markers.

    Attributes:
        measured: centre [m] and unit quaternion (x, y, z, w); zero where there is none.
        line: which rows have a pose, and which one came before, as of a single marker.
    """

    measured: Float[Any, "recording time 7"]
    line: Timeline


def object_specs(used: bool) -> tuple[ParameterSpec, ...]:
    """Parameters of the body's poses; none where they are not used."""
    return (OBJECT_NOISE, OBJECT_TURN_NOISE, OBJECT_CORRELATION_TIME) if used else ()


def gather_objects(simulator: object, trajectories: Sequence[Trajectory], length: int) -> ObjectData:
    """Poses of recordings padded to ``length`` rows.

    Raises:
        InputError: a simulator without a body to push, or a recording whose first pose is missing.
    """
    if not isinstance(simulator, Placing):
        raise InputError(
            "the simulator has no body whose pose could be measured",
            where="[model] object_pose",
            remedy="leave it out, or put the cube before the robot with push = true in [simulator]",
        )
    measured, lines = [], []
    for trajectory in trajectories:
        pose = np.full((length, 7), np.nan)
        if trajectory.object_pose is not None:
            pose[: len(trajectory.time)] = trajectory.object_pose
        seen = np.isfinite(pose).all(axis=1)
        if not seen[0]:
            raise InputError(
                "its first row has no pose of the pushed body",
                where=trajectory.name,
                remedy="leave [model] object_pose = true out, or start where the body is seen",
            )
        step = trajectory.dataset.attrs["sample_time"]
        tail = trajectory.time[-1] + step * np.arange(1, length - len(trajectory.time) + 1)
        lines.append(timeline(np.concatenate([trajectory.time, tail]), seen[:, None]))
        measured.append(np.where(seen[:, None], pose, 0.0))
    return ObjectData(np.stack(measured), Timeline(*(np.stack(part) for part in zip(*lines, strict=True))))


def offset_of(values: Mapping[str, Any]) -> Float[Array, "3"]:
    """Shift [m] of measured against simulated positions among the values of one rollout."""
    return jnp.stack([jnp.asarray(values.get(name, 0.0), float) for name in OFFSETS])


def object_residuals(
    simulated: Float[Array, "recording time 7"],
    offset: Float[Array, "recording 3"],
    values: Mapping[str, Any],
    data: ObjectData,
) -> tuple[Float[Array, "recording time 1 6"], Float[Array, "recording time"]]:
    """Unit-variance residuals of centre and turn, zero where there is no pose, and the log normaliser of each row."""
    tau = values[OBJECT_CORRELATION_TIME.name]
    measured = jnp.asarray(data.measured)
    centre = measured[..., :3] - simulated[..., :3] - offset[:, None]
    turned = _turn_between(_turn_since_start(simulated[..., 3:]), _turn_since_start(measured[..., 3:]))
    white, normaliser = [], jnp.zeros(data.line.valid.shape[:2])
    for left, size in ((centre, values[OBJECT_NOISE.name]), (turned, values[OBJECT_TURN_NOISE.name])):
        # A masked row must not reach the next one, nor make a NaN of a derivative.
        left = jnp.where(data.line.valid, left, 0.0)[:, :, None]
        own, scale = jax.vmap(lambda r, line, size=size: whiten(r, Noise(size, tau), line))(left, data.line)
        white.append(own)
        normaliser += 1.5 * jnp.log(2.0 * jnp.pi) + 3.0 * jnp.log(scale[:, :, 0])
    counted = data.line.valid[:, :, 0].copy()
    counted[:, 0] = False  # where the body starts is taken from it, and not predicted
    return jnp.where(counted[:, :, None, None], jnp.concatenate(white, axis=-1), 0.0), jnp.where(
        counted, normaliser, 0.0
    )


def object_log_density(
    simulated: Float[Array, "recording time 7"],
    offset: Float[Array, "recording 3"],
    values: Mapping[str, Any],
    data: ObjectData,
) -> Float[Array, " time"]:
    """Log density of each row's poses given those before, summed over recordings."""
    white, normaliser = object_residuals(simulated, offset, values, data)
    return jnp.sum(-0.5 * jnp.sum(white**2, axis=(2, 3)) - normaliser, axis=0)


def draw_object_error(
    key: PRNGKeyArray, pose: Float[Array, "time 7"], time: Float[Array, " time"], values: Mapping[str, Any]
) -> Float[Array, "time 7"]:
    """A body's poses with a realisation of the noise of centre and turn, of which there is none in the first row."""
    error = _error(key, time, values)
    half = 0.5 * jnp.linalg.norm(error[:, 1], axis=1, keepdims=True)
    turn = jnp.concatenate([0.5 * jnp.sinc(half / jnp.pi) * error[:, 1], jnp.cos(half)], axis=1)
    return jnp.concatenate([pose[:, :3] + error[:, 0], _product(turn, pose[:, 3:])], axis=1)


def object_features(pose: Float[Any, "recording time 7"]) -> Float[Array, "recording time 6"]:
    """Centre [m], and the turn since the start as the way of points at `LEVER` [m]."""
    pose = jnp.asarray(pose)
    turn = _turn_since_start(pose[..., 3:])
    none = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0]), turn.shape)
    return jnp.concatenate([pose[..., :3], LEVER * _turn_between(none, turn)], axis=-1)


def draw_feature_error(
    key: PRNGKeyArray, time: Float[Array, " time"], values: Mapping[str, Any]
) -> Float[Array, "time 6"]:
    """Noise of `object_features` [m], for turns much smaller than one."""
    error = _error(key, time, values)
    return jnp.concatenate([error[:, 0], LEVER * error[:, 1]], axis=1)


def feature_deviation(values: Mapping[str, Any]) -> Float[np.ndarray, "6"]:
    """Standard deviation of the noise of `object_features` [m], long after the start."""
    return np.repeat([values[OBJECT_NOISE.name], LEVER * values[OBJECT_TURN_NOISE.name]], 3)


def _error(key: PRNGKeyArray, time: Float[Array, " time"], values: Mapping[str, Any]) -> Float[Array, "time 2 3"]:
    """Noise of centre [m] and turn [rad].

    An Ornstein-Uhlenbeck process less its decaying start is the same process conditioned on starting at zero.
    """
    tau = values[OBJECT_CORRELATION_TIME.name]
    sizes = jnp.stack([values[OBJECT_NOISE.name], values[OBJECT_TURN_NOISE.name]])
    error = sizes[:, None] * draw_noise(key, time, 2, Noise(jnp.ones(()), tau))
    return error - jnp.exp(-(time - time[0]) / tau)[:, None, None] * error[0]


def _turn_since_start(q: Float[Array, "recording time 4"]) -> Float[Array, "recording time 4"]:
    return _product(q, _inverse(q[:, :1]))


def _turn_between(
    first: Float[Array, "recording time 4"], second: Float[Array, "recording time 4"]
) -> Float[Array, "recording time 3"]:
    """Twice the vector of the quaternion from one turn to another: of a small one the rotation vector [rad], and of a
    large one without a singularity."""
    between = _product(second, _inverse(first))
    return 2.0 * jnp.where(between[..., 3:] < 0.0, -1.0, 1.0) * between[..., :3]


def _inverse(q: Float[Array, "... 4"]) -> Float[Array, "... 4"]:
    return q * jnp.array([-1.0, -1.0, -1.0, 1.0])


def _product(a: Float[Array, "... 4"], b: Float[Array, "... 4"]) -> Float[Array, "... 4"]:
    """Quaternion product (x, y, z, w): first b, then a."""
    vector = a[..., 3:] * b[..., :3] + b[..., 3:] * a[..., :3] + jnp.cross(a[..., :3], b[..., :3])
    scalar = a[..., 3] * b[..., 3] - jnp.sum(a[..., :3] * b[..., :3], axis=-1)
    return jnp.concatenate([vector, scalar[..., None]], axis=-1)
