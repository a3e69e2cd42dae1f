"""``rfdropo predict``: commands that were never run, from at most the start pose."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pandas as pd
import pytest
import tomli_w
import xarray as xr

import rfdropo_bayes as rb
from rfdropo_bayes.bayes.inferred_parameter import Pooled
from rfdropo_bayes.bayes.scopes import build_scopes
from rfdropo_bayes.data import Trajectory, first_row_only
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.groups import gather_groups
from rfdropo_bayes.mechanisms import REGISTRY, mechanisms_named
from rfdropo_bayes.model.assembly import pooling
from rfdropo_bayes.model.experiment import Experiment
from rfdropo_bayes.model.fitted_integrator import INTEGRATOR
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.posteriors import ParameterInfo, PosteriorRecord, RecordingPrediction, Scope
from rfdropo_bayes.prediction.first_row import first_row_distances, match_first_row, resampled_by_first_row
from rfdropo_bayes.prediction.model_error import MODEL_ERROR, ModelError
from rfdropo_bayes.prediction.predictive import NOISE, draw_extended
from rfdropo_bayes.results.calibrated import Calibration
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.parameters import ParameterSpec
from rfdropo_bayes.verbs.simulate import simulate_all

FITTED_WITH = {INTEGRATOR: "sdirk2"}
EXPERIMENTS = Path(__file__).resolve().parents[2] / "experiments"
COMMANDS = "demo/demo_3.nc"
SHIFT = np.array([0.004, -0.003, 0.002])  # [m]
RANGES = {"young_modulus": (1.9e6, 2.1e6), "trunk_mass": (0.088, 0.092), "observation_noise": (0.0019, 0.0021)}
UNITS = {"young_modulus": "Pa", "trunk_mass": "kg", "observation_noise": "m"}
COARSE = ("simulator.refine=1", "simulator.precision=float64", "model.noise=white")


@pytest.fixture(scope="module")
def posterior(tmp_path_factory) -> Path:
    """A posterior of two shared parameters, the noise, and offsets of two recordings."""
    folder, rng = tmp_path_factory.mktemp("posterior"), np.random.default_rng(0)
    infos, draws = [], {}
    for name, (low, high) in RANGES.items():
        infos.append(ParameterInfo(name, UNITS[name], 0.0, np.inf, prior_of(0.5 * (low + high))))
        draws[name] = rng.uniform(low, high, (1, 40))
    for axis in "xyz":
        for recording in ("demo_1", "demo_2"):
            normal, scope = {"distribution": "Normal", "loc": 0.0, "scale": 0.005}, Scope(recording)
            infos.append(ParameterInfo(f"offset_{axis}", "m", -0.05, 0.05, normal, scope=scope))
            draws[infos[-1].name] = rng.normal(0.0, 0.003, (1, 40))
    PosteriorRecord(tuple(infos), draws, attrs=FITTED_WITH).save(folder / "posterior.nc")
    return folder


def prior_of(median: float) -> dict[str, object]:
    return {"distribution": "LogNormal", "median": median, "sigma": 0.5}


def predict(posterior: Path, commands: str, out: Path, rows: tuple[int, int] = (0, 30), **options) -> xr.Dataset:
    out.mkdir(exist_ok=True)
    piece = Trajectory.load(EXPERIMENTS / commands).slice_rows(*rows)
    piece.save(out / "commands.nc")
    model = Model.read(EXPERIMENTS / "demo.toml", COARSE)
    rb.predict(Calibration.of_posterior(posterior, model), out / "commands.nc", out=out, **options)
    with xr.open_dataset(out / "prediction.nc") as opened:
        return opened.load()


def test_only_the_first_row_is_seen_and_sets_the_frame(posterior, tmp_path):
    """The measured rest pose is shifted: so is all of the prediction. What came after it changes nothing."""
    whole = Trajectory.load(EXPERIMENTS / COMMANDS)
    moved = whole.dataset.assign(position=whole.dataset["position"] + xr.DataArray(SHIFT, dims="axis"))
    Trajectory(moved).save(tmp_path / "moved.nc")
    first_row_only(Trajectory(moved)).save(tmp_path / "first.nc")
    here = predict(posterior, COMMANDS, tmp_path / "a")
    there = predict(posterior, str(tmp_path / "moved.nc"), tmp_path / "b")
    blind = predict(posterior, str(tmp_path / "first.nc"), tmp_path / "c")
    for name in ("mean", "q05", "q95"):
        np.testing.assert_allclose(
            there[name].values - here[name].values, np.broadcast_to(SHIFT, here[name].shape), atol=1e-7
        )
        np.testing.assert_array_equal(blind[name].values, there[name].values)
    said = [json.loads((tmp_path / name / "prediction.json").read_text())["compared"] for name in "abc"]
    assert said[2] is None  # no later row has a marker
    assert said[0]["rows"] == 30
    off = here["mean"].values[1:] - whole.position[1:31]
    expected = 1e3 * np.sqrt(np.mean(np.sum(off**2, axis=-1), axis=0))
    np.testing.assert_allclose(list(said[0]["rms_mm"].values()), expected, rtol=1e-9)
    assert said[1]["rms_mm"] == pytest.approx(said[0]["rms_mm"])
    inside = (here["q05"].values[1:] <= whole.position[1:31]) & (whole.position[1:31] <= here["q95"].values[1:])
    assert said[0]["in_90_percent_bands"] == pytest.approx(inside.mean())
    start = here["mean"].values[0] - whole.position[0]
    np.testing.assert_allclose(start.mean(axis=0), 0.0, atol=1e-9)


@pytest.mark.slow
def test_the_marker_that_the_model_knows_best_sets_the_frame(posterior, tmp_path):
    """All weight on the first marker: it agrees in the first row, draw by draw, and the others keep their error."""
    record = PosteriorRecord.load(posterior / "posterior.nc")
    scale = [1e-6] * 3 + [1.0] * 9
    left = {"markers": ["m1", "m2", "m3", "m4"], "scale": scale, "correlation_time": 0.1}
    (tmp_path / "weighed").mkdir()
    attributes = {**record.attrs, MODEL_ERROR: left}
    PosteriorRecord(record.parameters, record.posterior, attrs=attributes).save(tmp_path / "weighed" / "posterior.nc")
    start = predict(tmp_path / "weighed", COMMANDS, tmp_path / "a")["mean"].values[0]
    measured = Trajectory.load(EXPERIMENTS / COMMANDS).position[0]
    np.testing.assert_allclose(start[0], measured[0], atol=1e-8)
    assert np.abs(start - measured)[1:].max() > 1e-4


def test_another_noise_than_the_fitted_one_is_refused(posterior, tmp_path):
    record = PosteriorRecord.load(posterior / "posterior.nc")
    (tmp_path / "auto").mkdir()
    PosteriorRecord(record.parameters, record.posterior, attrs=FITTED_WITH | {NOISE: "auto"}).save(
        tmp_path / "auto" / "posterior.nc"
    )
    with pytest.raises(InputError, match=r"fitted with noise = 'auto', the experiment says 'white'.*model\.noise=auto"):
        predict(tmp_path / "auto", COMMANDS, tmp_path / "a")


def test_a_piece_of_a_fitted_recording_keeps_its_frame(posterior, tmp_path):
    """What its first row says about the frame has been used already, with all the other rows."""
    record = PosteriorRecord.load(posterior / "posterior.nc")
    owners = {"": "", "demo_1": "demo_3[0:9]", "demo_2": "other"}
    infos = tuple(replace(info, scope=Scope(owners[info.scope.owner])) for info in record.parameters)
    draws = {new.name: record.posterior[info.name] for new, info in zip(infos, record.parameters, strict=True)}
    (tmp_path / "same").mkdir()
    PosteriorRecord(infos, draws, attrs=FITTED_WITH).save(tmp_path / "same" / "posterior.nc")
    whole = Trajectory.load(EXPERIMENTS / COMMANDS)
    moved = whole.dataset.assign(position=whole.dataset["position"] + xr.DataArray(SHIFT, dims="axis"))
    Trajectory(moved).save(tmp_path / "moved.nc")
    here = predict(tmp_path / "same", COMMANDS, tmp_path / "a", rows=(20, 30))
    there = predict(tmp_path / "same", str(tmp_path / "moved.nc"), tmp_path / "b", rows=(20, 30))
    np.testing.assert_array_equal(here["mean"].values, there["mean"].values)


def test_what_one_recording_alone_had_free_is_not_carried_to_a_new_one():
    """Offsets of every fitted recording are drawn from for a new one; a payload of one of two is not, nor for itself
    lost."""
    names = ("offset_x@a", "offset_x@b[0:9]", "payload@b[0:9]")
    specs = {
        "offset_x": ParameterSpec(
            "offset_x", "m", -1.0, 1.0, 0.0, {"distribution": "Normal", "loc": 0.0, "scale": 1.0}, ""
        )
    }
    specs["payload"] = ParameterSpec("payload", "kg", 0.0, 1.0, 0.0, {"distribution": "HalfNormal", "scale": 1.0}, "")
    space = build_scopes(
        tuple(specs.values()),
        {"offset_x": {}, "payload": {}},
        {"offset_x": ["a", "b[0:9]"], "payload": ["b[0:9]"]},
        ["a", "b[0:9]"],
    )
    values = {name: np.full(3, 0.1 * k) for k, name in enumerate(names)}
    names = ["new", "b[20:30]", "a[3:4]"]
    extension = space.extended(names, ["a", "b[0:9]"], {})
    found, drawn = extension.scopes, draw_extended(extension, values, names, jax.random.key(0))
    assert set(drawn) == {"offset_x@new", "offset_x@b[20:30]", "payload@b[20:30]", "offset_x@a[3:4]"}
    assert set(found.names) == set(drawn)
    np.testing.assert_array_equal(drawn["offset_x@b[20:30]"], 0.1)
    assert set(drawn["offset_x@new"]) <= {0.0, 0.1}


def test_bands_are_those_of_what_would_be_measured(posterior, tmp_path):
    """Quantiles in order, no narrower than the noise alone; the table holds the same numbers as the NetCDF."""
    found = predict(posterior, COMMANDS, tmp_path)
    levels = [found[name].values for name in ("q05", "q25", "q75", "q95")]
    assert all(np.all(low <= high) for low, high in pairwise(levels))
    width = np.median(levels[3] - levels[0])
    assert 0.8 * 2 * 1.645 * 0.0019 < width < 0.01
    table = pd.read_csv(tmp_path / "prediction.csv")
    np.testing.assert_allclose(table["m4_z_q95"], found["q95"].sel(marker="m4", axis="z"), atol=1e-5)
    np.testing.assert_array_equal(table["time"].round(6), found["time"].values.round(6))
    assert found["mean"].attrs["units"] == "m"
    facts = json.loads((tmp_path / "prediction.json").read_text())
    assert (facts["group"], facts["group_fitted"], facts["cautions"]) == ("demo_3", None, [])  # nothing differs


def test_the_chosen_group_says_what_the_drives_follow(posterior, tmp_path):
    """In April they lose all pulls; the recording is of no group unless one is chosen for it."""
    overrides = [*COARSE, 'model.drives=[{recordings="april", high=0.0, beyond="lost"}]']
    moved, said = {}, {}
    for group in (None, "april"):
        out = tmp_path / str(group)
        model = Model.read(EXPERIMENTS / "demo.toml", overrides)
        facts = rb.predict(Calibration.of_posterior(posterior, model), COMMANDS, out=out, group=group).content
        moved[group] = np.ptp(pd.read_csv(out / "prediction.csv")["m4_x_mean"])
        said[group] = [caution["code"] for caution in facts["cautions"]]
    assert said == {None: ["drives_unstated"], "april": []}
    assert moved["april"] < 0.2 * moved[None]


def test_wrong_requests_are_named(posterior, tmp_path):
    with pytest.raises(InputError, match="one file"):
        predict(posterior, COMMANDS, tmp_path, start=COMMANDS)
    fit = Calibration.of_posterior(posterior, Model.read(EXPERIMENTS / "demo.toml", COARSE))
    with pytest.raises(InputError, match="no such file"):
        rb.predict(fit, "demo/none.nc", out=tmp_path)
    stranger = PosteriorRecord.load(posterior / "posterior.nc")
    infos = (*stranger.parameters, ParameterInfo("delay", "s", 0.0, 1.0, prior_of(0.1)))
    draws = {**stranger.posterior, "delay": np.full((1, 40), 0.1)}
    (tmp_path / "other").mkdir()
    PosteriorRecord(infos, draws, attrs=FITTED_WITH).save(tmp_path / "other" / "posterior.nc")
    with pytest.raises(InputError, match="the experiment's model lacks"):
        predict(tmp_path / "other", COMMANDS, tmp_path)


def test_asl_commands_may_come_with_a_start_pose_or_without(datasets):
    from rfdropo_bayes.data import DataSpec, load_recordings, load_unseen

    observations, commands = (f"asl_trunk/{kind}_controlled_1.csv.gz" for kind in ("observations", "control_inputs"))
    entry = {"observations": observations, "commands": commands}
    spec = DataSpec.parse({"format": "asl-csv", "fit": [entry]})
    measured = load_recordings(spec, datasets)[0]
    seen = load_unseen(spec, datasets, commands, observations)
    np.testing.assert_array_equal(seen.position[0], measured.position[0])
    assert not seen.position_mask[1:].any()
    np.testing.assert_array_equal(seen.command, measured.command)
    np.testing.assert_array_equal(seen.initial_command, measured.initial_command)
    unknown = load_unseen(spec, datasets, commands)
    assert not unknown.position_mask.any()
    np.testing.assert_array_equal(unknown.command, measured.command)


def deviating(recordings, groups):
    """A space of one parameter that deviates between groups with a spread of 2, and draws of it."""
    spec = ParameterSpec("level", "m", -9.0, 9.0, 0.0, {"distribution": "Normal", "loc": 0.0, "scale": 1.0}, "")
    pooled = {"level": Pooled(2.0, gather_groups(recordings, groups))}
    space = build_scopes([spec], {"level": {}}, {}, recordings, pooled=pooled)
    return space, {name: np.asarray(v) for name, v in space.sample(jax.random.key(1), 4000).items()}


def test_a_new_recording_of_a_known_day_has_that_day_s_values_and_one_of_a_new_day_their_spread():
    days = {"january": "jan*", "april": "apr*"}
    space, values = deviating(["jan_1", "jan_2"], days)
    extension = space.extended(["jan_3", "apr_1"], ["jan_1", "jan_2"], days)
    found, drawn = extension.scopes, draw_extended(extension, values, ["jan_3", "apr_1"], jax.random.key(0))
    january, april = (found.values_in(name, drawn)["level"] for name in ("jan_3", "apr_1"))
    np.testing.assert_array_equal(january, values["level"] + values["level_deviation@january"])
    new = april - values["level"]
    assert np.std(new) == pytest.approx(2.0, rel=0.06)  # 5 standard errors
    assert abs(np.corrcoef(new, values["level_deviation@january"])[0, 1]) < 0.08


def test_deviations_given_a_first_row_are_draws_from_the_linear_model_s_posterior():
    """Two markers move by 1 and 3 along x per unit of the deviation; the closed form is that of a linear regression."""
    space, values = deviating(["new"], {})
    slope, left = np.array([1.0, 3.0]), ModelError(("a", "b"), (2.0,) * 3 + (5.0,) * 3, 0.1)
    measured = np.array([[4.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    recordings = SimpleNamespace(
        names=("new",),
        markers=("a", "b"),
        position=measured[None, None],
        line=SimpleNamespace(valid=np.ones((1, 1, 2)) > 0),
    )

    def rollouts(given, horizon):
        moved = np.zeros((len(given["level"]), horizon, 2, 3))
        moved[..., 0] = (given["level_deviation@new"][:, None] * slope)[:, None]
        return moved.reshape(len(moved), horizon, 6), np.zeros(len(moved))

    problem = SimpleNamespace(
        model=SimpleNamespace(scopes=space, recordings=recordings), n_recordings=1, rollouts=rollouts
    )
    drawn = [p for p in space.parameters if p.scope.added_to]
    matched, unmatched = match_first_row(problem, values, ["new"], drawn, left, jax.random.key(2))
    found = matched["level_deviation@new"]
    assert unmatched == 0
    weight = 1.0 / np.array([2.0, 5.0]) ** 2
    precision = 1.0 / 4.0 + np.sum(slope**2 * weight)
    assert abs(np.mean(found) - np.sum(slope * weight * measured[:, 0]) / precision) < 5.0 / np.sqrt(4000 * precision)
    assert np.std(found) == pytest.approx(precision**-0.5, rel=0.06)
    np.testing.assert_array_equal(
        match_first_row(problem, values, ["new"], drawn, None, jax.random.key(2))[0]["level_deviation@new"],
        values["level_deviation@new"],
    )


def test_draws_count_as_they_predict_the_first_row():
    """Against the weighted mean of the closed form; a row that all but a few draws miss leaves a tenth of them."""
    simulated = np.random.default_rng(0).normal(size=(4000, 2, 1, 3))
    measured = np.full((2, 1, 1, 3), 1.0)
    line = SimpleNamespace(valid=np.ones((2, 1, 1), dtype=bool))
    recordings = SimpleNamespace(names=("seen", "new"), markers=("a",), position=measured, line=line)
    index = resampled_by_first_row(
        recordings, simulated, ["new"], ModelError(("a",), (2.0,) * 3, 0.1), jax.random.key(0)
    )
    np.testing.assert_array_equal(index[:, 0], np.arange(4000))
    drawn = simulated[index[:, 1], 1, 0]
    # prior N(0, 1), a measurement of 1 with deviation 2: the posterior is N(1/5, 4/5); 5 standard errors of the draws
    np.testing.assert_allclose(drawn.mean(axis=0), 0.2, atol=5.0 * np.sqrt(0.8 / 3000))
    np.testing.assert_allclose(drawn.std(axis=0), np.sqrt(0.8), rtol=0.08)
    few = resampled_by_first_row(
        recordings, simulated, ["new"], ModelError(("a",), (1e-3,) * 3, 0.1), jax.random.key(0)
    )[:, 1]
    share = np.bincount(few, minlength=4000) / 4000
    assert 1.0 / np.sum(share**2) == pytest.approx(400, rel=0.1)


def test_a_first_row_far_from_the_model_s_is_found_by_the_model_s_own_error():
    """Markers are off by 2 and 3 times the model's error: 2.55 times in root mean square. By chance alone one of twenty
    rows of independent normal errors is."""
    left = ModelError(("a", "b"), (1.0, 2.0, 2.0, 4.0, 4.0, 2.0), 0.1)  # off by 3 and by 6
    simulated, seen = np.zeros((1, 2, 2, 3)), np.ones((2, 2), dtype=bool)
    off = np.array([[[6.0, 0.0, 0.0], [0.0, 0.0, 18.0]], [[99.0, 0.0, 0.0]] * 2])

    def far(observed, mask=seen, error=left):
        row = RecordingPrediction("run", "test", np.arange(2.0), ("a", "b"), observed, mask, simulated)
        return first_row_distances([row], error)

    assert far(off)["run"] == pytest.approx(np.sqrt((2.0**2 + 3.0**2) / 2))
    assert far(off, np.array([[True, False], [True, True]]))["run"] == pytest.approx(2.0)
    assert not far(off, np.array([[False, False], [True, True]]))
    assert not far(0.4 * off)
    assert not far(off, error=None)
    rows = np.random.default_rng(0).normal(size=(2000, 2, 2, 3)) * np.reshape(left.scale, (2, 3))
    assert 0.03 < np.mean([bool(far(row)) for row in rows]) < 0.09


def test_noise_is_not_pooled():
    """It is the same for all recordings: a deviation of it would be drawn and never used."""
    spec = ModelSpec(Robot.load("smooth_arm"), per_group={"observation_noise": 1e-3})
    with pytest.raises(InputError, match="unknown parameter 'observation_noise'"):
        pooling(spec, (ParameterSpec("mass", "kg", 0.0, 1.0, 0.1, {}, ""),), ["a"])


def beyond_null(spec: ParameterSpec, sign: float) -> float:
    """A value at which a mechanism acts: twice the spread of its prior from the null value, within the bounds."""
    prior = dict(spec.prior)
    value = (
        spec.grid[1] if spec.grid else prior.get("median", prior.get("loc", 0.0) + 2.0 * sign * prior.get("scale", 0))
    )
    return float(np.clip(value, 0.9 * spec.low, 0.9 * spec.high))


MEASURING = sorted(n for n, m in REGISTRY.items() if m.stage in ("actuation", "sensing"))


@pytest.mark.slow
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("name", MEASURING)
def test_a_simulated_recording_is_predicted_from_its_first_row(name, sign, tmp_path):
    """Whatever drives and cameras do: the frame's offset, found from the first row alone, is nil, and so is the error.

    A clock that is late shows in the first row what the body does later.
    """
    experiment = {
        "robot": "smooth_arm",
        "simulator": {"time_step": 0.005},
        "model": {"noise": "white", "mechanisms": [name], "priors": {"offset": {}}, "per_recording": {"offset": "all"}},
    }
    specs = [spec for mechanism in mechanisms_named([name], Robot.load("smooth_arm")) for spec in mechanism.parameters]
    values = {spec.name: beyond_null(spec, sign) for spec in specs}
    commands = {"duration": 0.8, "interval": 0.05, "step": 0.004, "low": 0, "high": 0.02, "sample_time": 0.05}
    made = experiment | {
        "commands": commands | {"recordings": ["new"]},
        "model": {"mechanisms": [name], "fixed": values},
    }
    simulate_all(Model.of_experiment(Experiment.model_validate(made), tmp_path), tmp_path)
    data = {"format": "netcdf", "fit": ["trajectory.nc"]}
    (tmp_path / "own.toml").write_text(tomli_w.dumps(experiment | {"data": data}))
    fixed = {"observation_noise": 1e-6} | values
    offset = {f"offset_{axis}@old": np.random.default_rng(i).normal(0.0, 0.01, (1, 4)) for i, axis in enumerate("xyz")}
    priors = {"observation_noise": prior_of(1e-3)} | {s.name: dict(s.prior) for s in specs}
    infos = [ParameterInfo(n, "-", -np.inf, np.inf, priors[n]) for n in fixed]
    normal = {"distribution": "Normal", "loc": 0.0, "scale": 0.01}
    infos += [ParameterInfo(f"offset_{axis}", "m", -0.5, 0.5, normal, scope=Scope("old")) for axis in "xyz"]
    draws = {n: np.full((1, 4), v) for n, v in fixed.items()} | offset
    PosteriorRecord(tuple(infos), draws, attrs=FITTED_WITH).save(tmp_path / "posterior.nc")
    fit = Calibration.of_posterior(tmp_path, Model.read(tmp_path / "own.toml"))
    rb.predict(fit, "trajectory.nc", out=tmp_path / "out")
    with xr.open_dataset(tmp_path / "out" / "prediction.nc") as opened:
        predicted = opened["mean"].values
    measured = Trajectory.load(tmp_path / "trajectory.nc").position
    assert np.ptp(measured, axis=0).max() > 0.01
    np.testing.assert_allclose(predicted, measured, atol=1e-5)
