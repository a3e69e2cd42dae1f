"""The noise model against the multivariate normal it stands for."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rfdropo_bayes.bayes.noise import (
    NOISE_MODELS,
    Noise,
    draw_noise,
    noise_specs,
    noise_values,
    row_log_density,
    timeline,
    whiten,
)
from rfdropo_bayes.errors import InputError

SIGMA, TAU, LASTING = 0.7, 0.3, 1.1
AR1, AUTO = Noise(SIGMA, TAU), Noise(SIGMA, TAU, LASTING)


def irregular(rows: int = 9) -> np.ndarray:
    return np.cumsum(np.r_[0.0, np.random.default_rng(1).uniform(0.05, 0.4, rows - 1)])


def covariance(time: np.ndarray, noise: Noise = AR1) -> np.ndarray:
    lasting = np.exp(-np.abs(time[:, None] - time) / TAU)
    if noise.lasting is None:
        return SIGMA**2 * lasting
    return SIGMA**2 * np.eye(len(time)) + LASTING**2 * lasting


@pytest.mark.parametrize("noise", [AR1, AUTO], ids=["ar1", "auto"])
def test_rows_add_up_to_the_joint_density_with_rows_masked(noise):
    """Lasting noise seen at irregular times, some missing: the closed form is a multivariate normal."""
    time = irregular()
    valid = np.array([1, 1, 0, 0, 1, 1, 1, 0, 1], dtype=bool)
    residual = np.random.default_rng(2).normal(size=(len(time), 1, 3))
    rows = row_log_density(residual, noise, timeline(time, valid[:, None]))
    joint = stats.multivariate_normal(cov=covariance(time[valid], noise))
    for prefix in range(1, len(time) + 1):
        kept = valid[:prefix]
        prior = stats.multivariate_normal(cov=covariance(time[:prefix][kept], noise))
        expected = sum(prior.logpdf(residual[:prefix][kept, 0, axis]) for axis in range(3))
        np.testing.assert_allclose(jnp.sum(rows[:prefix]), expected, rtol=1e-10)
    np.testing.assert_allclose(jnp.sum(rows), sum(joint.logpdf(residual[valid, 0, a]) for a in range(3)), rtol=1e-10)


def test_white_noise_is_independent():
    residual = np.random.default_rng(3).normal(size=(5, 2, 3))
    line = timeline(np.arange(5.0), np.ones((5, 2), bool))
    expected = stats.norm(0, SIGMA).logpdf(residual).sum(axis=(1, 2))
    np.testing.assert_allclose(row_log_density(residual, Noise(SIGMA), line), expected, rtol=1e-10)


@pytest.mark.parametrize("noise", [AR1, AUTO], ids=["ar1", "auto"])
def test_draws_have_the_stated_covariance(noise):
    """20,000 draws: a sample covariance is off by more than 5 standard errors with probability below 1e-5 over all
    45 entries."""
    time = irregular()
    draws = jax.vmap(lambda key: draw_noise(key, jnp.asarray(time), 1, noise))(
        jax.random.split(jax.random.key(4), 20000)
    )[:, :, 0, 0]
    expected = covariance(time, noise)
    error = np.cov(np.asarray(draws).T) - expected
    bound = 5 * np.sqrt((expected**2 + np.outer(np.diag(expected), np.diag(expected))) / 20000)
    assert np.all(np.abs(error) < bound)


@pytest.mark.parametrize("noise", [AR1, AUTO], ids=["ar1", "auto"])
def test_whitened_draws_are_independent_and_the_gradient_is_finite(noise):
    time = irregular()
    line = timeline(time, np.ones((len(time), 1), bool))
    drawn = draw_noise(jax.random.key(5), jnp.asarray(time), 1, noise)
    white, _ = whiten(drawn, noise, line)
    assert stats.kstest(np.asarray(white).ravel(), "norm").pvalue > 1e-3  # false-failure rate 1e-3 for this seed's draw

    def density(tau):
        return jnp.sum(row_log_density(drawn, noise._replace(tau=tau), line))

    step = 1e-5
    difference = (density(TAU + step) - density(TAU - step)) / (2 * step)
    assert float(jax.grad(density)(TAU)) == pytest.approx(float(difference), rel=1e-5)


def test_the_sum_of_both_parts_becomes_either_where_the_other_vanishes():
    time = irregular()
    valid = np.array([1, 0, 1, 1, 0, 0, 1, 1, 1], dtype=bool)[:, None]
    residual, line = np.random.default_rng(6).normal(size=(len(time), 1, 3)), timeline(time, valid)
    for limit, other in ((Noise(1e-7, TAU, SIGMA), Noise(SIGMA, TAU)), (Noise(SIGMA, TAU, 1e-7), Noise(SIGMA))):
        expected = row_log_density(residual, other, line)
        np.testing.assert_allclose(row_log_density(residual, limit, line), expected, rtol=1e-9)


@pytest.mark.parametrize("degrees", [1.5, 4.0, 300.0])
def test_heavy_tails_have_the_density_of_a_student_t(degrees):
    """Its scale is such that sigma is half of the central 68 %, as of a normal distribution."""
    residual = np.random.default_rng(7).normal(size=(40, 2, 3)) * np.geomspace(1e-9, 30.0, 40)[:, None, None]
    line = timeline(np.arange(40.0), np.ones((40, 2), bool))
    scale = SIGMA / stats.t.ppf(stats.norm.cdf(1.0), degrees)
    expected = stats.t(degrees, scale=scale).logpdf(residual).sum(axis=(1, 2))
    noise = Noise(SIGMA, degrees=degrees)
    np.testing.assert_allclose(row_log_density(residual, noise, line), expected, rtol=1e-5)
    slope = jax.grad(lambda r: jnp.sum(row_log_density(r, noise, line)))(jnp.zeros_like(residual))
    np.testing.assert_array_equal(slope, 0.0)
    drawn = np.asarray(draw_noise(jax.random.key(8), jnp.arange(4000.0), 1, noise)).ravel()
    assert stats.kstest(drawn, stats.t(degrees, scale=scale).cdf).pvalue > 1e-3  # false-failure rate 1e-3


def test_every_model_reads_its_own_parameters_and_says_what_is_missing():
    for model in NOISE_MODELS:
        known = {spec.name: spec.nominal for spec in noise_specs(model)}
        assert sum(value is not None for value in noise_values(model, known)) == len(known)
    with pytest.raises(InputError, match="lasting_noise"):
        noise_values("auto", {"observation_noise": 1e-3, "noise_correlation_time": 0.1})
