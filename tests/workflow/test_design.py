"""A design ends in its time, with the best of what it has looked at."""

from __future__ import annotations

import json
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from rfdropo_bayes.audit.forward import Lanes, OutOfTime, RoutedLanes
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.commands import Commands
from rfdropo_bayes.workflow.design import Clock, run_design

DEMO = Path(__file__).resolve().parents[2] / "experiments" / "demo.toml"
SHORT = ['data.fit=[{observations="demo/demo_1.nc", rows=[0, 30]}]', "data.test=[]", "simulator.refine=1"]
COMMANDS = Commands(np.zeros((1, 1)), np.zeros((1, 3, 1)), np.zeros((1, 3), dtype=int), np.zeros((1, 3)))


def lanes() -> Lanes:
    return Lanes(SimpleNamespace(parameters=()), np.arange(1), width=2)


def call(own: Lanes) -> int:
    """Number of batches of five rollouts that are done."""
    return len(own._chunks(lambda theta, commands: theta, COMMANDS, np.zeros(5, dtype=int), np.zeros((5, 1))))


def test_lanes_end_when_their_time_is_up():
    own = lanes()
    assert call(own) == 3
    own.until = time.monotonic() - 1.0
    with pytest.raises(OutOfTime):
        call(own)


def test_both_simulators_of_routed_lanes_end():
    both = RoutedLanes(lanes(), lanes(), {})
    both.until = time.monotonic() - 1.0
    for own in (both.fast, both.slow):
        with pytest.raises(OutOfTime):
            call(own)


def test_a_part_that_is_given_up_is_noted_and_the_next_has_its_own_time():
    own = lanes()
    clock = Clock(own, minutes=1.0, began=time.monotonic() - 45.0)
    with clock.part(0.5, "the first half"):
        call(own)
    with clock.part(1.0, "the second half"):
        call(own)
    assert clock.missed == ["the first half"]
    assert call(own) == 3


@pytest.mark.slow
def test_a_design_in_too_little_time_says_so_and_one_in_enough_writes_commands(tmp_path):
    with pytest.raises(InputError, match=r"\[design\] minutes"):
        run_design(DEMO, tmp_path / "short", overrides=[*SHORT, "design.minutes=0.0001"])
    found = run_design(DEMO, tmp_path / "long", overrides=SHORT)
    assert found["not_finished"] == []
    assert len(found["tried"]) == 24
    assert json.loads((tmp_path / "long" / "design.json").read_text()) == found
    table = pd.read_csv(found["commands"])
    assert list(table) == ["time_s", "up_m", "left_m", "down_m", "right_m"]
