"""Data sets that a model makes itself: simulated from known parameters, with the noise that it assumes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import singledispatch
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from rfdropo_bayes.bayes.calibration_problem import CalibrationProblem
from rfdropo_bayes.bayes.channels import Channel, Markers, ObjectPose, Seen
from rfdropo_bayes.bayes.channels.channel import WhiteSeries
from rfdropo_bayes.bayes.channels.object_pose import LEVER, draw_object_error, object_error
from rfdropo_bayes.bayes.channels.orientation import Orientation
from rfdropo_bayes.bayes.channels.quaternions import of_rotation_vector, product
from rfdropo_bayes.bayes.channels.tension import Tension, reading_size
from rfdropo_bayes.bayes.channels.weighed import WeighedParts
from rfdropo_bayes.bayes.problem import RolloutProblem, Values
from rfdropo_bayes.bayes.trajectory_model import Measured


def simulated_data(problem: CalibrationProblem, truth: Mapping[str, float], key: PRNGKeyArray) -> Measured | None:
    """Simulated data under ``truth``, with the times, markers and faults of the problem's own data.

    Returns:
        None after a failed rollout.
    """
    observed = problem.observe({name: jnp.array([truth[name]]) for name in problem.names})
    if observed.status[0] != 0:
        return None
    single = jax.tree.map(lambda field: jnp.asarray(field[0]), observed)
    seen = problem.model.seen(single, {name: jnp.asarray(truth[name]) for name in problem.names})
    first, second, third = jax.random.split(key, 3)  # the order fixes the data sets of a seed
    keys = {"markers": jax.random.split(first, 1)[0], "tension": second, "weighed": third}
    keys |= {"motor_angle": jax.random.fold_in(key, 3), "object_pose": jax.random.fold_in(key, 4)}
    keys |= {"orientation": jax.random.fold_in(key, 5)}
    return {channel.name: np.asarray(drawn(channel, keys[channel.name], seen)) for channel in problem.model.channels}


def with_measured(problem: CalibrationProblem, measured: Measured) -> CalibrationProblem:
    """The same problem with other data."""
    return replace(problem, other=measured)


def drawn(channel: Channel, key: PRNGKeyArray, seen: Seen) -> Float[Any, "..."]:
    """A simulated measurement: the model's observation with a draw of the noise."""
    if isinstance(channel, WeighedParts):
        entries = channel.entries
        sums = jnp.stack(
            [jnp.asarray(sum(seen.values[name] for name in entry.parameters)) for entry in channel.entries]
        )
        deviations = np.array([entry.sd for entry in entries])
        return sums + deviations * jax.random.normal(key, deviations.shape)
    assert isinstance(channel, Markers | ObjectPose | WhiteSeries)
    clean = channel.expected(seen)
    if isinstance(channel, Markers):
        keys, time = jax.random.split(key, len(channel.readings)), jnp.asarray(channel.recordings.time)
        noise = jax.vmap(lambda k, t: channel.draw_noise(k, t, seen.values))(keys, time)
        return jnp.where(channel.recordings.line.valid[..., None], clean + noise, 0.0)
    if isinstance(channel, ObjectPose):
        with_error = jax.vmap(lambda k, p, t: draw_object_error(k, p, t, seen.values, channel.known))
        poses = with_error(jax.random.split(key, len(channel.readings)), clean, jnp.asarray(channel.time))
        return jnp.where(channel.line.valid, poses, 0.0)
    errors = _errors(channel, key, seen.values)
    if isinstance(channel, Orientation):
        turns = of_rotation_vector(errors.reshape(*errors.shape[:2], -1, 3))
        poses = jnp.asarray(clean).reshape(*errors.shape[:2], -1, 4)
        return product(turns, poses).reshape(channel.readings.shape)
    if isinstance(channel, Tension):
        errors = errors * reading_size(clean, channel.valid, clean)
    return jnp.where(channel.valid, clean + errors, 0.0)


def _errors(channel: WhiteSeries, key: PRNGKeyArray, values: Mapping[str, Any]) -> Float[Any, "recording time column"]:
    """Errors of a replica, in the unit of the noise."""
    if channel.known is None:
        return values[channel.size.name] * jax.random.normal(key, channel.valid.shape)
    count, rows = channel.valid.shape[:2]
    keys, known = jax.random.split(key, count), channel.known
    if known.paces is None or known.step is None:
        return jax.vmap(lambda k: known.draw_rows(k, rows))(keys)
    times = known.step * np.outer(known.paces, np.arange(rows))
    return jax.vmap(lambda k, time: known.draw_rows(k, rows, time))(keys, jnp.asarray(times))


@singledispatch
def noisy_rollouts(
    problem: RolloutProblem, key: PRNGKeyArray, values: Values
) -> tuple[Float[Any, "n n_rows feature"], Int[Any, " n"]]:
    """Features of all rows with observation noise; a problem without a noise model has none."""
    return problem.rollouts(values, problem.n_rows)


@noisy_rollouts.register
def _(
    problem: CalibrationProblem, key: PRNGKeyArray, values: Values
) -> tuple[Float[Any, "n n_rows feature"], Int[Any, " n"]]:
    features, status = problem.rollouts(values, problem.n_rows)
    count, recordings = len(features), problem.n_recordings
    parts = [problem.draw_noise(key, values).reshape(count, recordings, problem.n_rows, -1)]
    for index, channel in enumerate(problem.model.compared[1:], start=1):
        assert isinstance(channel, ObjectPose)

        def of_all(key: PRNGKeyArray, values: Mapping[str, Any], known: ObjectPose = channel) -> Any:
            given = {**problem.model.scopes.fixed, **values}

            def of_one(key: PRNGKeyArray, time: Any) -> Any:  # for turns much smaller than one
                error = object_error(key, time, given, known.known)
                return jnp.concatenate([error[:, 0], LEVER * error[:, 1]], axis=1)

            return jax.vmap(of_one)(jax.random.split(key, recordings), jnp.asarray(problem.model.recordings.time))

        inferred = {name: jnp.asarray(values[name]) for name in problem.names}
        keys = jax.random.split(jax.random.fold_in(key, index), count)
        parts.append(np.asarray(jax.vmap(of_all)(keys, inferred)))
    noise = np.concatenate(parts, axis=-1)
    return features + np.moveaxis(noise, 1, 2).reshape(features.shape), status


@singledispatch
def actions(problem: RolloutProblem) -> Float[np.ndarray, "n_rows action"]:
    """Commands in force at each row; none in general."""
    return np.zeros((problem.n_rows, 0))


@actions.register
def _(problem: CalibrationProblem) -> Float[np.ndarray, "n_rows action"]:
    """Those of all recordings side by side."""
    commands = problem.model.recordings.commands
    level = np.concatenate([np.asarray(commands.initial)[:, None], np.asarray(commands.step)], axis=1)
    index = np.minimum(np.asarray(commands.sample_step), level.shape[1] - 1)
    return np.concatenate([steps[rows] for steps, rows in zip(level, index, strict=True)], axis=1)
