"""The noise model against the multivariate normal it stands for."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rfdropo_bayes.bayes.noise import draw_noise, row_log_density, timeline, whiten

SIGMA, TAU = 0.7, 0.3


def irregular(rows: int = 9) -> np.ndarray:
    return np.cumsum(np.r_[0.0, np.random.default_rng(1).uniform(0.05, 0.4, rows - 1)])


def covariance(time: np.ndarray) -> np.ndarray:
    return SIGMA**2 * np.exp(-np.abs(time[:, None] - time) / TAU)


def test_rows_add_up_to_the_joint_density_with_rows_masked():
    """Ornstein-Uhlenbeck noise seen at irregular times, some missing: the closed form is a multivariate normal."""
    time = irregular()
    valid = np.array([1, 1, 0, 0, 1, 1, 1, 0, 1], dtype=bool)
    residual = np.random.default_rng(2).normal(size=(len(time), 1, 3))
    rows = row_log_density(residual, SIGMA, TAU, timeline(time, valid[:, None]))
    joint = stats.multivariate_normal(cov=covariance(time[valid]))
    for prefix in range(1, len(time) + 1):
        kept = valid[:prefix]
        prior = stats.multivariate_normal(cov=covariance(time[:prefix][kept]))
        expected = sum(prior.logpdf(residual[:prefix][kept, 0, axis]) for axis in range(3))
        np.testing.assert_allclose(jnp.sum(rows[:prefix]), expected, rtol=1e-10)
    np.testing.assert_allclose(jnp.sum(rows), sum(joint.logpdf(residual[valid, 0, a]) for a in range(3)), rtol=1e-10)


def test_white_noise_is_independent():
    residual = np.random.default_rng(3).normal(size=(5, 2, 3))
    line = timeline(np.arange(5.0), np.ones((5, 2), bool))
    expected = stats.norm(0, SIGMA).logpdf(residual).sum(axis=(1, 2))
    np.testing.assert_allclose(row_log_density(residual, SIGMA, None, line), expected, rtol=1e-10)


def test_draws_have_the_stated_covariance():
    """20,000 draws: a sample covariance is off by more than 5 standard errors with probability below 1e-5 over all
    45 entries."""
    time = irregular()
    draws = jax.vmap(lambda key: draw_noise(key, jnp.asarray(time), 1, SIGMA, TAU))(
        jax.random.split(jax.random.key(4), 20000)
    )[:, :, 0, 0]
    expected = covariance(time)
    error = np.cov(np.asarray(draws).T) - expected
    bound = 5 * np.sqrt((expected**2 + np.outer(np.diag(expected), np.diag(expected))) / 20000)
    assert np.all(np.abs(error) < bound)


def test_whitened_draws_are_independent_and_the_gradient_is_finite():
    time = irregular()
    line = timeline(time, np.ones((len(time), 1), bool))
    noise = draw_noise(jax.random.key(5), jnp.asarray(time), 1, SIGMA, TAU)
    white, _ = whiten(noise, SIGMA, TAU, line)
    assert stats.kstest(np.asarray(white).ravel(), "norm").pvalue > 1e-3  # false-failure rate 1e-3 for this seed's draw
    gradient = jax.grad(lambda tau: jnp.sum(row_log_density(noise, SIGMA, tau, line)))(TAU)
    step = 1e-5
    difference = (
        jnp.sum(row_log_density(noise, SIGMA, TAU + step, line))
        - jnp.sum(row_log_density(noise, SIGMA, TAU - step, line))
    ) / (2 * step)
    assert gradient == pytest.approx(float(difference), rel=1e-5)
