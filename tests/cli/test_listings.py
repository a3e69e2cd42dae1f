"""Commands that list what there is leave nothing out."""

from __future__ import annotations

import sys
from typing import get_args

import pytest

from rfdropo_bayes.cli import main
from rfdropo_bayes.data.format_descriptions import FORMATS
from rfdropo_bayes.data.spec import Format
from rfdropo_bayes.inference.methods import METHODS
from rfdropo_bayes.mechanisms.registry import REGISTRY
from rfdropo_bayes.robots import Robot, known_robots


def told(monkeypatch, capsys, *words: str) -> str:
    monkeypatch.setattr(sys, "argv", ["rfdropo", *words])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert not stopped.value.code
    return capsys.readouterr().out


@pytest.mark.parametrize(
    ("command", "names"),
    [("robots", known_robots()), ("mechanisms", REGISTRY), ("formats", FORMATS), ("methods", METHODS)],
)
def test_a_list_has_one_line_for_each(monkeypatch, capsys, command, names):
    lines = told(monkeypatch, capsys, command).splitlines()
    first = [line.split()[0] for line in lines if line.split()]
    assert [name for name in first if name in names] == list(names)


def test_formats_are_those_that_are_read():
    assert set(FORMATS) == set(get_args(Format))


def test_a_robot_says_what_it_is(monkeypatch, capsys):
    text = told(monkeypatch, capsys, "robots", "asl_trunk")
    robot = Robot.load("asl_trunk")
    assert str(known_robots()["asl_trunk"]) in text
    for name in (*robot.cable_names, *robot.channel_names, *robot.marker_names, *robot.parameters):
        assert name in text


def test_a_mechanism_says_its_cause_and_the_parameters_of_a_robot(monkeypatch, capsys):
    text = told(monkeypatch, capsys, "mechanisms", "cable_gain")
    assert REGISTRY["cable_gain"].cause in text
    assert all(f"cable_gain_error_{channel}" in text for channel in Robot.load("smooth_arm").channel_names)
