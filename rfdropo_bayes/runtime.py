"""Process-wide settings: double precision, operations in turn, and one BLAS thread for the small solves."""

from __future__ import annotations

import os


def limit_blas_threads() -> None:
    """Keep BLAS on one thread, unless the user chose otherwise.

    Two threads that fight over 12 x 12 blocks make a factorisation fifty times slower. The variables are read when the
    library is loaded, so this runs before anything imports SciPy or JAX.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def configure_jax() -> None:
    """Make float64 the default of JAX, and let it finish one operation before the next.

    Stiff finite-element solves lose their answer in float32. Operations that run ahead of a callback into the compiled
    engines can take the threads that the callback waits for: on two processors a rollout outside ``jax.jit`` then
    hangs for ever.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_cpu_enable_async_dispatch", False)
