"""Known noise: an autoregression, stated or estimated from repeats.

Whitening is exact for a stationary Gaussian AR(p) on every unbroken stretch of rows: the k-th row of a stretch is
predicted from the min(k, p) rows before it (Levinson-Durbin). Noise shared by columns, such as from a shaking mount,
has the memory of the other columns (a separable covariance); whitening is approximate across a gap in only some
columns.

Memory is defined in seconds, not in rows: in recordings of another rate each row is predicted under the autocorrelation
at its own lags (`Autoregression.at`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray
from scipy.stats import chi2

from rfdropo_bayes.data.sample_times import ONE_RATE

MAX_ORDER = 3
LEAST_SHARE = 0.05  # of the mean deviation that a column has at least: a marker that never moves is no certainty
REPEATS, STATED, RESIDUALS = "repeats", "stated", "residuals"
INNOVATIONS = "innovations"  # white: the size of slow residuals that the rows before do not predict
MISFIT = "misfit"  # white, of the size of a misspecified model's residuals
SLOW = 0.9  # share that the rows before predict, at or above which a model's residuals are not taken for noise alone
INDEPENDENT = 0.05  # p-value of independence, below which columns are taken to share noise
LEAST_ROWS = 3  # for each column, to estimate correlations at all


@dataclass(frozen=True)
class Autoregression:
    """Stationary AR(p) noise with one memory for all columns."""

    scale: Float[np.ndarray, " column"]  # marginal standard deviation of each column, in the column's unit
    autocorrelation: Float[np.ndarray, " lag"]  # values at lags 0 ... p; its length gives the order.
    # "repeats" (pure error), "stated" (in the experiment file) or "residuals" (assumes that the base model's residuals
    # are noise of such a process)
    source: str
    freedom: float  # degrees of freedom of the variance; infinite if stated
    # correlation of the columns at one time; None if they are independent
    correlation: Float[np.ndarray, "column column"] | None = None
    # time between rows [s] that the lags count; None if unknown, and rows of any rate count equally
    step: float | None = None
    # time between the rows of each recording, in steps; None if all have the rate of ``step``. Series then have an axis
    # of these recordings before the time axis.
    paces: tuple[float, ...] | None = None

    @property
    def order(self) -> int:
        """Rows of memory."""
        return len(self.autocorrelation) - 1

    @property
    def remembered(self) -> float:
        """Share of the variance that the rows before predict."""
        return 1.0 - float(self.predictors[1][-1] ** 2)

    @property
    def doubtful(self) -> bool:
        """Whether the noise was estimated from a model's residuals that change more slowly than measurement noise."""
        slow = self.source == RESIDUALS and self.remembered > SLOW
        return slow or self.source == INNOVATIONS

    @property
    def unpredicted(self) -> Autoregression:
        """White noise with the size of the innovations."""
        scale = self.scale * float(self.predictors[1][-1])
        return replace(self, scale=scale, autocorrelation=np.ones(1), source=INNOVATIONS, correlation=None)

    def of_columns(self, columns: Sequence[int]) -> Autoregression:
        """The noise of some columns."""
        index = list(columns)
        across = None if self.correlation is None else self.correlation[np.ix_(index, index)]
        return replace(self, scale=self.scale[index], correlation=across)

    def at(self, steps: Sequence[float] | Float[np.ndarray, " recording"]) -> Autoregression:
        """The same noise in recordings with the given seconds between rows."""
        if self.step is None or not self.order:
            return self
        every = tuple(_pace(float(step) / self.step, np) for step in steps)
        paces = None if set(every) <= {1.0} else every
        return self if paces == self.paces else replace(self, paces=paces)

    def resampled(self, step: float) -> Autoregression:
        """The same noise in rows that are ``step`` seconds apart, which its lags then count."""
        if self.step is None:
            return self
        pace = _pace(step / self.step, np)
        return replace(self, autocorrelation=self._autocorrelation_at(np.array(pace)), step=step, paces=None)

    def of_recordings(self, index: Sequence[int]) -> Autoregression:
        """The noise in some of the recordings."""
        return self if self.paces is None else replace(self, paces=tuple(self.paces[i] for i in index))

    def as_dict(self) -> dict[str, Any]:
        """The noise as plain values without recordings; `from_dict` is the inverse."""
        arrays = {"scale": self.scale, "autocorrelation": self.autocorrelation, "correlation": self.correlation}
        values = {name: None if array is None else array.tolist() for name, array in arrays.items()}
        freedom = self.freedom if np.isfinite(self.freedom) else None
        return {**values, "source": self.source, "freedom": freedom, "step": self.step}

    @classmethod
    def from_dict(cls, given: Mapping[str, Any]) -> Autoregression:
        """From plain values."""
        across, freedom = given["correlation"], given["freedom"]
        return cls(
            np.array(given["scale"]),
            np.array(given["autocorrelation"]),
            given["source"],
            np.inf if freedom is None else freedom,
            None if across is None else np.array(across),
            given["step"],
        )

    @cached_property
    def predictors(self) -> tuple[Float[np.ndarray, "rows order"], Float[np.ndarray, " rows"]]:
        """Coefficients of the best prediction from 0, 1, ... p rows, and its relative standard deviation."""
        return levinson(self.autocorrelation)

    def _autocorrelation_at(self, pace: Float[Any, "..."]) -> Float[Any, "... lag"]:
        """Autocorrelation at lags of rows that are ``pace`` steps apart.

        The autocorrelation is interpolated linearly between whole lags. The process stays stationary (the periodic
        spectrum times a squared sinc). Interpolation is exact for a first-order process with positive memory.
        """
        numbers: Any = jnp if isinstance(pace, jax.Array) else np
        lags = numbers.asarray(pace)[..., None] * np.arange(self.order + 1)
        if self.order == 1 and self.autocorrelation[1] >= 0.0:
            return self.autocorrelation[1] ** lags
        known = list(self.autocorrelation)
        coefficients = self.predictors[0][-1]
        while len(known) <= self.order * (max(self.paces or (1.0,)) if isinstance(pace, jax.Array) else np.max(pace)):
            known.append(float(coefficients @ known[: -self.order - 1 : -1]))
        return numbers.interp(lags, np.arange(len(known)), np.array(known))

    def _prediction(
        self, valid: Bool[np.ndarray, "*batch time column"]
    ) -> tuple[Float[np.ndarray, "*batch time column order"], Float[np.ndarray, "*batch time column"]]:
        """Coefficients and relative standard deviation of the prediction of each value from the rows before it."""
        memory = np.minimum(rows_before(valid), self.order)
        if self.paces is None:
            coefficients, deviation = self.predictors
            return coefficients[memory], deviation[memory]
        coefficients, deviation = levinson(self._autocorrelation_at(np.array(self.paces)))
        which = np.arange(len(self.paces))[:, None, None]
        return coefficients[which, memory], deviation[which, memory]

    def whiten(
        self,
        series: Float[Any, "*batch time column"],
        valid: Bool[np.ndarray, "*rest time column"],
        count: Float[np.ndarray, "*rest time column"] | None = None,
    ) -> Float[Any, "*batch time column"]:
        """Independent unit-variance rows, zero if not valid; linear in the series.

        Each value is a mean of ``count`` repeats, with noise smaller by its square root; by default a single reading.
        """
        innovations = self.innovations(series, valid)
        return self.separate(innovations if count is None else innovations * np.sqrt(count), valid)

    def log_scale(self, valid: Bool[np.ndarray, "*rest time column"]) -> Float[np.ndarray, "*rest time column"]:
        """Logarithms that normalise the density of `whiten`: zero if not valid; their sum is half the log determinant
        of the covariance. The effect of correlation is divided equally between a row's columns.
        """
        logarithm = np.log(self._prediction(valid)[1] * self.scale)
        if self.correlation is not None:
            shared = half_log_determinant(self.correlation, valid)
            logarithm = logarithm + (shared / np.maximum(valid.sum(axis=-1), 1))[..., None]
        return np.where(valid, logarithm, 0.0)

    def innovations(
        self, series: Float[Any, "*batch time column"], valid: Bool[np.ndarray, "*rest time column"]
    ) -> Float[Any, "*batch time column"]:
        """Prediction errors from earlier rows, with unit variance; shared noise between columns remains."""
        coefficients, deviation = self._prediction(valid)
        numbers: Any = jnp if isinstance(series, jax.Array) else np
        innovation = numbers.asarray(series, dtype=float)
        for lag in range(1, self.order + 1):
            nothing = numbers.zeros_like(series[..., :lag, :])
            before = numbers.concatenate([nothing, series[..., :-lag, :]], axis=-2)
            innovation = innovation - coefficients[..., lag - 1] * before
        return numbers.where(valid, innovation / (deviation * self.scale), 0.0)

    def separate(
        self, innovations: Float[Any, "*batch time column"], valid: Bool[np.ndarray, "*rest time column"]
    ) -> Float[Any, "*batch time column"]:
        """Independent innovations of each column; `gather` is the inverse."""
        return innovations if self.correlation is None else mixed(innovations, valid, self.correlation, -0.5)

    def gather(
        self, white: Float[Any, "*batch time column"], valid: Bool[np.ndarray, "*rest time column"]
    ) -> Float[Any, "*batch time column"]:
        """Innovations of the columns, with their shared noise."""
        return white if self.correlation is None else mixed(white, valid, self.correlation, 0.5)

    def colour(
        self, white: Float[np.ndarray, "*batch time column"], valid: Bool[np.ndarray, "*rest time column"]
    ) -> Float[np.ndarray, "*batch time column"]:
        """Inverse of `whiten`; zero if not valid."""
        coefficients, deviation = self._prediction(valid)
        series = np.where(valid, self.gather(white, valid) * deviation * self.scale, 0.0)
        for row in range(1, series.shape[-2]):
            for lag in range(1, min(self.order, row) + 1):
                share = coefficients[..., row, :, lag - 1]
                series[..., row, :] += np.where(valid[..., row, :], share * series[..., row - lag, :], 0.0)
        return series

    def row_log_density(
        self, series: Float[Any, "*batch time column"], valid: Bool[np.ndarray, "*rest time column"]
    ) -> Float[Any, "*batch time"]:
        """Log density of each row given the earlier rows."""
        white = self.whiten(series, valid)
        return -(0.5 * white**2 + np.where(valid, self.log_scale(valid) + 0.5 * np.log(2.0 * np.pi), 0.0)).sum(axis=-1)

    def draw_rows(
        self, key: PRNGKeyArray, rows: int, time: Float[Any, " time"] | None = None
    ) -> Float[Any, "time column"]:
        """A realisation in one recording, at the times ``time`` [s] if there are several rates; traceable."""
        coefficients, deviation = self.predictors
        if self.paces is not None and self.step is not None and time is not None:
            pace = _pace(jnp.median(jnp.diff(jnp.asarray(time))) / self.step, jnp)
            coefficients, deviation = levinson(self._autocorrelation_at(pace))
        white = jax.random.normal(key, (rows, len(self.scale)))
        if self.correlation is not None:
            white = mixed(white, np.ones(white.shape, dtype=bool), self.correlation, 0.5)
        memory = np.minimum(np.arange(rows), self.order)

        def advance(last: jax.Array, row: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
            share, scale, fresh = row
            now = share @ last + scale * fresh
            return jnp.concatenate([now[None], last[:-1]]), now

        before = jnp.zeros((coefficients.shape[1], len(self.scale)))
        rows_of = (jnp.asarray(coefficients)[memory], jnp.asarray(deviation)[memory], white)
        return self.scale * jax.lax.scan(advance, before, rows_of)[1]

    def draw(self, rng: np.random.Generator, shape: tuple[int, ...]) -> Float[np.ndarray, "*batch time column"]:
        """A realisation of shape (..., time, column), stationary from its first row on."""
        own = shape[-2:] if self.paces is None else shape[-3:]
        return self.colour(rng.standard_normal(shape), np.ones(own, dtype=bool))


def rows_before(valid: Bool[np.ndarray, "*batch time column"]) -> np.ndarray:
    """Valid rows in unbroken succession before each row."""
    rows = np.arange(valid.shape[-2])[:, None]
    broken = np.maximum.accumulate(np.where(valid, -1, rows), axis=-2)
    shifted = np.concatenate([np.full_like(broken[..., :1, :], -1), broken[..., :-1, :]], axis=-2)
    return rows - shifted - 1


def _pace(ratio: Any, numbers: Any) -> Any:
    """Time between rows in steps: exactly 1 if all rows have the same rate."""
    same = (ratio < ONE_RATE) & (ratio > 1.0 / ONE_RATE)
    return numbers.where(same, 1.0, ratio) if numbers is jnp else (1.0 if same else ratio)


def steps_of(time: Float[np.ndarray, "recording time"]) -> Float[np.ndarray, " recording"]:
    """Time between rows of each recording [s]."""
    return np.median(np.diff(time, axis=-1), axis=-1)


def levinson(
    autocorrelation: Float[Any, "*batch lag"],
) -> tuple[Float[Any, "*batch rows order"], Float[Any, "*batch rows"]]:
    """Levinson-Durbin recursion: row k holds the coefficients of the best linear prediction from k rows, whose relative
    standard deviation is the k-th; traceable."""
    numbers: Any = jnp if isinstance(autocorrelation, jax.Array) else np
    order, batch = autocorrelation.shape[-1] - 1, autocorrelation.shape[:-1]
    last, variance = numbers.zeros((*batch, 0)), [numbers.ones(batch)]
    table = [numbers.zeros((*batch, max(order, 1)))]
    for k in range(1, order + 1):
        explained = numbers.sum(last * autocorrelation[..., k - 1 : 0 : -1], axis=-1)
        partial = numbers.clip((autocorrelation[..., k] - explained) / variance[-1], -0.999, 0.999)
        last = numbers.concatenate([last - partial[..., None] * last[..., ::-1], partial[..., None]], axis=-1)
        table.append(numbers.concatenate([last, numbers.zeros((*batch, order - k))], axis=-1))
        variance.append(variance[-1] * (1.0 - partial**2))
    return numbers.stack(table, axis=-2), numbers.sqrt(numbers.stack(variance, axis=-1))


def estimate_noise(
    series: Float[np.ndarray, "series time column"],
    valid: Bool[np.ndarray, "series time column"],
    freedom_share: float,
    *,
    source: str,
    steps: Float[np.ndarray, " series"] | None = None,
    order: int | None = None,
    pooled: bool | None = None,
    shared: bool | None = False,
) -> Autoregression:
    """Fit the noise to deviations of pure noise.

    Args:
        series: deviations [m], e.g. of repeats from their mean.
        valid: mask of usable values.
        freedom_share: degrees of freedom per value: (n - 1) / n for deviations from the mean of n repeats.
        source: source of the deviations.
        steps: time between rows of each series [s]; with several rates, memory is estimated from the series of the rate
            that has the most values. By default all recordings have the same, unknown rate.
        order: order of the process; by default with the smallest BIC up to `MAX_ORDER`.
        pooled: whether all columns have the same standard deviation; by default chosen by BIC.
        shared: whether columns share noise; None to test it.
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
    step, main = (None, slice(None)) if steps is None else _main_rate(steps, valid.sum(axis=(1, 2)))
    whitened = np.where(valid, series, 0.0)[main] / scale
    correlation = _autocorrelation(whitened, valid[main], MAX_ORDER if order is None else order)
    if order is None:
        _, deviation = levinson(correlation)
        total = float(np.maximum(valid[main].sum(axis=(0, 1)), 1).sum()) * freedom_share
        order = int(np.argmin([2.0 * total * np.log(deviation[k]) + k * np.log(total) for k in range(len(deviation))]))
    alone = Autoregression(scale, correlation[: order + 1], source, float(count.sum()), step=step)
    alone = alone if steps is None else alone.at(steps)
    whole = valid.all(axis=-1)
    across = shrunk_correlation(alone.innovations(series, valid)[whole], freedom_share, shared=shared)
    if across is None:
        return alone
    # The mean of correlated squares is as accurate as the mean of fewer independent squares.
    return replace(alone, correlation=across, freedom=alone.freedom * len(across) / float(np.sum(across**2)))


def _main_rate(
    steps: Float[np.ndarray, " series"], values: Float[np.ndarray, " series"]
) -> tuple[float, Bool[np.ndarray, " series"]]:
    """Time between rows [s] of the rate that has the most values, and the series of this rate."""
    ratio = steps[:, None] / steps[None]
    alike = (ratio < ONE_RATE) & (ratio > 1.0 / ONE_RATE)
    main = alike[int(np.argmax(alike @ values))]
    return float(np.median(steps[main])), main


def _autocorrelation(series: np.ndarray, valid: np.ndarray, lags: int) -> np.ndarray:
    """Pooled over series and columns, each lag over the pairs of rows it has."""
    variance = np.sum(series**2) / max(valid.sum(), 1)
    values = [1.0]
    for lag in range(1, lags + 1):
        pairs = max(int((valid[..., lag:, :] & valid[..., :-lag, :]).sum()), 1)
        values.append(float(np.sum(series[..., lag:, :] * series[..., :-lag, :]) / pairs / max(variance, 1e-300)))
    return np.array(values)


def shrunk_correlation(
    rows: Float[np.ndarray, "row column"], freedom_share: float, *, shared: bool | None = None
) -> Float[np.ndarray, "column column"] | None:
    """Correlation of the columns, shrunk towards independence according to its uncertainty.

    Args:
        rows: independent rows without missing columns.
        freedom_share: degrees of freedom per value.
        shared: whether noise is shared; by default by Bartlett's test of independence (Bartlett 1951).

    Returns:
        Schaefer and Strimmer's (2005) estimate under normal errors; None if the columns are independent.
    """
    count, columns = len(rows) * freedom_share, rows.shape[1]
    if shared is False or columns < 2 or count < LEAST_ROWS * columns:
        return None
    scale = np.sqrt(np.maximum(np.mean(rows**2, axis=0), 1e-300))
    sample = (rows / scale).T @ (rows / scale) / len(rows)
    np.fill_diagonal(sample, 1.0)  # also of a constant column
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
    result = numbers.zeros_like(used)
    for index, pattern in enumerate(patterns):
        root = np.zeros_like(correlation)
        root[np.ix_(pattern, pattern)] = _power(correlation[np.ix_(pattern, pattern)], power)
        result = numbers.where((which == index)[..., None], used @ root, result)
    return result


def half_log_determinant(
    correlation: Float[np.ndarray, "column column"], valid: Bool[np.ndarray, "*batch row column"]
) -> Float[np.ndarray, "*batch row"]:
    """Half the log determinant of the correlation of the columns that each row has."""
    patterns, which = _patterns(valid)
    return np.array([0.5 * np.linalg.slogdet(correlation[np.ix_(p, p)])[1] if p.any() else 0.0 for p in patterns])[
        which
    ]


def _patterns(valid: Bool[np.ndarray, "*batch row column"]) -> tuple[np.ndarray, np.ndarray]:
    """The distinct sets of valid columns, and the index of each row's set; empty rows count as complete."""
    rows = valid.reshape(-1, valid.shape[-1])
    rows = np.where(rows.any(axis=1, keepdims=True), rows, True)
    if rows.all():
        return rows[:1], np.zeros(valid.shape[:-1], dtype=int)
    patterns, which = np.unique(rows, axis=0, return_inverse=True)
    return patterns, which.reshape(valid.shape[:-1])


def _power(matrix: np.ndarray, power: float) -> np.ndarray:
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.maximum(values, 1e-12) ** power) @ vectors.T
