"""A model of an experiment file carries what the file says, and gives it up where a call says otherwise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rfdropo_bayes as rb

FILE = """
robot = "smooth_arm"
seed = 3
[model]
mechanisms = ["backlash"]
[model.priors]
young_modulus = {}
[inference]
method = "laplace"
"""


@pytest.fixture
def model(tmp_path: Path) -> rb.Model:
    (tmp_path / "monday.toml").write_text(FILE)
    return rb.Model.read(tmp_path / "monday.toml", ["seed=4"])


def test_the_record_of_a_run_is_the_file_with_what_the_call_gave(model: rb.Model) -> None:
    meant = {"title": "never used", "seed": 0}
    assert model.record(meant, {"seed": None}) == model.tables()
    assert model.tables()["seed"] == model.settings.seed == 4
    assert model.record(meant, {"seed": 7}) == {**model.tables(), "seed": 7}
    assert "title" not in model.record(meant, {})
    assert rb.Model("smooth_arm").record(meant, {})["title"] == "never used"


def test_reports_are_headed_by_title_or_file_or_robot(model: rb.Model) -> None:
    assert model.title == "monday"
    assert rb.Model("smooth_arm").title == "smooth_arm"
    assert rb.Model("smooth_arm", title="Tuesday").title == "Tuesday"


def test_a_changed_model_is_no_longer_that_of_the_file(model: rb.Model) -> None:
    changed = model.with_mechanisms("command_delay")
    assert changed.file is None
    assert changed.tables()["model"]["mechanisms"] == ["backlash", "command_delay"]
    assert changed.settings.seed == 4


def test_recordings_come_from_the_call_or_from_the_file(model: rb.Model) -> None:
    path = np.linspace(0.0, 0.1, 9).reshape(3, 1, 3)
    given = [
        rb.Trajectory.from_arrays(
            time=np.arange(3.0), position=path, command=np.zeros((3, 1)), markers=["tip"], channels=["a"]
        )
    ]
    assert model.runs(given) == (given, [])  # the file's are then not read for a test either
    assert model.runs(given, given) == (given, given)
    with pytest.raises(rb.InputError, match=r"\[data\]"):
        model.runs(None)
