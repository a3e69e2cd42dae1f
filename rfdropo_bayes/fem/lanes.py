"""Functions of arrays whose last axis is a batch: ``jax.vmap`` extends this axis instead of adding a leading axis.

XLA vectorises over the last axis. With a batch in front, matrices of 6 x 6 would be that axis, and short.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array


def _width(arrays: Any) -> int:
    return max(part.shape[-1] for part in jax.tree.leaves(arrays))


def _merged(array: Array, batched: bool, size: int, width: int) -> Array:
    """The new axis of a batch after the lanes that are there, as one axis; an array that is the same for all keeps its
    one lane."""
    if not batched and array.shape[-1] == 1:
        return array
    array = jnp.moveaxis(array, 0, -1) if batched else jnp.broadcast_to(array[..., None], (*array.shape, size))
    array = jnp.broadcast_to(array, (*array.shape[:-2], width, size))
    return array.reshape(*array.shape[:-2], width * size)


def laned(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function of arrays without lanes, given how it acts on arrays with lanes in their last axis.

    Arguments and results are trees of arrays. The caller defines derivatives.
    """

    @custom_vmap
    def with_lanes(*arguments: Any) -> Any:
        width = _width(arguments)

        def whole(part: Array) -> Array:
            return jnp.broadcast_to(part, (*part.shape[:-1], width))

        return jax.tree.map(whole, function(*jax.tree.map(whole, arguments)))

    @with_lanes.def_vmap
    def more_lanes(size: int, batched: Any, *arguments: Any) -> Any:
        width = _width(arguments)
        merged = jax.tree.map(lambda part, new: _merged(part, new, size, width), arguments, tuple(batched))
        result = with_lanes(*merged)
        split = jax.tree.map(lambda part: jnp.moveaxis(part.reshape(*part.shape[:-1], width, size), -1, 0), result)
        return split, jax.tree.map(lambda _: True, split)

    @wraps(function)
    def without_lanes(*arguments: Any) -> Any:
        given = jax.tree.map(lambda part: jax.lax.stop_gradient(jnp.asarray(part))[..., None], arguments)
        return jax.tree.map(lambda part: part[..., 0], with_lanes(*given))

    return without_lanes
