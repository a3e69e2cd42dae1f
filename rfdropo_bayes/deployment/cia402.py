"""The power-drive state machine of CiA 402 (IEC 61800-7-201, section 5): states, commands and transitions.

Master and simulated drive share this table, so that both have the same states. Nothing here
sends or receives: a master asks `controlword_towards`, a drive asks `obey`.
"""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import NamedTuple


class DriveState(Enum):
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
        return self in (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE, DriveState.FAULT_REACTION)


class Controlword(IntEnum):
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
    REMOTE = 1 << 9
    LIMIT_ACTIVE = 1 << 11
    FOLLOWS_COMMAND = 1 << 12
    FOLLOWING_ERROR = 1 << 13


CYCLIC_SYNCHRONOUS_POSITION = 8
FAULT_RESET_BIT = 0x80


class Transition(NamedTuple):
    """One row of the table: number in the standard, source state, target state."""

    number: int
    start: DriveState
    end: DriveState


TRANSITIONS = {
    row.number: row
    for row in (
        Transition(1, DriveState.NOT_READY, DriveState.SWITCH_ON_DISABLED),
        Transition(2, DriveState.SWITCH_ON_DISABLED, DriveState.READY_TO_SWITCH_ON),
        Transition(3, DriveState.READY_TO_SWITCH_ON, DriveState.SWITCHED_ON),
        Transition(4, DriveState.SWITCHED_ON, DriveState.OPERATION_ENABLED),
        Transition(5, DriveState.OPERATION_ENABLED, DriveState.SWITCHED_ON),
        Transition(6, DriveState.SWITCHED_ON, DriveState.READY_TO_SWITCH_ON),
        Transition(7, DriveState.READY_TO_SWITCH_ON, DriveState.SWITCH_ON_DISABLED),
        Transition(8, DriveState.OPERATION_ENABLED, DriveState.READY_TO_SWITCH_ON),
        Transition(9, DriveState.OPERATION_ENABLED, DriveState.SWITCH_ON_DISABLED),
        Transition(10, DriveState.SWITCHED_ON, DriveState.SWITCH_ON_DISABLED),
        Transition(11, DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE),
        Transition(12, DriveState.QUICK_STOP_ACTIVE, DriveState.SWITCH_ON_DISABLED),
        Transition(14, DriveState.FAULT_REACTION, DriveState.FAULT),
        Transition(15, DriveState.FAULT, DriveState.SWITCH_ON_DISABLED),
        Transition(16, DriveState.QUICK_STOP_ACTIVE, DriveState.OPERATION_ENABLED),
    )
}
"""All transitions but 0 (power on) and 13 (a fault, from every state)."""

_COMMANDED: dict[DriveState, dict[Controlword, int]] = {
    DriveState.SWITCH_ON_DISABLED: {Controlword.SHUTDOWN: 2},
    DriveState.READY_TO_SWITCH_ON: {
        Controlword.SWITCH_ON: 3,
        Controlword.QUICK_STOP: 7,
        Controlword.DISABLE_VOLTAGE: 7,
    },
    DriveState.SWITCHED_ON: {
        Controlword.ENABLE_OPERATION: 4,
        Controlword.SHUTDOWN: 6,
        Controlword.QUICK_STOP: 10,
        Controlword.DISABLE_VOLTAGE: 10,
    },
    DriveState.OPERATION_ENABLED: {
        Controlword.SWITCH_ON: 5,
        Controlword.SHUTDOWN: 8,
        Controlword.DISABLE_VOLTAGE: 9,
        Controlword.QUICK_STOP: 11,
    },
    DriveState.QUICK_STOP_ACTIVE: {Controlword.ENABLE_OPERATION: 16, Controlword.DISABLE_VOLTAGE: 12},
}

_PATTERNS = (
    (0x82, 0x00, Controlword.DISABLE_VOLTAGE),
    (0x86, 0x02, Controlword.QUICK_STOP),
    (0x87, 0x06, Controlword.SHUTDOWN),
    (0x8F, 0x07, Controlword.SWITCH_ON),
    (0x8F, 0x0F, Controlword.ENABLE_OPERATION),
)
"""Mask, pattern and meaning of controlwords without the fault reset bit."""


def state_of(statusword: int) -> DriveState | None:
    """State that a statusword shows; None for a pattern outside the standard."""
    for state in DriveState:
        mask, pattern = state.value
        if statusword & mask == pattern:
            return state
    return None


def command_of(controlword: int) -> Controlword | None:
    """Command that a controlword carries; the fault reset is an edge, hence no command of its own."""
    for mask, pattern, command in _PATTERNS:
        if controlword & mask == pattern:
            return command
    return None


def obey(state: DriveState, controlword: int, previous: int) -> int | None:
    """Number of the transition that a controlword causes in a drive; None if it changes nothing.

    Args:
        state: state of the drive.
        controlword, previous: the present and the previous word: a fault is reset by the rising edge of bit 7 alone.
    """
    if state is DriveState.FAULT:
        rising = controlword & FAULT_RESET_BIT and not previous & FAULT_RESET_BIT
        return 15 if rising else None
    command = command_of(controlword)
    return None if command is None else _COMMANDED.get(state, {}).get(command)


_UPWARDS = {
    DriveState.SWITCH_ON_DISABLED: Controlword.SHUTDOWN,
    DriveState.READY_TO_SWITCH_ON: Controlword.SWITCH_ON,
    DriveState.SWITCHED_ON: Controlword.ENABLE_OPERATION,
    DriveState.OPERATION_ENABLED: Controlword.ENABLE_OPERATION,
}
_RANK = {state: rank for rank, state in enumerate(_UPWARDS)}
_KEEP = {
    DriveState.SWITCH_ON_DISABLED: Controlword.DISABLE_VOLTAGE,
    DriveState.READY_TO_SWITCH_ON: Controlword.SHUTDOWN,
    DriveState.SWITCHED_ON: Controlword.SWITCH_ON,
    DriveState.OPERATION_ENABLED: Controlword.ENABLE_OPERATION,
    DriveState.QUICK_STOP_ACTIVE: Controlword.QUICK_STOP,
}


def controlword_towards(state: DriveState, target: DriveState, previous: int) -> int:
    """Controlword that brings a drive one step nearer to a state, or keeps it there.

    A drive leaves quick stop only through SWITCH ON DISABLED; transition 16, which continues directly, is not used. A
    fault is reset only on the way to another state than FAULT.

    Args:
        state: state that the drive reports.
        target: SWITCH_ON_DISABLED, READY_TO_SWITCH_ON, SWITCHED_ON, OPERATION_ENABLED or QUICK_STOP_ACTIVE.
        previous: controlword sent last; the fault reset bit is cleared after each use, so that it can rise again.

    Raises:
        ValueError: if no command leads to ``target``.
    """
    if target not in _KEEP:
        raise ValueError(f"no command leads to {target.words}")
    if state is target:
        return int(_KEEP[target])
    if state is DriveState.FAULT:
        return int(Controlword.DISABLE_VOLTAGE if previous & FAULT_RESET_BIT else Controlword.FAULT_RESET)
    if state in (DriveState.NOT_READY, DriveState.FAULT_REACTION):
        return int(Controlword.DISABLE_VOLTAGE)  # the drive leaves them by itself
    if target is DriveState.QUICK_STOP_ACTIVE:
        return int(
            Controlword.QUICK_STOP
        )  # from lower states it leads to SWITCH ON DISABLED, in which nothing moves either
    if state is DriveState.QUICK_STOP_ACTIVE or target is DriveState.SWITCH_ON_DISABLED:
        return int(Controlword.DISABLE_VOLTAGE)
    if _RANK[state] < _RANK[target]:
        return int(_UPWARDS[state])
    return int(_KEEP[target])
