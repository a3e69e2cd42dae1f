"""The state machine of CiA 402 against the table of the standard."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfdropo_bayes.deployment.cia402 import (
    TRANSITIONS,
    Controlword,
    DriveState,
    command_of,
    controlword_towards,
    obey,
    state_of,
)

N, D, R, S = DriveState.NOT_READY, DriveState.SWITCH_ON_DISABLED, DriveState.READY_TO_SWITCH_ON, DriveState.SWITCHED_ON
E, Q, A, F = DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE, DriveState.FAULT_REACTION, DriveState.FAULT

# IEC 61800-7-201, figure 6 and table 4: for each state, where each command leads (None: it stays).
TABLE = {
    #   disable voltage, quick stop, shutdown, switch on, enable operation
    N: (None, None, None, None, None),
    D: (None, None, 2, None, None),
    R: (7, 7, None, 3, None),
    S: (10, 10, 6, None, 4),
    E: (9, 11, 8, 5, None),
    Q: (12, None, None, None, 16),
    A: (None, None, None, None, None),
    F: (None, None, None, None, None),
}
COMMANDS = (
    Controlword.DISABLE_VOLTAGE,
    Controlword.QUICK_STOP,
    Controlword.SHUTDOWN,
    Controlword.SWITCH_ON,
    Controlword.ENABLE_OPERATION,
)
CASES = [(state, command, row[place]) for state, row in TABLE.items() for place, command in enumerate(COMMANDS)]


@pytest.mark.parametrize(("state", "command", "number"), CASES, ids=lambda value: getattr(value, "name", str(value)))
@pytest.mark.parametrize("others", [0x0000, 0xFF70 & ~0x80])
def test_every_command_from_every_state(
    state: DriveState, command: Controlword, number: int | None, others: int
) -> None:
    """Bits that are no part of a command change nothing."""
    assert obey(state, command | others, previous=0) == number
    if number is not None:
        assert TRANSITIONS[number].start is state


def test_every_transition_of_the_table_is_reached() -> None:
    commanded = {number for _, _, number in CASES if number} | {15}
    assert commanded | {1, 14} == set(TRANSITIONS)  # the drive makes 1 and 14 by itself


@pytest.mark.parametrize(
    ("previous", "word", "number"),
    [
        (0x00, 0x80, 15),
        (0x80, 0x80, None),
        (0x80, 0x00, None),
        (0x0F, 0x8F, 15),
        (0x8F, 0x8F, None),
        (0x00, 0x0F, None),
    ],
)
def test_only_the_rising_edge_resets_a_fault(previous: int, word: int, number: int | None) -> None:
    assert obey(F, word, previous) == number


@pytest.mark.parametrize("state", [state for state in DriveState if state is not F])
def test_the_fault_reset_bit_does_nothing_in_other_states(state: DriveState) -> None:
    assert obey(state, 0x80, 0) is None


STATUSWORDS = [
    (0x0000, N), (0x0010, N), (0x0040, D), (0x0060, D), (0x0021, R), (0x0031, R), (0x0023, S), (0x0033, S),
    (0x0027, E), (0x0037, E), (0x1637, E), (0x0007, Q), (0x0017, Q), (0x000F, A), (0x002F, A), (0x0008, F), (0x0028, F),
]  # fmt: skip


@pytest.mark.parametrize(("word", "state"), STATUSWORDS)
def test_statuswords_with_and_without_other_bits(word: int, state: DriveState) -> None:
    assert state_of(word) is state
    assert state_of(word | 0xFF80) is state


def test_no_statusword_means_two_states() -> None:
    for word in range(0x80):
        fits = [state for state in DriveState if word & state.value[0] == state.value[1]]
        assert len(fits) <= 1


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_are_recognised(command: Controlword) -> None:
    assert command_of(command) is command


@given(
    state=st.sampled_from([state for state in DriveState if state not in (N, A)]),
    target=st.sampled_from([D, R, S, E]),
    previous=st.integers(0, 0xFFFF),
)
def test_a_master_reaches_every_state_from_every_other(state: DriveState, target: DriveState, previous: int) -> None:
    """Within eight words, through the table alone, whatever was sent before; a fault included."""
    for _ in range(8):
        word = controlword_towards(state, target, previous)
        number = obey(state, word, previous)
        state, previous = state if number is None else TRANSITIONS[number].end, word
    assert state is target


@pytest.mark.parametrize("state", list(DriveState))
def test_a_quick_stop_ends_where_nothing_is_driven(state: DriveState) -> None:
    """From every state; a fault is not reset on the way."""
    start, previous = state, 0
    for _ in range(4):
        word = controlword_towards(state, Q, previous) if state is not F else int(Controlword.QUICK_STOP)
        number = obey(state, word, previous)
        state, previous = state if number is None else TRANSITIONS[number].end, word
    assert state is (Q if start in (E, Q) else F if start is F else A if start is A else N if start is N else D)


def test_a_drive_in_quick_stop_is_not_sent_on_by_accident() -> None:
    """Enabling after a stop goes through SWITCH ON DISABLED, never by transition 16."""
    assert controlword_towards(Q, E, Controlword.QUICK_STOP) == Controlword.DISABLE_VOLTAGE


@pytest.mark.parametrize("target", [N, A, F])
def test_what_cannot_be_commanded_is_refused(target: DriveState) -> None:
    with pytest.raises(ValueError, match="no command leads"):
        controlword_towards(E, target, 0)
