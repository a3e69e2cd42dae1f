"""Kernels have as many lanes as the processor that Numba compiles for, which need not be this machine's."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

ASK = "from rfdropo_bayes.fem.native.simd import native_lanes; print(native_lanes('float64'), native_lanes('float32'))"


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="names of x86-64 processors")
@pytest.mark.parametrize(
    ("name", "lanes"),
    [
        pytest.param("x86-64-v2", "2 4", marks=pytest.mark.slow),
        ("x86-64-v3", "4 8"),
        pytest.param("x86-64-v4", "8 16", marks=pytest.mark.slow),
    ],
)
def test_lanes_fill_the_registers_of_the_processor_that_is_compiled_for(name, lanes) -> None:
    variables = {**os.environ, "NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": ""}
    assert subprocess.check_output([sys.executable, "-c", ASK], env=variables, text=True).strip() == lanes
