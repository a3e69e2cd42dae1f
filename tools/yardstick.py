"""Processor seconds of a fixed piece of work on this machine, so that costs measured on different machines compare.

The work is what the package spends its time on: JAX compiles a program, the program solves block systems in double
precision, NumPy factorises matrices, Python runs a loop. No cache is used.

    python tools/yardstick.py
"""

from __future__ import annotations

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)

import time

import jax
import jax.numpy as jnp
import numpy as np


def compile_and_solve() -> float:
    """Compile a scan of block eliminations, and run it; the sum of its solution."""
    jax.config.update("jax_enable_x64", True)
    blocks = jnp.eye(6) * 4.0 + jnp.sin(jnp.arange(36.0)).reshape(6, 6) / 6.0

    def eliminate(carry: jax.Array, right: jax.Array) -> tuple[jax.Array, jax.Array]:
        pivot = blocks - 0.1 * carry @ jnp.linalg.inv(blocks + jnp.diag(jnp.cos(right)))
        return jnp.tanh(pivot), jnp.linalg.solve(pivot, right)

    @jax.jit
    def solve(rights: jax.Array) -> jax.Array:
        total = jnp.zeros(())
        for shift in range(6):
            _, solutions = jax.lax.scan(eliminate, jnp.zeros((6, 6)), rights + shift)
            total += solutions.sum()
        return total

    return float(sum(solve(jnp.ones((2000, 6)) * scale) for scale in range(1, 6)))


def factorise() -> float:
    """Cholesky factors of matrices of 12 to 300 rows; the sum of their diagonals."""
    return float(
        sum(
            np.linalg.cholesky(np.eye(rows) * rows + 0.5).trace()
            for rows in (12, 60, 300)
            for _ in range(30_000 // rows)
        )
    )


def count() -> int:
    """A loop in Python over a dictionary."""
    kept: dict[int, int] = {}
    for number in range(1_500_000):
        kept[number % 1000] = kept.get(number % 997, 0) + number
    return len(kept)


def main() -> None:
    """Print the processor seconds of each part and of all."""
    parts = {}
    for part in (compile_and_solve, factorise, count):
        start = time.process_time()
        part()
        parts[part.__name__] = time.process_time() - start
    each = ", ".join(f"{name} {seconds:.1f}" for name, seconds in parts.items())
    print(f"yardstick: {sum(parts.values()):.1f} processor seconds ({each})")


if __name__ == "__main__":
    main()
