"""Rollouts outside traced programs: one callback for a whole batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Array

Output = TypeVar("Output")


def one_callback(roll: Callable[[Any, int], Output], shapes: Output, inputs: Any, limit: Array) -> Output:
    """Outputs of rollouts, from a traced program that ``vmap`` may have given any batch axes.

    Padding of a batch, and perturbations of parameters after the body, ask for the same rollout again and again: each
    is computed once.

    Args:
        roll: rollouts of inputs with one batch axis, up to a number of steps; later rows may be missing.
        shapes: shapes of one rollout's outputs; arrays have rows as their first axis. Missing rows are zero.
        inputs: inputs of one rollout.
        limit: steps to compute.
    """

    def on_host(given: Any, limits: np.ndarray) -> Output:
        batch, count = np.shape(limits), np.size(limits)
        flat = jax.tree.map(lambda value: np.asarray(value).reshape(count, *value.shape[len(batch) :]), given)
        chosen, place = distinct(jax.tree.leaves(flat))
        outputs = roll(jax.tree.map(lambda value: value[chosen], flat), int(np.max(limits)))

        def restored(shape: jax.ShapeDtypeStruct, part: np.ndarray) -> np.ndarray:
            part = part[place]
            if shape.shape and part.shape[1] < shape.shape[0]:
                part = np.pad(part, [(0, 0), (0, shape.shape[0] - part.shape[1]), *[(0, 0)] * (part.ndim - 2)])
            return part.reshape((*batch, *shape.shape))

        return jax.tree.map(restored, shapes, outputs)

    return jax.pure_callback(on_host, shapes, inputs, limit, vmap_method="broadcast_all")


def distinct(arrays: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Indices of distinct rows, and for every row the position of its equal among them."""
    seen: dict[bytes, int] = {}
    place = [seen.setdefault(b"".join(a[row].tobytes() for a in arrays), len(seen)) for row in range(len(arrays[0]))]
    return np.unique(place, return_index=True)[1], np.array(place)
