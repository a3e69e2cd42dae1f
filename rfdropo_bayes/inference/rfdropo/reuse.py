"""Rollouts used again for other distributions: they depend on the parameters, not on the distribution they came from.

A rollout drawn under one phi counts under another by the ratio of the densities; with several sources the ratio is to
their mixture (the balance heuristic). The effective sample size says how far that carries.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import logsumexp

from rfdropo_bayes.inference.rfdropo.families import Family
from rfdropo_bayes.inference.rfdropo.optimisers import default_population, make_optimiser
from rfdropo_bayes.inference.rfdropo.randomisation import WIDTH
from rfdropo_bayes.inference.rfdropo.trajectory_match import step_log_likelihood

LEAST_ESS = 30.0  # rollouts behind a mean and a covariance
TRUST = 0.05  # initial step of the search, as a share of its range: the pool knows the neighbourhood only
FORBIDDEN = 1e9


@dataclass(frozen=True)
class Pool:
    """Rollouts of several distributions at the full horizon.

    Attributes:
        family: theirs.
        values: parameter sets, physical units.
        features: rollouts, in units of the motion.
        log_source: log density of each set under the mixture of all sources.
        observed, mask: the trajectory, likewise.
        recordings: how many lie side by side in the features.
        floor: as in the search.
    """

    family: Family
    values: Float[np.ndarray, "n d"]
    features: Float[np.ndarray, "n time f"]
    log_source: Float[np.ndarray, " n"]
    observed: Float[np.ndarray, "time f"]
    mask: Bool[np.ndarray, "time f"]
    recordings: int
    floor: Float[np.ndarray, " f"]

    def weights(self, vector: Float[np.ndarray, " k"]) -> tuple[Float[np.ndarray, " n"], float]:
        """Normalised weights of the pool under a distribution, and their effective sample size."""
        logs = self.family.log_density(vector, self.values) - self.log_source
        total = logsumexp(logs)
        if not np.isfinite(total):
            return np.zeros(len(logs)), 0.0
        weights = np.exp(logs - total)
        return weights, float(1.0 / np.sum(weights**2))

    def loss(self, vector: Float[np.ndarray, " k"], counts: Float[np.ndarray, " recordings"]) -> float:
        """Minus the log likelihood, every recording counted so often; forbidden where too few rollouts matter."""
        weights, effective = self.weights(vector)
        if effective < LEAST_ESS:
            return FORBIDDEN * (1.0 + LEAST_ESS - effective)
        kept = weights > 1e-6 * weights.max()
        blocks = np.array_split(np.arange(self.features.shape[2]), self.recordings)
        total = 0.0
        for count, columns in zip(counts, blocks, strict=True):
            if count:
                rows = step_log_likelihood(
                    self.features[kept][:, :, columns],
                    np.ones(int(kept.sum()), dtype=bool),
                    self.observed[:, columns],
                    self.mask[:, columns],
                    self.floor[columns],
                    weights[kept] / weights[kept].sum(),
                )
                total -= count * float(rows.sum())
        return total


def make_pool(
    family: Family,
    candidates: Float[np.ndarray, "c k"],
    values: Float[np.ndarray, "c m d"],
    features: Float[np.ndarray, "c m time f"],
    alive: Bool[np.ndarray, "c m"],
    observed: Float[np.ndarray, "time f"],
    mask: Bool[np.ndarray, "time f"],
    recordings: int,
    floor: Float[np.ndarray, " f"],
) -> Pool:
    """Pool of the live rollouts of some candidates; each counts as a source by the rollouts of it that are alive."""
    flat = values[alive]
    with np.errstate(divide="ignore"):
        share = np.log(alive.sum(axis=1) / max(alive.sum(), 1))
    logs = np.stack([family.log_density(c, flat) for c in candidates]) + share[:, None]
    return Pool(family, flat, features[alive], logsumexp(logs, axis=0), observed, mask, recordings, floor)


def refine(
    pool: Pool, start: Float[np.ndarray, " k"], counts: Float[np.ndarray, " recordings"], evaluations: int, seed: int
) -> Float[np.ndarray, " k"]:
    """The best distribution near ``start`` that the pool can judge, without a single further rollout."""
    k = len(start)
    population = default_population("cma", k)
    optimiser = make_optimiser("cma", k, high=WIDTH, sigma=TRUST, population=population, seed=seed, start=start)
    best, lowest = start, pool.loss(start, counts)
    for _ in range(max(1, evaluations // population)):
        asked = np.clip(optimiser.ask(), 0.0, WIDTH)
        losses = np.array([pool.loss(vector, counts) for vector in asked])
        optimiser.tell(asked, losses)
        if losses.min() < lowest:
            best, lowest = asked[int(np.argmin(losses))], float(losses.min())
    return best


def bootstrap(
    pool: Pool, start: Float[np.ndarray, " k"], repeats: int, evaluations: int, generator: np.random.Generator
) -> dict[str, dict[str, Any]]:
    """Scatter of each parameter's mean when the recordings are drawn again with replacement."""
    means, effective = [], []
    for _ in range(repeats):
        counts = np.bincount(generator.integers(pool.recordings, size=pool.recordings), minlength=pool.recordings)
        found = refine(pool, start, counts.astype(float), evaluations, int(generator.integers(2**31)))
        table = pool.family.describe(found, dict.fromkeys(pool.family.names, ""))
        means.append([table[name]["mean"] for name in pool.family.names])
        effective.append(pool.weights(found)[1])
    drawn = np.array(means)
    low, high = np.quantile(drawn, [0.05, 0.95], axis=0)
    return {
        name: {"sd": float(drawn[:, j].std(ddof=1)), "q05": float(low[j]), "q95": float(high[j])}
        for j, name in enumerate(pool.family.names)
    } | {"effective_sample_size": {"mean": float(np.mean(effective)), "least": float(np.min(effective))}}
