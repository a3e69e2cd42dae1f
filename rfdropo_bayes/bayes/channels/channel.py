"""Interface of every channel of measurements: parameters, residuals, density, and draws of the noise."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rfdropo_bayes.bayes.noise.autoregression import STATED, Autoregression
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.parameters import ParameterSpec
from rfdropo_bayes.simulators.protocol import Observation


class Seen(NamedTuple):
    """Simulated observations under a set of values."""

    observation: Observation  # observations of every recording, with a leading axis over recordings
    values: Mapping[str, Any]  # all parameters by name, inferred and fixed
    offset: Float[Any, "recording 3"]  # shift of measured against simulated positions in each recording [m]


class Channel(ABC):
    """One kind of measurement; a model's log likelihood is the sum over its channels."""

    name: ClassVar[str]  # name of its data

    @property
    @abstractmethod
    def specs(self) -> tuple[ParameterSpec, ...]:
        """Parameters of the channel's noise and gain."""

    @property
    @abstractmethod
    def measured(self) -> Float[Any, "..."]:
        """The measured array; other arrays of this shape are other data of the same channel."""

    @abstractmethod
    def residuals(self, seen: Seen, measured: Float[Any, "..."]) -> Float[Array, "..."]:
        """Residuals of unit variance, zero without a reading; axes (recording, time, ...) of a `Series`."""

    @abstractmethod
    def row_log_density(self, seen: Seen, measured: Float[Any, "..."]) -> Float[Array, " row"]:
        """Log density of each row given the earlier rows, summed over recordings. Data without a time axis count in the
        first row.
        """


@dataclass(frozen=True)
class Series(Channel):
    """A channel with readings in every row of every recording."""

    linear: ClassVar[bool]  # whether errors are readings less simulated values, without a nonlinear map
    readings: Float[Any, "recording time *reading"]  # readings, zero if missing
    valid: Bool[np.ndarray, "recording time column"]  # mask of the valid columns of an error (`deviation`)
    # its noise in these recordings if stated or estimated; None if its parameters are inferred
    known: Autoregression | None = None

    @property
    def measured(self) -> Float[Any, "recording time *reading"]:
        return self.readings

    @property
    def specs(self) -> tuple[ParameterSpec, ...]:
        return self.gain_specs + (() if self.known is not None else self.noise_specs)

    @property
    def gain_specs(self) -> tuple[ParameterSpec, ...]:
        """Parameters that are not of the noise; known unless they have a prior."""
        return ()

    @property
    @abstractmethod
    def noise_specs(self) -> tuple[ParameterSpec, ...]:
        """Inferred parameters of the channel's noise."""

    @property
    def independent(self) -> bool:
        """Whether the channel's noise is independent between rows and between columns."""
        return self.known is not None and self.known.order == 0 and self.known.correlation is None

    @abstractmethod
    def expected(self, seen: Seen) -> Float[Any, "recording time *reading"]:
        """Expected readings without noise."""

    @abstractmethod
    def deviation(
        self, measured: Float[Any, "recording time *reading"], about: Float[Any, "recording time *reading"]
    ) -> Float[Any, "recording time column"]:
        """Readings less others, in the unit of the noise."""

    @abstractmethod
    def whiten_inferred(
        self, errors: Float[Any, "recording time column"], values: Mapping[str, Any]
    ) -> tuple[Float[Any, "recording time column"], Float[Any, "recording time column"]]:
        """Errors as residuals of unit variance, and the logarithms that normalise them, under inferred noise."""

    @abstractmethod
    def stated(self, values: Mapping[str, float], step: float) -> Autoregression:
        """The channel's noise at given values of its parameters, in rows that are ``step`` seconds apart."""

    def log_size(
        self, about: Float[Any, "recording time *reading"], measured: Float[Any, "recording time *reading"]
    ) -> Float[Any, "recording time column"] | None:
        """Logarithm of the unit of a relative error; None for an absolute error."""
        return None

    def of_recordings(self, index: list[int], rows: int | None = None) -> Series:
        """The channel restricted to some recordings and their first rows."""
        own = {"readings": self.readings[index, :rows], "valid": self.valid[index, :rows]}
        return replace(self, **own, known=self.known_of(index))

    def known_of(self, index: list[int]) -> Autoregression | None:
        """Its known noise in some recordings; None if it is inferred."""
        return None if self.known is None else self.known.of_recordings(index)

    def mean(
        self, readings: Float[np.ndarray, "repeat time *reading"], valid: Bool[np.ndarray, "repeat time column"]
    ) -> Float[np.ndarray, "time *reading"]:
        """Mean of valid readings over repeats, zero if none is valid."""
        shape = readings.shape[1:]
        used = np.where(valid, readings.reshape(valid.shape), 0.0)
        return (used.sum(axis=0) / np.maximum(valid.sum(axis=0), 1)).reshape(shape)

    def errors(
        self, seen: Seen, measured: Float[Any, "recording time *reading"]
    ) -> Float[Any, "recording time column"]:
        """Measured less expected readings, in the unit of the noise."""
        return self.deviation(measured, self.expected(seen))

    def whiten(
        self, errors: Float[Any, "recording time column"], values: Mapping[str, Any]
    ) -> tuple[Float[Any, "recording time column"], Float[Any, "recording time column"]]:
        """Errors as residuals of unit variance, zero if not valid, and the logarithms that normalise them."""
        if self.known is None:
            return self.whiten_inferred(errors, values)
        return self.known.whiten(errors, self.valid), self.known.log_scale(self.valid)

    def residuals(
        self, seen: Seen, measured: Float[Any, "recording time *reading"]
    ) -> Float[Any, "recording time column"]:
        """See `Channel.residuals`; further columns stand for the sizes that errors are relative to."""
        about = self.expected(seen)
        white, _ = self.whiten(self.deviation(measured, about), seen.values)
        size = self.log_size(about, measured)
        if size is None:
            return white
        return jnp.concatenate([white, size_residuals(size, self.log_size(measured, measured), self.valid)], axis=-1)

    def row_log_density(self, seen: Seen, measured: Float[Any, "recording time *reading"]) -> Float[Array, " time"]:
        about = self.expected(seen)
        white, scale = self.whiten(self.deviation(measured, about), seen.values)
        size = self.log_size(about, measured)
        normaliser = scale + 0.5 * jnp.log(2.0 * jnp.pi) + (0.0 if size is None else size)
        return jnp.sum(-0.5 * white**2 - jnp.where(self.valid, normaliser, 0.0), axis=(0, 2))


class WhiteSeries(Series):
    """A channel whose inferred noise is white with a single standard deviation."""

    size: ClassVar[ParameterSpec]  # standard deviation of an error

    @property
    def noise_specs(self) -> tuple[ParameterSpec, ...]:
        return (self.size,)

    @property
    def independent(self) -> bool:
        return self.known is None or super().independent

    def whiten_inferred(
        self, errors: Float[Any, "recording time column"], values: Mapping[str, Any]
    ) -> tuple[Float[Any, "recording time column"], Float[Any, "recording time column"]]:
        size = values[self.size.name]
        return jnp.where(self.valid, errors / size, 0.0), jnp.broadcast_to(jnp.log(size), errors.shape)

    def stated(self, values: Mapping[str, float], step: float) -> Autoregression:
        return Autoregression(np.full(self.valid.shape[-1], values[self.size.name]), np.ones(1), STATED, np.inf)


def padded_readings(
    trajectories: Sequence[Trajectory],
    length: int,
    needed: int | None,
    read: Callable[[Trajectory], tuple[np.ndarray, np.ndarray] | None],
    key: str,
    words: str,
) -> tuple[Float[np.ndarray, "recording time reading"], Bool[np.ndarray, "recording time reading"]]:
    """Readings of recordings and their mask, padded to ``length`` rows.

    Args:
        trajectories: the recordings.
        length: rows.
        needed: number of recordings, from the first, that must have readings; all by default.
        read: readings of one recording and their mask; None without readings.
        key: key of [model] that uses the readings as data; words: name of the readings.

    Raises:
        InputError: a recording lacks the readings.
    """
    parts: list[tuple[np.ndarray, ...]] = []
    for index, trajectory in enumerate(trajectories):
        own = read(trajectory)
        if own is not None:
            parts.append(tuple(np.pad(part, ((0, length - len(part)), (0, 0))) for part in own))
        elif needed is not None and index >= needed:
            parts.append(tuple(np.zeros_like(part) for part in parts[0]))
        else:
            remedy = f"leave [model] {key} = true out, or record them"
            raise InputError(f"has no {words}", where=trajectory.name, remedy=remedy)
    measured, valid = zip(*parts, strict=True)
    return np.stack(measured), np.stack(valid)


ABOVE_ZERO = 50.0  # larger than any logarithm of a ratio of sizes: keeps a root in `size_residuals` real


def size_residuals(
    size: Float[Any, "recording time column"],
    read: Float[Any, "recording time column"] | None,
    valid: Bool[np.ndarray, "recording time column"],
) -> Float[Any, "recording time column"]:
    """Residuals whose squares add to twice the logarithms of the sizes, up to a constant; zero if not valid.

    With these residuals the log likelihood is a sum of squares, plus terms of the noise alone, as Gauss-Newton
    requires.
    """
    return jnp.where(valid, jnp.sqrt(2.0 * (ABOVE_ZERO + size - (0.0 if read is None else read))), 0.0)


@runtime_checkable
class FeatureChannel(Protocol):
    """A channel that methods without a likelihood compare rollouts by: features in metres, side by side."""

    name: ClassVar[str]

    @property
    def feature_valid(self) -> Bool[np.ndarray, "recording time feature"]:
        """True for measured features."""

    def expected(self, seen: Seen) -> Float[Any, "recording time *reading"]:
        """Expected readings without noise."""

    def features(self, readings: Float[Any, "recording time *reading"]) -> Float[Any, "recording time feature"]:
        """Features of readings [m]."""

    def feature_deviation(self, values: Mapping[str, Any]) -> Float[np.ndarray, " feature"]:
        """Standard deviation of the features' noise [m]."""
