"""Batches of any size through functions compiled for a few."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes.bayes.batches import in_chunks, is_batch, padded


@pytest.mark.parametrize("count", [0, 1, 8, 9, 130])
def test_padding_changes_nothing_but_the_sizes_that_are_seen(count):
    seen = []

    def double(given):
        seen.append(len(given["x"]))
        return {"y": 2.0 * given["x"]}, given["x"].sum(axis=1)

    x = np.arange(3.0 * count).reshape(count, 3)
    found, total = padded(double, {"x": x})
    np.testing.assert_array_equal(found["y"], 2.0 * x)
    np.testing.assert_array_equal(total, x.sum(axis=1))
    assert seen == [{0: 0, 1: 8, 8: 8, 9: 32, 130: 512}[count]]


def test_what_has_other_axes_is_no_batch():
    assert is_batch({"x": np.zeros(3)}, 1)
    assert not is_batch(np.zeros(3), 2)


@pytest.mark.parametrize(
    ("count", "sizes"),
    [(3, [8]), (49, [32, 32]), (33, [32, 8]), (70, [128]), (130, [128, 8]), (300, [128, 128, 32, 8, 8])],
)
def test_no_chunk_is_padding_for_a_half_unless_it_is_the_smallest(count, sizes):
    seen, counted = [], []

    def double(x):
        seen.append(len(x))
        return 2.0 * x

    x = np.arange(float(count))
    np.testing.assert_array_equal(in_chunks(double, x, (8, 32, 128), after=counted.append), 2.0 * x)
    assert seen == sizes
    assert sum(counted) == count
