"""Spreads between groups, integrated out of a normal approximation: against quadrature of a linear hierarchy."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from rfdropo_bayes.inference.modes.optimisation import Laplace
from rfdropo_bayes.inference.modes.scales import integrate_scales

GROUPS, KINDS, SIGMA, WIDTH = 4, 3, 0.3, 2.0


def half_normal(scale):
    return 0.5 * np.log(2.0 / np.pi) - np.log(WIDTH) - 0.5 * (scale[:, 0] / WIDTH) ** 2


@pytest.mark.parametrize("spread", [1.0, 0.0])
def test_spread_values_and_evidence_are_those_of_quadrature(spread):
    """Values of three kinds in four groups, mean N(0, 10^2) and one spread for all; 5 standard errors of 4000 draws."""
    rng, size = np.random.default_rng(1), KINDS * GROUPS
    measured = 5.0 + rng.normal(0.0, max(spread, 1e-9), size) + rng.normal(0.0, SIGMA, size)
    design = np.concatenate([np.kron(np.eye(KINDS), np.ones((GROUPS, 1))), np.eye(size)], axis=1)
    held, d = 0.6745 * WIDTH, KINDS + size
    prior = np.diag(np.concatenate([np.full(KINDS, 0.01), np.full(size, held**-2)]))
    information = design.T @ design / SIGMA**2
    covariance = np.linalg.inv(information + prior)
    mode = covariance @ design.T @ measured / SIGMA**2
    height = -0.5 * np.sum((measured - design @ mode) ** 2) / SIGMA**2 - 0.5 * mode @ prior @ mode
    height += 0.5 * np.linalg.slogdet(prior)[1] - 0.5 * d * np.log(2.0 * np.pi)
    found = integrate_scales(
        Laplace(mode, covariance, height, information),
        np.array([held]),
        [range(KINDS, d)],
        half_normal,
        4000,
        jax.random.key(0),
    )
    grid = np.linspace(1e-4, 8.0, 1500)
    density = np.array([evidence(design, measured, s) for s in grid]) + half_normal(grid[:, None])
    total = np.log(np.sum(np.exp(density - density.max())) * (grid[1] - grid[0])) + density.max()
    weight = np.exp(density - density.max()) / np.sum(np.exp(density - density.max()))
    mean = float(weight @ grid)
    sd = float(np.sqrt(weight @ (grid - mean) ** 2))
    assert found.log_evidence == pytest.approx(total, abs=0.1)
    assert found.scales.mean() == pytest.approx(mean, abs=5.0 * sd / np.sqrt(1000))
    assert found.scales.std() == pytest.approx(sd, rel=0.2)
    np.testing.assert_allclose(
        found.position[:, :KINDS].mean(axis=0), measured.reshape(KINDS, GROUPS).mean(axis=1), atol=0.2
    )


def evidence(design, measured, spread):
    """Log evidence given the spread, without the normalisation of the noise."""
    prior = np.concatenate([np.full(KINDS, 100.0), np.full(KINDS * GROUPS, spread**2)])
    size = len(measured)
    covariance = (design * prior) @ design.T + SIGMA**2 * np.eye(size)
    return multivariate_normal(np.zeros(size), covariance).logpdf(measured) + 0.5 * size * np.log(2 * np.pi * SIGMA**2)
