"""Warnings of posteriors that a bound decides, judged by the posterior's own width and in the prior's coordinates."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from rfdropo_bayes.inference import methods
from rfdropo_bayes.inference.result import bound_warnings

from .toys import LinearGaussian, Ratio

GRID = (np.arange(2000) + 0.5) / 2000.0  # of a distribution function: draws without scatter


class OneParameter(LinearGaussian):
    def __init__(self, prior, bounds):
        super().__init__(d=1)
        self.prior, self.bounds = prior, {"x0": bounds}

    def sample_prior(self, key, n):
        return {"x0": self.prior(key, n)}


def uniform(key, n):
    return jax.random.uniform(key, (n,))


def log_normal(key, n):
    return 1e-2 * jax.numpy.exp(2.0 * jax.random.normal(key, (n,)))


@pytest.mark.parametrize(
    ("prior", "bounds", "draws", "side"),
    [
        (uniform, (0.0, 1.0), -1e-3 * np.log(GRID), "lower"),
        (uniform, (0.0, 1.0), 1.0 + 1e-3 * np.log(GRID), "upper"),
        (uniform, (0.0, 1.0), 2e-3 + 1e-3 * (GRID - 0.5), None),  # small, and well known
        (uniform, (0.0, 1.0), GRID, None),  # the prior come back
        (uniform, (-np.inf, np.inf), GRID, None),
        (log_normal, (0.0, 10.0), 1e-4 * np.exp(1.5 * np.sqrt(2.0) * np.log(GRID / (1.0 - GRID))), None),  # decades
        (log_normal, (1e-3, 10.0), 1e-3 * GRID**-0.5, "lower"),
    ],
)
def test_only_a_posterior_cut_off_at_its_mode_is_warned_of(prior, bounds, draws, side):
    sentences = bound_warnings(OneParameter(prior, bounds), {"x0": draws[None]})
    assert [sentence.split()[4] for sentence in sentences] == ([side] if side else [])


@pytest.mark.slow
def test_methods_say_which_bound_decides():
    """The data want a ratio of stiffness to mass that only the ends of both ranges have."""
    result = methods.run(Ratio(truth=(2.02, 0.995)), "laplace", {"blocks": 1}, jax.random.key(1))
    assert any("stiffness sits on its lower bound 2" in sentence for sentence in result.warnings)
