"""The known noise of several channels side by side: the channels have different memories and independent noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np
from jaxtyping import Bool, Float

from rfdropo_bayes.bayes.noise.autoregression import Autoregression


@dataclass(frozen=True)
class Stacked:
    """Noise of columns that belong to several channels."""

    parts: tuple[Autoregression, ...]  # one for each channel, the markers' first

    @property
    def first(self) -> Autoregression:
        """Noise of the markers."""
        return self.parts[0]

    @property
    def source(self) -> str:
        """Source of the noise, the same for all channels."""
        return self.first.source

    @property
    def doubtful(self) -> bool:
        """Whether the noise of any channel is doubtful."""
        return any(part.doubtful for part in self.parts)

    @property
    def scale(self) -> Float[np.ndarray, " column"]:
        """Marginal standard deviation of each column, in the column's unit."""
        return np.concatenate([part.scale for part in self.parts])

    @property
    def columns(self) -> list[slice]:
        """Columns of each channel."""
        return side_by_side([len(part.scale) for part in self.parts])

    def at(self, steps: Sequence[float] | Float[np.ndarray, " recording"]) -> Stacked:
        return Stacked(tuple(part.at(steps) for part in self.parts))

    def whiten(
        self,
        series: Float[np.ndarray, "*batch time column"],
        valid: Bool[np.ndarray, "*rest time column"],
        count: Float[np.ndarray, "*rest time column"] | None = None,
    ) -> Float[np.ndarray, "*batch time column"]:
        return self._each(lambda part, *own: part.whiten(*own), series, valid, *([] if count is None else [count]))

    def colour(
        self, white: Float[np.ndarray, "*batch time column"], valid: Bool[np.ndarray, "*rest time column"]
    ) -> Float[np.ndarray, "*batch time column"]:
        return self._each(lambda part, x, ok: part.colour(x, ok), white, valid)

    def draw(self, rng: np.random.Generator, shape: tuple[int, ...]) -> Float[np.ndarray, "*batch time column"]:
        """A realisation of shape (..., time, column)."""
        return np.concatenate([part.draw(rng, (*shape[:-1], len(part.scale))) for part in self.parts], axis=-1)

    def _each(self, operate: Callable[..., np.ndarray], *arrays: np.ndarray) -> np.ndarray:
        parts = zip(self.parts, self.columns, strict=True)
        return np.concatenate([operate(part, *(a[..., own] for a in arrays)) for part, own in parts], axis=-1)


def side_by_side(widths: Sequence[int]) -> list[slice]:
    """Slices of adjacent blocks of columns."""
    return [slice(low, high) for low, high in pairwise(accumulate(widths, initial=0))]
