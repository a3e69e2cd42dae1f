"""What the calls of the front door say where they are given something else than they take."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rfdropo_bayes as rb
from rfdropo_bayes.model.fitted_integrator import INTEGRATOR
from rfdropo_bayes.posteriors import ParameterInfo, PosteriorRecord

EXPERIMENTS = Path(__file__).resolve().parents[2] / "experiments"
RUN = rb.Trajectory.load(EXPERIMENTS / "demo" / "demo_1.nc")
MODEL = rb.Model("smooth_arm", priors={"young_modulus": {}})


@pytest.mark.parametrize(
    "call",
    [
        lambda model: rb.calibrate(model, [RUN]),
        lambda model: rb.audit(model, [RUN]),
        lambda model: rb.design(model, [RUN]),
        lambda model: rb.check(model, [RUN]),
        lambda model: rb.simulate(model, [RUN]),
        lambda model: rb.make_vec("TrunkReach-v0", model),
    ],
    ids=["calibrate", "audit", "design", "check", "simulate", "make_vec"],
)
def test_the_path_of_an_experiment_is_no_model(call):
    with pytest.raises(rb.InputError, match=r"'own\.toml' is not a model; .*rb\.Model\.read\("):
        call("own.toml")


@pytest.mark.parametrize(
    "call",
    [lambda runs: rb.calibrate(MODEL, runs), lambda runs: rb.audit(MODEL, runs), lambda runs: rb.check(MODEL, runs)],
)
@pytest.mark.parametrize(
    ("runs", "message"),
    [
        ("run.csv", r"runs: 'run\.csv' is not a list of recordings; read files with rb\.read"),
        (["run.csv"], r"runs: 'run\.csv' is not a recording; read files with rb\.read"),
        (np.zeros((3, 2)), r"runs: a ndarray is not a recording; .*rb\.Trajectory\.from_arrays"),
        (3, r"runs: 3 is not a list of recordings"),
        ([], r"runs: the list of recordings is empty; give at least one"),
    ],
)
def test_what_is_no_recording_is_named(call, runs, message):
    with pytest.raises(rb.InputError, match=message):
        call(runs)


def test_one_recording_is_a_list_of_one():
    fit, test = MODEL.runs(RUN, RUN)
    assert fit == [RUN]
    assert test == [RUN]


@pytest.mark.parametrize("call", [rb.predict, rb.adapt], ids=["predict", "adapt"])
def test_the_folder_of_a_run_is_no_calibration(call):
    with pytest.raises(rb.InputError, match=r"'runs/arm' is not a calibration; .*rb\.load\(folder\)"):
        call("runs/arm", RUN)


@pytest.mark.parametrize(
    ("commands", "message"),
    [
        ([RUN], "predict: a list of 1 is not a recording; give one of them"),
        ((RUN, RUN), "predict: a list of 2 is not a recording"),
    ],
)
def test_a_prediction_takes_one_recording(fitted, commands, message):
    with pytest.raises(rb.InputError, match=message):
        rb.predict(fitted, commands)
    with pytest.raises(rb.InputError, match=message.replace("predict", "adapt")):
        rb.adapt(fitted, commands)


@pytest.fixture(scope="module")
def fitted() -> rb.Calibration:
    """A calibration of three draws."""
    modulus = ParameterInfo("young_modulus", "Pa", 1e4, 1e9, {}, "stiffness")
    draws = {"young_modulus": np.full((1, 3), 2e6)}
    return rb.Calibration(PosteriorRecord((modulus,), draws, attrs={INTEGRATOR: "sdirk2"}), {}, "", MODEL)


def test_a_method_by_name_is_answered_with_the_calls_that_make_one():
    with pytest.raises(rb.InputError, match=r"'laplace' is not a method; give one of rb\.SMC\(\), .*rb\.Laplace\(\)"):
        rb.calibrate(MODEL, [RUN], "laplace")


def test_reading_a_table_without_its_columns_names_the_argument():
    with pytest.raises(rb.InputError, match=r"needs a \[data\.columns\] table \(columns= of rb\.read\)"):
        rb.read("run.csv", format="csv")
