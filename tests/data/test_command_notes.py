"""Commands that a recorder lost, and commands of two programs, are noted; regular and rare ones are not."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes.data.command_notes import command_notes

TIME = 0.1 * np.arange(80) + np.random.default_rng(0).normal(0.0, 2e-3, 80)
COMMAND = 5e-3 * np.maximum(np.sin(2.0 * np.pi * 0.3 * TIME[:, None] + np.arange(4) * np.pi / 2.0), 0.0)


@pytest.mark.parametrize(
    ("kept", "said"),
    [
        (np.random.default_rng(1).random(80) > 0.1, "are missing: the longest gap is 0."),
        (~((TIME > 3.0) & (TIME < 6.0)), "30 of them are missing: the longest gap is 3"),
    ],
)
def test_gaps_in_regular_commands_are_noted(kept, said):
    (note,) = command_notes(TIME[kept], COMMAND[kept])
    assert "commands come every" in note
    assert said in note


@pytest.mark.parametrize("seed", range(3))
def test_commands_that_come_as_a_person_gives_them_are_not(seed):
    time = np.cumsum(np.random.default_rng(seed).exponential(1.0, 60))
    assert command_notes(TIME, COMMAND) == command_notes(time, np.repeat(COMMAND[:20], 3, axis=0)) == []


def test_two_programs_on_the_same_channels_are_noted():
    time = np.concatenate([TIME, TIME[40:] + 0.05])
    command = np.concatenate([COMMAND, np.zeros((40, 4))])
    order = np.argsort(time)
    notes = command_notes(time[order], command[order])
    assert any("go to and fro between two values, one of them zero, " in note for note in notes)


def test_a_square_wave_of_one_program_is_not():
    command = np.where((np.arange(80) // 5 % 2 == 0)[:, None], 0.0, COMMAND.max(axis=0))
    assert command_notes(TIME, command) == []
