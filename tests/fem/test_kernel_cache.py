"""Compiled kernels are kept between processes, each version of their sources in files of its own."""

from __future__ import annotations

import jax.numpy as jnp
import numba
import numpy as np
import pytest

from rfdropo_bayes.fem.native import rod_rollout, tetrahedral_rollout
from rfdropo_bayes.fem.native.rod_engine import NativeRod

from .native_cases import STEPS, TIME_STEP, materials, uneven_rod


@pytest.mark.parametrize("kernels", [rod_rollout, tetrahedral_rollout])
def test_versions_of_a_kernel_share_no_cache(kernels) -> None:
    """Numba reads the whole index of a cache first, and fails where a module that an entry names is gone."""
    one, other, again = (kernels.compile_rollout(digit * 64)._cache._impl.filename_base for digit in "aba")
    assert one != other
    assert one == again


def test_one_rollout_and_many_from_numpy_and_from_jax_take_one_kernel() -> None:
    """Numba compiles another kernel for an array that cannot be written to, as JAX's and broadcast ones cannot."""
    engine, kinds = NativeRod(*uneven_rod(), TIME_STEP), set()
    for batch, given in ((1, np.zeros((STEPS, 3))), (3, jnp.zeros((3, STEPS, 3))), (3, np.zeros((1, STEPS, 3)))):
        material = materials(1, batch)
        shared = material._replace(density=material.density[0], gravity=material.gravity[0])
        run = engine.run_of(shared, given, None, None, None, 1, None)
        kinds.add(numba.typeof(run.batch))
    assert len(kinds) == 1
    assert "readonly" not in str(kinds.pop())
