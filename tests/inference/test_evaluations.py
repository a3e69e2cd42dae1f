"""Prefixes of rows at which sequential methods look further ahead."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rfdropo_bayes.inference.evaluations import block_boundaries


@given(n_rows=st.integers(1, 2000), blocks=st.integers(1, 12))
def test_blocks_are_increasing_prefixes_that_end_at_the_data(n_rows, blocks):
    ends = block_boundaries(n_rows, blocks)
    assert ends[-1] == n_rows
    assert ends[0] >= 1
    assert all(np.diff(ends) > 0)
    assert len(ends) <= blocks


def test_geometric_blocks_cost_less_than_two_full_looks():
    ends = block_boundaries(1024, 8)
    assert ends == (8, 16, 32, 64, 128, 256, 512, 1024)
    assert sum(ends) < 2 * 1024
