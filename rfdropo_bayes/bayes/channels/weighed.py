"""Weighed parts, and other sums of parameters known from separate measurements.

With cables that impose a displacement, all stiffnesses and masses times one factor give the same motion. A mass from a
balance fixes the factor, as a tension reading does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfdropo_bayes.bayes.channels.channel import Channel, Seen
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.groups import whole
from rfdropo_bayes.posteriors import ParameterInfo, label
from rfdropo_bayes.simulators.parameters import ParameterSpec


class Weighed(NamedTuple):
    """A parameter, or a sum of parameters, known from a separate measurement."""

    parameters: tuple[str, ...]  # names; their sum was measured
    value: float  # measured value in their unit
    sd: float  # its standard deviation


@dataclass(frozen=True)
class WeighedParts(Channel):
    """Weighed parts; they are known before the first row and count with it."""

    name: ClassVar[str] = "weighed"
    entries: tuple[Weighed, ...]

    def named(self, inferred: Sequence[ParameterInfo]) -> WeighedParts:
        """The weighings with the names under which parameters are inferred.

        The whole recording's name denotes its only piece: ``payload_mass@a`` for ``payload_mass@a[0:99]``.

        Raises:
            InputError: a part that is no inferred parameter, or one of several.
        """
        entries = (
            entry._replace(parameters=tuple(_inferred_name(p, inferred) for p in entry.parameters))
            for entry in self.entries
        )
        return replace(self, entries=tuple(entries))

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
        normaliser = np.sum(np.log(self._sd * np.sqrt(2.0 * np.pi)))
        return (-0.5 * jnp.sum(self.residuals(seen, measured) ** 2) - normaliser)[None]


def _inferred_name(name: str, inferred: Sequence[ParameterInfo]) -> str:
    """The label of the inferred parameter that is meant."""
    names = [p.name for p in inferred]
    pieces = [p.name for p in inferred if p.scope.owner and label(p.parameter, whole(p.scope.owner)) == name]
    if name in names or len(pieces) == 1:
        return name if name in names else pieces[0]
    what = f"several pieces of {name!r} are fitted" if pieces else f"{name!r} was weighed but is not inferred"
    raise InputError(what, where="[[model.weighed]]", remedy=f"use one of {', '.join(pieces or names)}")
