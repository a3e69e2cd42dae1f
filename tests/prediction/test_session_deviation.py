"""Days that no fit has seen deviate by the fitted spread, in episodes of policies as in predictions."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

import rfdropo_bayes as rb
from rfdropo_bayes.policies.randomisation import fitting
from rfdropo_bayes.posteriors import ParameterInfo, PosteriorRecord, Scope
from rfdropo_bayes.prediction.model_error import ADAPTED_TO
from rfdropo_bayes.prediction.session_deviation import session_deviations
from rfdropo_bayes.results.calibrated import Calibration
from rfdropo_bayes.verbs.make_vec import randomisation_of, training_of, with_training

MODEL = rb.Model("trunk_sofa")
TABLE, _, SIMULATOR = training_of(with_training(MODEL, {"task": "TrunkReach-v0"}))
ROWS, DRAWN = 400, 4000
CENTRE, WIDTH = 4e6, 2e5  # Pa, of the value that the days share
NORMAL = {"distribution": "Normal", "loc": 0.0, "scale": 1e6}


def pooled_posterior(spread: np.ndarray | None, **attrs: str) -> Calibration:
    """Draws whose mass follows the modulus, of two days; the spread is inferred, or known to be a million."""
    rng = np.random.default_rng(0)
    modulus = rng.normal(CENTRE, WIDTH, ROWS)
    infos = [ParameterInfo("young_modulus", "Pa", 1e6, 5e7), ParameterInfo("trunk_mass", "kg", 1e-4, 10.0)]
    draws = {"young_modulus": modulus, "trunk_mass": 1e-7 * modulus}
    scale = "" if spread is None else "young_modulus_spread"
    for day, apart in {"monday": 3e5, "tuesday": -3e5}.items():
        scope = Scope(day, group=True, added_to="young_modulus", scaled_by=scale)
        infos.append(ParameterInfo("young_modulus_deviation", "Pa", prior=NORMAL, scope=scope))
        draws[infos[-1].name] = rng.normal(apart, 1e4, ROWS)
    if spread is not None:
        prior = {"distribution": "HalfNormal"}
        infos.append(ParameterInfo(scale, "Pa", 0.0, prior=prior, scope=Scope(spread=True)))
        draws[infos[-1].name] = spread
    record = PosteriorRecord(tuple(infos), {name: column[None] for name, column in draws.items()}, attrs=attrs)
    return Calibration(record, {}, "")


def episodes_of(fit: Calibration) -> dict[str, np.ndarray]:
    found = fitting(randomisation_of(TABLE, MODEL.spec, SIMULATOR, fit), SIMULATOR.parameters)
    rng = np.random.default_rng(1)
    drawn = [found.draw(rng) for _ in range(DRAWN)]
    return {name: np.array([each[name] for each in drawn]) for name in drawn[0]}


@pytest.mark.parametrize("inferred", [True, False])
def test_an_episode_is_on_a_day_that_deviates_by_the_spread(inferred) -> None:
    """Its variance is that of the shared value and the mean square of the spreads: far from the hard bounds a day is
    normal about a row, given the row."""
    spread = np.random.default_rng(2).uniform(2e5, 8e5, ROWS) if inferred else None
    fit = pooled_posterior(spread)
    drawn = episodes_of(fit)
    shared = fit.record.flat("young_modulus")
    square = np.mean(spread**2) if inferred else 1e12
    standard_error = np.sqrt((shared.var() + square) / DRAWN)
    assert drawn["young_modulus"].mean() == pytest.approx(shared.mean(), abs=4 * standard_error)
    # The kurtosis of this mixture is 4 at most: five deviations of the variance of 4000 draws are 14 %.
    assert drawn["young_modulus"].var() == pytest.approx(shared.var() + square, rel=0.14)
    assert np.isin(np.round(1e7 * drawn["trunk_mass"]), np.round(shared)).all()  # rows stay whole otherwise


def test_predictions_deviate_by_the_same_spread() -> None:
    spread = np.random.default_rng(2).uniform(2e5, 8e5, ROWS)
    record = pooled_posterior(spread).record
    deviation = next(info for info in record.free if info.scope.added_to)
    values = {info.name: record.flat(info.name) for info in record.free}
    found = session_deviations(record, SIMULATOR.parameters)["young_modulus"].spread
    np.testing.assert_allclose(deviation.spread_of(values, ROWS), found)


def test_no_day_is_beyond_the_hard_bounds() -> None:
    drawn = episodes_of(pooled_posterior(np.full(ROWS, 1e8)))["young_modulus"]
    low, high = next((spec.low, spec.high) for spec in SIMULATOR.parameters if spec.name == "young_modulus")
    assert low <= drawn.min() < 2e6 < 3e7 < drawn.max() <= high


def test_an_adapted_posterior_is_for_its_day() -> None:
    fit = pooled_posterior(np.full(ROWS, 5e5), **{ADAPTED_TO: "tuesday"})
    values = {name: fit.record.flat(name) for name in fit.record.posterior}
    wanted = values["young_modulus"] + values["young_modulus_deviation@tuesday"]
    assert np.isin(episodes_of(fit)["young_modulus"], wanted).all()


def test_sums_end_at_the_hard_bounds_as_in_the_fit_on_the_adapted_day_and_on_others() -> None:
    """Of a parameter that is near its bound the deviations of half of the days lead beyond it: these days are at it."""
    low = next(spec.low for spec in SIMULATOR.parameters if spec.name == "young_modulus")
    fit = pooled_posterior(np.full(ROWS, 1e9), **{ADAPTED_TO: "tuesday"})
    beyond = dict(fit.record.posterior)
    beyond["young_modulus_deviation@tuesday"] = np.where(np.arange(ROWS) % 2, -1e7, 1e5)[None]
    adapted = episodes_of(Calibration(replace(fit.record, posterior=beyond), {}, ""))["young_modulus"]
    assert np.mean(adapted == low) == pytest.approx(0.5, abs=4 * np.sqrt(0.25 / DRAWN))
    unseen = episodes_of(pooled_posterior(np.full(ROWS, 1e7)))["young_modulus"]
    assert np.mean(unseen == low) == pytest.approx(norm.cdf((low - CENTRE) / 1e7), abs=4 * np.sqrt(0.25 / DRAWN))


def test_a_posterior_of_one_day_is_drawn_as_it_is() -> None:
    record = PosteriorRecord((ParameterInfo("young_modulus", "Pa", 1e6, 5e7),), {"young_modulus": np.full((1, 3), 4e6)})
    assert set(episodes_of(Calibration(record, {}, ""))["young_modulus"]) == {4e6}
