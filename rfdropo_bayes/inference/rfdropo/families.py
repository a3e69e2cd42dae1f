"""Families of distributions over simulator parameters that RF-DROPO can search, beside the paper's independent normals.

Each is coded by a vector in [0, 4]^k, as the optimisers want it, and draws by transforming given uniform numbers, so
that several vectors share their random numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp, ndtr, ndtri

from rfdropo_bayes.cautions import Caution
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference.rfdropo.randomisation import TRUNCATION, WIDTH, SearchSpace

FAMILIES = ("independent", "full", "mixture")
LARGEST_CORRELATION = 0.999


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
