"""Derivatives by differences against a function whose derivative is known."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rfdropo_bayes.simulators.finite_differences import with_differences


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
