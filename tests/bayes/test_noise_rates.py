"""A noise that lasts is the same process in recordings of every rate."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import rfdropo_bayes as rb
from rfdropo_bayes.bayes.noise import Autoregression
from rfdropo_bayes.bayes.noise.autoregression import estimate_noise
from rfdropo_bayes.bayes.repeat_noise import repeat_shift
from tests.verbs.toys import BOX, PRIORS, STEP

TAU, SLOW = 0.3, 0.1
STEPS = np.array([SLOW, 3.0 * SLOW, 0.5 * SLOW])
FIRST = Autoregression(np.array([2.0, 0.5]), np.array([1.0, np.exp(-SLOW / TAU)]), "stated", np.inf, step=SLOW)


def test_every_recording_has_the_density_of_the_process_at_its_own_times():
    """An Ornstein-Uhlenbeck process, seen at three rates; in the last recording two rows are missing."""
    rng, rows = np.random.default_rng(1), 7
    series, valid = rng.normal(size=(3, rows, 2)), np.ones((3, rows, 2), dtype=bool)
    valid[2, 5:] = False
    found = FIRST.at(STEPS).row_log_density(series, valid).sum(axis=-1)
    for density, own, step, kept in zip(found, series, STEPS, (7, 7, 5), strict=True):
        time = step * np.arange(kept)
        memory = np.exp(-np.abs(time[:, None] - time) / TAU)
        joint = [stats.multivariate_normal(cov=size**2 * memory) for size in FIRST.scale]
        expected = sum(each.logpdf(own[:kept, column]) for column, each in enumerate(joint))
        assert float(density) == pytest.approx(expected, rel=1e-9)
    white = FIRST.at(STEPS).whiten(series, valid)
    np.testing.assert_allclose(FIRST.at(STEPS).colour(white, valid), np.where(valid, series, 0.0), atol=1e-12)
    chosen = FIRST.at(STEPS).of_recordings([2, 0])
    np.testing.assert_array_equal(chosen.whiten(series[[2, 0]], valid[[2, 0]]), white[[2, 0]])


def test_rows_of_one_rate_are_left_as_they_are():
    """Clocks jitter; and a noise whose rate is not known has one for all rows."""
    assert FIRST.at(np.array([SLOW, 1.02 * SLOW])) is FIRST
    assert FIRST.at(STEPS).at([SLOW]).paces is None
    unknown = Autoregression(np.ones(1), np.array([1.0, 0.5]), "stated", np.inf)
    assert unknown.at(STEPS) is unknown


def test_a_longer_memory_is_read_at_the_lags_of_other_rates():
    """Every second row of a third-order process: four rows are predicted under the joint covariance, exactly."""
    memory = np.array([1.0, 0.9, 0.7, 0.45])
    noise = Autoregression(np.ones(1), memory, "stated", np.inf, step=SLOW)
    lags = [*memory]
    for _ in range(4):
        lags.append(float(noise.predictors[0][-1] @ lags[:-4:-1]))
    cov = np.array(lags)[2 * np.abs(np.subtract.outer(np.arange(4), np.arange(4)))]
    series = np.random.default_rng(2).normal(size=(1, 4, 1))
    found = noise.at([2.0 * SLOW]).row_log_density(series, np.ones(series.shape, dtype=bool)).sum()
    assert float(found) == pytest.approx(stats.multivariate_normal(cov=cov).logpdf(series[0, :, 0]), rel=1e-9)
    np.testing.assert_allclose(noise.resampled(2.0 * SLOW).autocorrelation, np.array(lags)[[0, 2, 4, 6]])


@pytest.mark.slow
def test_draws_forget_after_the_same_time_at_every_rate():
    """4000 draws know a correlation to 0.016; four times that."""
    noise, rows = FIRST.at(STEPS), 6
    keys = jax.random.split(jax.random.key(0), 4000)
    by_time = [
        jax.vmap(lambda key, step=step: noise.draw_rows(key, rows, step * jnp.arange(rows)))(keys) for step in STEPS
    ]
    plain = noise.draw(np.random.default_rng(0), (4000, 3, rows, 2))
    for index, step in enumerate(STEPS):
        for drawn in (np.asarray(by_time[index]), plain[:, index]):
            np.testing.assert_allclose(drawn.std(axis=0), np.tile(FIRST.scale, (rows, 1)), rtol=0.06)
            seen = np.corrcoef(drawn[:, -2, 0], drawn[:, -1, 0])[0, 1]
            assert seen == pytest.approx(np.exp(-step / TAU), abs=0.065)


def test_memory_is_estimated_from_the_rate_with_most_rows():
    """20 recordings of 400 rows know a correlation of 0.72 to 0.008, five times that; rows four times as far apart,
    pooled with them as if they had one rate, would make it 0.6."""
    rng, steps = np.random.default_rng(3), np.array([SLOW] * 20 + [4.0 * SLOW] * 12)
    series = FIRST.of_columns([0]).at(steps).draw(rng, (32, 400, 1))
    valid = np.ones(series.shape, dtype=bool)
    pooled = estimate_noise(series, valid, 1.0, source="repeats", order=1)
    found = estimate_noise(series, valid, 1.0, source="repeats", order=1, steps=steps)
    assert found.autocorrelation[1] == pytest.approx(np.exp(-SLOW / TAU), abs=0.04)
    assert pooled.autocorrelation[1] < 0.63
    assert found.step == pytest.approx(SLOW)
    assert found.scale[0] == pytest.approx(2.0, rel=0.05)
    assert found.row_log_density(series, valid).sum() > pooled.row_log_density(series, valid).sum() + 100.0


def test_slow_noise_in_short_repeats_is_no_constant_between_them():
    """The mean of few rows varies more than that of many: 20 sets of repeats, of which two are short; under the
    variance of the long ones' mean, many sets would be called shifted."""
    noise, steps = Autoregression(np.ones(3), np.array([1.0, 0.9]), "stated", np.inf), np.full(10, SLOW)
    valid = np.ones((10, 1000, 3), dtype=bool)
    valid[6:, 30:] = False
    for seed in range(20):
        drawn = noise.draw(np.random.default_rng(seed), (10, 1000, 3)).reshape(5, 2, 1000, 3)
        left = (drawn - drawn.mean(axis=1, keepdims=True)).reshape(10, 1000, 3)
        assert repeat_shift(np.where(valid, left, 0.0), valid, 0.5, steps) is None


def test_a_stated_noise_is_the_inferred_one_at_its_values_whatever_the_rates():
    walk = {"duration": 1.2, "interval": 0.2, "step": 0.01, "low": -0.03, "high": 0.03}
    runs = []
    for name, step in (("fine", STEP), ("coarse", 3.0 * STEP)):
        noise = {"standard_deviation": 1e-3}
        truth = {"gain": 1.2, "time_constant": 0.3, "zero": 0.0}
        runs += rb.simulate(
            rb.Model(BOX), walk | {"recordings": [name], "sample_time": step}, parameters=truth, noise=noise, seed=1
        )
    values = {"gain": np.array([1.0]), "time_constant": np.array([0.3]), "zero": np.array([0.0])}
    known = {"observation_noise": 1.5e-3, "noise_correlation_time": 0.1}
    inferred = rb.Model(BOX, noise="ar1", priors=PRIORS, fixed=known).problem(runs)
    table = {"standard_deviation": 1.5e-3, "correlation_time": 0.1}
    stated = rb.Model(BOX, noise=table, priors=PRIORS).problem(runs)
    rows = [each.row_log_likelihood(values, each.n_rows)[0] for each in (inferred, stated)]
    np.testing.assert_allclose(rows[1], rows[0], rtol=1e-9)
