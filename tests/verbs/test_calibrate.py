"""``rfdropo calibrate`` from recordings to report: what it writes, and that a killed run ends as if it had not been."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import arviz
import numpy as np
import pytest

import rfdropo_bayes as rb
from rfdropo_bayes.cautions import Code
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.posteriors import ParameterInfo, PosteriorRecord, Scope
from rfdropo_bayes.report import page
from rfdropo_bayes.results.calibrated import Calibration
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.verbs.calibrate import calibrate, earlier_draws, implausible_fit
from tests.undrawn import without_panels
from tests.verbs.toys import BOX, PRIORS, SIGMA, STEP, lag

REPOSITORY = Path(__file__).resolve().parents[2]
DEMO = REPOSITORY / "experiments" / "demo.toml"
SHORT = [
    'data.fit=[{observations="demo/demo_1.nc", rows=[0, 20]}]',
    'data.test=["demo/demo_3.nc"]',
    "simulator.refine=1",
    "inference.method=smc",
    "inference.particles=50",
    "inference.rollouts=400",
    "inference.blocks=3",
]


def test_a_fitted_stiffness_that_nothing_has_is_a_caution():
    """Whatever the bounds of the robot's file allow; a wide posterior that reaches plausible values is none."""
    arm, info = Robot.load("smooth_arm"), ParameterInfo("young_modulus", "Pa", 0.1, 1e9, scope=Scope("run"))
    for draws, cautions in ((np.linspace(1.0, 5.0, 99), 1), (np.geomspace(1.0, 1e6, 99), 0)):
        record = PosteriorRecord((info,), {info.name: draws[None]}, {})
        found = implausible_fit(arm, {"trunk_mass": 0.1}, record)
        assert [caution.code for caution in found] == [Code.IMPLAUSIBLE] * cautions
    (found,) = implausible_fit(arm, {"trunk_mass": 9.0}, record)
    assert found.sentence.startswith("trunk_mass is 9 kg")


def test_a_black_box_is_calibrated_and_its_run_is_read_again(tmp_path, monkeypatch):
    monkeypatch.setattr(page, "embed", without_panels)
    walk = {"duration": 1.0, "interval": 0.2, "step": 0.01, "low": -0.03, "high": 0.03, "sample_time": STEP}
    truth, noise = {"gain": 1.4, "time_constant": 0.25, "zero": 0.0}, {"standard_deviation": SIGMA}
    model = rb.Model(BOX, noise="white", priors=PRIORS)
    runs = rb.simulate(model, walk | {"recordings": ["one", "two"]}, parameters=truth, noise=noise, seed=1)
    quick = rb.Laplace(draws=200, starts=2, prior_draws=16)
    found = rb.calibrate(model, runs[:1], quick, test=runs[1:], seed=0, show=False, out=tmp_path / "run")
    for name in ("gain", "time_constant"):
        row = found.summary.loc[name]
        assert abs(row["mean"] - truth[name]) < 5.0 * row["sd"] < 0.2 * truth[name]
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (summary["status"], summary["method"]) == ("done", "laplace")
    assert summary["rmse"]["test"]["tip"] < 3.0 * 1e3 * SIGMA
    assert "two" in (tmp_path / "run" / "report.html").read_text()
    back = rb.load(tmp_path / "run", model=model)
    np.testing.assert_array_equal(back.record.flat("gain"), found.record.flat("gain"))


def test_commands_that_no_draw_survives_leave_the_fit_its_page(tmp_path, monkeypatch):
    """The simulator fails on the test recording alone: nothing of the fit is lost, and the page begins with it."""
    monkeypatch.setattr(page, "embed", without_panels)

    def fragile(parameters, command):
        path = lag(parameters, command)
        return np.where(np.abs(command).max() > 0.05, np.nan, path)

    box = rb.BlackBox(
        fragile,
        parameters={name: {"low": 0.01 if name == "time_constant" else -1.0, "high": 3.0} for name in PRIORS},
        markers=["tip"],
        channels=["pull"],
        time_step=STEP,
        batched=True,
        name="fragile",
    )
    walk = {"duration": 1.0, "interval": 0.2, "step": 0.01, "low": -0.03, "high": 0.03, "sample_time": STEP}
    model = rb.Model(BOX, noise="white", priors=PRIORS)
    truth = {"gain": 1.4, "time_constant": 0.25, "zero": 0.0}
    noise = {"standard_deviation": SIGMA}
    (run,) = rb.simulate(model, walk | {"recordings": ["one"]}, parameters=truth, noise=noise, seed=1)
    wide = walk | {"recordings": ["two"], "low": -0.3, "high": 0.3, "step": 0.1}
    (far,) = rb.simulate(model, wide, parameters=truth, noise=noise, seed=1)
    own = rb.Model(box, noise="white", priors=PRIORS)
    quick = rb.Laplace(draws=200, starts=2, prior_draws=16)
    found = rb.calibrate(own, [run], quick, test=[far], seed=0, show=False, out=tmp_path / "run")
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    (caution,) = [each for each in summary["cautions"] if each["code"] == Code.NOT_PREDICTED]
    assert caution["grave"]
    assert "two: no draw of the posterior" in caution["sentence"]
    assert found.summary.loc["gain"]["mean"] == pytest.approx(1.4, rel=0.1)
    assert "one" in (tmp_path / "run" / "report.html").read_text()


@pytest.mark.slow
def test_a_calibration_writes_what_it_promises(tmp_path):
    stated = 'model.drives=[{recordings="demo_1", high=1.0, beyond="lost"}]'
    Trajectory.load(DEMO.parent / "demo" / "demo_3.nc").with_attributes(name="again").save(tmp_path / "again.nc")
    tested = f'data.test=["demo/demo_3.nc", "{tmp_path / "again.nc"}"]'
    found = calibrate(Model.read(DEMO, [*SHORT, stated, tested]), out=tmp_path / "run")
    assert Code.DRIVES_UNSTATED in [caution.code for caution in found.cautions]  # of the test recording
    assert found.verdict in ("safe", "with care", "unsafe")
    assert (tmp_path / "run" / "report.html").read_text().startswith("<!DOCTYPE html>")
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["status"] == "done"
    assert set(summary["parameters"]) >= {"young_modulus", "trunk_mass", "observation_noise"}
    assert summary["rmse"]["test"]["m4"] > 0
    record = PosteriorRecord.load(tmp_path / "run" / "posterior.nc")
    assert [(r.split, r.repeat_group) for r in record.recordings] == [("fit", -1), ("test", 0), ("test", 0)]
    assert all(np.isfinite(record.flat(p.name)).all() for p in record.parameters)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Estimated shape parameter of Pareto")  # a hundred draws: k is 0.67 for one row
@pytest.mark.filterwarnings("ignore:The inplace keyword")  # of pandas 3, in ArviZ
def test_two_runs_of_the_same_data_are_compared_by_what_they_predict_of_each_row(tmp_path):
    """Independent replicates are chains, and every row's log likelihood is there for ArviZ."""
    runs = {}
    for noise in ("white", "auto"):
        overrides = [*SHORT, "inference.rollouts=4000", "inference.replicates=2", f'model.noise="{noise}"']
        calibrate(Model.read(DEMO, overrides), out=tmp_path / noise)
        runs[noise] = arviz.from_netcdf(tmp_path / noise / "posterior.nc")
        summary = json.loads((tmp_path / noise / "summary.json").read_text())
        rows = [row for row in summary["parameters"].values() if not row.get("derived")]
        assert runs[noise].posterior.sizes["chain"] == 2
        assert all(np.isfinite(row["r_hat"]) for row in rows)
        assert summary["rollouts"] <= 4400
    compared = arviz.compare(runs, ic="loo")
    assert set(compared.index) == set(runs)
    assert np.isfinite(compared["elpd_loo"].astype(float)).all()
    for data in runs.values():
        rows = data.log_likelihood["row"].stack(sample=("chain", "draw")).values
        assert len(rows) == 21
        # What a row is worth to a fit that has not seen it is less than to one that has.
        assert arviz.loo(data).elpd_loo < np.sum(np.logaddexp.reduce(rows, axis=1) - np.log(rows.shape[1]))


def command(out: Path, *extra: str) -> list[str]:
    overrides = [argument for override in SHORT for argument in ("--set", override)]
    return [sys.executable, "-m", "rfdropo_bayes", "calibrate", str(DEMO), "--out", str(out), *overrides, *extra]


@pytest.mark.slow
def test_a_killed_run_resumes_to_the_same_posterior(tmp_path):
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    subprocess.run(command(whole), env=environment, check=True, capture_output=True)
    running = subprocess.Popen(command(killed), env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    log = killed / "log.jsonl"
    while not (log.exists() and len(log.read_text().splitlines()) >= 3):
        assert running.poll() is None, "the run ended before it could be killed"
        time.sleep(0.05)
    running.send_signal(signal.SIGKILL)
    running.wait()
    assert not (killed / "posterior.nc").exists()
    subprocess.run(command(killed, "--resume"), env=environment, check=True, capture_output=True)
    first, second = (PosteriorRecord.load(folder / "posterior.nc") for folder in (whole, killed))
    for parameter in first.parameters:
        np.testing.assert_array_equal(first.flat(parameter.name), second.flat(parameter.name))


def test_a_start_is_refused_where_it_would_be_ignored_or_is_not_there(tmp_path):
    with pytest.raises(InputError, match="does not optimise"):
        earlier_draws(tmp_path, "rfdropo")
    with pytest.raises(InputError, match="no such file"):
        earlier_draws(tmp_path, "laplace")
    assert earlier_draws(None, "rfdropo") is None


def test_optimisations_start_from_the_optimum_of_an_earlier_calibration(tmp_path):
    """Draws of many parameters may all fit worse than the optimum; a folder without summary has draws alone."""
    draws = {"young_modulus": np.array([[1e6, 2e6, 3e6]])}
    info = ParameterInfo("young_modulus", "Pa", 0.0, np.inf, {}, "")
    record = PosteriorRecord((info,), draws, {"young_modulus": draws["young_modulus"][0]}, ())
    record.save(tmp_path / "posterior.nc")
    np.testing.assert_allclose(earlier_draws(tmp_path, "laplace")["young_modulus"][""], [1e6, 2e6, 3e6])
    for optimum, expected in (({"young_modulus": 5e6}, [5e6, 5e6, 5e6, 1e6, 2e6, 3e6]), (None, [1e6, 2e6, 3e6])):
        found = earlier_draws(Calibration(record, {"optimum": optimum}, ""), "laplace")
        np.testing.assert_allclose(found["young_modulus"][""], expected)


def test_optimisations_start_from_the_extended_model_of_an_audit(tmp_path):
    """A difference of a group is kept by its owner; an audit that has no such values asks for another."""
    optimum = {"young_modulus": {"": 5e6}, "play": {"april": 1e-3}}
    (tmp_path / "audit.json").write_text(json.dumps({"verdict": "explained", "optimum": optimum}))
    (tmp_path / "extended.toml").write_text("[model]\n")
    found = earlier_draws(tmp_path, "laplace")
    assert {name: {owner: draws.tolist() for owner, draws in own.items()} for name, own in found.items()} == {
        "young_modulus": {"": [5e6]},
        "play": {"april": [1e-3]},
    }
    (tmp_path / "audit.json").write_text(json.dumps({"verdict": "explained"}))
    with pytest.raises(InputError, match="audit again"):
        earlier_draws(tmp_path, "laplace")
