"""Whether anything is wrong at all: tests of the whitened residuals against independent unit normals, as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import norm, rankdata

DIRECTED = "candidates"  # the statistic that is the largest score of any candidate
# Share of the level that this statistic gets. Of 75 effects of rho .15 it shows 72 at its share of 2 %, the others but
# the test of the pose show 15 at theirs, and none besides.
SHARE = 0.75
POSE = "pose"  # the statistic of what depends on the predicted pose, see `pose_regressors`
BLOCK = 10  # rows
LAGS = 10
STILL = 1e-6  # of the largest motion along an axis, below which motion along another is rounding


@dataclass(frozen=True)
class Omnibus:
    """Result of the joint test.

    Attributes:
        p: p-value of the joint test, see `joint_test`.
        single: p-value of each test on its own.
        blocks: mean square of each block of rows, over channels and groups; 1 if the model is right.
    """

    p: float
    single: dict[str, float]
    blocks: Float[np.ndarray, " block"]


def statistics(white: Float[np.ndarray, "*batch group time channel"]) -> dict[str, Float[np.ndarray, "*batch"]]:
    """Statistics that are large for a wrong model.

    - variance: mean square (lack of fit against pure error);
    - blocks: squares of the means of `BLOCK` rows, per channel;
    - modes: the largest share of these in a single pattern over the channels;
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


def block_squares(
    white: Float[np.ndarray, "group time channel"], valid: Bool[np.ndarray, "group time channel"]
) -> Float[np.ndarray, " block"]:
    """Mean square of the means of blocks of rows, over groups and channels, 1 if the model is right; unmeasured rows
    are skipped, and an empty block is NaN.
    """
    size = min(BLOCK, white.shape[-2])
    measured = np.round(np.sqrt(size) * block_means(valid.astype(float)))
    sums = np.sqrt(size) * block_means(np.where(valid, white, 0.0))
    count = np.sum(measured, axis=(0, 2))
    return np.where(count > 0, np.sum(sums**2, axis=(0, 2)) / np.maximum(count, 1.0), np.nan)


def pose_regressors(
    position: Float[np.ndarray, "group time marker 3"],
    time: Float[np.ndarray, "group time"],
    valid: Bool[np.ndarray, "group time column"],
) -> Float[np.ndarray, "regressor group time column"]:
    """Errors of each coordinate that depend on the predicted pose: a shift, a drift, an affine map of the pose, and its
    rate, the same for all markers and recordings.

    A model with a wrong cause that predicts nearly as well leaves little, and leaves it there; a test that asks for any
    pattern does not see it. That errors must not depend on predictions is the idea of Ramsey's RESET (1969). Measured
    positions would not do: their noise is in the errors as well.
    """
    usable = valid.reshape(position.shape)
    count = np.maximum(np.sum(usable, axis=(0, 1, 2)), 1)
    around = position - np.sum(position, axis=(0, 1, 2), where=usable) / count
    spread = np.sqrt(np.sum(around**2, axis=(0, 1, 2), where=usable) / count)
    around = np.where(spread > STILL * spread.max(), around, 0.0)
    step = np.diff(time, axis=1, prepend=time[:, :1])[..., None, None]
    change = np.diff(around, axis=1, prepend=around[:, :1])
    rate = np.divide(change, step, out=np.zeros_like(change), where=step > 0.0)
    drift = np.broadcast_to(np.linspace(-1.0, 1.0, position.shape[1])[:, None, None], usable.shape)
    found = []
    for axis, unit in enumerate(np.eye(3)):
        found += [part * unit for part in (np.ones(usable.shape), drift, rate)]
        found += [np.where(np.arange(3) == axis, around[..., [k]], 0.0) for k in range(3)]
    return np.stack([np.where(usable, each, 0.0).reshape(valid.shape) for each in found])


def joint_test(
    observed: dict[str, float], simulated: dict[str, Float[np.ndarray, " count"]], blocks: Float[np.ndarray, " block"]
) -> Omnibus:
    """Calibrate each statistic, and the smallest p-value, against the simulated statistics.

    The largest score of the candidates has `SHARE` of the level, all other statistics together have the rest: tests
    that ask whether anything at all is wrong must not hide the effect of a known cause. The observed data
    set is ranked among the simulated data sets in every step: under a right model it is one of them, and the joint
    p-value is then valid at any level. Ties in the smallest p-value are broken by the distance from the median.
    """
    single = {}  # p-value of each data set, and its distance from the median in distances of the 95 % quantile
    for name in observed:
        values = np.append(simulated[name], observed[name])
        middle, high = np.quantile(values, [0.5, 0.95])
        p = (len(values) - np.searchsorted(np.sort(values), values, side="left")) / len(values)
        single[name] = p, (values - middle) / max(high - middle, 1e-300)
    joint, distance = _smallest([both for name, both in single.items() if name != DIRECTED])
    if DIRECTED in single:
        p, beyond = single[DIRECTED]
        joint, _ = _smallest([(joint / (1.0 - SHARE), distance), (p / SHARE, beyond)])
    return Omnibus(float(joint[-1]), {name: float(p[-1]) for name, (p, _) in single.items()}, blocks)


def _smallest(tests: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """The test by the smallest p-value of several: p-value and distance of each data set among all."""
    p, distance = (np.stack(part) for part in zip(*tests, strict=True))
    smallest = p.min(axis=0)
    out = np.where(p == smallest, distance, -np.inf).max(axis=0)
    _, place = np.unique(np.stack([smallest, -out], axis=1), axis=0, return_inverse=True)
    return rankdata(place, method="max") / len(place), out
