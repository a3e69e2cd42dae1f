"""Intermediate results of an audit on disk, from which a killed audit continues.

An audit is a fixed sequence of long computations, each a function of its inputs. Results are kept under a digest of
these inputs, so that a change of data, model or seed finds nothing and computes anew.
"""

from __future__ import annotations

import hashlib
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rfdropo_bayes import __version__
from rfdropo_bayes.files import whole

Arrays = dict[str, np.ndarray]


def digest(*parts: Any) -> str:
    """SHA-256 of arrays (shape, type and bytes) and of the text of everything else."""
    hashed = hashlib.sha256(__version__.encode())
    for part in parts:
        if isinstance(part, np.ndarray):
            hashed.update(f"{part.shape}{part.dtype}".encode())
            hashed.update(np.ascontiguousarray(part).tobytes())
        else:
            hashed.update(repr(part).encode())
    return hashed.hexdigest()


class Journal:
    """Results on disk by the digest of their inputs.

    Args:
        folder: folder of the results; None stores nothing.
        resume: use the results of an earlier run; otherwise they are removed.
    """

    def __init__(self, folder: Path | None = None, *, resume: bool = False) -> None:
        self.folder = folder
        if folder is not None:
            if not resume:
                shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True, exist_ok=True)

    def recall(self, key: str, compute: Callable[[], Arrays]) -> Arrays:
        """The arrays stored under a key; computed and stored if missing."""
        if self.folder is None:
            return compute()
        path = self.folder / f"{key[:32]}.npz"
        found = _read(path)
        if found is None:
            found = compute()
            _write(path, found)
        return found


def _read(path: Path) -> Arrays | None:
    """Arrays of a file; None for a missing or damaged file."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile):
        return None


def _write(path: Path, arrays: Arrays) -> None:
    """Replace the whole file: a killed process leaves the old file or the new file."""
    with whole(path) as partial, partial.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
