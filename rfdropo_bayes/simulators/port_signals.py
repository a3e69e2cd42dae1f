"""Ports: the places at which signals over time may act on a rollout, beside its commands and its parameters.

A port of actuation changes the commands at the cables, a port of the body its loads. Signals that are absent cost
nothing; signals of zeros change nothing. Measurements also have ports, but these are maps of simulated markers and need
no rollout (see `mechanisms.laws`).
"""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Array, Float


class BodySignals(NamedTuple):
    """Loads on a rod that change from step to step, see `fem.section_loads`; forces at the engine's stations."""

    force: Float[Array, "*batch row place 3"]  # [N]
    stiffness: Float[Array, "*batch row"]  # logarithm of a factor
    damping: Float[Array, "*batch row"]  # logarithm of a factor on both of Rayleigh's coefficients
    gravity: Float[Array, "*batch row 3"]  # added to gravity [m/s2]


class PortSignals(NamedTuple):
    """Signals at the ports of a simulator; row 0 belongs to the initial state, row k to the end of step k."""

    command: Float[Array, "*batch row channel"]  # added to the commands that reach the cables [m or rad]
    delay: Float[Array, "*batch row"]  # delay of commands at the cables [s]
    body: BodySignals | None = None  # loads on the body; None without loads


def reached(
    signals: PortSignals, initial: Float[Array, " channel"], command: Float[Array, "step channel"], time_step: float
) -> tuple[Float[Array, " channel"], Float[Array, "step channel"]]:
    """Commands that reach the cables before the first step and at the end of each, from commands without signals."""
    import jax.numpy as jnp

    late = read_late(jnp.concatenate([initial[None], command]), signals.delay / time_step) + signals.command
    return late[0], late[1:]


def read_late(levels: Float[Array, "row channel"], late: Float[Array, " row"]) -> Float[Array, "row channel"]:
    """Levels ``late`` rows earlier, linear between rows, constant beyond the ends."""
    import jax.numpy as jnp

    last = len(levels) - 1
    at = jnp.arange(len(levels)) - late
    # Whole rows count as the later end of an interval: without a delay its slope is the past interval's.
    after = jnp.clip(jnp.ceil(at), 0, last).astype(int)
    weight = jnp.where((at > 0) & (at <= last), after - at, 0.0)[:, None]
    newer = levels[after]
    return newer - weight * (newer - levels[jnp.maximum(after - 1, 0)])
