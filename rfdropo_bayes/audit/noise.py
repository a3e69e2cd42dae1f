"""The noise of a measurement as an autoregressive process, estimated where an experiment was repeated.

Whitening is exact for a stationary Gaussian AR(p) on every unbroken stretch of rows: the k-th row of a stretch is
predicted from the min(k, p) rows before it (Levinson-Durbin). Noise that channels share has the same memory as the rest
(a separable covariance); across a gap in some of the channels alone its whitening is approximate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float
from scipy.signal import lfilter

from rfdropo_bayes.audit.shared_noise import mixed, shrunk_correlation

MAX_ORDER = 3
LEAST_SHARE = 0.05  # of the mean deviation that a channel has at least: a marker that never moves is no certainty
REPEATS, STATED, RESIDUALS = "repeats", "stated", "residuals"
SLOW = 0.9  # share that the rows before predict, from which on a model's residuals are not taken for noise alone


@dataclass(frozen=True)
class NoiseModel:
    """Stationary AR(p) noise with one memory for all channels.

    Attributes:
        scale: marginal standard deviation of each channel (marker coordinate) [m].
        autocorrelation: at lags 0 ... p; its length says the order.
        source: "repeats" (pure error), "stated" (in the experiment file) or "residuals" (an assumption: what the base
            model leaves is taken for noise as far as such a process can make it).
        freedom: degrees of freedom of the variance; infinite where stated.
        correlation: of the channels at one time; None where they are independent.
    """

    scale: Float[np.ndarray, " channel"]
    autocorrelation: Float[np.ndarray, " lag"]
    source: str
    freedom: float
    correlation: Float[np.ndarray, "channel channel"] | None = None

    @property
    def order(self) -> int:
        """Rows of memory."""
        return len(self.autocorrelation) - 1

    @property
    def doubtful(self) -> bool:
        """Whether it was taken from residuals of a model that change more slowly than the noise of a measurement."""
        return self.source == RESIDUALS and float(self.predictors[1][-1] ** 2) < 1.0 - SLOW

    @cached_property
    def predictors(self) -> tuple[Float[np.ndarray, "rows order"], Float[np.ndarray, " rows"]]:
        """Coefficients of the best prediction from 0, 1, ... p rows, and its relative standard deviation."""
        return levinson(self.autocorrelation)

    def whiten(
        self, series: Float[np.ndarray, "*batch time channel"], valid: Bool[np.ndarray, "*rest time channel"]
    ) -> Float[np.ndarray, "*batch time channel"]:
        """Independent unit-variance rows, zero where not valid; linear in the series."""
        return self.separate(self.innovations(series, valid), valid)

    def innovations(
        self, series: Float[np.ndarray, "*batch time channel"], valid: Bool[np.ndarray, "*rest time channel"]
    ) -> Float[np.ndarray, "*batch time channel"]:
        """What the rows before do not predict, in unit variance; channels that share noise still do."""
        coefficients, deviation = self.predictors
        memory = np.minimum(rows_before(valid), self.order)
        innovation = np.array(series, dtype=float)
        for lag in range(1, self.order + 1):
            before = np.zeros_like(innovation)
            before[..., lag:, :] = series[..., :-lag, :]
            innovation -= coefficients[memory, lag - 1] * before
        return np.where(valid, innovation / (deviation[memory] * self.scale), 0.0)

    def separate(
        self, innovations: Float[np.ndarray, "*batch time channel"], valid: Bool[np.ndarray, "*rest time channel"]
    ) -> Float[np.ndarray, "*batch time channel"]:
        """Innovations of which each channel has its own; `gather` undoes it."""
        return innovations if self.correlation is None else mixed(innovations, valid, self.correlation, -0.5)

    def gather(
        self, white: Float[np.ndarray, "*batch time channel"], valid: Bool[np.ndarray, "*rest time channel"]
    ) -> Float[np.ndarray, "*batch time channel"]:
        """Innovations of the channels themselves, what they share included."""
        return white if self.correlation is None else mixed(white, valid, self.correlation, 0.5)

    def colour(
        self, white: Float[np.ndarray, "*batch time channel"], valid: Bool[np.ndarray, "*rest time channel"]
    ) -> Float[np.ndarray, "*batch time channel"]:
        """The series that `whiten` makes ``white`` of; zero where not valid."""
        coefficients, deviation = self.predictors
        memory = np.minimum(rows_before(valid), self.order)
        series = np.where(valid, self.gather(white, valid) * deviation[memory] * self.scale, 0.0)
        for row in range(1, series.shape[-2]):
            for lag in range(1, min(self.order, row) + 1):
                share = coefficients[memory[..., row, :], lag - 1]
                series[..., row, :] += np.where(valid[..., row, :], share * series[..., row - lag, :], 0.0)
        return series

    def draw(self, rng: np.random.Generator, shape: tuple[int, ...]) -> Float[np.ndarray, "*batch time channel"]:
        """A realisation of shape (..., time, channel)."""
        coefficients, deviation = self.predictors
        warm = 0 if self.order == 0 else 60
        white = rng.standard_normal((*shape[:-2], shape[-2] + warm, shape[-1]))
        white = self.gather(white, np.ones(white.shape[-2:], dtype=bool))
        filtered = lfilter([deviation[-1]], np.concatenate([[1.0], -coefficients[-1]]), white, axis=-2)
        return self.scale * filtered[..., warm:, :]


def rows_before(valid: Bool[np.ndarray, "*batch time channel"]) -> np.ndarray:
    """Valid rows in unbroken succession before each row."""
    rows = np.arange(valid.shape[-2])[:, None]
    broken = np.maximum.accumulate(np.where(valid, -1, rows), axis=-2)
    shifted = np.concatenate([np.full_like(broken[..., :1, :], -1), broken[..., :-1, :]], axis=-2)
    return rows - shifted - 1


def levinson(
    autocorrelation: Float[np.ndarray, " lag"],
) -> tuple[Float[np.ndarray, "rows order"], Float[np.ndarray, " rows"]]:
    """Levinson-Durbin recursion: row k holds the coefficients of the best linear prediction from k rows."""
    order = len(autocorrelation) - 1
    table, variance = np.zeros((order + 1, max(order, 1))), np.ones(order + 1)
    for k in range(1, order + 1):
        last = table[k - 1, : k - 1]
        partial = (autocorrelation[k] - last @ autocorrelation[k - 1 : 0 : -1]) / variance[k - 1]
        partial = float(np.clip(partial, -0.999, 0.999))
        table[k, : k - 1] = last - partial * last[::-1]
        table[k, k - 1] = partial
        variance[k] = variance[k - 1] * (1.0 - partial**2)
    return table, np.sqrt(variance)


def estimate_noise(
    series: Float[np.ndarray, "series time channel"],
    valid: Bool[np.ndarray, "series time channel"],
    freedom_share: float,
    *,
    source: str,
    order: int | None = None,
    pooled: bool | None = None,
    shared: bool | None = False,
) -> NoiseModel:
    """Fit the noise to deviations that hold nothing else.

    Args:
        series: deviations [m], e.g. of repeats from their mean.
        valid: which may be used.
        freedom_share: degrees of freedom per value: (n - 1) / n for deviations from the mean of n repeats.
        source: what the deviations are.
        order: of the process; by default the one of smallest BIC up to `MAX_ORDER`.
        pooled: one standard deviation for all channels; by default as BIC has it.
        shared: whether channels share noise; None to test it.
    """
    square = np.where(valid, series, 0.0) ** 2
    count = np.maximum(valid.sum(axis=(0, 1)), 1) * freedom_share
    own = np.sqrt(np.maximum(square.sum(axis=(0, 1)) / count, 1e-20))
    mean = float(np.sqrt(max(square.sum() / count.sum(), 1e-20)))
    own = np.maximum(own, LEAST_SHARE * mean)
    if pooled is None:
        gain = count.sum() * np.log(mean) - np.sum(count * np.log(own))
        pooled = bool(gain < 0.5 * len(own) * np.log(count.sum()) * 3.0)  # memory leaves a third of the rows' worth
    scale = np.full(len(own), mean) if pooled else own
    correlation = _autocorrelation(np.where(valid, series, 0.0) / scale, valid, MAX_ORDER if order is None else order)
    if order is None:
        _, deviation = levinson(correlation)
        total = count.sum()
        order = int(np.argmin([2.0 * total * np.log(deviation[k]) + k * np.log(total) for k in range(len(deviation))]))
    alone = NoiseModel(scale, correlation[: order + 1], source, float(count.sum()))
    whole = valid.all(axis=-1)
    across = shrunk_correlation(alone.innovations(series, valid)[whole], freedom_share, shared=shared)
    if across is None:
        return alone
    # The mean of correlated squares is known as well as that of fewer independent ones.
    return replace(alone, correlation=across, freedom=alone.freedom * len(across) / float(np.sum(across**2)))


def _autocorrelation(series: np.ndarray, valid: np.ndarray, lags: int) -> np.ndarray:
    """Pooled over series and channels, each lag over the pairs of rows it has."""
    variance = np.sum(series**2) / max(valid.sum(), 1)
    values = [1.0]
    for lag in range(1, lags + 1):
        pairs = max(int((valid[..., lag:, :] & valid[..., :-lag, :]).sum()), 1)
        values.append(float(np.sum(series[..., lag:, :] * series[..., :-lag, :]) / pairs / max(variance, 1e-300)))
    return np.array(values)
