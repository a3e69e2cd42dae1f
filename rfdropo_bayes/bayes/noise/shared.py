"""Noise that columns share, such as that of a shaking mount: their correlation, found in repeats, and its roots."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import chi2

INDEPENDENT = 0.05  # p-value of independence, below which columns are taken to share noise
LEAST_ROWS = 3  # for each column, to estimate correlations at all


def shrunk_correlation(
    rows: Float[np.ndarray, "row column"], freedom_share: float, *, shared: bool | None = None
) -> Float[np.ndarray, "column column"] | None:
    """Correlation of the columns, drawn towards independence as far as its own uncertainty calls for.

    Args:
        rows: independent of one another, every column present.
        freedom_share: degrees of freedom per value.
        shared: whether noise is shared; by default as Bartlett's test of independence has it (Bartlett 1951).

    Returns:
        Schaefer and Strimmer's (2005) estimate under normal errors; None where the columns are independent.
    """
    count, columns = len(rows) * freedom_share, rows.shape[1]
    if shared is False or columns < 2 or count < LEAST_ROWS * columns:
        return None
    scale = np.sqrt(np.maximum(np.mean(rows**2, axis=0), 1e-300))
    sample = (rows / scale).T @ (rows / scale) / len(rows)
    np.fill_diagonal(sample, 1.0)  # of a column that never differs, too
    pairs = columns * (columns - 1) / 2
    if shared is None:
        likelihood = -(count - 1.0 - (2.0 * columns + 5.0) / 6.0) * np.linalg.slogdet(sample)[1]
        if chi2.sf(likelihood, pairs) > INDEPENDENT:
            return None
    upper = sample[np.triu_indices(columns, 1)]
    excess = float(np.sum((1.0 - upper**2) ** 2)) / count
    kept = 1.0 - min(1.0, excess / max(float(np.sum(upper**2)), 1e-300))
    return np.eye(columns) + kept * (sample - np.eye(columns))


def mixed(
    series: Float[Any, "*batch row column"],
    valid: Bool[np.ndarray, "*rest row column"],
    correlation: Float[np.ndarray, "column column"],
    power: float,
) -> Float[Any, "*batch row column"]:
    """Each row times the symmetric root of the correlation of the columns it has: power -1/2 makes unit normals
    independent (each stays as near as can be to the column it was), 1/2 correlates them again."""
    numbers: Any = jnp if isinstance(series, jax.Array) else np
    used = numbers.where(valid, series, 0.0)
    patterns, which = _patterns(valid)
    if len(patterns) == 1 and patterns[0].all():
        return used @ _power(correlation, power)
    found = numbers.zeros_like(used)
    for index, pattern in enumerate(patterns):
        root = np.zeros_like(correlation)
        root[np.ix_(pattern, pattern)] = _power(correlation[np.ix_(pattern, pattern)], power)
        found = numbers.where((which == index)[..., None], used @ root, found)
    return found


def half_log_determinant(
    correlation: Float[np.ndarray, "column column"], valid: Bool[np.ndarray, "*batch row column"]
) -> Float[np.ndarray, "*batch row"]:
    """Half the log determinant of the correlation of the columns that each row has."""
    patterns, which = _patterns(valid)
    return np.array([0.5 * np.linalg.slogdet(correlation[np.ix_(p, p)])[1] if p.any() else 0.0 for p in patterns])[
        which
    ]


def _patterns(valid: Bool[np.ndarray, "*batch row column"]) -> tuple[np.ndarray, np.ndarray]:
    """The sets of columns that rows have, and which of them each row has; rows without any count with whole ones."""
    rows = valid.reshape(-1, valid.shape[-1])
    rows = np.where(rows.any(axis=1, keepdims=True), rows, True)
    if rows.all():
        return rows[:1], np.zeros(valid.shape[:-1], dtype=int)
    patterns, which = np.unique(rows, axis=0, return_inverse=True)
    return patterns, which.reshape(valid.shape[:-1])


def _power(matrix: np.ndarray, power: float) -> np.ndarray:
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.maximum(values, 1e-12) ** power) @ vectors.T
