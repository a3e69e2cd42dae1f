"""Tangents of functions along tangents of which many are zero."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array


def pushed_forward(function: Callable[..., Any], primals: Any, tangents: Any) -> Any:
    """Tangent of a function. Nothing is computed for tangents that are symbolic zeros."""
    values, structure = jax.tree.flatten(primals)
    changes = jax.tree.leaves(tangents, is_leaf=lambda leaf: isinstance(leaf, SymbolicZero))
    moving = [i for i, change in enumerate(changes) if not isinstance(change, SymbolicZero)]

    def moved(chosen: list[Array]) -> Any:
        whole = list(values)
        for place, value in zip(moving, chosen, strict=True):
            whole[place] = value
        return function(*jax.tree.unflatten(structure, whole))

    return jax.jvp(moved, ([values[i] for i in moving],), ([changes[i] for i in moving],))[1]
