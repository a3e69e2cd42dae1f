"""Compiled kernels are kept between processes, each version of their sources in files of its own."""

from __future__ import annotations

import pytest

from rfdropo_bayes.fem.native import rod_rollout, tetrahedral_rollout


@pytest.mark.parametrize("kernels", [rod_rollout, tetrahedral_rollout])
def test_versions_of_a_kernel_share_no_cache(kernels) -> None:
    """Numba reads the whole index of a cache first, and fails where a module that an entry names is gone."""
    one, other, again = (kernels.compile_rollout(digit * 64)._cache._impl.filename_base for digit in "aba")
    assert one != other
    assert one == again
