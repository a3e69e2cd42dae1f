"""Recordings of unlike lengths and with gaps: what was not measured counts as nothing, not as agreement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rfdropo_bayes.bayes.noise.autoregression import STATED, Autoregression
from rfdropo_bayes.discrepancy.held_out import BLOCKS, HELD_OUT_ROWS, blocks_of_rows, later_rows
from rfdropo_bayes.discrepancy.omnibus import block_squares
from rfdropo_bayes.discrepancy.remainder import describe_remainder

from .toys import measurements

SIZE = 1e-3  # [m] of the noise


@pytest.mark.parametrize("rows", [30, 60])
def test_what_remains_of_short_recordings_is_as_large_as_of_these_alone(rows):
    """Five recordings beside one of 120 rows: a process of twice the noise, with a memory of ten rows."""
    rng = np.random.default_rng(rows)
    distance = np.sqrt(3.0) * np.abs(np.subtract.outer(np.arange(120), np.arange(120))) / 10.0
    root = np.linalg.cholesky((1.0 + distance) * np.exp(-distance) + 1e-9 * np.eye(120))
    white = 2.0 * root @ rng.normal(size=(6, 120, 12)) + rng.normal(size=(6, 120, 12))
    noise = Autoregression(np.full(12, SIZE), np.ones(1), STATED, np.inf)
    whole = measurements(white, tuple((k,) for k in range(6)))
    count = whole.count.copy()
    count[1:, rows:] = 0.0
    short = replace(whole, count=count)
    found = describe_remainder(short, np.where(count > 0, white, 0.0).reshape(-1), noise)
    # The amplitudes that are tried lie a third apart; 12 coordinates of 6 recordings have tens of independent values.
    assert found.amplitude == pytest.approx(2.0 * SIZE, rel=0.3)
    assert np.all(found.sd[1:, rows + 40 :] > 1.5 * SIZE)  # nothing was measured there


def test_the_rows_that_are_predicted_follow_those_that_were_measured():
    """A recording whose first half was lost, one with a gap, and one without: each has its later measured rows left."""
    valid = np.ones((3, 100, 6), dtype=bool)
    valid[0, :50] = False
    valid[1, 20:60] = False
    later = later_rows(valid)
    for seen, kept in zip(valid[..., 0], later, strict=True):
        assert (seen & ~kept).sum() == pytest.approx(HELD_OUT_ROWS * seen.sum(), abs=1)
    np.testing.assert_array_equal(later[2], np.arange(100) >= 60)


def test_blocks_of_rows_are_as_large_as_noise_where_some_were_not_measured():
    """Mean squares of 300 and 2000 independent values: standard errors of .08 and .03."""
    rng = np.random.default_rng(5)
    valid = np.ones((10, 60, 30), dtype=bool)
    valid[1:, 20:] = False
    valid[0, 50:] = False
    valid[:, 5:9] = False
    white = np.where(valid, rng.normal(size=valid.shape), 0.0)
    found = block_squares(white, valid)
    np.testing.assert_allclose(found[:5], 1.0, atol=0.6)
    np.testing.assert_allclose(found[:2], 1.0, atol=0.25)
    assert np.isnan(found[5])


def test_blocks_of_poses_share_all_measured_rows_evenly():
    rng = np.random.default_rng(4)
    valid = rng.random((2, 23, 1)) < 0.8
    blocks = blocks_of_rows(valid)
    assert len(blocks) == BLOCKS
    np.testing.assert_array_equal(np.sum(blocks, axis=0), valid[:, :, 0].astype(int))
    counts = np.array([block.sum(axis=1) for block in blocks])
    assert np.ptp(counts, axis=0).max() <= 1
    for block in blocks:  # of successive measured rows
        for own, seen in zip(block, valid[:, :, 0], strict=True):
            assert np.all(np.diff(np.flatnonzero(own[seen])) == 1)
