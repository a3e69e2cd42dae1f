"""Process-wide settings: double precision, operations in turn, one BLAS thread for the small solves, and a persistent
cache for JAX compilations.
"""

from __future__ import annotations

import hashlib
import os
import sys
from pathlib import Path

from rfdropo_bayes.errors import InputError

# The rollouts of a value and of a central difference are simultaneous callbacks; one thread is left to copy.
CALLBACK_THREADS = 4


def available_processors() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def limit_blas_threads() -> None:
    """Keep BLAS on one thread, unless the user chose otherwise.

    Two threads that fight over 12 x 12 blocks make a factorisation fifty times slower. The variables are read when the
    library is loaded, so this runs before anything imports SciPy or JAX.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def keep_callback_threads() -> None:
    """Give XLA's pool at least `CALLBACK_THREADS` threads, unless the user chose otherwise.

    A callback occupies one thread of the pool, and waits for another thread to copy its arguments. The pool has one
    thread for each processor: on one processor two callbacks of one program wait forever. The variable is read when
    JAX first makes an array, and engines that use JAX do so when they are imported.
    """
    if available_processors() < CALLBACK_THREADS:
        os.environ.setdefault("PJRT_NPROC", str(CALLBACK_THREADS))


class _Fork:
    """Whether this process was forked after JAX had started threads, which do not exist in the fork."""

    without_threads = False


def _after_fork() -> None:
    bridge = sys.modules.get(
        "jax._src.xla_bridge"
    )  # asking JAX itself could wait for a lock that nobody holds any more
    _Fork.without_threads |= bridge is not None and bool(getattr(bridge, "_backends", True))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def refuse_lost_threads() -> None:
    """Refuse to compute in a forked process that JAX's threads are missing in: it would wait for them forever.

    Raises:
        InputError: with the way out.
    """
    if _Fork.without_threads:
        raise InputError(
            "was forked after JAX had started, and JAX would wait for threads that it lacks",
            where=f"process {os.getpid()}",
            remedy='start workers with multiprocessing.get_context("spawn")',
        )


def configure_jax() -> None:
    """Make float64 the default of JAX, and let it finish one operation before the next.

    Stiff finite-element solves are wrong in float32. Asynchronous operations before a callback into the compiled
    engines can occupy the threads that the callback needs. A rollout outside ``jax.jit`` on two processors then waits
    forever.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_cpu_enable_async_dispatch", False)


def cache_folder() -> Path:
    """The user's folder for what the package has compiled."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rfdropo_bayes"


def keep_compilations() -> None:
    """Let JAX keep compiled programs in the user's cache folder, unless the user chose otherwise.

    A calibration of the demo spends a quarter of its processor time on repeated compilation. Programs that call the
    compiled engines are not kept: JAX leaves callbacks out. The variables are read when JAX is loaded.
    """
    from llvmlite import binding

    # Homes are shared between machines; machine code is not.
    machine = f"{binding.get_host_cpu_name()} {binding.get_host_cpu_features().flatten()}"
    folder = cache_folder() / f"jax-{hashlib.sha256(machine.encode()).hexdigest()[:12]}"
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
