"""Gradient-free optimisers in a box, ask and tell: the cross-entropy method, and CMA-ES through pycma.

Both are functions of their seed and of the losses told, so that a run is resumed by telling them again.
"""

from __future__ import annotations

import math
import warnings
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.errors import InputError

OPTIMISERS = ("cma", "cem")


@runtime_checkable
class Optimiser(Protocol):
    """Minimises a noisy loss over a box."""

    def ask(self) -> Float[np.ndarray, "population d"]:
        """Candidates of the next generation, inside the box."""
        ...

    def tell(self, candidates: Float[np.ndarray, "population d"], losses: Float[np.ndarray, " population"]) -> None:
        """Losses of the candidates last asked for; infinite ones rank last."""
        ...

    @property
    def centre(self) -> Float[np.ndarray, " d"]:
        """Where the search distribution now stands."""
        ...


def default_population(name: str, d: int) -> int:
    """``4 + floor(3 ln d)``, Hansen's default for CMA-ES; the cross-entropy method wants 5 d, it keeps little."""
    hansen = 4 + math.floor(3.0 * math.log(d))
    return max(hansen, 5 * d) if name == "cem" else hansen


def make_optimiser(
    name: str,
    d: int,
    *,
    high: float,
    sigma: float,
    population: int,
    seed: int,
    start: Float[np.ndarray, " d"] | None = None,
) -> Optimiser:
    """An optimiser over ``[0, high]^d`` that starts in the middle, or at ``start`` (CMA-ES only).

    Args:
        name: "cma" or "cem".
        d: dimension.
        high: upper edge of the box.
        sigma: initial step, as a share of the box.
        population: candidates per generation.
        seed: of its random numbers.
    """
    if name == "cma":
        return CovarianceAdaptation(d, high, sigma * high, population, seed, start)
    if name == "cem":
        return CrossEntropy(d, high, sigma * high, population, seed)
    raise InputError(f"unknown optimiser {name!r}", where="[inference]", remedy=f"one of {', '.join(OPTIMISERS)}")


class CrossEntropy:
    """Cross-entropy method: refit a diagonal normal to the best candidates of each generation.

    Args:
        d, high, sigma, population, seed: as in `make_optimiser`, sigma in the box's units.
        elite: share of the candidates that the refit uses.
        smoothing: weight of the new fit; the rest stays with the old one, which keeps the spread from collapsing.
    """

    def __init__(
        self, d: int, high: float, sigma: float, population: int, seed: int, elite: float = 0.3, smoothing: float = 0.7
    ) -> None:
        self.high, self.population, self.smoothing = high, population, smoothing
        self.elites = max(2, round(elite * population))
        self.mean, self.sd = np.full(d, 0.5 * high), np.full(d, sigma)
        self._generator = np.random.default_rng(seed)

    def ask(self) -> Float[np.ndarray, "population d"]:
        """Normal candidates; what falls outside is reflected, so that the edges do not collect mass."""
        z = self._generator.standard_normal((self.population, len(self.mean)))
        folded = np.mod(self.mean + self.sd * z, 2.0 * self.high)
        return np.minimum(folded, 2.0 * self.high - folded)

    def tell(self, candidates: Float[np.ndarray, "population d"], losses: Float[np.ndarray, " population"]) -> None:
        """Refit to the elite; the spread is taken about the OLD mean, so that it cannot collapse on the way."""
        best = candidates[np.argsort(losses, kind="stable")[: self.elites]]
        spread = np.sqrt(np.mean((best - self.mean) ** 2, axis=0))
        self.mean = self.smoothing * best.mean(axis=0) + (1.0 - self.smoothing) * self.mean
        self.sd = self.smoothing * spread + (1.0 - self.smoothing) * self.sd

    @property
    def centre(self) -> Float[np.ndarray, " d"]:
        """Mean of the normal."""
        return self.mean


class CovarianceAdaptation:
    """CMA-ES of pycma, with random numbers of its own instead of numpy's global ones."""

    def __init__(
        self, d: int, high: float, sigma: float, population: int, seed: int, start: np.ndarray | None = None
    ) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # pycma warns of optional plotting packages when imported
            import cma

        generator = np.random.default_rng(seed)
        options = {
            "bounds": [0.0, high],
            "popsize": population,
            "seed": np.nan,
            "randn": lambda *shape: generator.standard_normal(shape),
            "verbose": -9,
            "tolfun": 0.0,  # the number of generations is the schedule's to decide, not a tolerance's
            "tolx": 0.0,
        }
        self._strategy = cma.CMAEvolutionStrategy(np.full(d, 0.5 * high) if start is None else start, sigma, options)

    def ask(self) -> Float[np.ndarray, "population d"]:
        """Candidates of the next generation."""
        return np.asarray(self._strategy.ask())

    def tell(self, candidates: Float[np.ndarray, "population d"], losses: Float[np.ndarray, " population"]) -> None:
        """Update the search distribution; pycma wants finite losses."""
        finite = losses[np.isfinite(losses)]
        worst = (finite.max() if len(finite) else 0.0) + 1e6
        self._strategy.tell(list(candidates), np.where(np.isfinite(losses), losses, worst).tolist())

    @property
    def centre(self) -> Float[np.ndarray, " d"]:
        """Mean of the search distribution, inside the box."""
        return np.asarray(self._strategy.result.xfavorite)
