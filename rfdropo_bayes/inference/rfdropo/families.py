"""Families of distributions over simulator parameters that RF-DROPO can search: the paper's independent truncated
normals, normals with a full covariance, and mixtures of two.

Each is coded by a vector in [0, 4]^k, as the optimisers want it, and draws by transforming given uniform numbers, so
that several vectors share their random numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp, ndtr, ndtri

from rfdropo_bayes.bayes.problem import Problem, Values
from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.errors import InputError

FAMILIES = ("independent", "full", "mixture")
LARGEST_CORRELATION = 0.999
WIDTH = 4.0  # every parameter's search range is scaled to [0, 4]
SMALLEST_STD = 1e-5  # in those units
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

    @property
    def columns(self) -> int:
        """Uniform numbers that a draw takes."""
        return len(self.names)

    def log_density(self, vector: Float[np.ndarray, " k"], values: Float[np.ndarray, "n d"]) -> np.ndarray:
        """Log density of parameter sets under the truncated normals; minus infinity beyond a truncation."""
        mean, std = self.unpack(vector)
        lower = np.clip((self.hard_low - mean) / std, -TRUNCATION, TRUNCATION)
        upper = np.clip((self.hard_high - mean) / std, -TRUNCATION, TRUNCATION)
        z = (values - mean) / std
        inside = np.all((z >= lower - 1e-9) & (z <= upper + 1e-9), axis=1)
        with np.errstate(divide="ignore"):
            mass = np.log(ndtr(upper) - ndtr(lower)) + 0.5 * np.log(2.0 * np.pi) + np.log(std)
        return np.where(inside, np.sum(-0.5 * z**2 - mass, axis=1), -np.inf)

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

    def edge_cautions(self, vector: Float[np.ndarray, " k"], edge: float = 0.01) -> list[Caution]:
        """A caution for every mean or standard deviation within ``edge`` of its range from an end of it."""
        d, found = len(self.names), []
        for j, name in enumerate(self.names):
            for what, value in (("mean", vector[j]), ("standard deviation", vector[d + j])):
                side = "lower" if value < edge * WIDTH else "upper" if value > (1.0 - edge) * WIDTH else None
                if side and not (what == "standard deviation" and side == "lower"):
                    sentence = f"the {what} of {name} sits on the {side} end of its search range"
                    found.append(Caution(Code.SEARCH_EDGE, sentence))
                elif side:
                    sentence = (
                        f"the standard deviation of {name} sits on its smallest value: the data do not ask for any "
                        "spread, which one trajectory never does"
                    )
                    found.append(Caution(Code.NO_SPREAD, sentence, grave=True))
        return found


def search_space(
    problem: Problem,
    names: tuple[str, ...],
    ranges: Mapping[str, tuple[float, float]],
    prior: Values,
) -> SearchSpace:
    """Search ranges: those asked for, else the central 99 % of the prior, which like the paper's is inside the bounds.

    Hard bounds would not do: they exclude the impossible and span decades, where a search range is linear.

    Raises:
        InputError: an unknown parameter, or a range that is empty or outside the bounds.
    """
    for name in (*names, *ranges):
        if name not in problem.names:
            raise InputError(
                f"unknown parameter {name!r}", where="[inference]", remedy=f"one of {', '.join(problem.names)}"
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


@runtime_checkable
class Family(Protocol):
    """What the search needs of a family."""

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters."""
        ...

    @property
    def dimension(self) -> int:
        """Length of a vector."""
        ...

    @property
    def columns(self) -> int:
        """Uniform numbers that a draw takes."""
        ...

    def draw(self, vector: Float[np.ndarray, "*batch k"], uniform: Float[np.ndarray, "m c"]) -> np.ndarray:
        """Draws (*batch, m, d) at given uniform numbers, physical units."""
        ...

    def log_density(self, vector: Float[np.ndarray, " k"], values: Float[np.ndarray, "n d"]) -> np.ndarray:
        """Log density of parameter sets, physical units."""
        ...

    def describe(self, vector: Float[np.ndarray, " k"], units: Mapping[str, str]) -> dict[str, dict[str, Any]]:
        """Table by parameter: mean, std (before truncation), low, high, unit, and what the family has beside."""
        ...

    def edge_cautions(self, vector: Float[np.ndarray, " k"]) -> list[Caution]:
        """Cautions on what sits at the end of its range."""
        ...


def make_family(name: str, space: SearchSpace) -> Family:
    """Family of a name over a search space.

    Raises:
        InputError: no such family, or one that needs several parameters.
    """
    if name not in FAMILIES:
        raise InputError(f"unknown family {name!r}", where="[inference] family", remedy=f"one of {', '.join(FAMILIES)}")
    if name == "full":
        if len(space.names) < 2:
            raise InputError("one parameter has no correlations", where="[inference] family", remedy="independent")
        return FullCovariance(space)
    return TwoNormals(space) if name == "mixture" else space


class FullCovariance(NamedTuple):
    """Normal with correlations, truncated at 2 deviations along its principal (Cholesky) directions.

    A vector is that of the independent normals, then the canonical partial correlations, scaled from [-1, 1]. Draws
    beyond a hard bound are moved onto it.
    """

    space: SearchSpace

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters."""
        return self.space.names

    @property
    def dimension(self) -> int:
        """2 d + d (d - 1) / 2."""
        d = len(self.names)
        return 2 * d + d * (d - 1) // 2

    @property
    def columns(self) -> int:
        """One per parameter."""
        return len(self.names)

    def factor(self, vector: Float[np.ndarray, "*batch k"]) -> Float[np.ndarray, "*batch d d"]:
        """Cholesky factor of the correlation matrix, by stick breaking (Lewandowski, Kurowicka and Joe 2009)."""
        d = len(self.names)
        partial = LARGEST_CORRELATION * (2.0 * vector[..., 2 * d :] / WIDTH - 1.0)
        factor = np.zeros((*vector.shape[:-1], d, d))
        index = 0
        for i in range(d):
            left = np.ones(vector.shape[:-1])
            for j in range(i):
                factor[..., i, j] = partial[..., index] * np.sqrt(left)
                left = left - factor[..., i, j] ** 2
                index += 1
            factor[..., i, i] = np.sqrt(left)
        return factor

    def draw(self, vector: Float[np.ndarray, "*batch k"], uniform: Float[np.ndarray, "m c"]) -> np.ndarray:
        """See `Family.draw`."""
        mean, std = self.space.unpack(vector[..., : self.space.dimension])
        low, high = ndtr(-TRUNCATION), ndtr(TRUNCATION)
        z = ndtri(low + uniform * (high - low))
        correlated = np.einsum("...ij,mj->...mi", self.factor(vector), z)
        drawn = mean[..., None, :] + std[..., None, :] * correlated
        return np.clip(drawn, self.space.hard_low, self.space.hard_high)

    def log_density(self, vector: Float[np.ndarray, " k"], values: Float[np.ndarray, "n d"]) -> np.ndarray:
        """See `Family.log_density`; draws moved onto a bound are not accounted for."""
        mean, std = self.space.unpack(vector[: self.space.dimension])
        factor = self.factor(vector)
        z = np.linalg.solve(factor, ((values - mean) / std).T).T
        inside = np.all(np.abs(z) <= TRUNCATION * (1.0 + 1e-9), axis=1)
        mass = np.log(ndtr(TRUNCATION) - ndtr(-TRUNCATION)) + 0.5 * np.log(2.0 * np.pi)
        scale = np.log(std).sum() + np.log(np.diag(factor)).sum()
        return np.where(inside, -0.5 * np.sum(z**2, axis=1) - len(mean) * mass - scale, -np.inf)

    def describe(self, vector: Float[np.ndarray, " k"], units: Mapping[str, str]) -> dict[str, dict[str, Any]]:
        """See `Family.describe`; ``correlation`` with every parameter is added."""
        table = self.space.describe(vector[: self.space.dimension], units)
        factor = self.factor(vector)
        correlation = factor @ factor.T
        for i, name in enumerate(self.names):
            table[name]["correlation"] = dict(zip(self.names, correlation[i].tolist(), strict=True))
        return table

    def edge_cautions(self, vector: Float[np.ndarray, " k"]) -> list[Caution]:
        """See `Family.edge_cautions`."""
        return self.space.edge_cautions(vector[: self.space.dimension])


class TwoNormals(NamedTuple):
    """Mixture of two sets of independent truncated normals; a vector is theirs, then the share of the first."""

    space: SearchSpace

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters."""
        return self.space.names

    @property
    def dimension(self) -> int:
        """Both components and the share."""
        return 2 * self.space.dimension + 1

    @property
    def columns(self) -> int:
        """One per parameter, and one that chooses the component."""
        return len(self.names) + 1

    def parts(self, vector: Float[np.ndarray, "*batch k"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vectors of the two components, and the share of the first."""
        k = self.space.dimension
        return vector[..., :k], vector[..., k : 2 * k], np.asarray(vector[..., -1] / WIDTH)

    def draw(self, vector: Float[np.ndarray, "*batch k"], uniform: Float[np.ndarray, "m c"]) -> np.ndarray:
        """See `Family.draw`."""
        first, second, share = self.parts(vector)
        chosen = uniform[:, -1] < share[..., None]
        drawn = [self.space.draw(part, uniform[:, :-1]) for part in (first, second)]
        return np.where(chosen[..., None], drawn[0], drawn[1])

    def log_density(self, vector: Float[np.ndarray, " k"], values: Float[np.ndarray, "n d"]) -> np.ndarray:
        """See `Family.log_density`."""
        first, second, share = self.parts(vector)
        with np.errstate(divide="ignore"):
            weights = np.log([share, 1.0 - share])
        parts = [self.space.log_density(part, values) for part in (first, second)]
        return logsumexp(np.stack(parts) + weights[:, None], axis=0)

    def describe(self, vector: Float[np.ndarray, " k"], units: Mapping[str, str]) -> dict[str, dict[str, Any]]:
        """See `Family.describe`; moments of the mixture, and its ``components``."""
        first, second, share = self.parts(vector)
        tables = [self.space.describe(part, units) for part in (first, second)]
        shares = (float(share), 1.0 - float(share))
        found = {}
        for name in self.names:
            entries = [table[name] for table in tables]
            mean = sum(s * e["mean"] for s, e in zip(shares, entries, strict=True))
            square = sum(s * (e["std"] ** 2 + e["mean"] ** 2) for s, e in zip(shares, entries, strict=True))
            found[name] = {
                "mean": mean,
                "std": float(np.sqrt(max(square - mean**2, 0.0))),
                "low": min(e["low"] for e in entries),
                "high": max(e["high"] for e in entries),
                "unit": units[name],
                "components": [{"share": s, **e} for s, e in zip(shares, entries, strict=True)],
            }
        return found

    def edge_cautions(self, vector: Float[np.ndarray, " k"]) -> list[Caution]:
        """Those of the larger component."""
        first, second, share = self.parts(vector)
        return self.space.edge_cautions(first if share >= 0.5 else second)
