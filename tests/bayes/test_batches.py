"""Batches of any size through functions compiled for a few."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes.bayes.batches import is_batch, padded


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
