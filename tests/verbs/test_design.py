"""A design ends in its time, with the best of what it has looked at."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.verbs.design import Clock, design

DEMO = Path(__file__).resolve().parents[2] / "experiments" / "demo.toml"
SHORT = ['data.fit=[{observations="demo/demo_1.nc", rows=[0, 30]}]', "data.test=[]", "simulator.refine=1"]


def test_a_part_that_is_given_up_is_noted_and_the_next_has_its_own_time():
    clock = Clock(minutes=1.0)
    clock.began -= 45.0
    with clock.part(0.5, "the first half"):
        clock.check()
    with clock.part(1.0, "the second half"):
        clock.check()
    assert clock.missed == ["the first half"]
    clock.check()


@pytest.mark.slow
def test_a_design_in_too_little_time_says_so_and_one_in_enough_writes_commands(tmp_path):
    with pytest.raises(InputError, match=r"\[design\] minutes"):
        design(Model.read(DEMO, [*SHORT, "design.minutes=0.0001"]), out=tmp_path / "short")
    found = design(Model.read(DEMO, SHORT), out=tmp_path / "long").content
    assert found["not_finished"] == []
    assert len(found["tried"]) == 24
    commands = tmp_path / "long" / "next_commands.csv"
    assert json.loads((tmp_path / "long" / "design.json").read_text()) == {**found, "commands": str(commands)}
    table = pd.read_csv(commands)
    assert list(table) == ["time_s", "up_m", "left_m", "down_m", "right_m"]
