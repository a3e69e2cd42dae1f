"""Noise that channels share, such as that of a shaking mount: their correlation, found in repeats, and its roots."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import chi2

INDEPENDENT = 0.05  # p-value of independence, below which channels are taken to share noise
LEAST_ROWS = 3  # for each channel, to estimate correlations at all


def shrunk_correlation(
    rows: Float[np.ndarray, "row channel"], freedom_share: float, *, shared: bool | None = None
) -> Float[np.ndarray, "channel channel"] | None:
    """Correlation of the channels, drawn towards independence as far as its own uncertainty calls for.

    Args:
        rows: independent of one another, every channel present.
        freedom_share: degrees of freedom per value.
        shared: whether noise is shared; by default as Bartlett's test of independence has it (Bartlett 1951).

    Returns:
        Schaefer and Strimmer's (2005) estimate under normal errors; None where the channels are independent.
    """
    count, channels = len(rows) * freedom_share, rows.shape[1]
    if shared is False or channels < 2 or count < LEAST_ROWS * channels:
        return None
    scale = np.sqrt(np.maximum(np.mean(rows**2, axis=0), 1e-300))
    sample = (rows / scale).T @ (rows / scale) / len(rows)
    np.fill_diagonal(sample, 1.0)  # of a channel that never differs, too
    pairs = channels * (channels - 1) / 2
    if shared is None:
        likelihood = -(count - 1.0 - (2.0 * channels + 5.0) / 6.0) * np.linalg.slogdet(sample)[1]
        if chi2.sf(likelihood, pairs) > INDEPENDENT:
            return None
    upper = sample[np.triu_indices(channels, 1)]
    excess = float(np.sum((1.0 - upper**2) ** 2)) / count
    kept = 1.0 - min(1.0, excess / max(float(np.sum(upper**2)), 1e-300))
    return np.eye(channels) + kept * (sample - np.eye(channels))


def mixed(
    series: Float[np.ndarray, "*batch row channel"],
    valid: Bool[np.ndarray, "*rest row channel"],
    correlation: Float[np.ndarray, "channel channel"],
    power: float,
) -> Float[np.ndarray, "*batch row channel"]:
    """Each row times the symmetric root of the correlation of the channels it has: power -1/2 makes unit normals
    independent (each stays as near as can be to the channel it was), 1/2 correlates them again."""
    used = np.where(valid, series, 0.0)
    rows = valid.reshape(-1, valid.shape[-1])
    if np.all(rows.all(axis=1) | ~rows.any(axis=1)):
        return used @ _power(correlation, power)
    found = np.empty_like(used)
    patterns, which = np.unique(rows, axis=0, return_inverse=True)
    which = np.broadcast_to(which.reshape(valid.shape[:-1]), series.shape[:-1])
    for index, pattern in enumerate(patterns):
        root = np.zeros_like(correlation)
        root[np.ix_(pattern, pattern)] = _power(correlation[np.ix_(pattern, pattern)], power)
        found[which == index] = used[which == index] @ root
    return found


def _power(matrix: np.ndarray, power: float) -> np.ndarray:
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.maximum(values, 1e-12) ** power) @ vectors.T
