"""Horizon schedules and the steps of tempering."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference.schedules import (
    SPACINGS,
    adaptive_horizon,
    block_boundaries,
    linear_horizon,
    log_effective_sample_size,
    next_step,
    paper_horizon,
)


def test_published_schedule_is_the_formula_and_never_sees_the_last_row():
    taus = [paper_horizon(i, 500, 100, mended=False) for i in range(501)]
    formula = [max(1, math.floor(100 * (1 - math.exp(-(2 / 500) * math.log(10) * i)))) for i in range(501)]
    assert taus == formula
    assert (taus[0], taus[250], taus[500]) == (1, 90, 99)


@given(iterations=st.integers(1, 300), n_rows=st.integers(1, 400))
def test_mended_schedules_grow_and_end_at_the_last_row(iterations, n_rows):
    for schedule in (paper_horizon, linear_horizon):
        taus = [schedule(i, iterations, n_rows) for i in range(iterations)]
        assert all(1 <= a <= b <= n_rows for a, b in zip(taus, [*taus[1:], n_rows], strict=True))
        if iterations > 1 or schedule is linear_horizon:
            assert taus[-1] == n_rows


def test_the_mended_curve_stays_close_to_the_published_one():
    differences = [paper_horizon(i, 500, 100) - paper_horizon(i, 500, 100, mended=False) for i in range(500)]
    assert 0 <= min(differences) <= max(differences) <= 2


@given(n_rows=st.integers(1, 2000), blocks=st.integers(1, 12), spacing=st.sampled_from(SPACINGS))
def test_blocks_are_increasing_prefixes_that_end_at_the_data(n_rows, blocks, spacing):
    ends = block_boundaries(n_rows, blocks, spacing)
    assert ends[-1] == n_rows
    assert ends[0] >= 1
    assert all(np.diff(ends) > 0)
    assert len(ends) == (n_rows if spacing == "every" else min(len(ends), blocks))


def test_geometric_blocks_cost_less_than_two_full_looks():
    ends = block_boundaries(1024, 8)
    assert ends == (8, 16, 32, 64, 128, 256, 512, 1024)
    assert sum(ends) < 2 * 1024


def test_an_adaptive_horizon_ends_where_candidates_part():
    """Ten candidates alike up to row 7; from row 8 on one of them is so much better that it alone is left."""
    scores = np.zeros((10, 20))
    scores[3, 7:] = 5.0
    assert adaptive_horizon(scores, 2, 0.5) == 7
    assert adaptive_horizon(scores, 7, 0.5) == 7
    assert adaptive_horizon(np.ones((10, 20)), 2, 0.5) == 20
    failed = np.full((1, 20), -np.inf)
    assert adaptive_horizon(np.concatenate([scores, failed]), 2, 0.5) == 7
    assert adaptive_horizon(failed, 5, 0.5) == 5


def test_an_unknown_spacing_is_refused():
    with pytest.raises(InputError, match="spacing"):
        block_boundaries(10, 2, "quadratic")


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
