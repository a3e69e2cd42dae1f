"""Do the predictive bands contain the measurements? Coverage, and the probability integral transform of every value."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats

from rfdropo_bayes.posteriors import RecordingPrediction
from rfdropo_bayes.report.residuals import autocorrelations

NOMINAL = (0.5, 0.9)


class Bands(NamedTuple):
    """Quantiles of the predicted positions [m], each (time, marker, axis)."""

    low90: Float[np.ndarray, "time marker 3"]
    low50: Float[np.ndarray, "time marker 3"]
    median: Float[np.ndarray, "time marker 3"]
    high50: Float[np.ndarray, "time marker 3"]
    high90: Float[np.ndarray, "time marker 3"]


class Coverage(NamedTuple):
    """Share of the measured coordinates inside the central bands, by nominal content; None without data."""

    over_all: dict[float, float | None]
    markers: dict[str, dict[float, float | None]]


class TransformCurve(NamedTuple):
    """Empirical distribution of the transform, and its band around the diagonal under chance."""

    grid: Float[np.ndarray, " grid"]  # probabilities
    ecdf: Float[np.ndarray, " grid"]  # share of the values at or below them
    independent: float  # number of independent values that the data are worth
    half_width: float  # half width of the 95 % simultaneous band about the diagonal (Kolmogorov)


def predictive_bands(predicted: Float[np.ndarray, "draw time marker 3"]) -> Bands:
    """Central 50 % and 90 % bands of predictive draws."""
    return Bands(*np.quantile(predicted, [0.05, 0.25, 0.5, 0.75, 0.95], axis=0, method="weibull"))


def coverage(recordings: Sequence[RecordingPrediction], *, nominal: Sequence[float] = NOMINAL) -> Coverage:
    """Observed against nominal coverage over all usable coordinates of all rows; recordings may have other markers."""
    transformed = [probability_transform(recording) for recording in recordings]
    parts: dict[str, list[np.ndarray]] = {}
    for recording, values in zip(recordings, transformed, strict=True):
        for index, name in enumerate(recording.marker_names):
            parts.setdefault(name, []).append(values[:, index].reshape(-1))
    by_marker = {name: _shares(np.concatenate(own), nominal) for name, own in parts.items()}
    everything = np.concatenate([t.reshape(-1) for t in transformed]) if transformed else np.zeros(0)
    return Coverage(_shares(everything, nominal), by_marker)


def _shares(transformed: Float[np.ndarray, " n"], nominal: Sequence[float]) -> dict[float, float | None]:
    values = transformed[np.isfinite(transformed)]
    return {p: float(np.mean(np.abs(values - 0.5) <= p / 2)) if len(values) else None for p in nominal}


def probability_transform(recording: RecordingPrediction) -> Float[np.ndarray, "time marker 3"]:
    """Share of predictive draws below the measurement, uniform on (0, 1) if predictions are honest; NaN if masked.

    With n draws and r of them below, (r + 1/2) / (n + 1): unbiased, and never 0 or 1.
    """
    below = np.sum(recording.predicted < recording.observed, axis=0)
    value = (below + 0.5) / (len(recording.predicted) + 1.0)
    return np.where(recording.mask[..., None], value, np.nan)


def transform_curve(recordings: Sequence[RecordingPrediction]) -> TransformCurve | None:
    """PIT-ECDF of all usable coordinates.

    Errors of neighbouring rows are correlated, so that thousands of rows may equal few independent rows. The effective
    number is estimated for each series (one marker, one axis) from the autocorrelation of the normal scores up to its
    first sign change.
    """
    series = [s for r in recordings for s in np.moveaxis(probability_transform(r), 0, -1).reshape(-1, len(r.time))]
    values = np.concatenate([s[np.isfinite(s)] for s in series]) if series else np.zeros(0)
    if len(values) == 0:
        return None
    draws = min(len(r.predicted) for r in recordings)
    grid = np.arange(draws + 2) / (draws + 1.0)  # between the values that the transform can take
    ecdf = np.searchsorted(np.sort(values), grid, side="right") / len(values)
    independent = sum(_independent_values(s[np.isfinite(s)]) for s in series)
    # Coordinates of one row err together too: a trunk has few ways to bend. One marker's worth is the honest count.
    independent /= max(1, round(len(series) / (3 * len(recordings))))
    return TransformCurve(grid, ecdf, independent, float(stats.kstwobign.ppf(0.95) / np.sqrt(max(independent, 1.0))))


def _independent_values(transformed: Float[np.ndarray, " n"]) -> float:
    """Correct scores have mean zero, so autocorrelations are taken about zero: a constant error then counts as one
    value.
    """
    n = len(transformed)
    if n < 3:
        return float(n)
    correlation = autocorrelations([stats.norm.ppf(transformed)])
    negative = np.flatnonzero(correlation <= 0)
    until = int(negative[0]) if len(negative) else len(correlation)
    return n / (1.0 + 2.0 * float(correlation[:until].sum()))
