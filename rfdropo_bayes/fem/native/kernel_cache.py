"""What compiled kernels are kept under between processes.

Numba's cache of what was compiled looks at one source file only, and fails where a module that an earlier kernel knew
is gone: each version of a kernel has a cache of its own, named by a digest of all the files that it is made of.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from pathlib import Path

from rfdropo_bayes.fem.native.compilers import COMPILERS

PACKAGE = Path(__file__).resolve().parents[2]
OWN = __package__.rpartition(".")[0]
"""The package that holds this folder."""
KERNELS = b"rfdropo_bayes.fem.native.simd import"
"""What a module of kernels contains."""
IMPORT = re.compile(rb"^from (\S+) import", re.MULTILINE)


def kernel_sources(module: str) -> str:
    """Digest of a module of kernels, of all modules of kernels that it imports, directly or not, and of the modules
    that these take their constants from; and of the compiler that is used."""
    found: dict[str, bytes] = {}
    waiting = [f"{__package__}.{module}"]
    while waiting:
        name = waiting.pop()
        path = PACKAGE.joinpath(*name.split(".")[1:]).with_suffix(".py")
        if name in found or not path.is_file():
            continue
        found[name] = path.read_bytes()
        if KERNELS not in found[name]:
            continue
        waiting.extend(module for match in IMPORT.findall(found[name]) if (module := match.decode()).startswith(OWN))
    compiler = COMPILERS.name.encode()
    return hashlib.sha256(b"".join(found[name] for name in sorted(found)) + compiler).hexdigest()


def named_by(sources: str) -> Callable[[Callable], Callable]:
    """Decorator that puts a digest of sources into a function's name, and so into that of its cache."""

    def rename(function: Callable) -> Callable:
        function.__qualname__ += f"_{sources[:16]}"
        return function

    return rename
