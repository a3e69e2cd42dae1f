"""What a file means: parsed once into objects, checked again when it is changed, and written back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import rfdropo_bayes as rb
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.mechanisms.actuation import Backlash
from rfdropo_bayes.model.experiment import Experiment, SimulatorTable
from rfdropo_bayes.model.model_spec import ModelSpec, RunSettings, spec_of
from rfdropo_bayes.robots import DriveTravel, Robot
from rfdropo_bayes.tables import changed, parse_table

TABLES = {
    "robot": "smooth_arm",
    "seed": 3,
    "title": "all keys",
    "data": {"format": "netcdf", "fit": [{"observations": "one.nc"}]},
    "noise": {"standard_deviation": 1e-3},
    "simulator": {"refine": 2, "integrator": "sdirk2"},
    "inference": {"method": "laplace", "rollouts": 700, "starts": 2},
    "audit": {"exclude": ["payload"]},
    "model": {
        "mechanisms": ["backlash", "command_delay"],
        "noise": "stated",
        "priors": {"young_modulus": {}},
        "fixed": {"trunk_mass": 0.1},
        "per_recording": {"command_delay": "all"},
        "groups": {"monday": "one"},
        "per_group": {"young_modulus": 1e5},
        "only_in": {"backlash": ["monday"]},
        "tension": True,
        "weighed": [{"parameters": ["trunk_mass"], "value": 0.1, "sd": 0.01}],
    },
}


def test_a_model_written_as_a_file_and_read_again_is_the_same():
    model = rb.Model.of_experiment(parse_table(Experiment, TABLES, where=""), Path())
    read = parse_table(Experiment, model.tables(), where="")
    assert model.tables() == TABLES
    assert spec_of(read, Path()) == model.spec
    assert RunSettings.of(read) == model.settings
    assert [choice.made_for(model.robot).name for choice in model.spec.mechanisms] == ["backlash", "command_delay"]


def test_mechanisms_and_robots_made_in_python_stay_the_objects_that_they_are():
    robot, lost = Robot.load("smooth_arm"), Backlash.for_robot(Robot.load("smooth_arm"))
    model = rb.Model(robot, mechanisms=[lost]).with_mechanisms("command_delay")
    assert model.robot is robot
    assert model.spec.mechanisms[0].made_for(robot) is lost
    assert model.spec.sources == ("backlash", "command_delay")
    assert model.tables()["robot"] == "robot.toml"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda: rb.Model("smooth_arm", mechanisms=["backlsh"]), "did you mean 'backlash'"),
        (lambda: replace(ModelSpec(Robot.load("smooth_arm")), noise="pink"), "unknown noise 'pink'"),
        (
            lambda: replace(
                ModelSpec(Robot.load("smooth_arm")), drives=(DriveTravel(beyond="lost", low=0.0, cables=("nine",)),)
            ),
            "nine",
        ),
        (lambda: ModelSpec("smooth_arm"), "str is not a robot"),
        (lambda: changed(SimulatorTable(), where="[simulator]", refine=99), "refine = 99"),
        (lambda: changed(SimulatorTable(), where="[simulator]", refin=2), "did you mean 'refine'"),
        (lambda: Robot.load("smooth_arm").with_changes(initial_state="asleep"), "initial_state"),
    ],
)
def test_a_change_is_checked_as_what_is_read(change, said):
    """And not when a simulator is built of it, or never."""
    with pytest.raises(InputError, match=said):
        change()


def test_a_changed_robot_keeps_the_groups_of_its_drives():
    robot = Robot.load("smooth_arm").grouped({"monday": "one"})
    for found in (robot.without_command_timing(), robot.with_changes(initial_state="rest")):
        assert found._groups == {"monday": "one"}
