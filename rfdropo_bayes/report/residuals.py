"""Do the residuals of a fit match its noise model: independent from row to row, without far outliers?

Intervals are as wide as the noise model makes them. If whitened residuals are still correlated, a row carries less
information than the model assumes: intervals are too narrow by ``sqrt(1 + 2 sum of the autocorrelations)``, the factor
for the mean of a stationary series. For a first-order process of correlation 0.2 it is 1.2.
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
