"""The power-drive state machine of CiA 402 (IEC 61800-7-201, section 5): states, commands and transitions.

Master and simulated drive share this table, so that neither can know a state that the other does not. Nothing here
sends or receives: a master asks `controlword_towards`, a drive asks `obey`.
"""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import NamedTuple


class State(Enum):
    """States of a drive; the value is the (mask, pattern) of the statusword that shows it."""

    NOT_READY = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    READY_TO_SWITCH_ON = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    OPERATION_ENABLED = (0x6F, 0x27)
    QUICK_STOP_ACTIVE = (0x6F, 0x07)
    FAULT_REACTION = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)

    @property
    def words(self) -> str:
        """The state as a person writes it."""
        return self.name.lower().replace("_", " ")

    @property
    def powered(self) -> bool:
        """Whether the motor may push or hold in this state."""
        return self in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION)


class Command(IntEnum):
    """Controlwords that a master sends (object 0x6040)."""

    DISABLE_VOLTAGE = 0x00
    QUICK_STOP = 0x02
    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    ENABLE_OPERATION = 0x0F
    FAULT_RESET = 0x80


class Status(IntEnum):
    """Bits of the statusword (object 0x6041) beyond the state."""

    VOLTAGE_ENABLED = 1 << 4
    WARNING = 1 << 7
    REMOTE = 1 << 9
    LIMIT_ACTIVE = 1 << 11
    FOLLOWS_COMMAND = 1 << 12
    FOLLOWING_ERROR = 1 << 13


CYCLIC_SYNCHRONOUS_POSITION = 8
FAULT_RESET_BIT = 0x80


class Transition(NamedTuple):
    """One row of the table: its number in the standard, where from, where to."""

    number: int
    start: State
    end: State


TRANSITIONS = {
    row.number: row
    for row in (
        Transition(1, State.NOT_READY, State.SWITCH_ON_DISABLED),
        Transition(2, State.SWITCH_ON_DISABLED, State.READY_TO_SWITCH_ON),
        Transition(3, State.READY_TO_SWITCH_ON, State.SWITCHED_ON),
        Transition(4, State.SWITCHED_ON, State.OPERATION_ENABLED),
        Transition(5, State.OPERATION_ENABLED, State.SWITCHED_ON),
        Transition(6, State.SWITCHED_ON, State.READY_TO_SWITCH_ON),
        Transition(7, State.READY_TO_SWITCH_ON, State.SWITCH_ON_DISABLED),
        Transition(8, State.OPERATION_ENABLED, State.READY_TO_SWITCH_ON),
        Transition(9, State.OPERATION_ENABLED, State.SWITCH_ON_DISABLED),
        Transition(10, State.SWITCHED_ON, State.SWITCH_ON_DISABLED),
        Transition(11, State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE),
        Transition(12, State.QUICK_STOP_ACTIVE, State.SWITCH_ON_DISABLED),
        Transition(14, State.FAULT_REACTION, State.FAULT),
        Transition(15, State.FAULT, State.SWITCH_ON_DISABLED),
        Transition(16, State.QUICK_STOP_ACTIVE, State.OPERATION_ENABLED),
    )
}
"""All transitions but 0 (power on) and 13 (a fault, from every state)."""

_COMMANDED: dict[State, dict[Command, int]] = {
    State.SWITCH_ON_DISABLED: {Command.SHUTDOWN: 2},
    State.READY_TO_SWITCH_ON: {
        Command.SWITCH_ON: 3,
        Command.QUICK_STOP: 7,
        Command.DISABLE_VOLTAGE: 7,
    },
    State.SWITCHED_ON: {
        Command.ENABLE_OPERATION: 4,
        Command.SHUTDOWN: 6,
        Command.QUICK_STOP: 10,
        Command.DISABLE_VOLTAGE: 10,
    },
    State.OPERATION_ENABLED: {
        Command.SWITCH_ON: 5,
        Command.SHUTDOWN: 8,
        Command.DISABLE_VOLTAGE: 9,
        Command.QUICK_STOP: 11,
    },
    State.QUICK_STOP_ACTIVE: {Command.ENABLE_OPERATION: 16, Command.DISABLE_VOLTAGE: 12},
}

_PATTERNS = (
    (0x82, 0x00, Command.DISABLE_VOLTAGE),
    (0x86, 0x02, Command.QUICK_STOP),
    (0x87, 0x06, Command.SHUTDOWN),
    (0x8F, 0x07, Command.SWITCH_ON),
    (0x8F, 0x0F, Command.ENABLE_OPERATION),
)
"""Mask, pattern and meaning of controlwords without the fault reset bit."""


def state_of(statusword: int) -> State | None:
    """State that a statusword shows; None for a pattern that the standard does not know."""
    for state in State:
        mask, pattern = state.value
        if statusword & mask == pattern:
            return state
    return None


def command_of(controlword: int) -> Command | None:
    """Command that a controlword carries; the fault reset is an edge, hence no command of its own."""
    for mask, pattern, command in _PATTERNS:
        if controlword & mask == pattern:
            return command
    return None


def obey(state: State, controlword: int, previous: int) -> int | None:
    """Number of the transition that a controlword causes in a drive; None where it changes nothing.

    Args:
        state: of the drive.
        controlword, previous: the word now and the one before: a fault is reset by the rising edge of bit 7 alone.
    """
    if state is State.FAULT:
        rising = controlword & FAULT_RESET_BIT and not previous & FAULT_RESET_BIT
        return 15 if rising else None
    command = command_of(controlword)
    return None if command is None else _COMMANDED.get(state, {}).get(command)


_UPWARDS = {
    State.SWITCH_ON_DISABLED: Command.SHUTDOWN,
    State.READY_TO_SWITCH_ON: Command.SWITCH_ON,
    State.SWITCHED_ON: Command.ENABLE_OPERATION,
    State.OPERATION_ENABLED: Command.ENABLE_OPERATION,
}
_RANK = {state: rank for rank, state in enumerate(_UPWARDS)}
_KEEP = {
    State.SWITCH_ON_DISABLED: Command.DISABLE_VOLTAGE,
    State.READY_TO_SWITCH_ON: Command.SHUTDOWN,
    State.SWITCHED_ON: Command.SWITCH_ON,
    State.OPERATION_ENABLED: Command.ENABLE_OPERATION,
    State.QUICK_STOP_ACTIVE: Command.QUICK_STOP,
}


def controlword_towards(state: State, target: State, previous: int) -> int:
    """Controlword that brings a drive one step nearer to a state, or keeps it there.

    A drive in quick stop is brought to another state through SWITCH ON DISABLED: to go on moving from a stop is a
    decision of its own (transition 16). A fault is reset only on the way to another state than FAULT.

    Args:
        state: that the drive reports.
        target: SWITCH_ON_DISABLED, READY_TO_SWITCH_ON, SWITCHED_ON, OPERATION_ENABLED or QUICK_STOP_ACTIVE.
        previous: controlword sent last; after one with the fault reset bit the next leaves it out, so that it can rise.

    Raises:
        ValueError: if no command leads to ``target``.
    """
    if target not in _KEEP:
        raise ValueError(f"no command leads to {target.words}")
    if state is target:
        return int(_KEEP[target])
    if state is State.FAULT:
        return int(Command.DISABLE_VOLTAGE if previous & FAULT_RESET_BIT else Command.FAULT_RESET)
    if state in (State.NOT_READY, State.FAULT_REACTION):
        return int(Command.DISABLE_VOLTAGE)  # the drive leaves them by itself
    if target is State.QUICK_STOP_ACTIVE:
        return int(Command.QUICK_STOP)  # from lower states it leads to SWITCH ON DISABLED, where nothing moves either
    if state is State.QUICK_STOP_ACTIVE or target is State.SWITCH_ON_DISABLED:
        return int(Command.DISABLE_VOLTAGE)
    if _RANK[state] < _RANK[target]:
        return int(_UPWARDS[state])
    return int(_KEEP[target])
