"""What residuals that last make of the likelihood of white noise: shares and sizes in closed form."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from rfdropo_bayes.cautions import Code
from rfdropo_bayes.inference.modes.lasting import Lasting, lasting_cautions, lasting_series

RECORDINGS, ROWS, COLUMNS = 3, 200, 2


def looked_at(design, residual, valid, steps=None):
    """`lasting_series` of a linear model, (recording, time, column, d), at its least squares."""
    flat = design.reshape(-1, design.shape[-1])
    factor = np.linalg.cholesky(np.linalg.inv(flat.T @ flat))
    steps = np.full(len(residual), 0.1) if steps is None else steps
    return lasting_series(residual, valid, np.moveaxis(design @ factor, -1, 0), steps)


def autoregressive(rng, memory, columns):
    """Of unit size; ``columns`` makes coordinates of independent ones."""
    series = rng.normal(size=(RECORDINGS, ROWS, len(columns)))
    for row in range(1, ROWS):
        series[:, row] = memory * series[:, row - 1] + np.sqrt(1.0 - memory**2) * series[:, row]
    return series @ columns


def fitted(design, data):
    flat = design.reshape(-1, design.shape[-1])
    return data - (flat @ np.linalg.lstsq(flat, data.ravel(), rcond=None)[0]).reshape(data.shape)


@pytest.mark.parametrize("memory", [0.0, 0.8])
def test_a_constant_counts_as_often_as_its_mean_says(memory):
    """The variance of the mean of an AR(1) series is (1 + phi) / (1 - phi) times that of independent rows."""
    design = np.zeros((RECORDINGS, ROWS, COLUMNS, COLUMNS))
    design[:, :, 0, 0] = design[:, :, 1, 1] = 1.0
    valid = np.ones((RECORDINGS, ROWS, COLUMNS), dtype=bool)
    shares = []
    for seed in range(20):
        data = autoregressive(np.random.default_rng(seed), memory, np.eye(COLUMNS))
        shares.append(looked_at(design, fitted(design, data), valid).share)
    # residuals about a mean that was fitted to them last a little less than the noise does
    assert np.mean(shares) == pytest.approx((1.0 - memory) / (1.0 + memory), rel=0.2)
    assert max(shares) <= 1.0


def test_residuals_last_for_seconds_in_recordings_of_every_rate():
    """A parameter of the recording whose rows are ten times as far apart: its rows are nearly independent, whatever
    those of the others are. One memory for all rows would make a row count half of that."""
    design = np.zeros((RECORDINGS, ROWS, COLUMNS, COLUMNS))
    design[2, :, 0, 0] = design[2, :, 1, 1] = 1.0
    valid, steps, shares = np.ones(design.shape[:3], dtype=bool), np.array([0.1, 0.1, 1.0]), []
    for seed in range(20):
        parts = [
            autoregressive(np.random.default_rng([seed, k]), m, np.eye(COLUMNS)) for k, m in ((0, 0.8), (1, 0.8**10))
        ]
        data = np.concatenate([parts[0][:2], parts[1][2:]])
        shares.append(looked_at(design, fitted(design, data), valid, steps).share)
    assert np.mean(shares) == pytest.approx((1.0 - 0.8**10) / (1.0 + 0.8**10), rel=0.1)


def test_coordinates_that_go_together_count_once():
    """A parameter moves both coordinates alike, and so does the noise: they are one reading."""
    design = np.ones((RECORDINGS, ROWS, COLUMNS, 1)) * np.random.default_rng(0).normal(size=(RECORDINGS, ROWS, 1, 1))
    data = autoregressive(np.random.default_rng(1), 0.0, np.array([[1.0, 1.0]]))
    data = data + 1e-3 * np.random.default_rng(2).normal(size=data.shape)
    found = looked_at(design, fitted(design, data), np.ones(data.shape, dtype=bool))
    assert found.share == pytest.approx(0.5, rel=0.15)


def test_known_noise_that_is_too_small_is_made_up_for():
    """Residuals of three times the size that the likelihood has for them: a row counts a ninth."""
    design = np.random.default_rng(0).normal(size=(RECORDINGS, ROWS, COLUMNS, 2))
    data = 3.0 * autoregressive(np.random.default_rng(1), 0.0, np.eye(COLUMNS))
    assert looked_at(design, fitted(design, data), np.ones(data.shape, dtype=bool)).share == pytest.approx(
        1 / 9, rel=0.1
    )


def test_errors_are_those_of_blocks_left_out_of_the_fit():
    """Against fits without each block; residuals last for about three rows."""
    rng = np.random.default_rng(0)
    residual = autoregressive(rng, 0.5, np.eye(COLUMNS))
    design, valid = rng.normal(size=(*residual.shape, 40)), rng.uniform(size=residual.shape) < 0.9
    design, residual = np.where(valid[..., None], design, 0.0), np.where(valid, residual, 0.0)
    data, found = residual + design @ rng.normal(size=40), looked_at(design, fitted(design, residual), valid)
    length, square = int(np.ceil(found.rows)), np.zeros(COLUMNS)
    assert 2 <= length <= 4
    for recording in range(RECORDINGS):
        for first in range(0, ROWS, length):
            kept = np.ones_like(valid)
            kept[recording, first : first + length] = False
            chosen = kept & valid
            solution = np.linalg.lstsq(design[chosen], data[chosen], rcond=None)[0]
            error = np.where(valid & ~kept, data - design @ solution, 0.0)
            square += np.sum(error**2, axis=(0, 1))
    expected = np.sqrt(square / np.sum(fitted(design, residual) ** 2, axis=(0, 1)))
    np.testing.assert_allclose(found.widened, expected, rtol=1e-6)


def test_masked_rows_say_nothing():
    rng = np.random.default_rng(0)
    design = rng.normal(size=(RECORDINGS, ROWS, COLUMNS, 2))
    residual = autoregressive(rng, 0.5, np.eye(COLUMNS))
    valid = rng.uniform(size=residual.shape) < 0.8
    seen = partial(looked_at, np.where(valid[..., None], design, 0.0))
    found, other = (seen(np.where(valid, residual, hidden), valid) for hidden in (0.0, 5.0))
    assert found.share == pytest.approx(other.share, rel=1e-9)
    np.testing.assert_allclose(found.widened, other.widened)


def test_a_caution_says_what_a_row_counts():
    lasting = {"markers": Lasting(0.1, 9.0, np.ones(2)), "tension": Lasting(0.9, 1.1, np.ones(2))}
    (caution,) = lasting_cautions(lasting)
    assert caution.code is Code.RESIDUALS_LAST
    assert "9 rows" in caution.sentence
    assert "worth 0.1 of an independent row" in caution.sentence
