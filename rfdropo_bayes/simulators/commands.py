"""Recorded commands on the simulator's clock."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.cable_drive import animated_commands

FEW_STEPS = 60_000  # ten minutes in steps of 10 ms: simulated however few the rows are, with a gigabyte or two
MOST_STEPS_PER_ROW = 200.0  # beyond these: two seconds a row in steps of 10 ms, whereas cameras see ten rows a second
UNITS = {
    1e3: '"ms" taken for "s", "us" for "ms" or "ns" for "us"',
    1e6: '"us" taken for "s" or "ns" for "ms"',
    1e9: '"ns" taken for "s"',
}
"""Units of time, by the factor by which they are finer than the assumed unit."""


class Commands(NamedTuple):
    """A command sequence on a simulator's clock, and when it is observed."""

    # command in force before the first step, to which the initial state belongs [m or rad]
    initial: Float[Array, "*batch channel"]
    step: Float[Array, "*batch step channel"]  # command reached at the end of each time step [m or rad]
    # last step that ends at or before each observation; 0 is the initial state. The first observation comes later if
    # earlier commands are known.
    sample_step: Int[Array, "*batch time"]
    sample_fraction: Float[Array, "*batch time"]  # position of the observation within the following step, in [0, 1)
    signals: Any = None  # further signals at the ports of the simulator (`ports.PortSignals`); None without signals

    def of(self, index: Sequence[int] | np.ndarray) -> Commands:
        """Some of a batch."""
        return _taken(self, index)


def commands_on_grid(
    time: Float[np.ndarray, " command"],
    value: Float[np.ndarray, "command channel"],
    initial: Float[np.ndarray, " channel"],
    observation_time: Float[np.ndarray, " time"],
    *,
    time_step: float,
    ramp: float = 0.0,
    dead_time: float = 0.0,
) -> Commands:
    """Sample a piecewise-constant command on steps of ``time_step``.

    ``value[k]`` is in force from ``time[k]`` on; a change is carried out linearly over ``ramp`` seconds (a moving
    average of the piecewise-constant signal, so that overlapping changes add up), ``dead_time`` seconds late. The clock
    starts at the first observation, or at the whole step before it that includes the first command.

    Args:
        time: time of each command [s], increasing.
        value: commands, cumulative [m or rad].
        initial: command in force before ``time[0]``.
        observation_time: times of the observations [s], increasing.

    Raises:
        InputError: times that are not finite or decrease, shapes that do not fit, or many more steps than rows.
    """
    time, value = np.asarray(time, float), np.asarray(value, float)
    observation_time = np.asarray(observation_time, float)
    if len(time) != len(value):
        raise InputError(f"{len(time)} command times for {len(value)} commands", remedy="give one time per command")
    if not len(observation_time):
        raise InputError("no observation", remedy="give at least one time")
    for name, clock in (("command", time), ("observation", observation_time)):
        if not np.all(np.isfinite(clock)):
            raise InputError(f"{name} time of row {int(np.argmax(~np.isfinite(clock)))} is not a number")
        if np.any(np.diff(clock) < 0):
            raise InputError(f"{name} times decrease at row {int(np.argmax(np.diff(clock) < 0)) + 1}")
    _check_steps(time, observation_time, time_step)
    before = _steps_before(time + dead_time if dead_time < 0.0 else time, observation_time, time_step)
    elapsed = before + (observation_time - observation_time[0]) / time_step
    # Observation clocks jitter by microseconds: an observation within 1e-6 of a step's end belongs to that step.
    sample_step = np.floor(elapsed + 1e-6).astype(np.int32)
    fraction = np.clip(elapsed - sample_step, 0.0, None)
    fraction[fraction < 1e-6] = 0.0
    n_steps = int(sample_step[-1]) + int(fraction[-1] > 0)
    end = observation_time[0] + time_step * (np.arange(1, n_steps + 1) - before) - dead_time
    return Commands(np.asarray(initial, float), _ramped(time, value, initial, end, ramp), sample_step, fraction)


def animated_on_grid(
    time: Float[np.ndarray, " command"],
    value: Float[np.ndarray, "command channel"],
    initial: Float[np.ndarray, " channel"],
    observation_time: Float[np.ndarray, " time"],
    *,
    time_step: float,
) -> Commands:
    """Hand every command over in equal updates, one a step until the next command, as SOFA's scene does.

    See `fem.drives.animated_commands`; otherwise as `commands_on_grid`.

    Raises:
        InputError: as `commands_on_grid`; or commands that are not evenly spaced, at least two steps apart, from the
            first observation on.
    """
    grid = commands_on_grid(time, value, initial, observation_time, time_step=time_step)
    before = _steps_before(time, observation_time, time_step)
    clock = before + (np.asarray(time, float) - observation_time[0]) / time_step
    start = np.round(clock).astype(int)
    every = int(start[1] - start[0]) if len(start) > 1 else len(grid.step)
    even = np.array_equal(start, every * np.arange(len(start))) and np.allclose(clock, start, atol=0.1)
    if len(start) == 0 or every < 2 or not even:
        raise InputError(
            "commands that are not evenly spaced from the first observation on cannot be animated",
            remedy='use drives = "robot" in [simulator.tetrahedra]',
        )
    changes = np.asarray(value, float) - np.asarray(initial, float)
    steps = animated_commands(changes, every, time_step).reshape(-1, changes.shape[1])
    length = len(grid.step)
    constant = _pad(steps, max(length, len(steps)))[:length]
    return grid._replace(step=grid.initial + constant)


def _check_steps(time: Float[np.ndarray, " command"], observation_time: np.ndarray, time_step: float) -> None:
    """Raise an InputError if the clocks require many more steps than rows, before memory is allocated."""
    start = min(observation_time[0], time[0]) if len(time) else observation_time[0]
    span, rows = float(observation_time[-1] - start), len(observation_time)
    steps = span / time_step
    if steps <= FEW_STEPS or steps <= MOST_STEPS_PER_ROW * rows:
        return
    gaps = np.diff(observation_time, prepend=start)
    row = int(np.argmax(gaps))
    if row == 0 and gaps[0] > 0.5 * span:
        remedy = f"the first command comes {gaps[0]:.4g} s before the first observation: give both on one clock"
    elif gaps[row] > 0.5 * span:
        remedy = f"{gaps[row]:.4g} s of it pass before row {row}: keep the rows on one side with rows = [first, last]"
    else:
        remedy = _finer_unit(float(np.median(gaps[1:])))
    raise InputError(
        f"{rows} rows over {span:.4g} s would be {steps:.3g} steps of {1e3 * time_step:g} ms, {steps / rows:.3g} a row",
        remedy=remedy,
    )


def _finer_unit(interval: float) -> str:
    """Remedy for an implausible interval between rows."""
    finer = [factor for factor in UNITS if interval / factor < 1.0]  # rows come more often than once in a second
    factor = finer[0] if finer else max(UNITS)
    return (
        f"the times look like {UNITS[factor]}, with rows {1e3 * interval / factor:.4g} ms apart: correct time_unit "
        "under [data.columns], or the times that were given"
    )


def _steps_before(time: Float[np.ndarray, " command"], observation_time: np.ndarray, time_step: float) -> int:
    """Steps from the first command to the first observation, if that comes later."""
    earlier = observation_time[0] - time[0] if len(time) else 0.0
    return max(0, int(np.ceil(earlier / time_step - 1e-6)))


def _ramped(
    time: Float[np.ndarray, " command"],
    value: Float[np.ndarray, "command channel"],
    initial: Float[np.ndarray, " channel"],
    at: Float[np.ndarray, " step"],
    ramp: float,
) -> Float[np.ndarray, "step channel"]:
    """The piecewise-constant command averaged over the last ``ramp`` seconds before each of ``at``."""
    given = np.concatenate([[-np.inf], time])
    levels = np.vstack([initial, value])
    # Commands before the first command in force count as carried out, so one more or less makes no difference.
    first = np.maximum(np.searchsorted(given, at - ramp, side="right") - 2, 0)
    last = np.searchsorted(given, at, side="right")
    window = np.minimum(first[:, None] + np.arange(np.max(last - first, initial=0) + 1), len(given) - 1)
    return carried_out(given[window], levels[window], at, ramp)


def carried_out(
    given: Float[np.ndarray, "*step command"],
    value: Float[np.ndarray, "*step command channel"],
    at: Float[np.ndarray, "*step"],
    ramp: float,
) -> Float[np.ndarray, "*step channel"]:
    """Position of a drive that carries out every change linearly over ``ramp`` seconds.

    Args:
        given: times of the last commands before each of ``at`` [s], in order; repeated and later commands have no
            effect. The first command must be completed.
        value: cumulative commands at these times [m or rad].
        at: times [s].
        ramp: 0 carries a command out at once: a command given at the start of a step acts during it.
    """
    reached = value[..., 0, :]
    for k in range(1, given.shape[-1]):
        elapsed = at - given[..., k]
        if ramp > 0.0:
            share = np.clip(elapsed / ramp, 0.0, 1.0)
        else:  # rounding must not postpone a command to the next step
            share = np.where(elapsed > 1e-9 * np.maximum(1.0, np.abs(at)), 1.0, 0.0)
        share = share[..., None]
        reached = np.where(share < 1.0, reached + share * (value[..., k, :] - value[..., k - 1, :]), value[..., k, :])
    return reached


def stack_commands(sequences: Sequence[Commands]) -> Commands:
    """Pad command sequences to one length and stack them along a leading axis.

    A shorter sequence holds its last command; the padded observations repeat its last observation, and the caller masks
    them.
    """
    steps = max(len(item.step) for item in sequences)
    rows = max(len(item.sample_step) for item in sequences)
    return Commands(
        np.stack([item.initial for item in sequences]),
        np.stack([_pad(item.step if len(item.step) else item.initial[None], steps) for item in sequences]),
        np.stack([_pad(item.sample_step, rows) for item in sequences]),
        np.stack([_pad(item.sample_fraction, rows) for item in sequences]),
    )


def _taken(part: Any, index: Any) -> Any:
    """Some rows of an array, of all arrays of a named tuple, or nothing of nothing."""
    if isinstance(part, tuple):
        return type(part)(*(_taken(own, index) for own in part))
    return None if part is None else np.asarray(part)[index]


def _pad(array: np.ndarray, length: int) -> np.ndarray:
    return np.concatenate([array, np.repeat(array[-1:], length - len(array), axis=0)])


def observed_at(commands: Commands, time_step: float) -> Float[Array, " time"]:
    """When the observations were made [s], on the simulator's clock."""
    return time_step * (commands.sample_step + commands.sample_fraction)


def sample(series: Float[Array, "steps ..."], commands: Commands) -> Float[Array, "time ..."]:
    """Read a per-step series (row 0 = initial state) at the observation times, linearly within a step."""
    import jax.numpy as jnp

    before = series[commands.sample_step]
    after = series[jnp.minimum(commands.sample_step + 1, series.shape[0] - 1)]
    weight = commands.sample_fraction.reshape((-1,) + (1,) * (series.ndim - 1))
    return before + weight * (after - before)
