"""Residuals of a fitted model, as an estimate of its error in other recordings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.noise import Autoregression
from rfdropo_bayes.bayes.noise.autoregression import RESIDUALS, estimate_noise
from rfdropo_bayes.data.sample_times import ONE_RATE, sample_time
from rfdropo_bayes.posteriors import PosteriorRecord, RecordingPrediction

MODEL_ERROR = "model_error"  # among the attributes of a posterior
MOST_LAGS = 100  # rows of memory of correlated noise: longer recordings forget its constant part within this time
MOST_CONSTANT = 0.95
FEWEST_ROWS = 4  # least rows for an estimate of the correlation time
ADAPTED_TO = "adapted_to"  # among the attributes of a posterior: the day, of an adaptation
CONSTANT_ROUNDS = 5  # until share and memory agree


class ModelError(NamedTuple):
    """Residuals of a fitted model: size for each coordinate of each marker, and correlation time."""

    markers: tuple[str, ...]  # names of the markers
    scale: tuple[float, ...]  # root mean square [m] of x, y and z of each marker
    correlation_time: float  # correlation time [s]
    # weight of a coordinate of a row, because errors of markers are correlated; the number of independent coordinates
    # is the participation ratio of the correlation matrix
    share: float = 1.0
    step: float = 0.0  # time between rows of the fitted recordings [s]
    memory: tuple[float, ...] = ()  # autocorrelation at lags 0, 1, 2 ... rows, about zero; empty if unknown.

    def of_marker(self, name: str) -> float:
        """Root mean square error [m] of a marker, scaled so that coordinates of a row count as independent."""
        index = self.markers.index(name)
        return float(np.linalg.norm(self.scale[3 * index : 3 * index + 3]) / np.sqrt(self.share))

    def every(self, step: float) -> Autoregression:
        """The model error as noise of rows with ``step`` seconds between them."""
        memory = np.array([1.0, np.exp(-step / self.correlation_time)])
        return Autoregression(np.array(self.scale), memory, RESIDUALS, np.inf, step=step)

    def lasting(self, step: float, rows: int) -> Autoregression:
        """The same as noise of ``rows`` rows, with the part of it that lasts for all of them.

        A first-order autoregression forgets that part, and takes a few seconds of a constant error for many
        measurements of it.
        """
        constant = self.constant(step * rows)
        if constant == 0.0:
            return self.every(step)
        fast = _fast(np.exp(-step / self.correlation_time), constant)
        lags = np.arange(min(rows, MOST_LAGS))
        memory = constant + (1.0 - constant) * fast**lags
        return Autoregression(np.array(self.scale), memory, RESIDUALS, np.inf, step=step)

    def constant(self, seconds: float) -> float:
        """Share of the variance that is constant over ``seconds``, so that the mean error over this time has the
        variance seen in the fitted recordings; zero if unknown.
        """
        rows = min(round(seconds / self.step), len(self.memory)) if self.step else 0
        if rows < FEWEST_ROWS:
            return 0.0
        memory, constant = float(np.exp(-self.step / self.correlation_time)), 0.0
        seen = _mean_variance(np.array(self.memory[:rows]))
        for _ in range(CONSTANT_ROUNDS):
            chance = _mean_variance(_fast(memory, constant) ** np.arange(rows))
            constant = float(np.clip((seen - chance) / (1.0 - chance), 0.0, min(MOST_CONSTANT, memory)))
        return constant


def model_error(
    predictions: Sequence[RecordingPrediction], widened: Float[np.ndarray, " column"] | float = 1.0
) -> ModelError | None:
    """Residuals of the mean prediction in the fitted recordings; None without such recordings.

    They are modelled as a first-order autoregression, whose time constant applies to rows of any rate. White noise of
    the same size would give three seconds of a recording the weight of three hundred independent measurements, although
    the error is correlated over a second.

    Args:
        predictions: predictions of recordings, including the fitted recordings.
        widened: factor from residuals to errors per coordinate, because parameters reduce residuals.
    """
    fitted = [p for p in predictions if p.split == "fit" and p.mask.any()]
    if not fitted:
        return None
    rows = max(len(p.time) for p in fitted)
    markers = fitted[0].marker_names
    error, valid = (
        np.zeros((len(fitted), rows, 3 * len(markers))),
        np.zeros((len(fitted), rows, 3 * len(markers)), bool),
    )
    for i, p in enumerate(fitted):
        error[i, : len(p.time)] = (p.observed - p.central).reshape(len(p.time), -1)
        valid[i, : len(p.time)] = np.repeat(p.mask, 3, axis=1)
    steps = np.array([sample_time(p.time) for p in fitted])
    noise = estimate_noise(error, valid, 1.0, source=RESIDUALS, steps=steps, order=1, pooled=False, shared=None)
    across = noise.correlation
    share = 1.0 if across is None else len(across) / float(np.sum(across**2))
    step = float(noise.step or steps[0])
    memory = float(np.clip(noise.autocorrelation[1], 1e-3, 0.999))
    scale, lasts = tuple((widened * noise.scale).tolist()), float(-step / np.log(memory))
    return ModelError(tuple(markers), scale, lasts, share, step, error_memory(fitted, step))


def error_memory(predictions: Sequence[RecordingPrediction], step: float) -> tuple[float, ...]:
    """Autocorrelation of the error of mean predictions at lags 0, 1, 2 ... rows, about zero, up to half a recording.
    Recordings whose rows are not ``step`` seconds apart are ignored.
    """
    fitted = [p for p in predictions if 1.0 / ONE_RATE < sample_time(p.time) / step < ONE_RATE]
    count = min(MOST_LAGS, max(len(p.time) for p in fitted) // 2)
    products, pairs = np.zeros(count), np.zeros(count)
    for p in fitted:
        error = np.where(p.mask[..., None], p.observed - p.central, 0.0)
        for lag in range(min(count, len(p.time))):
            products[lag] += float(np.sum(error[lag:] * error[: len(error) - lag]))
            pairs[lag] += float(np.sum(p.mask[lag:] & p.mask[: len(error) - lag]))
    mean = products / np.maximum(pairs, 1.0)
    return tuple((mean / mean[0]).tolist()) if count and mean[0] > 0.0 else ()


def _fast(memory: float, constant: float) -> float:
    """Correlation of neighbouring rows in the part of an error that is not constant."""
    return max((memory - constant) / (1.0 - constant), 0.0)


def _mean_variance(memory: Float[np.ndarray, " lag"]) -> float:
    """Variance of the mean over ``len(memory)`` rows, relative to a single row."""
    rows = len(memory)
    lags = np.arange(1, rows)
    return float((1.0 + 2.0 * np.sum((1.0 - lags / rows) * memory[1:])) / rows)


def recorded_model_error(record: PosteriorRecord) -> ModelError | None:
    """Residuals of a fit, from its file or from its predictions of the fitted recordings; None if it has neither."""
    given = record.attrs.get(MODEL_ERROR)
    if given is None:
        return model_error(record.recordings)
    lists = {name: tuple(given.get(name, ())) for name in ("markers", "scale", "memory")}
    error, fitted = ModelError(**{**given, **lists}), [p for p in record.recordings if p.split == "fit"]
    if error.memory or not fitted or record.attrs.get(ADAPTED_TO):
        return error
    # A record may lack the correlation time. With several rates, one is used rather than an intermediate value.
    step = sample_time(max(fitted, key=lambda p: len(p.time)).time)
    return error._replace(step=step, memory=error_memory(fitted, step))
