"""Whether anything is wrong at all: tests of the whitened residuals against independent unit normals, as one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.stats import norm

BLOCK = 10  # rows
LAGS = 10


@dataclass(frozen=True)
class Omnibus:
    """Result of the joint test.

    Attributes:
        p: of the joint test: the smallest of the single p-values, calibrated as such.
        single: p-value of each test on its own.
        blocks: mean square of each block of rows, over channels and groups; 1 where the model is right.
    """

    p: float
    single: dict[str, float]
    blocks: Float[np.ndarray, " block"]


def statistics(white: Float[np.ndarray, "*batch group time channel"]) -> dict[str, Float[np.ndarray, "*batch"]]:
    """Large where something is wrong.

    - variance: mean square (lack of fit against pure error);
    - blocks: squares of the means of `BLOCK` rows, per channel;
    - modes: the largest share of these that one pattern over the channels takes;
    - memory: Ljung-Box over `LAGS` lags, pooled over channels;
    - distribution: Kolmogorov-Smirnov distance of the PIT.
    """
    axes = (-3, -2, -1)
    rows = white.shape[-2]
    square = np.mean(white**2, axis=axes)
    means = block_means(white)
    flat = means.reshape(*means.shape[:-3], -1, means.shape[-1])
    gram = np.swapaxes(flat, -1, -2) @ flat
    pooled = []
    for lag in range(1, min(LAGS, rows - 1) + 1):
        pooled.append(np.mean(white[..., lag:, :] * white[..., :-lag, :], axis=axes) / np.maximum(square, 1e-12))
    memory = np.sum(np.stack(pooled) ** 2, axis=0)
    ranks = np.sort(white.reshape(*white.shape[:-3], -1), axis=-1)
    ladder = (np.arange(ranks.shape[-1]) + 0.5) / ranks.shape[-1]
    return {
        "variance": square,
        "blocks": np.mean(means**2, axis=axes),
        "modes": np.linalg.eigvalsh(gram)[..., -1],
        "memory": memory,
        "distribution": np.max(np.abs(norm.cdf(ranks) - ladder), axis=-1),
    }


def block_means(white: Float[np.ndarray, "*batch group time channel"]) -> Float[np.ndarray, "*batch group b channel"]:
    """Means of successive rows, scaled to unit variance; rows beyond the last whole block are left out."""
    size = min(BLOCK, white.shape[-2])
    count = white.shape[-2] // size
    cut = white[..., : count * size, :]
    return cut.reshape(*cut.shape[:-2], count, size, cut.shape[-1]).sum(axis=-2) / np.sqrt(size)


def joint_test(
    observed: dict[str, float], simulated: dict[str, Float[np.ndarray, " count"]], blocks: Float[np.ndarray, " block"]
) -> Omnibus:
    """Calibrate each statistic, and the smallest p-value of all, against the simulated ones."""
    names = list(observed)
    count = len(simulated[names[0]])
    own = {name: (1 + np.sum(simulated[name] >= observed[name])) / (1 + count) for name in names}
    ranks = np.stack([_upper_ranks(simulated[name]) for name in names])
    smallest = ranks.min(axis=0)
    p = (1 + np.sum(smallest <= min(own.values()))) / (1 + count)
    return Omnibus(float(p), {name: float(value) for name, value in own.items()}, blocks)


def _upper_ranks(values: np.ndarray) -> np.ndarray:
    """p-value of each simulated statistic among all of them."""
    ordered = np.sort(values)
    return (1 + len(values) - np.searchsorted(ordered, values, side="left")) / (1 + len(values))
