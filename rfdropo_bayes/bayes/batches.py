"""Batches of any size through functions that are compiled for a few sizes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
    floats = jax.tree.map(lambda array: np.asarray(array, dtype=float), given)
    return jax.tree.map(jnp.asarray, in_chunks(function, floats, (size,)))  # sliced by JAX, it would compile


def in_chunks(
    function: Callable[[Any], Any],
    given: Any,
    sizes: Sequence[int],
    *,
    before: Callable[[], None] = lambda: None,
    after: Callable[[int], None] = lambda count: None,
) -> Any:
    """A function of arrays with a common first axis, evaluated chunk by chunk.

    Args:
        function: maps a tree of arrays to a tree of arrays.
        given: the tree.
        sizes: chunk sizes, ascending. A chunk has the smallest sufficient size, padded by repeats of the last entry, or
            the largest; if it would be padding for a half, the next smaller size is filled first.
        before: function called before every chunk; may raise an exception.
        after: called with the number of entries after every chunk.
    """
    count, start, parts = len(jax.tree.leaves(given)[0]), 0, []
    while start < count:
        before()
        left = count - start
        size = next((size for size in sizes if size >= left), sizes[-1])
        filled = [smaller for smaller in sizes if smaller <= left <= size // 2]
        size = filled[-1] if filled else size
        index = np.minimum(np.arange(start, start + size), count - 1)
        chunk = jax.tree.map(lambda array, index=index: np.asarray(array)[index], given)
        parts.append(jax.device_get(function(chunk)))
        after(min(size, left))
        start += size
    return jax.tree.map(lambda *pieces: np.concatenate(pieces)[:count], *parts)


def chunk_sizes(largest: int) -> tuple[int, ...]:
    """Sizes of chunks, ascending: a quarter of the next, down to the lanes of one SIMD register."""
    sizes = [largest]
    while sizes[-1] >= GROWTH * SMALLEST:
        sizes.append(sizes[-1] // GROWTH)
    return tuple(reversed(sizes))


def is_batch(given: Any, axes: int) -> bool:
    """Whether these are concrete arrays with ``axes`` axes, not JAX tracers."""
    return all(not isinstance(a, jax.core.Tracer) and np.ndim(a) == axes for a in jax.tree.leaves(given))
