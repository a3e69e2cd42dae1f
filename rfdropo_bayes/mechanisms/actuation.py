"""Mechanisms between the command that was sent and the displacement that reaches the cables."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.simulators.mechanisms import Values
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
        at = jnp.arange(1, len(history)) - values["command_delay"] / time_step
        # Interpolating towards the past keeps the derivative right at zero delay, where only later times count.
        after = jnp.clip(jnp.ceil(at), 0, len(command)).astype(int)
        before = jnp.maximum(after - 1, 0)
        weight = jnp.where(at > 0, after - at, 0.0)[:, None]
        return history[after] - weight * (history[after] - history[before])


class ActuatorLag:
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

    def actuate(
        self, values: Values, command: Float[Array, "step channel"], initial: Float[Array, " channel"], time_step: float
    ) -> Float[Array, "step channel"]:
        """Filter the command, starting from rest at its initial value."""
        kept = kept_over(time_step, values["actuator_lag"])

        def advance(last: Array, sent: Array) -> tuple[Array, Array]:
            reached = sent + kept * (last - sent)
            return reached, reached

        return jax.lax.scan(advance, jnp.asarray(initial, command.dtype), command)[1]


class CommandGain:
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

    def actuate(
        self, values: Values, command: Float[Array, "step channel"], initial: Float[Array, " channel"], time_step: float
    ) -> Float[Array, "step channel"]:
        """Scale the displacement from the initial command, to which the initial state belongs."""
        return initial + (1.0 + values["command_gain_error"]) * (command - initial)
