"""The steps of differences that are taken of smooth, rough and bent motions."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes.discrepancy.usable_difference import usable_difference


@pytest.mark.parametrize(
    ("amplitude", "length", "expected"),
    [
        (0.0, 1.0, 1e-7),  # smooth
        (1e-13, 1e-14, 1e-7),  # rounding
        (1e-6, 1e-10, 1e-5),  # noise on the smallest scales
        (1e-4, 1e-6, 1e-3),  # smooth at 1e-7, with slopes a hundred times those that matter
        (1e3, 1e-6, 1e-2),  # rough on all scales
    ],
)
def test_the_smallest_step_is_taken_from_which_on_slopes_agree(amplitude, length, expected):
    def motion(x):
        return np.array([x, x**2, 0.3 * np.sin(x)]) + amplitude * np.sin(x / length + np.arange(3))

    found = usable_difference(lambda step: (motion(0.7 + step) - motion(0.7 - step)) / (2 * step))
    assert found == pytest.approx(expected, rel=1e-9) or (expected > 1e-7 and expected / 11 < found < expected * 11)


def test_a_motion_that_bends_is_not_taken_for_rough():
    """A cable goes slack 0.002 beside the point: over 0.01 its slope is a fifth of what it is there."""

    def motion(x):
        return np.array([x, abs(x - 0.702)])

    assert usable_difference(lambda step: (motion(0.7 + step) - motion(0.7 - step)) / (2 * step)) == 1e-7
