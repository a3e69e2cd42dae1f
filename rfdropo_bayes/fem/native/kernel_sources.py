"""The version of the compiled kernels: Numba's cache looks at one source file only, so kernels are cached under a
digest of all the files that they are made of."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2]
OWN = __package__.rpartition(".")[0]
"""The package that holds this folder."""
KERNELS = b"rfdropo_bayes.fem.native.simd import"
"""What a module of kernels contains."""
IMPORT = re.compile(rb"^from (\S+) import", re.MULTILINE)


def kernel_sources(module: str) -> str:
    """Digest of a module of kernels, of all modules of kernels that it imports, directly or not, and of the modules
    that these take their constants from."""
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
    return hashlib.sha256(b"".join(found[name] for name in sorted(found))).hexdigest()
