"""A posterior survives the disk, and a file that is none is refused in one clear line."""

from __future__ import annotations

import warnings
from pathlib import Path

import arviz
import numpy as np
import pytest
import xarray as xr

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.posteriors import (
    LessMedian,
    ParameterInfo,
    PosteriorRecord,
    ProductOfPowers,
    RecordingPrediction,
    Scope,
    load_posterior,
    summarise,
)

BESIDE = LessMedian("density_less_median", "kg/m3", "density", ("young_modulus", "density", "offset_x@day/1"))


def make_record(rng: np.random.Generator) -> PosteriorRecord:
    """Two parameters on a scale ridge, one of a recording with a slash in its name, two recordings of unlike length."""
    scale = rng.normal(0.0, 0.4, (2, 60))
    posterior = {
        "young_modulus": 4.5e6 * np.exp(scale + 0.01 * rng.normal(size=(2, 60))),
        "density": 1080.0 * np.exp(scale),
        "offset_x@day/1": rng.normal(0.0, 1e-3, (2, 60)),
    }
    parameters = (
        ParameterInfo("young_modulus", "Pa", 1e4, 1e10, {"distribution": "LogNormal", "median": 4.5e6, "sigma": 0.5}),
        ParameterInfo("density", "kg/m3", 1.0, 1e5, {"distribution": "LogNormal", "median": 1e3, "sigma": 0.5}),
        ParameterInfo("offset_x", "m", description="offset of the camera frame", scope=Scope("day/1")),
    )
    recordings = []
    for i, rows in enumerate((7, 5)):
        recordings.append(
            RecordingPrediction(
                name=f"day/{i}",
                split=("fit", "test")[i],
                time=0.1 * np.arange(rows),
                marker_names=("middle", "tip"),
                observed=rng.normal(0.0, 0.05, (rows, 2, 3)),
                mask=rng.random((rows, 2)) > 0.2,
                predicted=rng.normal(0.0, 0.05, (11 + i, rows, 2, 3)),
                prior_predicted=rng.normal(0.0, 0.1, (4, rows, 2, 3)) if i == 0 else None,
                repeat_group=i - 1,
            )
        )
    return PosteriorRecord(
        parameters,
        posterior,
        {name: values[0] for name, values in posterior.items()},
        tuple(recordings),
        trace=[{"horizon": 3, "ess": 0.5, "note": "text is dropped"}, {"horizon": 7, "ess": 0.6, "final": True}],  # type: ignore[dict-item]
        block_scores=[{"first_row": 1, "last_row": 3, "log_score": 4.0, "sd": float("nan")}],
        log_likelihood=rng.normal(size=(2, 60, 7)),
        attrs={"data_sha256": "ab", "seed": 3, "versions": {"numpy": "2"}},
    ).with_derived([ProductOfPowers("specific_stiffness", "m2/s2", {"young_modulus": 1, "density": -1}), BESIDE])


@pytest.fixture
def record() -> PosteriorRecord:
    return make_record(np.random.default_rng(0))


def test_everything_survives_the_disk(record: PosteriorRecord, tmp_path: Path) -> None:
    record.save(tmp_path / "posterior.nc")
    back = PosteriorRecord.load(tmp_path / "posterior.nc")
    assert back.parameters == record.parameters
    assert back.derived == record.derived
    assert back.attrs == record.attrs
    for name, values in record.posterior.items():
        np.testing.assert_array_equal(back.posterior[name], values)
        np.testing.assert_array_equal(back.prior[name], record.prior[name])
    for old, new in zip(record.recordings, back.recordings, strict=True):
        assert (old.name, old.split, old.marker_names, old.repeat_group) == (
            new.name,
            new.split,
            new.marker_names,
            new.repeat_group,
        )
        np.testing.assert_array_equal(new.mask, old.mask)
        np.testing.assert_array_equal(new.time, old.time)
        np.testing.assert_array_equal(new.observed, old.observed)
        np.testing.assert_array_equal(new.central, old.central)
        np.testing.assert_allclose(new.predicted, old.predicted, rtol=1e-6)
        assert (new.prior_predicted is None) == (old.prior_predicted is None)
    assert back.trace == ({"horizon": 3.0, "ess": 0.5}, {"horizon": 7.0, "ess": 0.6, "final": 1.0})
    assert back.block_scores == ({"first_row": 1.0, "last_row": 3.0, "log_score": 4.0},)
    np.testing.assert_array_equal(back.log_likelihood, record.log_likelihood)


def test_arviz_scores_what_is_written_and_finds_a_prediction_of_all_that_is_observed(
    record: PosteriorRecord, tmp_path: Path
) -> None:
    """Recordings of unlike length and number of draws, one of them without prior predictions."""
    record.save(tmp_path / "posterior.nc")
    read = arviz.from_netcdf(tmp_path / "posterior.nc")
    for name, observed in read.observed_data.data_vars.items():
        assert read.posterior_predictive[name].dims == ("chain", "draw", *observed.dims)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # these draws are no posterior
        assert np.isfinite(arviz.loo(read).elpd_loo)


@pytest.mark.slow
def test_arviz_plots_predictions(record: PosteriorRecord, tmp_path: Path) -> None:
    record.save(tmp_path / "posterior.nc")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ArviZ calls what matplotlib has deprecated
        axes = arviz.plot_ppc(arviz.from_netcdf(tmp_path / "posterior.nc"), num_pp_samples=4, random_seed=0)
    assert len(np.ravel(axes)) == len(record.recordings)


def test_derived_quantities_follow_their_draws(record: PosteriorRecord) -> None:
    ratio = record.posterior["young_modulus"] / record.posterior["density"]
    np.testing.assert_allclose(record.posterior["specific_stiffness"], ratio, rtol=1e-12)
    assert not record.posterior[BESIDE.name].any(), "density lies between the two others"
    assert [info.name for info in record.free] == ["young_modulus", "density", "offset_x@day/1"]
    with pytest.raises(InputError, match="unknown parameter 'mass'"):
        record.with_derived([ProductOfPowers("x", "-", {"mass": 1})])
    with pytest.raises(InputError, match="not always positive"):
        record.with_derived([ProductOfPowers("x", "-", {"offset_x@day/1": 1})])


def test_files_that_are_no_posterior_are_refused(record: PosteriorRecord, tmp_path: Path) -> None:
    path = tmp_path / "posterior.nc"
    with pytest.raises(InputError, match="no such file"):
        load_posterior(path)
    path.write_bytes(b"not a NetCDF file")
    with pytest.raises(InputError, match="not a readable NetCDF"):
        load_posterior(path)
    record.save(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match="not a readable NetCDF"):
        load_posterior(path)
    xr.Dataset({"a": ("x", [1.0])}).to_netcdf(path, engine="h5netcdf")
    with pytest.raises(InputError, match="not a posterior of ours"):
        load_posterior(path)


def test_an_unwritable_folder_is_refused(record: PosteriorRecord, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written"):
        record.save(tmp_path / "missing" / "posterior.nc")


def test_predictions_must_fit_the_measurements() -> None:
    with pytest.raises(InputError, match="differ in shape"):
        RecordingPrediction(
            "r", "fit", np.arange(3.0), ("tip",), np.zeros((3, 1, 3)), np.ones((3, 1), bool), np.zeros((5, 4, 1, 3))
        )


def test_diagnostics_tell_mixed_chains_from_stuck_ones() -> None:
    """False-failure rate below 1e-6 under other seeds: the effective size of 4000 independent draws varies by 3 %."""
    rng = np.random.default_rng(1)
    good = rng.normal(size=(4, 1000))
    stuck = good + 3.0 * np.arange(4)[:, None]
    table = summarise({"good": good, "stuck": stuck})
    assert table["good"]["r_hat"] < 1.01
    assert table["stuck"]["r_hat"] > 1.5
    assert abs(table["good"]["ess_bulk"] / 4000 - 1) < 0.25
    assert table["stuck"]["ess_bulk"] < 50
    assert np.isnan(summarise({"one": good[:1]})["one"]["r_hat"])


def test_draws_that_are_not_finite_are_refused(record: PosteriorRecord, tmp_path: Path) -> None:
    bad = {name: np.where(values > 0, values, np.nan) for name, values in record.posterior.items()}
    broken = PosteriorRecord(record.parameters, bad)
    with pytest.raises(InputError, match="not finite"):
        broken.save(tmp_path / "posterior.nc")
