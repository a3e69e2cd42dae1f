"""Interfaces of model extensions that act on a rollout; a simulator calls only their members.

A mechanism is nested: at its null value (the nominal value of its parameters) the extended simulator is the base
simulator exactly. The library of mechanisms lives one room above.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.commands import Commands
from rfdropo_bayes.simulators.parameters import ParameterSpec
from rfdropo_bayes.simulators.port_signals import BodySignals

Values = Mapping[str, Float[Array, ""]]

STAGES = ("actuation", "body", "contact", "sensing")
BODIES = ("rod", "tetrahedra")
ENGINES = ("jax", "numba")
MOTIONS = ("dynamic", "quasi-static")
BLACK_BOX = "black box"  # in the place of body and engine: a program whose inside nobody reaches


class Mechanism(Protocol):
    """A named physical effect on top of a base simulator.

    Attributes:
        name: registry name.
        stage: one of `STAGES`, which are in the order of their action on a rollout.
        parameters: parameters of the mechanism; nominal values are null values, except for parameters with a ``grid``.
            A null value that is a bound makes the effect one-sided.
        cause: one line on the physical cause.
        remedy: one line on the remedy in a laboratory.

    Three more are optional: ``bodies``, ``engines`` and ``motions``, the members of `BODIES`, `ENGINES` and `MOTIONS`
    that it supports; all by default.
    """

    name: str
    stage: str
    parameters: tuple[ParameterSpec, ...]
    cause: str
    remedy: str


@runtime_checkable
class ActuationMechanism(Mechanism, Protocol):
    """Acts on the command before it becomes a cable displacement.

    It may have an attribute ``inside_drive``, True by default: whether an encoder on the motor shows the effect.
    Effects behind the motor, in gears, spools and cables, have ``inside_drive = False``. It may have a method
    ``settle(values, constant)``: its output for a command that was constant long before the first step. By default, it
    is the command itself. The initial state of the body, and the ``initial`` of the next mechanism, belong to it.
    """

    def actuate(
        self, values: Values, command: Float[Array, "step channel"], initial: Float[Array, " channel"], time_step: float
    ) -> Float[Array, "step channel"]:
        """Return the command that reaches the cables at the end of each step, from the sent command."""


@runtime_checkable
class BodyMechanism(Mechanism, Protocol):
    """Acts on the body's material, masses and gravity."""

    def embody(self, values: Values, material: Any, body: Any) -> Any:
        """Return the material (`fem.Material`) of the extended body (`fem.Rod`), from the base material."""


@runtime_checkable
class SensingMechanism(Mechanism, Protocol):
    """Acts on measurements of the body's motion."""

    def sense(self, values: Values, position: Float[Array, "time marker 3"]) -> Float[Array, "time marker 3"]:
        """Return the measured marker positions [m], from the true positions."""


@runtime_checkable
class TimedSensingMechanism(Mechanism, Protocol):
    """Acts on measurements, with a memory or a clock."""

    def sense_over_time(
        self, values: Values, position: Float[Array, "time marker 3"], time: Float[Array, " time"]
    ) -> Float[Array, "time marker 3"]:
        """Return the measured marker positions [m], from the true positions and their times of observation [s]."""


class Meanwhile(NamedTuple):
    """Commands at the cables during a rollout."""

    levels: Float[Array, "row channel"]  # commands before the first step and at the end of every step [m or rad]
    commands: Commands  # commands, with the observed steps
    time_step: float  # time step [s]


@runtime_checkable
class CommandedSensingMechanism(Mechanism, Protocol):
    """Acts on measurements, depending on the commands."""

    def sense_with_commands(
        self, values: Values, position: Float[Array, "time marker 3"], time: Float[Array, " time"], meanwhile: Meanwhile
    ) -> Float[Array, "time marker 3"]:
        """Return the measured marker positions [m], from the true positions, their times of observation [s], and the
        commands at the cables.
        """


@runtime_checkable
class PushingMechanism(Mechanism, Protocol):
    """Acts on a rod from step to step, by time, by commands, and by the body's motion."""

    @property
    def follows_motion(self) -> bool:
        """Whether the mechanism depends on the motion of the body."""

    def push(
        self, values: Values, command: Float[Array, "row channel"], path: Float[Array, "row 3"] | None, time_step: float
    ) -> BodySignals:
        """Return the loads on the body; row 0 is before the first step.

        Args:
            values: parameters by name.
            command: command at the cables.
            path: path of the last marker in the base frame [m]; None for the part independent of motion.
            time_step: time step [s].
        """


@runtime_checkable
class SignallingMechanism(Mechanism, Protocol):
    """A mechanism for sessions that acts on the body, or on measurements depending on commands, by a signal w(t)
    computed step by step. Its steps give the same result as its form for whole rollouts.
    """

    @property
    def whole_only(self) -> str:
        """Reason why sessions do not support it; empty if they do."""

    def signal_before(self, values: Values, first: Float[Array, " channel"]) -> tuple[Any, Float[Array, ""]]:
        """Memory and signal before the first step, given the command that reaches the cables then."""

    def signal_after(
        self, values: Values, memory: Any, given: Float[Array, " channel"], time_step: float
    ) -> tuple[Any, Float[Array, ""]]:
        """Memory and signal at the end of a step [s], given the command that has reached the cables."""

    def carried(self, w: Float[Array, " row"], *seen: Any) -> Any:
        """Loads on the body under a signal; for sensing the marker positions [m], from ``seen``: positions without the
        signal (row, marker, 3) and their times [s].
        """


@runtime_checkable
class SteppedMechanism(Mechanism, Protocol):
    """A mechanism of actuation or sensing that can also act step by step in a session.

    For a mechanism of actuation a step is one of time, ``now`` is the time step [s], and ``first`` the command before
    the first step. For a mechanism of sensing a step is one observation, ``now`` its time [s], and ``first`` the first
    observation of the markers [m]; it is also shown. Its steps give the same result as its form for whole rollouts.
    """

    def begin(self, values: Values, first: Array, interval: float) -> Any:
        """Memory before the first step; ``interval`` [s] is the time between steps."""

    def advance(self, values: Values, memory: Any, given: Array, now: Any) -> tuple[Any, Array]:
        """Memory after a step, and the mechanism's output for its input."""


class SteppedActuation:
    """Base of mechanisms of actuation that are written as a step; a rollout scans it."""

    def begin(self, values: Values, first: Float[Array, " channel"], interval: float) -> Any:
        raise NotImplementedError

    def advance(
        self, values: Values, memory: Any, given: Float[Array, " channel"], now: float
    ) -> tuple[Any, Float[Array, " channel"]]:
        raise NotImplementedError

    def actuate(
        self, values: Values, command: Float[Array, "step channel"], initial: Float[Array, " channel"], time_step: float
    ) -> Float[Array, "step channel"]:
        """Return the command that reaches the cables at the end of each step, from the sent command."""
        memory = self.begin(values, jnp.asarray(initial, command.dtype), time_step)
        return jax.lax.scan(lambda kept, sent: self.advance(values, kept, sent, time_step), memory, command)[1]


class MemorylessActuation:
    """Base of mechanisms of actuation that depend on the present command only."""

    def reach(self, values: Values, sent: Float[Array, "*step channel"]) -> Float[Array, "*step channel"]:
        """Return the command that reaches the cables, from the sent command."""
        raise NotImplementedError

    def settle(self, values: Values, constant: Float[Array, " channel"]) -> Float[Array, " channel"]:
        return self.reach(values, constant)

    def begin(self, values: Values, first: Float[Array, " channel"], interval: float) -> tuple[()]:
        return ()

    def advance(
        self, values: Values, memory: tuple[()], given: Float[Array, " channel"], now: float
    ) -> tuple[tuple[()], Float[Array, " channel"]]:
        return memory, self.reach(values, given)

    def actuate(
        self, values: Values, command: Float[Array, "step channel"], initial: Float[Array, " channel"], time_step: float
    ) -> Float[Array, "step channel"]:
        """Return the command that reaches the cables at the end of each step, from the sent command."""
        return self.reach(values, command)


def settled(mechanism: Mechanism, values: Values, constant: Float[Array, " channel"]) -> Float[Array, " channel"]:
    """Output of a mechanism of actuation for a command that was constant long before the first step."""
    settle = getattr(mechanism, "settle", None)
    return constant if settle is None else settle(values, constant)


def inside_drive(mechanism: Mechanism) -> bool:
    """Whether an encoder on the motor shows the effect of a mechanism of actuation."""
    return bool(getattr(mechanism, "inside_drive", True))


def bodies_of(mechanism: Mechanism | type) -> tuple[str, ...]:
    """Kinds of body that a mechanism runs on."""
    return tuple(getattr(mechanism, "bodies", BODIES))


def engines_of(mechanism: Mechanism | type) -> tuple[str, ...]:
    """Engines that a mechanism runs on."""
    return tuple(getattr(mechanism, "engines", ENGINES))


def motions_of(mechanism: Mechanism | type) -> tuple[str, ...]:
    """Kinds of motion that a mechanism runs on."""
    return tuple(getattr(mechanism, "motions", MOTIONS))


def needs_cables(mechanism: Mechanism | type) -> bool:
    """Whether a mechanism acts on cables in the body."""
    return bool(getattr(mechanism, "needs_cables", False))


def needs_times(mechanism: Mechanism) -> bool:
    """Whether a parameter of a mechanism is a time or a rate."""
    return any("s" in re.findall(r"[A-Za-z]+", spec.unit) for spec in mechanism.parameters)


def obstacle(
    mechanism: Mechanism, body: str, engine: str, motion: str = MOTIONS[0], *, cables: bool = True, timed: bool = True
) -> str | None:
    """Why a mechanism does not run on a body with or without cables, on an engine or in a motion, or on rows with or
    without times; None if it runs.
    """
    if body == BLACK_BOX:
        return None if mechanism.stage in ("actuation", "sensing") else f"it acts on the {mechanism.stage}, inside"
    if body not in bodies_of(mechanism):
        return f"it acts on {' and '.join(bodies_of(mechanism))} bodies only"
    if needs_cables(mechanism) and not cables:
        return "it acts on cables, and the robot has none"
    if engine not in engines_of(mechanism):
        return f"it runs on the engine {' or '.join(engines_of(mechanism))} only"
    if not timed and needs_times(mechanism):
        return "it acts in time, and the rows have no times"
    if motion not in motions_of(mechanism):
        return f"it acts on a body in motion, and motion is {motion}"
    return None


def code_of(mechanisms: Iterable[Mechanism]) -> bytes:
    """Source files of mechanisms: their digests show whether the code of a name has changed."""
    sources: set[bytes] = set()
    for kind in {type(mechanism) for mechanism in mechanisms}:
        try:
            sources.add(Path(inspect.getfile(kind)).read_bytes())
        except (OSError, TypeError):  # written in a notebook or at a prompt
            sources.add(f"{kind.__module__}.{kind.__qualname__}".encode())
    return b"".join(sorted(sources))


def check_mechanisms(mechanisms: Iterable[Mechanism]) -> tuple[Mechanism, ...]:
    """Return the mechanisms as a tuple; InputError if one stands twice or two share a parameter."""
    chosen = tuple(mechanisms)
    owner: dict[str, str] = {}
    for mechanism in chosen:
        if mechanism.stage not in STAGES:
            raise InputError(
                f"mechanism {mechanism.name!r} has stage {mechanism.stage!r}", remedy=f"use one of {STAGES}"
            )
        for spec in mechanism.parameters:
            if spec.name in owner:
                raise InputError(
                    f"mechanisms {owner[spec.name]!r} and {mechanism.name!r} share the parameter {spec.name!r}",
                    remedy="list each mechanism once",
                )
            owner[spec.name] = mechanism.name
    return chosen
