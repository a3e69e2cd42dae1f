"""Days of a black box: their spread is inferred, and new ones are predicted with it, or adapted to."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import rfdropo_bayes as rb
from rfdropo_bayes.cli.main import app
from rfdropo_bayes.posteriors import ParameterInfo, PosteriorRecord
from rfdropo_bayes.prediction.model_error import MODEL_ERROR
from rfdropo_bayes.prediction.predictive import FITTED, NOISE

STEP, SIGMA, SPREAD = 0.02, 2e-4, 0.01
GAIN, LAG = 1.4, 0.25


def lag(parameters, command):
    """The tip follows gain * (command + zero) with a time constant; many parameter sets at once."""
    gain, share = parameters["gain"][:, None], 1.0 - np.exp(-STEP / parameters["time_constant"])
    wanted = gain * (command[:, :, 0] + parameters["zero"][:, None])
    place = [wanted[:, 0]]
    for row in range(1, command.shape[1]):
        place.append(place[-1] + share * (wanted[:, row] - place[-1]))
    x = np.stack(place, axis=1)
    return np.stack([x, np.zeros_like(x), np.full_like(x, 0.1)], axis=-1)[:, :, None]


BOX = rb.BlackBox(
    lag,
    parameters={
        "gain": {"low": 0.2, "high": 3.0},
        "time_constant": {"low": 0.05, "high": 1.0, "unit": "s"},
        "zero": {"low": -1.0, "high": 1.0, "unit": "m"},
    },
    markers=["tip"],
    channels=["pull"],
    time_step=STEP,
    batched=True,
    name="lag",
)
DAYS = {f"day_{k}": f"day_{k}_*" for k in range(5)}
PRIORS = {"gain": {}, "time_constant": {}, "zero": {"distribution": "Normal", "loc": 0.0, "scale": 0.05}}


def recorded(names, zeros, seed):
    walk = {"duration": 2.0, "interval": 0.2, "step": 0.01, "low": -0.03, "high": 0.03, "sample_time": STEP}
    runs = []
    for k, (name, zero) in enumerate(zip(names, zeros, strict=True)):
        truth = {"gain": GAIN, "time_constant": LAG, "zero": float(zero)}
        noise = {"standard_deviation": SIGMA}
        runs += rb.simulate(rb.Model(BOX), walk | {"recordings": [name]}, parameters=truth, noise=noise, seed=seed + k)
    return runs


@pytest.fixture(scope="module")
def zeros():
    return 0.005 + SPREAD * np.random.default_rng(4).normal(size=15)


@pytest.fixture(scope="module")
def fit(zeros):
    """Fitted to five days; ten days that it has not seen are predicted from their first rows."""
    model = rb.Model(BOX, noise="white", priors=PRIORS, groups=DAYS, per_group={"zero": 0.02})
    runs = recorded([f"day_{k}_a" for k in range(5)], zeros[:5], 0)
    unseen = recorded([f"new_{k}" for k in range(10)], zeros[5:], 10)
    return rb.calibrate(model, runs, rb.Laplace(draws=800, starts=2, screen=32), test=unseen, seed=0, show=False)


@pytest.mark.slow
def test_the_spread_between_days_is_inferred(fit, zeros):
    """The 90 % interval holds the truth, and each day's zero is found to a twentieth of the spread."""
    row = fit.summary.loc["zero_spread"]
    assert row["q05"] < SPREAD < row["q95"]
    assert row["q95"] < 3.0 * SPREAD
    for k in range(5):
        own = fit.record.flat("zero") + fit.record.flat(f"zero_deviation@day_{k}")
        assert own.mean() == pytest.approx(zeros[k], abs=0.05 * SPREAD)


@pytest.mark.slow
def test_days_that_no_fit_saw_are_in_the_bands(fit):
    """Ten days, from their first rows: their zeros are known from these to about the noise."""
    inside = []
    for prediction in fit.record.recordings:
        if prediction.split == "test":
            low, high = np.quantile(prediction.predicted, [0.05, 0.95], axis=0)
            inside.append(np.mean((prediction.observed >= low) & (prediction.observed <= high)))
    assert len(inside) == 10
    assert 0.8 < np.mean(inside) <= 1.0


@pytest.fixture(scope="module")
def known():
    """What such a fit knows, written down: 60 draws, of which gain and time constant are known to 1 %."""
    rng = np.random.default_rng(0)
    normal = {"distribution": "Normal", "loc": 0.0, "scale": 0.02}
    infos = {
        "gain": ("-", {"distribution": "Uniform", "low": 0.2, "high": 3.0}),
        "time_constant": ("s", {"distribution": "Uniform", "low": 0.05, "high": 1.0}),
        "zero": ("m", PRIORS["zero"]),
        "zero_spread": ("m", {"distribution": "HalfNormal", "scale": 0.02}),
        "zero_deviation@day_0": ("m", normal),
        "observation_noise": ("m", {"distribution": "LogNormal", "median": 0.002, "sigma": 1.5}),
    }
    middle = {"gain": GAIN, "time_constant": LAG, "zero": 0.005, "zero_spread": SPREAD, "zero_deviation@day_0": 0.0}
    draws = {name: value * (1.0 + 0.01 * rng.normal(size=(1, 60))) for name, value in middle.items()}
    draws["observation_noise"] = np.full((1, 60), SIGMA)
    left = {"markers": ["tip"], "scale": [SIGMA] * 3, "correlation_time": STEP}
    attributes = {MODEL_ERROR: left, FITTED: ["day_0_a"], NOISE: "white"}
    parameters = tuple(ParameterInfo(name, unit, -1.0, 3.0, prior) for name, (unit, prior) in infos.items())
    model = rb.Model(BOX, noise="white", priors=PRIORS, groups={**DAYS, "before": "morning"}, per_group={"zero": 0.02})
    return rb.Calibration(PosteriorRecord(parameters, draws, attrs=attributes), {"title": "lag"}, "", model)


@pytest.fixture(scope="module")
def adapted(known, zeros, tmp_path_factory):
    out = tmp_path_factory.mktemp("adapted") / "out"
    run = recorded(["morning"], zeros[9:10], 30)[0]
    return rb.adapt(known, run, seconds=0.5, group="today", seed=1, out=out, show=False)


def test_a_short_recording_moves_the_day_and_not_the_body(known, adapted, zeros):
    own = adapted.record.flat("zero") + adapted.record.flat("zero_deviation@today")
    assert own.mean() == pytest.approx(zeros[9], abs=0.1 * SPREAD)
    assert adapted.record.flat("gain").mean() == pytest.approx(known.record.flat("gain").mean(), abs=0.01)
    assert not [caution for caution in adapted.cautions if caution.grave]
    rest = adapted.prediction("morning")
    assert not rest.mask[:26].any()
    error = np.linalg.norm(rest.central - rest.observed, axis=-1)[rest.mask]
    assert np.sqrt(np.mean(error**2)) < 5.0 * SIGMA


def test_the_rest_of_the_day_is_predicted_from_the_folder(adapted, zeros):
    """The day's values serve it alone: without a first row, the bands of another day have the spread between days."""
    other = recorded(["later"], zeros[9:10], 40)[0]
    error = rb.predict(adapted, other, group="today").bands["mean"].values - other.position
    assert np.sqrt(np.mean(error**2)) < 5.0 * SIGMA
    commands = other.time[:-1], other.command_at(other.time[:-1])
    bands = [rb.predict(adapted, commands, group=day).bands for day in ("today", "tomorrow")]
    today, tomorrow = (float(np.mean(b["q95"].values - b["q05"].values)) for b in bands)
    assert tomorrow > 5.0 * today
    back = rb.load(adapted.folder)
    np.testing.assert_array_equal(back.record.flat("zero_spread"), adapted.record.flat("zero_spread"))
    assert json.loads((adapted.folder / "summary.json").read_text())["method"] == "adapt"
    assert (adapted.folder / "report.html").stat().st_size > 10_000


def test_the_shortest_commands_that_determine_a_day(known, zeros):
    """One row of a marker that a zero moves says what there is to say; where it moves none, no commands do."""
    runs = recorded(["day_0_a"], zeros[:1], 0)
    found = rb.design_day(known, runs, seconds=1.0)
    assert found.content["determined"]
    assert found.content["seconds"] <= 5 * STEP
    assert found.content["parameters_of_a_day"] == ["zero_deviation@another day"]
    assert found.content["tip_uncertain_before_mm"] == pytest.approx(1e3 * GAIN * SPREAD, rel=0.1)
    assert found.content["tip_uncertain_after_mm"] <= found.content["tip_error_of_the_model_mm"]
    assert list(found.commands.columns) == ["time_s", "pull_m"]
    assert f"Record the first {found.content['seconds']:.3g} s" in found.sentence
    none = {**known.record.posterior, "zero_spread": np.full((1, 60), 1e-9)}
    same = rb.design_day(replace(known, record=replace(known.record, posterior=none)), runs, seconds=1.0)
    assert same.content["tip_uncertain_before_mm"] < 1e-3


def test_a_model_that_is_the_same_on_all_days_says_what_to_name(known, zeros):
    record = known.record
    shared = tuple(info for info in record.parameters if info.name in (*PRIORS, "observation_noise"))
    draws = {info.name: record.posterior[info.name] for info in shared}
    run = recorded(["b"], zeros[1:2], 51)[0]
    same = replace(known, model=rb.Model(BOX, noise="white", priors=PRIORS))
    with pytest.raises(rb.InputError, match="nothing of the model differs between days"):
        rb.adapt(replace(same, record=replace(record, parameters=shared, posterior=draws)), run, show=False)
    silent = {**record.attrs, MODEL_ERROR: None}
    with pytest.raises(rb.InputError, match="does not say what its model leaves"):
        rb.adapt(replace(known, record=replace(record, attrs=silent)), run, show=False)


def test_the_command_refuses_a_folder_without_a_posterior(tmp_path):
    found = CliRunner().invoke(app, ["adapt", str(tmp_path), "--recording", "x.csv", "--out", str(tmp_path / "out")])
    assert isinstance(found.exception, rb.InputError)
    assert "holds no posterior.nc" in str(found.exception)
