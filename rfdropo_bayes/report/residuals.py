"""Do the residuals of a fit match its noise model: independent from row to row, without far outliers?

Intervals are as wide as the noise model makes them. If whitened residuals are still correlated, a row carries less
information than the model assumes: intervals are too narrow by ``sqrt(1 + 2 sum of the autocorrelations)``, the factor
for the mean of a stationary series. For a first-order process of correlation 0.2 it is 1.2.

Do the predictive bands contain the measurements? Coverage, and the probability integral transform of every value.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats
from scipy.signal import correlate

from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.posteriors import RecordingPrediction

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


TOO_NARROW = 1.2  # a fifth: as much as a correlation of 0.2 from row to row
FAR = 4.0  # deviations; normal noise is farther off in 1 of 16,000 values
MORE_THAN_CHANCE = 1e-3  # for a given number of lags; that it is chosen makes it up to 1 % (15 to 600 rows)
REMEDIES = {
    "white": 'use noise = "auto", which finds how long the noise lasts',
    "student-t": 'use noise = "auto", which finds how long the noise lasts',
}
NO_REMEDY = "rfdropo audit can find the effect that the simulator lacks"


class ResidualCheck(NamedTuple):
    """Statistics of the whitened residuals of one marker, or of all."""

    correlation: float  # between whitened residuals of successive rows
    narrowing: float  # factor by which intervals are too narrow
    correlated: bool  # whether ``narrowing`` exceeds chance and `TOO_NARROW`
    far: float  # share of the whitened residuals beyond `FAR` deviations
    heavy: bool  # whether ``far`` exceeds chance
    values: int  # number of residuals


def check_residuals(
    white: Sequence[Float[np.ndarray, "time marker 3"]], markers: Sequence[str], *, counted: bool = False
) -> dict[str, ResidualCheck]:
    """Check of each marker, and of all under the key ``all``.

    Args:
        white: whitened residuals of each recording, NaN if masked.
        markers: names of the markers.
        counted: whether the fit down-weighted rows by the residual correlation time; intervals are then wide enough.
    """
    own = {name: check([part[:, index] for part in white], counted) for index, name in enumerate(markers)}
    return {**own, "all": check([part.reshape(len(part), -1) for part in white], counted)}


def check(white: Sequence[Float[np.ndarray, "time series"]], counted: bool = False) -> ResidualCheck:
    """Check of series that may have gaps (NaN); a lag counts measured rows."""
    series = [column[np.isfinite(column)] for part in white for column in part.T]
    series = [column for column in series if len(column) > 1]
    values = np.concatenate(series) if series else np.zeros(0)
    if not np.any(values):
        return ResidualCheck(0.0, 1.0, False, 0.0, False, len(values))
    correlation = autocorrelations(series)
    ends = np.flatnonzero(correlation <= 0.0)
    lags = int(ends[0]) if len(ends) else len(correlation)
    total = float(correlation[:lags].sum())
    narrowing = 1.0 if counted else float(np.sqrt(1.0 + 2.0 * total))
    chance = stats.norm.isf(MORE_THAN_CHANCE) * np.sqrt(max(lags, 1) / len(values))
    outliers = int(np.sum(np.abs(values) > FAR))
    expected = 2.0 * stats.norm.sf(FAR) * len(values)
    heavy = outliers > 1 and stats.poisson.sf(outliers - 1, expected) < MORE_THAN_CHANCE
    return ResidualCheck(
        float(correlation[0]),
        narrowing,
        bool(narrowing > TOO_NARROW and total > chance),
        outliers / len(values),
        bool(heavy),
        len(values),
    )


def autocorrelations(series: Sequence[Float[np.ndarray, " time"]]) -> Float[np.ndarray, " lag"]:
    """Autocorrelation about zero at the lags 1, 2, ... up to half of the longest series, pooled over series."""
    most = max(1, max(len(column) for column in series) // 2)
    total = np.zeros(most + 1)
    for column in series:
        products = correlate(column, column, method="fft")[len(column) - 1 :][: most + 1]
        total[: len(products)] += products
    return total[1:] / total[0]


def residual_cautions(checks: Mapping[str, ResidualCheck], noise: str) -> list[Caution]:
    """Cautions on residuals that are correlated beyond the noise model, and on outliers.

    Args:
        checks: result of `check_residuals`.
        noise: name of the noise model.
    """
    cautions = []
    correlated = _names(checks, "correlated")
    if correlated:
        worst = max(check.narrowing for check in checks.values() if check.correlated)
        sentence = (
            f"residuals are correlated beyond the noise model {noise!r} ({correlated}): intervals are too narrow, by "
            f"up to {worst:.2g} times; {REMEDIES.get(noise, NO_REMEDY)}"
        )
        cautions.append(Caution(Code.RESIDUALS_CORRELATED, sentence))
    if noise != "student-t" and (heavy := _names(checks, "heavy")):
        share = max(check.far for check in checks.values() if check.heavy)
        sentence = (
            f"up to {share:.1%} of the residuals are more than {FAR:g} deviations off ({heavy}) and inflate the noise: "
            'mask recording faults, or use noise = "student-t"'
        )
        cautions.append(Caution(Code.RESIDUALS_HEAVY, sentence))
    return cautions


def _names(checks: Mapping[str, ResidualCheck], flag: str) -> str:
    own = [name for name, marker_check in checks.items() if name != "all" and getattr(marker_check, flag)]
    return ", ".join(own) or ("all markers together" if getattr(checks.get("all"), flag, False) else "")


def error_correlations(recordings: Sequence[RecordingPrediction], split: str) -> dict[str, float]:
    """Lag-one correlation of each marker's prediction error, about zero mean."""
    chosen = [r for r in recordings if r.split == split]
    correlations = {}
    for index, name in enumerate(chosen[0].marker_names if chosen else ()):
        parts = [np.where(r.mask[:, index, None], (r.observed - r.central)[:, index], np.nan) for r in chosen]
        correlations[name] = check(parts).correlation
    return correlations


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
