"""Which integrator a model has: the robot's, unless the experiment says otherwise; an answer keeps that of its fit."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import rfdropo_bayes as rb
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.assembly import build_robot_simulator, integrator_of
from rfdropo_bayes.model.experiment import SimulatorTable
from rfdropo_bayes.model.experiment_file import describe, read_tables
from rfdropo_bayes.model.fitted_integrator import INTEGRATOR, check_fitted_integrator
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.model.run_folder import CONFIG, run_folder
from rfdropo_bayes.policies.building import trunk_simulator
from rfdropo_bayes.posteriors import ParameterInfo, PosteriorRecord
from rfdropo_bayes.report.run_files import POSTERIOR
from rfdropo_bayes.results.calibrated import Calibration
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.robots.catalogue import known_robots
from rfdropo_bayes.verbs.evaluate import _otherwise_trained
from rfdropo_bayes.verbs.make_vec import randomisation_of, training_of
from rfdropo_bayes.verbs.predict import model_of

EXPERIMENTS = Path(__file__).resolve().parents[2] / "experiments"
OF_SOFA = {"trunk_sofa", "trunk_sofa_mesh"}
EXPERIMENT = 'robot = "smooth_arm"\n[simulator]\nrefine = 1\n'


def written(path: Path, text: str = EXPERIMENT) -> Path:
    path.write_text(text)
    return path


def posterior(**attributes: str) -> PosteriorRecord:
    modulus = ParameterInfo("young_modulus", "Pa", 1e4, 1e9, {}, "stiffness")
    return PosteriorRecord((modulus,), {"young_modulus": np.full((1, 3), 2e6)}, attrs=attributes)


def test_robots_step_in_second_order_unless_their_data_are_of_sofa():
    assert {name for name in known_robots() if Robot.load(name).integrator == "euler"} == OF_SOFA
    assert Robot.outline(name="new", length=0.2, radius=0.01, markers={"tip": 0.2}).integrator == "sdirk2"


@pytest.mark.parametrize("name", ["smooth_arm", "trunk_sofa"])
@pytest.mark.parametrize("asked", [None, "euler", "sdirk2"])
def test_an_experiment_may_choose_another_integrator_than_the_robot(name, asked):
    robot = Robot.load(name)
    spec = ModelSpec(robot, simulator=SimulatorTable(integrator=asked))
    assert integrator_of(spec) == build_robot_simulator(spec).engine.integrator == (asked or robot.integrator)
    assert trunk_simulator(robot, integrator=asked).engine.integrator == (asked or robot.integrator)


@pytest.mark.parametrize("name", ["demo", "virtual/push", "virtual/reach", "virtual/audit", "virtual/extended"])
def test_simulated_recordings_are_fitted_with_the_integrator_that_made_them(name):
    model = rb.Model.read(EXPERIMENTS / f"{name}.toml")
    for recording in (*model.recordings("fit"), *model.recordings("test")):
        assert recording.settings.get("simulator", {}).get(INTEGRATOR, "euler") == integrator_of(model.spec)


def test_a_run_states_its_integrator(tmp_path):
    model = rb.Model.read(written(tmp_path / "mine.toml"))
    with run_folder(tmp_path / "run", "simulate", tables=model.tables(), folder=tmp_path):
        pass
    assert read_tables(tmp_path / "run" / CONFIG)["simulator"] == {"refine": 1, "integrator": "sdirk2"}
    assert rb.Model("smooth_arm").tables()["simulator"] == {"integrator": "sdirk2"}


def test_an_answer_is_used_with_the_integrator_of_its_fit(tmp_path):
    check_fitted_integrator({INTEGRATOR: "euler"}, None, None, where="a black box")
    check_fitted_integrator({}, tmp_path, "euler", where="a fit that states none")
    written(tmp_path / CONFIG, EXPERIMENT + 'integrator = "sdirk2"\n')
    check_fitted_integrator({}, tmp_path, "sdirk2", where="a run")
    with pytest.raises(InputError, match="fitted with integrator 'sdirk2'"):
        check_fitted_integrator({}, tmp_path, "euler", where="a run")
    early, late = (
        Calibration(posterior(**given), {}, "", rb.Model("smooth_arm"))
        for given in ({INTEGRATOR: "euler"}, {INTEGRATOR: "sdirk2"})
    )
    assert model_of(late) is late.model
    with pytest.raises(InputError, match=r"fitted with integrator 'euler', .*'sdirk2'.*simulator.integrator=euler"):
        model_of(early)


def test_training_over_a_posterior_takes_its_integrator(tmp_path):
    posterior(**{INTEGRATOR: "euler"}).save(tmp_path / POSTERIOR)
    training = {"task": "TrunkReach-v0", "randomisation": "posterior", "source": str(tmp_path)}
    for integrator, fits in (("euler", True), ("sdirk2", False)):
        tables = {"robot": "trunk_sofa", "simulator": {"integrator": integrator}, "training": training}
        model = rb.Model.read(written(tmp_path / "mine.toml", describe(tables)))
        table, _, simulator = training_of(model)
        if fits:
            assert "young_modulus" in randomisation_of(table, model.spec, simulator).names
            continue
        for given in (None, tmp_path, Calibration(posterior(**{INTEGRATOR: "euler"}), {}, "")):
            with pytest.raises(InputError, match="fitted with integrator 'euler'"):
                randomisation_of(table, model.spec, simulator, given)


def test_an_evaluation_says_which_policies_were_trained_otherwise():
    policies = {
        "old": SimpleNamespace(facts={INTEGRATOR: "euler"}),
        "new": SimpleNamespace(facts={INTEGRATOR: "sdirk2"}),
    }
    said = _otherwise_trained(policies, "sdirk2")
    assert said == ["old was trained with integrator 'euler', and is evaluated with 'sdirk2'."]
    assert _otherwise_trained({"old": policies["old"]}, "euler") == []
