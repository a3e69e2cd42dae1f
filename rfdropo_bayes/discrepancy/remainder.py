"""Unexplained residual of the positions, as a Gaussian process in time on every coordinate: size, time scale and
place.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from rfdropo_bayes.bayes.noise.autoregression import Autoregression
from rfdropo_bayes.discrepancy.measurements import Measurements

MOST_ROWS = 300
SMALLEST, LARGEST, AMPLITUDES = 0.02, 50.0, 28  # of the amplitudes that are tried, in deviations of the noise
LENGTHS = (1.5, 3.0, 6.0, 12.0, 25.0, 50.0, 100.0)  # in rows


class Remainder(NamedTuple):
    """Posterior of a Matern-3/2 process plus the measurement's noise, hyperparameters at their likelihood's maximum.

    Attributes:
        amplitude: standard deviation of the process [m]; 0 if noise alone is likelier.
        memory: its length scale [s].
        time: times of its rows [s].
        mean, sd: mean and deviation of the process [m], for every group, row and channel.
        log_likelihood_ratio: log likelihood ratio with and without the process.
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
    covariance is also whitened. Coordinates are fitted separately. Unmeasured rows of a recording, and rows after its
    end, are ignored.
    """
    own = slice(0, measurements.markers)
    shape = measurements.count.shape
    rows = np.arange(shape[1])[: min(shape[1], MOST_ROWS)]
    columns = noise.gather(measurements.series(white)[..., own], measurements.valid[..., own])
    data = columns[:, rows] * noise.scale / np.mean(noise.scale)
    weight = np.sqrt(np.maximum(measurements.count[:, rows, own].max(axis=(1, 2)), 1.0))
    unit = Autoregression(np.ones(1), noise.autocorrelation, noise.source, noise.freedom)
    parts = _parts(np.asarray(measurements.valid[:, rows, own].any(axis=2)), unit)
    seen = np.concatenate([data[part.groups][:, part.seen].reshape(-1) for part in parts])
    most = max(LARGEST, 3.0 * float(np.sqrt(np.mean(seen**2))))  # a stated noise may be a thousandth of the residuals
    amplitudes = np.concatenate([[0.0], np.geomspace(SMALLEST, most, AMPLITUDES)])
    best = (0.0, 0.0, LENGTHS[0])
    for length in LENGTHS:
        gains = np.sum([_gains(part, data, rows, length, amplitudes, weight) for part in parts], axis=0)
        place = int(np.argmax(gains))
        if gains[place] > best[0] + 1e-9:
            best = (float(gains[place]), float(amplitudes[place]), float(length))
    gain, amplitude, length = best
    mean, sd = np.zeros_like(data), np.zeros_like(data)
    for part in parts:
        mean[part.groups], sd[part.groups] = _posterior(
            data[part.groups][:, part.seen], part, _matern(rows, length), amplitude, weight[part.groups]
        )
    size = float(np.mean(noise.scale))
    clock = measurements.time[0]
    step = float(np.median(np.diff(clock)))
    return Remainder(amplitude * size, length * step, clock[rows], size * mean, size * sd, gain)


def _matern(rows: np.ndarray, length: float) -> np.ndarray:
    distance = np.sqrt(3.0) * np.abs(rows[:, None] - rows[None]) / length
    return (1.0 + distance) * np.exp(-distance)


class _Part(NamedTuple):
    """Recordings that were measured in the same rows.

    Attributes:
        groups: indices of the groups.
        seen: rows in which anything was measured.
        whitener: matrix that whitens the noise of these rows.
    """

    groups: Int[np.ndarray, " group"]
    seen: Bool[np.ndarray, " row"]
    whitener: Float[np.ndarray, "seen seen"]


def _parts(seen: Bool[np.ndarray, "group row"], unit: Autoregression) -> list[_Part]:
    parts = []
    patterns, place = np.unique(seen, axis=0, return_inverse=True)
    for number, pattern in enumerate(patterns):
        if pattern.any():
            count = len(pattern)
            valid = np.broadcast_to(pattern[:, None], (count, count, 1))
            white = unit.whiten(np.eye(count)[:, :, None], valid)[..., 0].T
            parts.append(_Part(np.flatnonzero(place.reshape(-1) == number), pattern, white[pattern][:, pattern]))
    return parts


def _gains(
    part: _Part, data: np.ndarray, rows: np.ndarray, length: float, amplitudes: np.ndarray, weight: np.ndarray
) -> Float[np.ndarray, " amplitude"]:
    """Log likelihood ratios of a process of each amplitude against none, in the recordings of a part."""
    own, white = data[part.groups][:, part.seen], part.whitener
    values, vectors = np.linalg.eigh(white @ _matern(rows[part.seen], length) @ white.T)
    power = np.einsum("rk,grc->gkc", vectors, own) ** 2
    gains = []
    for amplitude in amplitudes:
        variance = 1.0 + (amplitude * weight[part.groups][:, None]) ** 2 * np.maximum(values, 0.0)
        gain = -0.5 * np.sum(power / variance[:, :, None] - power) - 0.5 * data.shape[2] * np.sum(np.log(variance))
        gains.append(float(gain))
    return np.array(gains)


def _posterior(
    data: np.ndarray, part: _Part, kernel: np.ndarray, amplitude: float, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and deviation of the process in all rows, given the data of measured rows."""
    means, deviations, whitener = [], [], part.whitener
    for series, scale in zip(data, weight, strict=True):
        across = amplitude**2 * scale * kernel[:, part.seen] @ whitener.T
        total = scale * whitener @ across[part.seen] + np.eye(len(whitener))
        gain = np.linalg.solve(total, across.T).T
        means.append(gain @ series)
        variance = amplitude**2 - np.einsum("ij,ij->i", gain, across)
        deviations.append(np.sqrt(np.maximum(variance, 0.0))[:, None] * np.ones(series.shape[1]))
    return np.stack(means), np.stack(deviations)
