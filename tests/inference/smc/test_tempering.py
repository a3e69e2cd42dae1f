"""Steps of tempering."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfdropo_bayes.inference.smc.tempering import log_effective_sample_size, next_step, path_density


@given(scale=st.floats(1e-3, 1e9), dead=st.integers(0, 30))
def test_a_step_keeps_the_effective_sample_size_whatever_the_likelihood_scale(scale, dead):
    likelihood = scale * np.random.default_rng(0).normal(size=200) ** 2
    likelihood[:dead] = -np.inf

    def log_weights_at(step):
        return -np.log(200) - (step * likelihood if step else np.zeros(200)) * np.where(likelihood == -np.inf, -1, 1)

    step, reached = next_step(log_weights_at, 1.0, 0.5)
    ess = math.exp(log_effective_sample_size(log_weights_at(step)))
    assert 0.0 < step <= 1.0
    if reached:
        assert ess >= 0.5 * (200 - dead) - 1e-6
    else:
        assert ess == pytest.approx(0.5 * (200 - dead), rel=1e-3)


def test_effective_sample_size_of_equal_and_of_single_weights():
    assert math.exp(log_effective_sample_size(np.zeros(7))) == pytest.approx(7.0)
    assert math.exp(log_effective_sample_size(np.array([0.0, -np.inf, -np.inf]))) == pytest.approx(1.0)
    assert log_effective_sample_size(np.full(3, -np.inf)) == -math.inf


@pytest.mark.parametrize(
    ("progress", "wanted"), [(0.0, [0.0, 0.0]), (0.25, [0.25, 0.5]), (1.5, [6.0, 12.0]), (3.0, [111.0, 222.0])]
)
def test_the_density_of_a_path_has_whole_rows_and_a_share_of_the_next(progress, wanted):
    rows = np.array([[1.0, 10.0, 100.0], [2.0, 20.0, 200.0]])
    np.testing.assert_allclose(path_density(rows, progress), wanted)
