"""Derivatives by differences against a function whose derivative is known."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.simulators.finite_differences import usable_difference, with_differences


class Ends(NamedTuple):
    place: jax.Array
    well: jax.Array


def test_slopes_are_those_of_the_closed_form():
    made = []

    def call(inputs, limit):
        made.append(1)
        x, y = inputs
        return Ends(jnp.sin(x) * jnp.exp(y), x > limit)

    motion = with_differences(call, lambda inputs: jax.tree.map(jnp.ones_like, inputs), "float64")
    x, y = jnp.array([0.3, -1.2]), jnp.array([0.1, 0.4])
    along = (jnp.array([1.0, 0.5]), jnp.array([-0.2, 0.0]))
    value, slope = jax.jvp(lambda *inputs: motion(inputs, jnp.asarray(0.0)), (x, y), along)
    assert len(made) == 3
    np.testing.assert_allclose(value.place, np.sin(x) * np.exp(y))
    exact = np.cos(x) * np.exp(y) * along[0] + np.sin(x) * np.exp(y) * along[1]
    np.testing.assert_allclose(slope.place, exact, atol=1e-9)
    assert slope.well.dtype == jax.dtypes.float0


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
