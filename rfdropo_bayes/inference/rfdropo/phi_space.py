"""Search space of RF-DROPO: independent truncated normals over simulator parameters, each coded by a vector.

Vectors lie in [0, 4]^k, as the optimisers want them. Draws transform given uniform numbers, so that several vectors
share their random numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr, ndtri

from rfdropo_bayes.bayes.problem import Problem, Values
from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.errors import InputError

WIDTH = 4.0  # every parameter's search range is scaled to [0, 4]
SMALLEST_STD = 1e-5  # in these units


LARGEST_STD = WIDTH / 4.0
TRUNCATION = 2.0  # standard deviations


class SearchSpace(NamedTuple):
    """Parameters that are searched, with range and hard bounds in physical units.

    A *vector* is (means, log standard deviations), each scaled to [0, 4].
    """

    names: tuple[str, ...]
    low: Float[np.ndarray, " d"]
    high: Float[np.ndarray, " d"]
    hard_low: Float[np.ndarray, " d"]
    hard_high: Float[np.ndarray, " d"]

    @property
    def dimension(self) -> int:
        """Length of a vector."""
        return 2 * len(self.names)

    def unpack(self, vector: Float[np.ndarray, "*batch k"]) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation (before truncation), physical units, each (*batch, d)."""
        d = len(self.names)
        unit = (self.high - self.low) / WIDTH
        logs = np.log(SMALLEST_STD) + vector[..., d:] / WIDTH * np.log(LARGEST_STD / SMALLEST_STD)
        return self.low + vector[..., :d] * unit, np.exp(logs) * unit

    def draw(self, vector: Float[np.ndarray, "*batch k"], uniform: Float[np.ndarray, "m d"]) -> np.ndarray:
        """Draws (*batch, m, d) of the truncated normals at given uniform numbers.

        Truncated at 2 standard deviations AND at the hard bounds, exactly, through the inverse distribution function.
        One set of uniform numbers for several vectors gives them common random numbers.
        """
        mean, std = self.unpack(vector)
        lower = ndtr(np.clip((self.hard_low - mean) / std, -TRUNCATION, TRUNCATION))
        upper = ndtr(np.clip((self.hard_high - mean) / std, -TRUNCATION, TRUNCATION))
        share = lower[..., None, :] + uniform * (upper - lower)[..., None, :]
        drawn = mean[..., None, :] + std[..., None, :] * ndtri(share)
        return np.clip(drawn, self.hard_low, self.hard_high)  # rounding only

    def describe(self, vector: Float[np.ndarray, " k"], units: Mapping[str, str]) -> dict[str, dict[str, Any]]:
        """The distribution as a table: mean, std (before truncation), truncation limits and unit of each parameter."""
        mean, std = self.unpack(vector)
        low = np.maximum(mean - TRUNCATION * std, self.hard_low)
        high = np.minimum(mean + TRUNCATION * std, self.hard_high)
        return {
            name: {
                "mean": float(mean[j]),
                "std": float(std[j]),
                "low": float(low[j]),
                "high": float(high[j]),
                "unit": units[name],
            }
            for j, name in enumerate(self.names)
        }

    def edge_cautions(self, vector: Float[np.ndarray, " k"]) -> list[Caution]:
        """A caution for every mean or standard deviation within a hundredth of its range from an end of it."""
        d, cautions = len(self.names), []
        for j, name in enumerate(self.names):
            for what, value in (("mean", vector[j]), ("standard deviation", vector[d + j])):
                side = "lower" if value < 0.01 * WIDTH else "upper" if value > 0.99 * WIDTH else None
                if side and not (what == "standard deviation" and side == "lower"):
                    sentence = f"the {what} of {name} sits on the {side} end of its search range"
                    cautions.append(Caution(Code.SEARCH_EDGE, sentence))
                elif side:
                    sentence = (
                        f"the standard deviation of {name} sits on its smallest value: the data do not ask for any "
                        "spread, which one trajectory never does"
                    )
                    cautions.append(Caution(Code.NO_SPREAD, sentence, grave=True))
        return cautions


def search_space(
    problem: Problem, names: tuple[str, ...], ranges: Mapping[str, tuple[float, float]], prior: Values
) -> SearchSpace:
    """Search ranges: the given ranges, else the central 99 % of the prior, which lie inside the bounds, like the
    paper's.

    Hard bounds exclude impossible values and span decades; a search range is linear and needs narrower bounds.

    Raises:
        InputError: an unknown parameter, or a range that is empty or outside the bounds.
    """
    for name in (*names, *ranges):
        if name not in problem.names:
            raise InputError(
                f"unknown parameter {name!r}", where="[inference]", remedy=f"use one of {', '.join(problem.names)}"
            )
    bounds = np.array([problem.bounds[name] for name in names], dtype=float)
    chosen = []
    for name, (low, high) in zip(names, bounds, strict=True):
        if name in ranges:
            chosen.append(tuple(ranges[name]))
        else:
            quantiles = np.quantile(np.asarray(prior[name]), [0.005, 0.995])
            chosen.append((max(float(quantiles[0]), low), min(float(quantiles[1]), high)))
        if not (low <= chosen[-1][0] < chosen[-1][1] <= high):
            raise InputError(
                f"the search range {chosen[-1]} of {name} is empty or leaves its bounds [{low:g}, {high:g}]",
                where="[inference] search",
            )
    ranges_array = np.array(chosen, dtype=float)
    return SearchSpace(tuple(names), ranges_array[:, 0], ranges_array[:, 1], bounds[:, 0], bounds[:, 1])
