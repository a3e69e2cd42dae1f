"""Gain of an extension on trajectories that no fit has seen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.fft import dct
from scipy.linalg import toeplitz
from scipy.special import logsumexp
from scipy.stats import norm, t

from rfdropo_bayes.bayes.noise.autoregression import STATED, Autoregression
from rfdropo_bayes.bayes.noise.stacked import Stacked

DIFFERENCE_FROM = 6  # trajectories below which an ELPD difference has no standard error worth stating
SPREAD_FROM = 3  # trajectories at or above which their spread is part of the explained fraction's interval
CHANCE = 0.05  # probability that unseen trajectories seem to support an extension that is worth nothing
# Nats by which densities of a few trajectories must differ to say anything: were the less likely model right, so large
# a difference would come up in at most `CHANCE` of cases (Markov's inequality: the mean of the ratio is one).
TELLING = -float(np.log(CHANCE))
FLIPS = 4095  # draws of the signs of more differences than can all be gone through
RESAMPLES = 2000
BANDS = 12
SURE = 3.0  # standard errors by which a discrepancy must exceed the noise to be taken for one
LEVELS = (0.5, 0.9)


class UnseenErrors(NamedTuple):
    """Residuals of unseen trajectories under draws of one model: measured less simulated, in the unit of the noise."""

    errors: Float[np.ndarray, "draw trajectory time column"]

    @property
    def mean(self) -> Float[np.ndarray, "trajectory time column"]:
        """Mean over the draws."""
        return self.errors.mean(axis=0)


class Unseen(NamedTuple):
    """Measured trajectories that no fit has seen.

    Attributes:
        position: coordinates of the markers [m], the first columns.
        valid: mask of usable values, in all columns.
        names: names of the trajectories.
        steps: time between their rows [s]; equal rates by default.
    """

    position: Float[np.ndarray, "trajectory time coordinate"]
    valid: Bool[np.ndarray, "trajectory time column"]
    names: tuple[str, ...]
    steps: Float[np.ndarray, " trajectory"] | None = None

    @property
    def markers(self) -> int:
        """Number of columns that are coordinates of markers."""
        return self.position.shape[-1]

    def under(self, noise: Stacked) -> Stacked:
        """A noise in the rows of these trajectories."""
        return noise if self.steps is None else noise.at(self.steps)

    def predicted(self, prediction: UnseenErrors) -> Float[np.ndarray, "trajectory time coordinate"]:
        """Marker positions of a model, averaged over its draws [m]."""
        return self.position - prediction.mean[..., : self.markers]


class Difference(NamedTuple):
    """Base model against extended model, on one unseen trajectory.

    Attributes:
        rmse_base, rmse_extended: root mean square distance of a marker [m].
        elpd: log predictive density of the extended model less the base model's.
    """

    rmse_base: float
    rmse_extended: float
    elpd: float


@dataclass(frozen=True)
class Gain:
    """Base model against extended model, on unseen trajectories.

    Attributes:
        rmse_base, rmse_extended: root mean square distance of a marker [m].
        elpd_difference: log predictive density of the extended model minus the base model's, summed over trajectories.
        From `DIFFERENCE_FROM` trajectories on also its standard error, and the probability of a sum this large under
        random signs.
        coverage: share of measurements in the extended model's central intervals.
        explained: share of the base model's discrepancy that the extension takes away; interval: its 90 % interval,
            for recordings like these.
        floor: the noise's root mean square distance of a marker [m].
        differences: the same for each trajectory, by name.
    """

    rmse_base: float
    rmse_extended: float
    elpd_difference: float
    elpd_difference_se: float | None
    elpd_p: float | None
    coverage: dict[float, float]
    explained: float
    interval: tuple[float, float]
    floor: float
    differences: dict[str, Difference]

    @property
    def trajectories(self) -> int:
        """Number of trajectories."""
        return len(self.differences)

    @property
    def by_trajectory(self) -> dict[str, dict[str, float]]:
        """Errors [mm] and log density of each trajectory, as plain values."""
        return {
            name: {
                "rmse_base_mm": 1e3 * each.rmse_base,
                "rmse_extended_mm": 1e3 * each.rmse_extended,
                "elpd_difference": each.elpd,
            }
            for name, each in self.differences.items()
        }

    @property
    def share(self) -> str:
        """The explained share with its interval, in percent from 0 to 100, beyond which noise alone moves estimates."""
        value, low, high = (100.0 * min(max(x, 0.0), 1.0) for x in (self.explained, *self.interval))
        return f"{value:.0f} % [{low:.0f}, {high:.0f}]"

    @property
    def worse(self) -> bool:
        """Whether unseen trajectories are predicted worse: their error grows, or the discrepancy surely does."""
        return self.rmse_extended > self.rmse_base or self.interval[1] < 0.0

    @property
    def opposed(self) -> bool:
        """Whether one of a few trajectories speaks clearly against the extension, though all together favour it."""
        return self.elpd_p is None and self.elpd_difference > 0.0 and bool(self.against)

    @property
    def against(self) -> dict[str, Difference]:
        """Trajectories that are clearly less likely with the extension: were it right, there would be any in at most
        `CHANCE` of cases, however many they are (Bonferroni)."""
        least = TELLING + np.log(max(self.trajectories, 1))
        return {name: each for name, each in self.differences.items() if each.elpd <= -least}

    @property
    def clear(self) -> bool:
        """Whether unseen trajectories clearly support the extension: it surely takes a part of the discrepancy away,
        their error does not grow, and they are clearly likelier: few by `TELLING`, and none clearly less likely."""
        if self.elpd_p is None:
            likelier = self.elpd_difference >= TELLING and not self.opposed
        else:
            likelier = self.elpd_difference > 0.0 and self.elpd_p <= CHANCE
        return self.interval[0] > 0.0 and likelier and not self.worse


def measure_gain(
    unseen: Unseen,
    base: UnseenErrors,
    extended: UnseenErrors,
    noise: Stacked,
    pattern: Float[np.ndarray, "group time column"],
    rng: np.random.Generator,
    *,
    noise_of_fit: Stacked | None = None,
    deviation: Float[np.ndarray, " column"] | None = None,
) -> Gain:
    """Compare two models.

    Args:
        unseen: measurements.
        base, extended: predictions.
        noise: noise of the measurements.
        pattern: whitened residuals of the base model on its fitted data: the discrepancy's distribution over
            frequencies and columns.
        rng: random generator of the interval.
        noise_of_fit: noise model for the fit and the densities of the base model; the measurements' noise by default.
        spread: deviation of the extended model's errors, for its bands; the noise's by default.
    """
    first, second = (np.where(unseen.valid, p.mean, 0.0) for p in (base, extended))
    seen = unseen.valid[..., : unseen.markers].sum(axis=(1, 2))
    markers = np.maximum(seen / 3.0, 1.0)
    squares = (np.sum(errors[..., : unseen.markers] ** 2, axis=(1, 2)) for errors in (first, second))
    distances = np.array([np.sqrt(square / markers) for square in squares])  # of a marker, root mean square
    densities = []  # log predictive densities of each trajectory, up to the noise's normaliser
    for prediction in (base, extended):
        residual = np.where(unseen.valid, prediction.errors, 0.0)
        white = unseen.under(noise_of_fit or noise).whiten(residual, unseen.valid)
        densities.append(logsumexp(-0.5 * np.sum(white**2, axis=(-2, -1)), axis=0) - np.log(len(residual)))
    difference = densities[1] - densities[0]
    count = len(difference)
    explained, interval = explained_fraction(unseen, first, second, noise, pattern, rng)
    whole = np.sqrt(extended.errors.var(axis=0) + (noise.scale if deviation is None else deviation) ** 2)
    z = (np.abs(extended.mean) / whole)[unseen.valid]
    rmse = np.sqrt(distances**2 @ seen / max(seen.sum(), 1))
    each = (Difference(*map(float, row)) for row in zip(*distances, difference, strict=True))
    return Gain(
        rmse_base=float(rmse[0]),
        rmse_extended=float(rmse[1]),
        elpd_difference=float(difference.sum()),
        elpd_difference_se=float(np.sqrt(count) * difference.std(ddof=1)) if count >= DIFFERENCE_FROM else None,
        elpd_p=sign_flip_p(difference, rng) if count >= DIFFERENCE_FROM else None,
        coverage={level: float(np.mean(z < norm.ppf(0.5 + level / 2))) for level in LEVELS},
        explained=explained,
        interval=interval,
        floor=noise_distance(noise.first),
        differences=dict(zip(unseen.names, each, strict=True)),
    )


def sign_flip_p(difference: Float[np.ndarray, " n"], rng: np.random.Generator) -> float:
    """Probability of a sum as large as these differences' if each sign were random.

    Fisher's randomisation test (1935, The Design of Experiments, section 21), exact for differences symmetric about
    zero. A standard error does not decide: if one recording shows an effect ten times as well as the others, the
    differences spread by more than their mean although all favour the same model.
    """
    count = len(difference)
    if 2**count <= FLIPS + 1:
        flips = 1.0 - 2.0 * (np.arange(2**count)[:, None] >> np.arange(count) & 1)
    else:
        flips = np.concatenate([np.ones((1, count)), rng.choice([-1.0, 1.0], (FLIPS, count))])
    total = float(difference.sum())
    return float(np.mean(flips @ difference >= total - 1e-9 * np.abs(difference).sum()))


def noise_distance(noise: Autoregression) -> float:
    """Root mean square distance of a marker that the noise of the positions alone makes [m]."""
    return float(np.sqrt(3.0 * np.mean(noise.scale**2)))


def explained_fraction(
    unseen: Unseen,
    base: Float[np.ndarray, "trajectory time column"],
    extended: Float[np.ndarray, "trajectory time column"],
    noise: Stacked,
    pattern: Float[np.ndarray, "group time column"],
    rng: np.random.Generator,
) -> tuple[float, tuple[float, float]]:
    """``1 - (ext^2 - noise^2) / (base^2 - noise^2)`` with its 90 % interval, of all channels together.

    The mean squares are taken frequency by frequency and pattern by pattern (cosine transform in time, principal
    components over the columns of a channel), each weighted by the squared share of discrepancy in the base model's
    residuals on the FITTED data (a Wiener filter of both factors): bands of pure noise are not counted, and noisy bands
    count little.

    The interval includes the common noise in both mean squares, the uncertainty of its power at these frequencies and,
    from `SPREAD_FROM` trajectories up, the variation of the fraction between trajectories (`_deviation_between`).
    """
    count = len(unseen.valid)
    sums, floors, drawn, expected = np.zeros((2, count)), np.zeros(count), np.zeros((RESAMPLES, 2)), np.zeros(RESAMPLES)
    for part, own in zip(unseen.under(noise).parts, noise.columns, strict=True):
        valid = unseen.valid[..., own]
        flat = pattern[..., own].reshape(-1, valid.shape[-1])
        axes = np.linalg.eigh(flat.T @ flat)[1]
        spectrum = _noise_power(part, base.shape[1])
        weight = _wiener(pattern[..., own] @ axes, base.shape[1]) ** 2 * spectrum[:, None]
        usable = np.maximum(valid.mean(axis=(1, 2)), 1e-9)
        first, second = (
            dct(part.whiten(left[..., own], valid) @ axes, axis=1, norm="ortho") for left in (base, extended)
        )
        sums += np.sum(weight * np.stack([first, second]) ** 2, axis=(2, 3))
        drawn += rng.standard_normal((RESAMPLES, 2)) @ _noise_in_sums(weight, first, second, float(usable.sum())).T
        least = usable * float(np.sum(weight))
        error = _floor_error(part, weight.sum(axis=1) / spectrum)
        expected += least.sum() * (1.0 + rng.standard_normal(RESAMPLES) * error)
        floors += least
    total, floor = sums.sum(axis=1), floors.sum()
    point = float(_fraction(total[0], total[1], floor, floor))
    fractions = _fraction(total[0] + drawn[:, 0], total[1] + drawn[:, 1], expected, floor)
    low, high = (float(np.quantile(fractions, level)) for level in (0.05, 0.95))
    apart = _deviation_between(sums, floors)
    return point, (min(low, point - apart), max(high, min(point + apart, 1.0)))


def _deviation_between(sums: Float[np.ndarray, "2 trajectory"], floors: Float[np.ndarray, " trajectory"]) -> float:
    """Half the 90 % interval of the fraction of all recordings like these: 0 for fewer than `SPREAD_FROM`.

    Student's t about the jackknife's standard error (Miller 1974, Biometrika 61:1-15): each trajectory is left out in
    turn. A bootstrap of three trajectories has 60 % coverage, and fractions of single trajectories are ill-defined if
    one has hardly any discrepancy.
    """
    count = len(floors)
    if count < SPREAD_FROM:
        return 0.0
    others, rest = sums.sum(axis=1, keepdims=True) - sums, floors.sum() - floors
    without = _fraction(others[0], others[1], rest, rest)
    error = np.sqrt((count - 1) / count * np.sum((without - without.mean()) ** 2))
    return float(t.ppf(0.95, count - 1) * error)


def _noise_in_sums(
    weight: Float[np.ndarray, "row component"], first: np.ndarray, second: np.ndarray, usable: float
) -> Float[np.ndarray, "2 2"]:
    """Square root of the covariance of the weighted sums of squares of two series that hold the same unit noise.

    The covariance of (d + z)^2 and (e + z)^2 is 2 + 4 d e, whose second part is estimated by 4 (d + z) (e + z) - 4.
    """
    square = weight**2
    least = 2.0 * usable * float(np.sum(square))
    products = [[float(np.sum(square * a * b)) for b in (first, second)] for a in (first, second)]
    covariance = 4.0 * np.array(products) - least
    values, vectors = np.linalg.eigh(covariance + np.diag(np.maximum(least - np.diag(covariance), 0.0)))
    return vectors * np.sqrt(np.maximum(values, 0.0))


def _fraction(
    base: np.ndarray, extended: np.ndarray, expected: np.ndarray | float, floor: np.ndarray | float
) -> np.ndarray:
    remaining = np.maximum(extended - expected, 0.0)
    # Less than the noise's own uncertainty is no discrepancy to be explained.
    return 1.0 - remaining / np.maximum(base - expected, 1e-3 * floor)


def _floor_error(noise: Autoregression, weight: Float[np.ndarray, " row"]) -> float:
    """Relative standard error of the noise's power, summed over frequencies with weights.

    Innovation variance and coefficients of an estimated autoregression are independent; their variances are 2 / n and
    (innovation variance) (covariance)^-1 / n (Brockwell and Davis 1991, section 8.8).
    """
    if noise.source == STATED or not np.isfinite(noise.freedom):
        return 0.0
    coefficients, deviation = noise.predictors
    own = coefficients[-1][: noise.order]

    def power(step: np.ndarray) -> float:
        return float(weight @ _spectrum(own + step, deviation[-1], len(weight)))

    relative = 2.0
    if noise.order:
        steps = 1e-4 * np.eye(noise.order)
        slope = np.array([(power(step) - power(-step)) / 2e-4 / power(0.0 * step) for step in steps])
        correlation = toeplitz(noise.autocorrelation[: noise.order])
        relative += deviation[-1] ** 2 * slope @ np.linalg.solve(correlation, slope)
    return float(np.sqrt(relative / noise.freedom))


def _noise_power(noise: Autoregression, rows: int) -> Float[np.ndarray, " row"]:
    """Power of the noise at the frequencies of the cosine transform, in units of its variance."""
    coefficients, deviation = noise.predictors
    return _spectrum(coefficients[-1][: noise.order], deviation[-1], rows)


def _spectrum(coefficients: Float[np.ndarray, " lag"], deviation: float, rows: int) -> Float[np.ndarray, " row"]:
    angle = np.pi * np.arange(rows) / rows
    transfer = 1.0 - np.exp(-1j * np.outer(angle, np.arange(1, len(coefficients) + 1))) @ coefficients
    return deviation**2 / np.abs(transfer) ** 2


def _wiener(pattern: Float[np.ndarray, "group time component"], rows: int) -> Float[np.ndarray, "row component"]:
    """Share of discrepancy in each band of frequencies and component, from residuals of unit noise; zero if their power
    is within three standard errors of the noise's.
    """
    power = np.mean(dct(pattern, axis=1, norm="ortho") ** 2, axis=0)
    place = np.arange(len(power)) / len(power)
    edges = np.concatenate([[0.0], np.geomspace(1.5 / len(power), 1.0, BANDS)])
    band = np.clip(np.searchsorted(edges, place, side="right") - 1, 0, BANDS - 1)
    mean, error = np.ones_like(power), np.ones_like(power)
    for index in range(BANDS):
        own = band == index
        if own.any():
            mean[own], error[own] = power[own].mean(axis=0), np.sqrt(2.0 / (len(pattern) * own.sum()))
    surprise = (mean - 1.0) / error
    # If nothing is significant, the most significant bands are used.
    excess = np.where(surprise >= min(SURE, surprise.max()), np.maximum(mean - 1.0, 0.0), 0.0)
    share = excess / (excess + 1.0) if excess.any() else np.ones_like(excess)
    at = np.minimum((np.arange(rows) / rows * len(power)).astype(int), len(power) - 1)
    return share[at]
