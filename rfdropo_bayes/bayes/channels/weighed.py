"""Parts that were weighed, and other sums of parameters known from a measurement of their own.

With cables that impose a displacement, all stiffnesses and masses times one factor give the same motion. A mass from a
balance fixes the factor, as a tension reading does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from rfdropo_bayes.bayes.channels.channel import Channel, Seen
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.parameters import ParameterSpec


class Weighed(NamedTuple):
    """A parameter, or the sum of several, known from a measurement of its own.

    Attributes:
        parameters: names; their sum was measured.
        value: in their unit.
        sd: its standard deviation.
    """

    parameters: tuple[str, ...]
    value: float
    sd: float


@dataclass(frozen=True)
class WeighedParts(Channel):
    """Weighed parts; they are known before the first row and count with it."""

    name: ClassVar[str] = "weighed"
    entries: tuple[Weighed, ...]

    @property
    def specs(self) -> tuple[ParameterSpec, ...]:
        """None: their errors are given."""
        return ()

    @property
    def measured(self) -> Float[np.ndarray, " weighed"]:
        """See `Channel.measured`: the sums."""
        return np.array([entry.value for entry in self.entries])

    @property
    def _sd(self) -> Float[np.ndarray, " weighed"]:
        return np.array([entry.sd for entry in self.entries])

    def _sums(self, values: Mapping[str, Any]) -> Float[Array, " weighed"]:
        return jnp.stack([jnp.asarray(sum(values[name] for name in entry.parameters)) for entry in self.entries])

    def residuals(self, seen: Seen, measured: Float[Any, " weighed"]) -> Float[Array, " weighed"]:
        """See `Channel.residuals`: one for each part."""
        return (measured - self._sums(seen.values)) / self._sd

    def row_log_density(self, seen: Seen, measured: Float[Any, " weighed"]) -> Float[Array, " 1"]:
        """See `Channel.row_log_density`."""
        normaliser = np.sum(np.log(self._sd * np.sqrt(2.0 * np.pi)))
        return (-0.5 * jnp.sum(self.residuals(seen, measured) ** 2) - normaliser)[None]

    def draw(self, key: PRNGKeyArray, seen: Seen) -> Float[Array, " weighed"]:
        """See `Channel.draw`."""
        return self._sums(seen.values) + self._sd * jax.random.normal(key, (len(self.entries),))


def check_weighed(weighed: Sequence[Weighed], names: Sequence[str]) -> None:
    """Raise InputError for a part that is no inferred parameter, or a deviation that is not positive."""
    for entry in weighed:
        for name in entry.parameters:
            if name not in names:
                raise InputError(
                    f"{name!r} was weighed but is not inferred",
                    where="[[model.weighed]]",
                    remedy=f"one of {', '.join(names)}",
                )
        if not (entry.sd > 0.0 and np.isfinite(entry.value)):
            raise InputError(
                "a weighed value needs a positive sd", where="[[model.weighed]]", remedy="give value and sd"
            )
