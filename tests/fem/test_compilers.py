"""Kernels are compiled by our compilers where these fit the Numba at hand, and else by Numba's own."""

from __future__ import annotations

import os
import subprocess
import sys

import numba
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.native import compilation
from rfdropo_bayes.fem.native.compilers import NUMBA, OURS, PLAIN, VARIABLE, chosen_compilers

MOTION = """
import numpy as np
import rfdropo_bayes as rb
from rfdropo_bayes.fem.native.compilers import COMPILERS
model = rb.Model("smooth_arm", simulator={"refine": 2, "time_step": 0.005})
walk = dict(duration=0.5, interval=0.1, step=2e-3, low=0.0, high=1e-2, sample_time=0.02, recordings=["one"])
print(COMPILERS.name, rb.simulate(model, walk)[0].position.tobytes().hex())
"""


def test_ours_are_used_with_the_numba_they_are_tested_with() -> None:
    assert chosen_compilers(None, "0.68.1").whole is compilation.whole


def test_with_another_numba_they_are_tried_first() -> None:
    assert chosen_compilers(None, "9.0.0").part is compilation.deferred


def test_numba_compiles_where_a_private_part_has_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compilation.CPUCodeLibrary, "_get_module_for_linking", None)
    assert chosen_compilers(None, "9.0.0") is PLAIN
    with pytest.raises(InputError, match=r"our compilers do not fit Numba 9\.0\.0"):
        chosen_compilers(OURS, "9.0.0")


def test_numba_compiles_on_request() -> None:
    assert chosen_compilers(NUMBA, numba.__version__) is PLAIN


def test_an_unknown_compiler_is_refused() -> None:
    with pytest.raises(InputError, match="'gcc' is not a compiler"):
        chosen_compilers("gcc", numba.__version__)


@pytest.mark.slow
def test_both_compilers_give_the_same_motion() -> None:
    """Bit for bit: a lane's result does not depend on what a compiler chose to inline."""
    found = {}
    for compiler in (OURS, NUMBA):
        done = subprocess.run(
            [sys.executable, "-c", MOTION], env={**os.environ, VARIABLE: compiler}, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        found[compiler] = done.stdout.split()
    assert all(found[compiler][0] == compiler for compiler in found)
    assert found[OURS][1] == found[NUMBA][1]
