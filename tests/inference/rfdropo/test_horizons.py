"""Horizons of RF-DROPO."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from rfdropo_bayes.inference.rfdropo.phi_search import paper_horizon


def test_published_schedule_is_the_formula_and_never_sees_the_last_row():
    taus = [paper_horizon(i, 500, 100, mended=False) for i in range(501)]
    formula = [max(1, math.floor(100 * (1 - math.exp(-(2 / 500) * math.log(10) * i)))) for i in range(501)]
    assert taus == formula
    assert (taus[0], taus[250], taus[500]) == (1, 90, 99)


@given(iterations=st.integers(1, 300), n_rows=st.integers(1, 400))
def test_the_mended_schedule_grows_and_ends_at_the_last_row(iterations, n_rows):
    taus = [paper_horizon(i, iterations, n_rows) for i in range(iterations)]
    assert all(1 <= a <= b <= n_rows for a, b in zip(taus, [*taus[1:], n_rows], strict=True))
    if iterations > 1:
        assert taus[-1] == n_rows


def test_the_mended_curve_stays_close_to_the_published_one():
    differences = [paper_horizon(i, 500, 100) - paper_horizon(i, 500, 100, mended=False) for i in range(500)]
    assert 0 <= min(differences) <= max(differences) <= 2
