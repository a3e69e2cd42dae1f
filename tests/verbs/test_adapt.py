"""Days of a black box: their spread is inferred, and new ones are predicted with it, or adapted to."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

import rfdropo_bayes as rb
from rfdropo_bayes.cautions import Code
from rfdropo_bayes.cli.main import app
from rfdropo_bayes.cli.terminal_summary import show_calibration, show_prediction
from rfdropo_bayes.data import RecordingEntry
from rfdropo_bayes.model.fitted_integrator import INTEGRATOR
from rfdropo_bayes.posteriors import SHARED, ParameterInfo, PosteriorRecord, Scope
from rfdropo_bayes.prediction.model_error import MODEL_ERROR
from rfdropo_bayes.prediction.predictive import FITTED, NOISE
from rfdropo_bayes.report import page
from rfdropo_bayes.verbs import adapt as adaptation
from rfdropo_bayes.verbs.left_out_sessions import of_unseen_sessions, openings_of
from studies.replicas import with_measured
from tests.undrawn import without_panels
from tests.verbs.toys import BOX, PRIORS, SIGMA, STEP

DEMO = Path(__file__).resolve().parents[2] / "experiments" / "demo" / "demo_1.nc"
SPREAD = 0.01
GAIN, LAG = 1.4, 0.25
DAYS = {f"day_{k}": f"day_{k}_*" for k in range(5)}


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
    return rb.calibrate(model, runs, rb.Laplace(draws=800, starts=2, prior_draws=32), test=unseen, seed=0, show=False)


@pytest.mark.slow
def test_a_model_of_days_whose_spread_is_held_keeps_start_data_and_listeners():
    """Optimisations start where an earlier fit ended, fit the data that they were given, and say how far they are."""
    model = rb.Model(BOX, noise="white", priors=PRIORS, groups=DAYS, per_group={"zero": 0.02})
    earlier = {"gain": {"": np.full(2, 1.1 * GAIN)}, "zero_deviation": {"day_1": np.full(2, 0.004)}}
    whole = model.problem(recorded(["day_0_a", "day_1_a"], [0.0, 0.01], 0), earlier)
    other = {name: 2.0 * measured for name, measured in whole.measured.items()}
    whole = with_measured(whole, other).counting({"markers": 0.5})
    told: list[float] = []
    held = whole.telling(told.append).holding(whole.typical_scales)
    assert set(whole.names) - set(held.names) == {"zero_spread"}
    starts = held.sample_starts(jax.random.key(0), 3)
    np.testing.assert_allclose(starts["gain"], 1.1 * GAIN)
    np.testing.assert_allclose(starts["zero_deviation@day_1"], 0.004)
    assert (held.measured, held.shares) == (whole.measured, whole.shares)
    held.row_log_likelihood(starts, held.n_rows)
    assert sum(told) == pytest.approx(3.0)


def test_the_value_of_a_day_stays_within_the_hard_bounds_of_its_parameter():
    """A time constant of 50 ms, the least that there is, and a day that is said to have 0.2 s less: it has no less."""
    model = rb.Model(BOX, noise="white", priors=PRIORS, groups=DAYS, per_group={"time_constant": 0.2})
    program = model.numpyro(recorded(["day_0_a", "day_1_a"], [0.0, 0.0], 0))
    values = {"gain": 1.0, "time_constant": 0.05, "zero": 0.0, "time_constant_spread": 0.2, "observation_noise": SIGMA}
    values |= {"time_constant_deviation@day_0": -0.2, "time_constant_deviation@day_1": 0.2}
    given = {name: jnp.asarray(value) for name, value in values.items()}
    found = [float(program.rollout_values(given, f"day_{k}_a")["time_constant"]) for k in range(2)]
    np.testing.assert_allclose(found, [0.05, 0.25])


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
        "zero_deviation": ("m", normal),
        "observation_noise": ("m", {"distribution": "LogNormal", "median": 0.002, "sigma": 1.5}),
    }
    middle = {"gain": GAIN, "time_constant": LAG, "zero": 0.005, "zero_spread": SPREAD, "zero_deviation@day_0": 0.0}
    draws = {name: value * (1.0 + 0.01 * rng.normal(size=(1, 60))) for name, value in middle.items()}
    draws["observation_noise"] = np.full((1, 60), SIGMA)
    left = {"markers": ["tip"], "scale": [SIGMA] * 3, "correlation_time": STEP}
    attributes = {MODEL_ERROR: left, FITTED: ["day_0_a"], NOISE: "white"}
    scopes = {"zero_spread": Scope(spread=True), "zero_deviation": Scope("day_0", True, "zero", "zero_spread")}
    ends = {"zero_spread": (0.0, np.inf), "zero_deviation": (-np.inf, np.inf)}
    parameters = tuple(
        ParameterInfo(name, unit, *ends.get(name, (-1.0, 3.0)), prior, scope=scopes.get(name, SHARED))
        for name, (unit, prior) in infos.items()
    )
    model = rb.Model(BOX, noise="white", priors=PRIORS, groups={**DAYS, "before": "morning"}, per_group={"zero": 0.02})
    return rb.Calibration(PosteriorRecord(parameters, draws, attrs=attributes), {"title": "lag"}, "", model)


@pytest.fixture(scope="module")
def adapted(known, zeros, tmp_path_factory):
    out = tmp_path_factory.mktemp("adapted") / "out"
    run = recorded(["morning"], zeros[9:10], 30)[0]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page, "embed", without_panels)
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
    by_default = rb.predict(adapted, commands)  # of its own day
    np.testing.assert_array_equal(by_default.bands["mean"], bands[0]["mean"])
    assert (by_default.group, by_default.group_fitted) == ("today", True)
    assert not rb.predict(adapted, commands, group="tomorrow").group_fitted
    back = rb.load(adapted.folder)
    np.testing.assert_array_equal(back.record.flat("zero_spread"), adapted.record.flat("zero_spread"))
    assert json.loads((adapted.folder / "summary.json").read_text())["method"] == "adapt"
    assert (adapted.folder / "report.html").stat().st_size > 10_000


@pytest.mark.slow
def test_the_folder_of_a_day_predicts_the_other_days_too(known, zeros):
    """A day that was fitted keeps its values, row by row with the draws of the body that the new day has left."""
    size = 0.03 + 1e-3 * np.arange(60.0)[None]
    posterior = {**known.record.posterior, "zero_deviation@day_0": size}
    fit = replace(known, record=replace(known.record, posterior=posterior))
    run = recorded(["morning"], zeros[9:10], 30)[0]
    found = rb.adapt(fit, run, seconds=0.5, group="today", seed=1, show=False)
    rows = np.searchsorted(size[0], found.record.flat("zero_deviation@day_0"))
    np.testing.assert_array_equal(found.record.flat("gain"), fit.record.flat("gain")[rows])
    commands = run.time[:-1], run.command_at(run.time[:-1])
    back = rb.predict(found, commands, group="day_0")
    assert back.group_fitted
    wanted, today = (rb.predict(each, commands, group=group) for each, group in ((fit, "day_0"), (found, "today")))
    off = [float(np.abs(back.bands["mean"] - other.bands["mean"]).max()) for other in (wanted, today)]
    assert off[0] < 3.0 * SIGMA < 10.0 * SIGMA < off[1]


@pytest.mark.slow
def test_the_folder_of_a_day_keeps_the_values_of_the_recordings_that_were_fitted(known):
    """Free in each recording: the new one gets its own, the others keep theirs, and further ones of the day take it."""
    rng, posterior, infos = np.random.default_rng(3), dict(known.record.posterior), list(known.record.free)
    gone = [info for info in infos if info.name.startswith("zero")]
    zeros = {"zero@a": -0.02, "zero@b": 0.03}
    infos = [info for info in infos if info not in gone]
    infos += [ParameterInfo("zero", "m", -1.0, 1.0, PRIORS["zero"], scope=Scope(owner)) for owner in "ab"]
    posterior = {info.name: posterior[info.name] for info in infos if info.name in posterior}
    posterior |= {name: value + 1e-4 * rng.normal(size=(1, 60)) for name, value in zeros.items()}
    attributes = {**known.record.attrs, FITTED: list("ab")}
    record = PosteriorRecord(tuple(infos), posterior, attrs=attributes)
    model = rb.Model(BOX, noise="white", priors=PRIORS, per_recording={"zero": ["*"]})
    fit = rb.Calibration(record, {"title": "lag"}, "", model)
    morning, noon = recorded(["morning", "noon"], [0.05, -0.04], 30)
    found = rb.adapt(fit, morning, seed=1, show=False)
    assert found.record.flat("zero@b").mean() == pytest.approx(zeros["zero@b"], abs=1e-4)
    assert found.record.flat("zero@morning").mean() == pytest.approx(0.05, abs=1e-3)
    for name, zero in (("a", zeros["zero@a"]), ("b", zeros["zero@b"]), ("later", 0.05)):
        run = recorded([name], [zero], 40)[0]
        error = rb.predict(found, run).bands["mean"].values - run.position
        assert np.sqrt(np.mean(error**2)) < 5.0 * SIGMA
    again = rb.adapt(found, noon, seed=1, show=False)  # a folder of a day is adapted to another one
    assert again.record.flat("zero@noon").mean() == pytest.approx(-0.04, abs=1e-3)
    for name in ("zero@a", "zero@b", "zero@morning"):
        assert again.record.flat(name).mean() == pytest.approx(found.record.flat(name).mean(), abs=1e-3)


@pytest.mark.slow
def test_errors_last_as_long_in_rows_of_another_rate(adapted):
    """The model's error forgets its sign over one row of the fit; nothing moves along y. Standard error: 0.02."""
    for step in (STEP, 2.0 * STEP):
        time = step * np.arange(50)
        noise = rb.predict(adapted, (time, np.zeros((50, 1)))).drawn.predicted[:, :, 0, 1]
        lag = np.mean(noise[:, 1:] * noise[:, :-1]) / np.mean(noise**2)
        assert lag == pytest.approx(np.exp(-step / STEP), abs=0.08)


def test_the_terminal_shows_the_day_first_and_what_comes_next(adapted, capsys):
    show_calibration(adapted)
    lines = capsys.readouterr().out.splitlines()
    header = next(k for k, line in enumerate(lines) if line.startswith("parameter"))
    assert lines[header + 1].startswith("zero_deviation@today")
    assert f"next: rfdropo predict {adapted.folder} --commands FILE --out OUT" in lines
    facts = {"start_pose_known": True, "rows": 3, "draws": 2, "posterior": "P"}
    facts |= {"group": "today", "group_fitted": True, "cautions": [{"sentence": "1 draws did not converge"}]}
    show_prediction(facts, [Path("f")])
    assert capsys.readouterr().out.splitlines()[1:3] == ["group today, fitted", "caution: 1 draws did not converge"]


def test_as_many_draws_as_were_asked_for_are_no_verdict(adapted):
    """Sixty draws cannot have a hundred effective ones."""
    assert adapted.summary["ess_bulk"].min() < 100.0
    assert "effective draws" not in adapted.sentence
    assert adapted.verdict != "unsafe"


@pytest.mark.slow
def test_a_piece_of_a_recording_belongs_to_its_group(known, zeros):
    """By name in the fit and in the prediction of a further piece."""
    run = recorded(["morning"], zeros[9:10], 30)[0]
    piece = rb.adapt(known, run.slice_rows(0, 25), group="today", seed=1, show=False)
    assert "zero_deviation@today" in piece.record.posterior
    assert not piece.cautions
    found = rb.predict(piece, run.slice_rows(50, 90, lead_in=1.0), group="today")
    assert found.group_fitted
    assert np.sqrt(np.mean((found.bands["mean"].values - run.position[50:91]) ** 2)) < 5.0 * SIGMA


def test_a_day_that_the_model_cannot_fit_has_a_caution(known, zeros):
    """A drift that no parameter makes, ten times as large as the model's error."""
    run = recorded(["b"], zeros[1:2], 51)[0]
    drift = 10.0 * SIGMA * np.sqrt(3.0) * np.sin(40.0 * run.time)
    off = rb.Trajectory(run.dataset.assign(position=run.dataset["position"] + xr.DataArray(drift, dims="time")))
    said = [caution for caution in rb.adapt(known, off, show=False).cautions if caution.code == Code.SESSION_UNMATCHED]
    times = float(said[0].sentence.removeprefix("the session is fitted ").partition(" ")[0])
    assert times == pytest.approx(np.sqrt(1.0 + 10.0**2 * 3.0 / 2.0), rel=0.25)
    assert not [c for c in rb.adapt(known, run, show=False).cautions if "times worse" in c.sentence]


def test_a_first_row_that_nothing_explains_has_a_caution(known, zeros):
    """What a day's zero moves along x is matched; five millimetres along y are not."""
    run = recorded(["b"], zeros[1:2], 51)[0]
    assert not rb.predict(known, run).cautions
    shift = xr.DataArray([0.0, 25.0 * SIGMA, 0.0], dims="axis")
    off = rb.Trajectory(run.dataset.assign(position=run.dataset["position"] + shift))
    (caution,) = rb.predict(known, off).cautions
    assert caution.code == Code.FIRST_ROW_FAR
    times = float(caution.sentence.removeprefix("the first row of b is ").partition(" ")[0])
    assert times == pytest.approx(25.0 / np.sqrt(3.0), rel=0.1)  # a row's noise is 4 % of it


@pytest.mark.slow
def test_an_error_of_the_first_seconds_leaves_the_rest_no_worse(known, zeros, capsys):
    """A bump of 10 mm that is over after the seconds that are shown moves the zero; the first row knows nothing of
    it."""
    run = recorded(["b"], zeros[1:2], 51)[0]
    bump = 0.01 * np.sin(np.pi * np.minimum(run.time / 0.5, 1.0))
    along = xr.DataArray(bump, dims="time") * xr.DataArray([1.0, 0.0, 0.0], dims="axis")
    off = rb.Trajectory(run.dataset.assign(position=run.dataset["position"] + along))
    found = rb.adapt(known, off, seconds=0.5, group="today", show=None)
    said = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("adapt: ")]
    assert said == [
        "adapting to today: 26 rows of b",
        "predicting from first rows alone, to compare: b",
        "the session is fitted: predicting b",
        "the rest of the recording is predicted worse: fitting the session to the first row alone",
        "the session is fitted: predicting b",
    ]
    check = found.content["details"]["checks"]["b"]
    assert check["adapted"]["error_mm"] < check["from_first_row"]["error_mm"] + 1e3 * SIGMA
    assert [c for c in found.cautions if "worsen the prediction of the rest of the recording" in c.sentence]
    (sentence,) = found.content["details"]["compared"]
    assert sentence.startswith("b, as far as it was not shown: from the first row ")
    assert "mm off, its 90 % bands held" in sentence


def test_a_run_without_days_left_out_has_the_prior_of_their_error(known, zeros):
    """Of a new day, and says so; a fitted day has none."""
    new, old = (recorded([name], zeros[1:2], 51)[0] for name in ("b", "day_0_b"))
    found = rb.predict(known, new)
    assert found.unseen.startswith("No recording of this session was seen. This run left no session out of its fit")
    assert rb.predict(known, old).unseen == ""


def test_fitted_days_under_other_commands_are_unseen(zeros):
    fitted = recorded(["day_0_a", "day_1_a"], zeros[:2], 0)
    openings = openings_of([run.slice_rows(0, 45) for run in fitted])
    repeat, new = (fitted[0].with_attributes(name=name) for name in ("day_0_b", "new"))
    other = recorded(["day_0_c"], zeros[:1], 77)[0]
    days = ["day_0", "day_1"]
    assert of_unseen_sessions([repeat, other, new, fitted[0]], DAYS, days, openings) == ["day_0_c", "new"]
    assert of_unseen_sessions([repeat, other, new], DAYS, days, None) == ["new"]


@pytest.mark.slow
def test_what_is_masked_after_the_first_seconds_is_no_rest(known, zeros):
    run = recorded(["b"], zeros[1:2], 51)[0]
    mask = run.position_mask & (run.time < 0.5)[:, None]
    lost = rb.Trajectory(run.dataset.assign(position_mask=run.dataset["position_mask"].copy(data=mask)))
    found = rb.adapt(known, lost, seconds=0.6, show=False)
    assert [prediction.split for prediction in found.record.recordings] == ["fit"]


def test_lost_markers_are_left_out(known, tmp_path, monkeypatch):
    """The file is read as `predict` reads it, and what is left out is said."""
    asked = {}

    def read(spec, folder):
        asked["missing"] = spec.missing
        raise rb.InputError("read")

    monkeypatch.setattr(adaptation, "load_recordings", read)
    (tmp_path / "config.toml").write_text('robot = "smooth_arm"\n[data]\nformat = "netcdf"\nfit = ["a.nc"]\n')
    record = replace(known.record, attrs={**known.record.attrs, INTEGRATOR: "sdirk2"})
    fit = rb.Calibration(record, {}, "", adaptation.fitted_model(tmp_path), tmp_path)
    with pytest.raises(rb.InputError, match="read"):
        rb.adapt(fit, RecordingEntry(observations="b.nc"), out=tmp_path / "out")
    assert asked["missing"] == "mask"


def test_what_was_left_out_is_printed(adapted, capsys):
    recordings = [{**row, "masked": 2} for row in adapted.content["recordings"]]
    show_calibration(replace(adapted, content={**adapted.content, "recordings": recordings}))
    assert "left out: 2 of 26 positions" in capsys.readouterr().out


def test_a_day_that_was_fitted_is_refused_before_a_folder_is_made(known, zeros, tmp_path):
    run = recorded(["day_0_b"], zeros[:1], 52)[0]
    with pytest.raises(rb.InputError, match=r"day_0_b belongs to day_0, which was fitted.*new --group"):
        rb.adapt(known, run, out=tmp_path / "out", show=False)
    assert not (tmp_path / "out").exists()
    assert rb.adapt(known, run, group="anew", show=False).content["details"]["moved"] == ["zero_deviation@anew"]


def test_a_model_that_is_the_same_on_all_days_says_what_to_name(known, zeros):
    record = known.record
    shared = tuple(info for info in record.parameters if info.name in (*PRIORS, "observation_noise"))
    draws = {info.name: record.posterior[info.name] for info in shared}
    run = recorded(["b"], zeros[1:2], 51)[0]
    same = replace(known, model=rb.Model(BOX, noise="white", priors=PRIORS))
    with pytest.raises(rb.InputError, match="no parameter of the model differs between sessions"):
        rb.adapt(replace(same, record=replace(record, parameters=shared, posterior=draws)), run, show=False)
    silent = {**record.attrs, MODEL_ERROR: None}
    with pytest.raises(rb.InputError, match="has no residuals of the fitted recordings"):
        rb.adapt(replace(known, record=replace(record, attrs=silent)), run, show=False)


def test_the_command_refuses_a_folder_without_a_posterior(tmp_path):
    found = CliRunner().invoke(app, ["adapt", str(tmp_path), "--recording", "x.csv", "--out", str(tmp_path / "out")])
    assert isinstance(found.exception, rb.InputError)
    assert "holds no posterior.nc" in str(found.exception)
