"""Which combinations of parameters the data determine, from the posterior covariance of their logarithms.

The covariance of log parameters is, for a posterior that the data dominate, the inverse of their Fisher information. An
eigenvector of it is a product of powers of parameters; a small eigenvalue means that the data determine this product,
an eigenvalue as large as under the prior means that they do not inform it. Weakly correlated parameters are separated
first, so that each product combines correlated parameters only. A parameter that may be zero or negative has no
logarithm: it enters linearly, in its own unit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.posteriors import ParameterInfo, PosteriorRecord
from rfdropo_bayes.report.units import display_unit

TOGETHER = 0.6  # correlation at or above which parameters are described jointly
DETERMINED, FREE = 0.5, 0.8  # contraction against the prior
RIDGE = 5.0  # standard deviation along a ridge over the next largest one
NEGLIGIBLE = 0.2  # exponents below this are left out of the words
WELL_AWAY = 0.4  # prior standard deviation over prior mean
_HOW = {
    "determined": "is determined to",
    "partly": "is partly determined, to",
    "free": "is left free by the data:",
    "unknown": "has a spread of",
}
TIMES = " \u00d7 "


@dataclass(frozen=True)
class Combination:
    """A product of powers of parameters and its uncertainty."""

    powers: dict[str, float]  # exponent of each parameter that takes part; the largest is 1 in absolute value
    unit: str  # "log" if ``sd`` refers to a logarithm, else the unit of the single parameter
    sd: float  # posterior standard deviation of the logarithm of the product, or of the parameter
    prior_sd: float | None  # the same under the prior; None without prior draws
    verdict: str  # "determined", "partly" or "free"; "unknown" without prior draws
    sentence: str  # the same in words

    @property
    def contraction(self) -> float | None:
        """Posterior over prior standard deviation."""
        return self.sd / self.prior_sd if self.prior_sd else None


def identify(record: PosteriorRecord) -> list[Combination]:
    """Combinations of the parameters shared by all recordings, best determined first."""
    chosen = [info for info in record.free if not info.scope.owner]
    varying = [info for info in chosen if np.ptp(record.flat(info.name)) > 0]
    scaled = [info.name for info in varying if _has_scale(record, info)]
    logs = {n: np.log(record.flat(n)) for n in scaled}
    prior = {n: np.log(record.prior[n]) for n in scaled if n in record.prior}
    combinations = [combination for group in _groups(logs) for combination in _eigen_combinations(group, logs, prior)]
    combinations += [_alone(record, info) for info in varying if info.name not in scaled]
    return sorted(combinations, key=lambda c: c.sd if c.contraction is None else c.contraction)


def _has_scale(record: PosteriorRecord, info: ParameterInfo) -> bool:
    """True for a parameter whose relative size means something: a logarithmic prior, or one well away from zero."""
    draws, prior = record.flat(info.name), record.prior.get(info.name, record.flat(info.name))
    if not (np.all(draws > 0) and np.all(prior > 0)):
        return False
    return info.logarithmic or float(prior.std()) < WELL_AWAY * float(prior.mean())


def _alone(record: PosteriorRecord, info: ParameterInfo) -> Combination:
    sd = float(record.flat(info.name).std())
    prior_sd = float(record.prior[info.name].std()) if info.name in record.prior else None
    verdict = _verdict(sd, prior_sd)
    factor, unit = display_unit(info.unit, prior_sd or sd)
    before = "" if prior_sd is None else f" (prior ±{_short(prior_sd / factor)} {unit})".replace(" )", ")")
    sentence = f"{info.name} {_HOW[verdict]} ±{_short(sd / factor)} {unit}".rstrip() + before
    return Combination({info.name: 1.0}, info.unit, sd, prior_sd, verdict, sentence)


def _short(value: float) -> str:
    return f"{value:.0f}" if 100 <= value < 1e5 else f"{value:.2g}"


def _groups(logs: Mapping[str, Float[np.ndarray, " n"]]) -> list[list[str]]:
    """Parameters joined by strong correlations."""
    names = list(logs)
    if not names:
        return []
    correlation = np.abs(np.corrcoef(np.stack([logs[n] for n in names]))).reshape(len(names), len(names))
    groups: list[set[int]] = []
    for i in range(len(names)):
        touching = [g for g in groups if any(correlation[i, j] > TOGETHER for j in g)]
        groups = [g for g in groups if g not in touching] + [set.union({i}, *touching)]
    return [[names[i] for i in sorted(group)] for group in sorted(groups, key=min)]


def _eigen_combinations(
    group: list[str], logs: Mapping[str, np.ndarray], prior: Mapping[str, np.ndarray]
) -> list[Combination]:
    stack = np.stack([logs[n] for n in group])
    before = np.stack([prior[n] for n in group]) if all(n in prior for n in group) else None
    combinations = []
    for weights in _directions(stack):
        weights = weights / weights[np.argmax(np.abs(weights))]
        powers = _readable(dict(zip(group, weights, strict=True)))
        sd = float(np.std(weights @ stack))  # of the exact weights: rounding them would let the ridge leak in
        prior_sd = None if before is None else float(np.std(weights @ before))
        verdict = _verdict(sd, prior_sd)
        combinations.append(Combination(powers, "log", sd, prior_sd, verdict, _sentence(powers, sd, prior_sd, verdict)))
    return combinations


def _directions(stack: Float[np.ndarray, "parameter n"]) -> Float[np.ndarray, "parameter parameter"]:
    """Weights of the logarithms, one row per combination.

    The eigenvectors of their covariance; but if one ridge dominates three parameters or more, the directions across it
    have nearly equal variances and an arbitrary basis. In that case, the ratios that do not change along the ridge are
    given, each relative to the parameter that changes most.
    """
    values, vectors = np.linalg.eigh(np.atleast_2d(np.cov(stack)))
    if len(values) < 3 or values[-1] < RIDGE**2 * max(values[-2], 0.0):
        return vectors.T
    ridge = vectors[:, -1]
    reference = int(np.argmax(np.abs(ridge)))
    rows = [ridge]
    for i in range(len(ridge)):
        if i != reference:
            row = np.zeros(len(ridge))
            row[i] = 1.0
            if abs(ridge[i]) >= NEGLIGIBLE * abs(ridge[reference]):
                row[i], row[reference] = -ridge[reference] / ridge[i], 1.0
            rows.append(row)
    return np.stack(rows)


def _readable(powers: dict[str, float]) -> dict[str, float]:
    """Largest exponent 1, the first sign positive, small exponents dropped, the rest rounded to a tenth."""
    largest = max(powers.values(), key=abs)
    kept = {n: round(p / largest, 1) for n, p in powers.items() if abs(p / largest) >= NEGLIGIBLE}
    sign = 1.0 if next(iter(kept.values())) > 0 else -1.0
    return {n: sign * p for n, p in kept.items()}


def _verdict(sd: float, prior_sd: float | None) -> str:
    if not prior_sd:
        return "unknown"
    return "determined" if sd < DETERMINED * prior_sd else "partly" if sd < FREE * prior_sd else "free"


def spread_in_words(sd: float) -> str:
    """A standard deviation of a logarithm in words: +-0.8 %, or a factor of 2.1."""
    if sd < 0.5:
        digits = 2 if 100 * sd < 0.1 else 1 if 100 * sd < 10 else 0
        return f"±{100 * sd:.{digits}f} %"
    return f"a factor of {np.exp(sd):.2g} either way"


def product_in_words(powers: Mapping[str, float]) -> str:
    """E / density, friction x E, E^0.5 / mass."""

    def factor(name: str, power: float) -> str:
        return name if power == 1.0 else f"{name}^{power:g}"

    above = [factor(n, p) for n, p in powers.items() if p > 0]
    below = [factor(n, -p) for n, p in powers.items() if p < 0]
    numerator, denominator = TIMES.join(above) or "1", TIMES.join(below)
    if not below:
        return numerator
    return f"{numerator} / {denominator}" if len(below) == 1 else f"{numerator} / ({denominator})"


def _sentence(powers: Mapping[str, float], sd: float, prior_sd: float | None, verdict: str) -> str:
    same_sign = len(powers) > 1 and all(p > 0 for p in powers.values())
    if same_sign and verdict in ("free", "partly"):
        names = list(powers)
        subject = f"the common scale of {', '.join(names[:-1])} and {names[-1]}"
        sd /= sum(powers.values())
        prior_sd = None if prior_sd is None else prior_sd / sum(powers.values())
    else:
        subject = product_in_words(powers)
    before = f" (prior {spread_in_words(prior_sd)})" if prior_sd else ""
    return f"{subject} {_HOW[verdict]} {spread_in_words(sd)}{before}"
