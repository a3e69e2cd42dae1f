"""Backends that compute the motion of the body."""

from __future__ import annotations

import jax

from rfdropo_bayes.model.experiment import SimulatorTable
from rfdropo_bayes.simulators.body_engine import Backend


def backend(table: SimulatorTable, rod: bool) -> Backend:
    """The backend that [simulator] asks for.

    "auto" is the compiled backend for meshes, which JAX lacks, and for rods if JAX has only a CPU.
    """
    compiled = table.engine == "numba"
    if table.engine == "auto":
        compiled = not rod or jax.default_backend() == "cpu"
    return Backend("numba", table.precision, table.threads) if compiled else Backend("jax")
