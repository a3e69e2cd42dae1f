"""Batches of any size through functions that are compiled for a few sizes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

SMALLEST, GROWTH = 8, 4  # sizes that batches are padded to: 8, 32, 128, ...


def padded(function: Callable[[Any], Any], given: Any) -> Any:
    """A function of arrays with a common first axis, evaluated on a padded batch; the padding repeats the last entry.

    JAX compiles anew for every shape, which takes longer than a thousand evaluations of a prior.
    """
    count = len(jax.tree.leaves(given)[0])
    if count == 0:
        return function(given)
    size = SMALLEST
    while size < count:
        size *= GROWTH
    index = np.minimum(np.arange(size), count - 1)
    found = function(jax.tree.map(lambda array: np.asarray(array, dtype=float)[index], given))
    return jax.tree.map(lambda array: jnp.asarray(np.asarray(array)[:count]), found)  # sliced by JAX, it would compile


def is_batch(given: Any, axes: int) -> bool:
    """Whether these are arrays of numbers with so many axes, and nothing that JAX traces."""
    return all(not isinstance(a, jax.core.Tracer) and np.ndim(a) == axes for a in jax.tree.leaves(given))
