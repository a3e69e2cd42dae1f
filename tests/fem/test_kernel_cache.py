"""Compiled kernels are kept between processes, each version of their sources in files of its own."""

from __future__ import annotations

import jax.numpy as jnp
import numba
import numpy as np
import pytest

from rfdropo_bayes.fem.native import kept_kernels, rod_rollout, tetrahedral_rollout
from rfdropo_bayes.fem.native.kept_kernels import KernelCache, kept_for_user, kernel_folder
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


def test_a_kernel_is_kept_in_the_users_folder_and_compiled_once(tmp_path, monkeypatch) -> None:
    """The second function of the same name stands for another process: it finds what the first one has compiled."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)

    def doubled(x):
        return 2 * x

    first, second = (kept_for_user(numba.njit(cache=True)(doubled)) for _ in range(2))
    assert [first(3), second(3)] == [6, 6]
    assert [sum(kernel.stats.cache_misses.values()) for kernel in (first, second)] == [1, 0]
    assert sorted(file.suffix for file in (tmp_path / "rfdropo_bayes" / "kernels").iterdir()) == [
        ".lock",
        ".nbc",
        ".nbi",
    ]
    assert kernel_folder() == tmp_path / "rfdropo_bayes" / "kernels"


def test_a_process_waits_for_the_one_that_compiles_and_no_longer(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    kernel_folder().mkdir(parents=True)
    one, other = (KernelCache(lambda x: x) for _ in range(2))
    waited = []
    monkeypatch.setattr(kept_kernels.time, "sleep", lambda seconds: (waited.append(seconds), one._let_others()))
    one._wait()
    one._wait()  # again after a compilation that failed: it does not wait for itself
    assert not waited
    other._wait()
    assert len(waited) == (kept_kernels.fcntl is not None)
    other._let_others()
