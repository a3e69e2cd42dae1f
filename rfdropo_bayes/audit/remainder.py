"""What no candidate explains of the positions, as a Gaussian process in time on every coordinate: how large, how slow,
where."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.audit.measurements import Measurements
from rfdropo_bayes.bayes.noise.autoregression import Autoregression

MOST_ROWS = 300
SMALLEST, LARGEST, AMPLITUDES = 0.02, 50.0, 28  # of the amplitudes that are tried, in deviations of the noise
LENGTHS = (1.5, 3.0, 6.0, 12.0, 25.0, 50.0, 100.0)  # in rows


class Remainder(NamedTuple):
    """Posterior of a Matern-3/2 process plus the measurement's noise, hyperparameters at their likelihood's maximum.

    Attributes:
        amplitude: standard deviation of the process [m]; 0 where noise alone is likelier.
        memory: its length scale [s].
        time: rows it is given at [s].
        mean, sd: of the process [m]; of every group, row and channel.
        log_likelihood_ratio: of the process with against without it.
    """

    amplitude: float
    memory: float
    time: Float[np.ndarray, " row"]
    mean: Float[np.ndarray, "group row channel"]
    sd: Float[np.ndarray, "group row channel"]
    log_likelihood_ratio: float


def describe_remainder(measurements: Measurements, white: Float[np.ndarray, " n"], noise: Autoregression) -> Remainder:
    """Fit the process to the whitened residuals of a model.

    The whitening is a linear map, so that the process is fitted to the residual itself under correlated noise: its
    covariance is whitened, too. Each coordinate is taken for itself.
    """
    own = slice(0, measurements.markers)
    shape = measurements.count.shape
    rows = np.arange(shape[1])[: min(shape[1], MOST_ROWS)]
    columns = noise.gather(measurements.series(white)[..., own], measurements.valid[..., own])
    data = columns[:, rows] * noise.scale / np.mean(noise.scale)
    weight = np.sqrt(np.maximum(measurements.count[:, rows, own].max(axis=(1, 2)), 1.0))
    every = np.ones((len(rows), 1), dtype=bool)
    unit = Autoregression(np.ones(1), noise.autocorrelation, noise.source, noise.freedom)
    whitener = unit.whiten(np.eye(len(rows))[:, :, None], np.broadcast_to(every, (len(rows), len(rows), 1)))[..., 0].T
    most = max(LARGEST, 3.0 * float(np.sqrt(np.mean(data**2))))  # a stated noise may be a thousandth of what is left
    amplitudes = np.concatenate([[0.0], np.geomspace(SMALLEST, most, AMPLITUDES)])
    best = (0.0, 0.0, LENGTHS[0])
    for length in LENGTHS:
        values, vectors = np.linalg.eigh(whitener @ _matern(rows, length) @ whitener.T)
        power = np.einsum("rk,grc->gkc", vectors, data) ** 2
        for amplitude in amplitudes:
            spread = 1.0 + (amplitude * weight[:, None]) ** 2 * np.maximum(values, 0.0)
            gain = -0.5 * np.sum(power / spread[:, :, None] - power) - 0.5 * data.shape[2] * np.sum(np.log(spread))
            if gain > best[0] + 1e-9:
                best = (float(gain), float(amplitude), float(length))
    gain, amplitude, length = best
    mean, sd = _posterior(data, whitener, _matern(rows, length), amplitude, weight)
    size = float(np.mean(noise.scale))
    clock = measurements.time[0]
    step = float(np.median(np.diff(clock)))
    return Remainder(amplitude * size, length * step, clock[rows], size * mean, size * sd, gain)


def _matern(rows: np.ndarray, length: float) -> np.ndarray:
    distance = np.sqrt(3.0) * np.abs(rows[:, None] - rows[None]) / length
    return (1.0 + distance) * np.exp(-distance)


def _posterior(
    data: np.ndarray, whitener: np.ndarray, kernel: np.ndarray, amplitude: float, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    means, deviations = [], []
    for series, scale in zip(data, weight, strict=True):
        across = amplitude**2 * scale * kernel @ whitener.T
        total = scale * whitener @ across + np.eye(len(kernel))
        gain = np.linalg.solve(total, across.T).T
        means.append(gain @ series)
        left = amplitude**2 - np.einsum("ij,ij->i", gain, across)
        deviations.append(np.sqrt(np.maximum(left, 0.0))[:, None] * np.ones(series.shape[1]))
    return np.stack(means), np.stack(deviations)
