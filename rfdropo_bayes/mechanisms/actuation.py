"""Mechanisms between the command that was sent and the displacement that reaches the cables."""

from __future__ import annotations

import math
from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rfdropo_bayes.simulators.mechanisms import MemorylessActuation, SteppedActuation, Values
from rfdropo_bayes.simulators.parameters import ParameterSpec


def kept_over(time_step: float, time_constant: Float[Array, ""]) -> Float[Array, ""]:
    """Share of a first-order filter's distance from a held input that is left after a step; none at tau = 0."""
    memory = time_constant > 1e-3 * time_step  # exp(-1000) is zero in any precision
    return jnp.where(memory, jnp.exp(-time_step / jnp.where(memory, time_constant, 1.0)), 0.0)


class CommandDelay:
    """Pure transport delay: the command acts ``command_delay`` seconds late; zero is the base simulator."""

    name = "command_delay"
    stage = "actuation"
    inside_drive = True
    cause = "communication and drive latency"
    remedy = "stamp commands where they are executed, or shift the clock by this much"
    parameters = (
        ParameterSpec(
            "command_delay", "s", 0.0, 2.0, 0.0, {"distribution": "HalfNormal", "scale": 0.1}, "delay of every command"
        ),
    )

    def actuate(
        self, values: Values, command: Float[Array, "step channel"], initial: Float[Array, " channel"], time_step: float
    ) -> Float[Array, "step channel"]:
        """Read the command ``command_delay`` earlier, linearly between steps."""
        history = jnp.concatenate([initial[None], command])
        late = values["command_delay"] / time_step
        return _read_late(jnp.arange(1, len(history)), late, lambda step: history[step])

    def begin(self, values: Values, first: Float[Array, " channel"], interval: float) -> tuple[Array, Array]:
        """Commands of the last steps, as far back as a delay may reach, and the number of steps."""
        steps = math.ceil(self.parameters[0].high / interval) + 2
        return jnp.broadcast_to(first, (steps, *first.shape)), jnp.zeros((), int)

    def advance(
        self, values: Values, memory: tuple[Array, Array], given: Float[Array, " channel"], now: float
    ) -> tuple[tuple[Array, Array], Float[Array, " channel"]]:
        """Read the command ``command_delay`` earlier; the oldest one is overwritten."""
        last, step = memory[0], memory[1] + 1
        last = last.at[step % len(last)].set(given)
        reached = _read_late(step, values["command_delay"] / now, lambda at: last[at % len(last)])
        return (last, step), reached


def _read_late(
    step: Int[Array, "*step"],
    late: Float[Array, ""],
    read: Callable[[Int[Array, "*step"]], Float[Array, "*step channel"]],
) -> Float[Array, "*step channel"]:
    """What ``read`` gives so many steps earlier, 0 at the earliest, linearly between steps."""
    at = step - late
    # Interpolating towards the past keeps the derivative right at zero delay, where only later times count.
    after = jnp.maximum(jnp.ceil(at), 0).astype(int)
    weight = jnp.where(at > 0, after - at, 0.0)[..., None]
    newer = read(after)
    return newer - weight * (newer - read(jnp.maximum(after - 1, 0)))


class ActuatorLag(SteppedActuation):
    """First-order lag of the drives, ``tau y' = u - y`` with u held over each step; tau = 0 is the base simulator.

    A lag much shorter than a time step changes nothing that can be seen: the derivative at tau = 0 is zero.
    """

    name = "actuator_lag"
    stage = "actuation"
    inside_drive = True
    cause = "bandwidth of the position loop of the drives"
    remedy = "stiffen the position loop, or keep the lag in the model"
    parameters = (
        ParameterSpec(
            "actuator_lag", "s", 0.0, 5.0, 0.0, {"distribution": "HalfNormal", "scale": 0.2}, "time constant of the lag"
        ),
    )

    def begin(self, values: Values, first: Float[Array, " channel"], interval: float) -> Float[Array, " channel"]:
        """Where the drives stand."""
        return first

    def advance(
        self, values: Values, memory: Float[Array, " channel"], given: Float[Array, " channel"], now: float
    ) -> tuple[Float[Array, " channel"], Float[Array, " channel"]]:
        """Follow the command, starting from rest at its initial value."""
        reached = given + kept_over(now, values["actuator_lag"]) * (memory - given)
        return reached, reached


class CommandGain(MemorylessActuation):
    """All commands scaled by ``1 + command_gain_error``; zero is the base simulator."""

    name = "command_gain"
    stage = "actuation"
    inside_drive = True
    cause = "wrong spool radius or transmission ratio, or cable stretch proportional to travel"
    remedy = "measure the cable travel of one motor turn"
    parameters = (
        ParameterSpec(
            "command_gain_error",
            "-",
            -0.9,
            2.0,
            0.0,
            {"distribution": "Normal", "loc": 0.0, "scale": 0.2},
            "relative error of the commanded displacement",
        ),
    )

    def reach(self, values: Values, sent: Float[Array, "*step channel"]) -> Float[Array, "*step channel"]:
        """Scale the whole command."""
        return (1.0 + values["command_gain_error"]) * sent
