"""Batches of the compiled engine as JAX hands them over."""

from __future__ import annotations

import numpy as np

from rfdropo_bayes.simulators.callbacks import distinct


def test_rollouts_that_are_asked_for_twice_are_found():
    first = np.array([[1.0, 2.0], [1.0, 2.0], [3.0, 4.0], [1.0, 2.0], [3.0, 4.0]])
    second = np.array([0.0, 0.0, 0.0, 1.0, 0.0])
    chosen, place = distinct([first, second])
    np.testing.assert_array_equal(chosen, [0, 2, 3])
    np.testing.assert_array_equal(place, [0, 0, 1, 2, 1])
    np.testing.assert_array_equal(first[chosen][place], first)
    np.testing.assert_array_equal(second[chosen][place], second)
