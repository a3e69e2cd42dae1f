"""Which compilers the kernels of rods take: ours, or Numba's own if ours do not fit the installed Numba.

Ours (`compilation`) rest on private parts of Numba. They are used without asking with the versions that they are tested
with. With another version of Numba a small program is compiled and run first. If that fails, Numba's standard compiler
is used, which is slower and gives the same numbers. See CONTRIBUTING.md.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import numba

from rfdropo_bayes.errors import InputError

VARIABLE = "RFDROPO_COMPILER"
OURS, NUMBA = "ours", "numba"
TESTED = ((0, 68),)
"""Versions of Numba that the tests run with."""


class Compilers(NamedTuple):
    """Compilers of kernels (`whole`) and of functions that only kernels call (`part`), with options of `njit`."""

    name: str
    part: Callable[..., Any]
    whole: Callable[..., Any]


def _numba(function: Callable, **options: Any) -> Callable:
    return numba.njit(**options)(function)


PLAIN = Compilers(NUMBA, _numba, _numba)


def chosen_compilers(wanted: str | None, version: str) -> Compilers:
    """Our compilers, or Numba's own.

    Args:
        wanted: "ours", "numba", or None to choose by the version of Numba.
        version: version of Numba.

    Raises:
        InputError: an unknown word, or "ours" with a version of Numba that the compilers do not support.
    """
    if wanted not in (None, "", OURS, NUMBA):
        raise InputError(f"{wanted!r} is not a compiler", where=VARIABLE, remedy=f"use {OURS} or {NUMBA}, or unset it")
    if wanted == NUMBA:
        return PLAIN
    tested = tuple(int(part) for part in re.findall(r"\d+", version)[:2]) in TESTED
    try:
        return _ours() if tested else _tried(_ours())
    except Exception as error:  # whatever a private part that has changed may raise
        if wanted == OURS:
            raise InputError(
                f"our compilers do not fit Numba {version} ({type(error).__name__}: {error})",
                where=VARIABLE,
                remedy="unset it, or install the Numba of constraints.txt",
            ) from error
        return PLAIN


def _ours() -> Compilers:
    from rfdropo_bayes.fem.native.compilation import deferred, whole

    return Compilers(OURS, deferred, whole)


def _tried(compilers: Compilers) -> Compilers:
    """The same compilers, after they have compiled a function within a function within a kernel, and it ran rightly."""
    square = compilers.part(lambda value: value * value, no_cpython_wrapper=True)
    shifted = compilers.part(lambda value: square(value) + 1.0, no_cpython_wrapper=True)
    total = compilers.whole(lambda value: shifted(value) + square(value))(3.0)
    if total != 19.0:
        raise ValueError(f"a trial kernel returned {total} for 19")
    return compilers


COMPILERS = chosen_compilers(os.environ.get(VARIABLE), numba.__version__)
