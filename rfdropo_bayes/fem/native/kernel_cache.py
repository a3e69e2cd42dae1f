"""Names of compiled kernels in the cache between processes.

Numba's cache checks a single source file, and fails if a module of an earlier kernel is gone. Each version of a kernel
therefore has its own cache, named by a digest of all its source files.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rfdropo_bayes.fem.native.compilers import COMPILERS, PLAIN

PACKAGE = Path(__file__).resolve().parents[2]
OWN = __package__.rpartition(".")[0]
"""The package that holds this folder."""
KERNELS = b"rfdropo_bayes.fem.native.simd import"
"""Text that every module of kernels contains."""
IMPORT = re.compile(rb"^from (\S+) import", re.MULTILINE)


def kernel_sources(module: str) -> str:
    """Digest of a module of kernels, of all imported modules of kernels and their sources of constants, and of the
    compiler.
    """
    sources: dict[str, bytes] = {}
    waiting = [f"{__package__}.{module}"]
    while waiting:
        name = waiting.pop()
        path = PACKAGE.joinpath(*name.split(".")[1:]).with_suffix(".py")
        if name in sources or not path.is_file():
            continue
        sources[name] = path.read_bytes()
        if KERNELS not in sources[name]:
            continue
        waiting.extend(module for match in IMPORT.findall(sources[name]) if (module := match.decode()).startswith(OWN))
    compiler = COMPILERS.name.encode()
    return hashlib.sha256(b"".join(sources[name] for name in sorted(sources)) + compiler).hexdigest()


def named_by(sources: str) -> Callable[[Callable], Callable]:
    """Decorator that puts a digest of sources into a function's name, and so into the name of its cache."""

    def rename(function: Callable) -> Callable:
        function.__qualname__ += f"_{sources[:16]}"
        return function

    return rename


def kept(kernel: Any) -> Any:
    """Decorator that keeps a kernel in the user's folder; Numba's own compilers keep it Numba's own way."""
    if COMPILERS is PLAIN:
        return kernel
    from rfdropo_bayes.fem.native.kept_kernels import kept_for_user

    return kept_for_user(kernel)
