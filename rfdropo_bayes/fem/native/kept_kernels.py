"""Compiled kernels in the user's cache folder: compiled once for all copies of the package and all processes.

Numba keeps a kernel beside its source, so each clone and each environment compiles it again, which takes half a minute.
The digest in a kernel's name replaces Numba's own stamp of the source. If several processes need a kernel at
the same time, the first compiles it and the others wait for it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator

from rfdropo_bayes.runtime import cache_folder

try:
    import fcntl
except ImportError:  # Windows: processes do not wait for each other
    fcntl = None  # type: ignore[assignment]

LONGEST_WAIT = 300.0  # [s] after which a process compiles what another one has not finished
POLL = 0.1  # [s]


class _UsersFolder(_CacheLocator):
    """Where kernels are kept."""

    def get_cache_path(self) -> str:
        """The folder."""
        return str(kernel_folder())

    def get_source_stamp(self) -> str:
        """Nothing: the digest is in the name."""
        return ""

    def get_disambiguator(self) -> str:
        """Nothing: the digest is in the name."""
        return ""

    @classmethod
    def from_function(cls, py_func: Callable, py_file: str) -> _UsersFolder:
        """For every kernel."""
        return cls()


class _Kept(CompileResultCacheImpl):
    _locator_classes = [_UsersFolder]  # noqa: RUF012


class KernelCache(FunctionCache):
    """Numba's cache of a function, in the user's folder and with one process at a time that compiles."""

    _impl_class = _Kept

    def __init__(self, function: Callable) -> None:
        super().__init__(function)
        self._lock: IO[str] | None = None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The kernel for a signature; None if this process has to compile it."""
        kernel = super().load_overload(sig, target_context)
        if kernel is None:
            self._wait()
            kernel = super().load_overload(sig, target_context)
            if kernel is not None:
                self._let_others()
        return kernel

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep what was compiled."""
        try:
            super().save_overload(sig, data)
        finally:
            self._let_others()

    def _wait(self) -> None:
        """Wait until no other process compiles this kernel."""
        self._let_others()
        if fcntl is None:
            return
        self._lock = Path(self.cache_path, f"{self._impl.filename_base}.lock").open("w")  # noqa: SIM115 - closing it unlocks
        end = time.monotonic() + LONGEST_WAIT
        while time.monotonic() < end:
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            except BlockingIOError:
                time.sleep(POLL)
            except OSError:  # a file system without locks
                return

    def _let_others(self) -> None:
        if self._lock is not None:
            self._lock.close()  # and so unlock it
            self._lock = None


def kernel_folder() -> Path:
    """Folder of the compiled kernels."""
    return cache_folder() / "kernels"


def kept_for_user(kernel: Any) -> Any:
    """The same kernel, cached in the user's folder if that is writable and no other folder was chosen."""
    folder = kernel_folder()
    if os.environ.get("NUMBA_CACHE_DIR"):
        return kernel
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return kernel
    if os.access(folder, os.W_OK):
        kernel._cache = KernelCache(kernel.py_func)
    return kernel
