"""Marker positions: the channel that every model has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from rfdropo_bayes.bayes.channels.channel import Seen, Series
from rfdropo_bayes.bayes.noise import (
    NOISE_CORRELATION_TIME,
    OBSERVATION_NOISE,
    Autoregression,
    Noise,
    Timeline,
    draw_noise,
    noise_specs,
    noise_values,
    row_log_density,
    whiten,
)
from rfdropo_bayes.bayes.noise.autoregression import STATED
from rfdropo_bayes.bayes.recordings import RecordingSet
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.parameters import ParameterSpec


@dataclass(frozen=True, kw_only=True)
class Markers(Series):
    """Positions of the markers [m], (recording, time, marker, 3); a column is one coordinate of one marker."""

    name: ClassVar[str] = "markers"
    linear: ClassVar[bool] = True
    recordings: RecordingSet  # recordings with these positions
    model: str = "auto"  # name of the noise model, one of `NOISE_MODELS`; of known noise its source

    @classmethod
    def gather(cls, recordings: RecordingSet, model: str, known: Autoregression | None = None) -> Markers:
        """The positions of recordings."""
        valid = np.repeat(np.asarray(recordings.line.valid), 3, axis=-1)
        return cls(np.asarray(recordings.position), valid, known, recordings=recordings, model=model)

    def like(self, recordings: RecordingSet) -> Markers:
        """The positions of other recordings, under the same noise.

        Raises:
            InputError: the noise is known, but not for all markers.
        """
        known = self.known
        if known is not None:
            known = noise_of_markers(known, self.recordings.markers, recordings).at(recordings.steps)
        return self.gather(recordings, self.model, known)

    def of_recordings(self, index: list[int], rows: int | None = None) -> Markers:
        readings, valid = self.readings[index, :rows], self.valid[index, :rows]
        recordings = self.recordings.of(index, rows)
        return replace(self, readings=readings, valid=valid, recordings=recordings, known=self.known_of(index))

    @property
    def noise_specs(self) -> tuple[ParameterSpec, ...]:
        return noise_specs(self.model)

    @property
    def independent(self) -> bool:
        return self.model == "white" if self.known is None else super().independent

    def expected(self, seen: Seen) -> Float[Any, "recording time marker 3"]:
        return seen.observation.position

    def deviation(
        self, measured: Float[Any, "recording time marker 3"], about: Float[Any, "recording time marker 3"]
    ) -> Float[Any, "recording time column"]:
        """See `Series.deviation`: a difference [m]."""
        return _flat(measured - about)

    def whiten_inferred(
        self, errors: Float[Any, "recording time column"], values: Mapping[str, Any]
    ) -> tuple[Float[Any, "recording time column"], Float[Any, "recording time column"]]:
        noise = noise_values(self.model, values)
        residual = errors.reshape(*errors.shape[:2], -1, 3)
        white, scale = jax.vmap(lambda r, line: whiten(r, noise, line))(residual, self.recordings.line)
        return _flat(white), jnp.repeat(jnp.log(scale), 3, axis=-1)

    def stated(self, values: Mapping[str, float], step: float) -> Autoregression:
        """See `Series.stated`: white noise, or correlated noise if there is a correlation time."""
        tau = values.get(NOISE_CORRELATION_TIME.name)
        memory = [] if tau is None else [float(np.exp(-step / tau))]
        scale = np.full(self.valid.shape[-1], values[OBSERVATION_NOISE.name])
        return Autoregression(scale, np.array([1.0, *memory]), STATED, np.inf, step=step)

    def draw_noise(
        self, key: PRNGKeyArray, time: Float[Array, " time"], values: Mapping[str, Any]
    ) -> Float[Array, "time marker 3"]:
        """A realisation of the noise in one recording [m]."""
        markers = self.readings.shape[2]
        if self.known is not None:
            return self.known.draw_rows(key, len(time), time).reshape(len(time), markers, 3)
        return draw_noise(key, time, markers, noise_values(self.model, values))

    def distribution(self, seen: Seen, index: int) -> dist.Distribution:
        """Numpyro distribution of the positions in one recording."""
        rows = int(self.recordings.rows[index])
        line = Timeline(*(part[index, :rows] for part in self.recordings.line))
        time = jnp.asarray(self.recordings.time[index, :rows])
        known = self.known_of([index])
        noise = known if known is not None else noise_values(self.model, seen.values)
        return PositionNoise(seen.observation.position[index, :rows], noise, time, line)

    @property
    def feature_valid(self) -> Bool[np.ndarray, "recording time feature"]:
        return self.valid

    def features(self, readings: Float[Any, "recording time marker 3"]) -> Float[Any, "recording time feature"]:
        """See `FeatureChannel`: coordinates of the markers."""
        return _flat(readings)

    def feature_deviation(self, values: Mapping[str, Any]) -> Float[np.ndarray, " feature"]:
        if self.known is not None:
            return self.known.scale
        return np.full(3 * self.readings.shape[2], float(noise_values(self.model, values).deviation))


def noise_of_markers(known: Autoregression, markers: Sequence[str], recordings: RecordingSet) -> Autoregression:
    """The part of a known noise for the markers of recordings.

    Raises:
        InputError: a marker whose noise is not known.
    """
    missing = [name for name in recordings.markers if name not in markers]
    if missing:
        raise InputError(
            f"the noise of marker {missing[0]!r} is not known",
            where=recordings.names[0],
            remedy="leave the marker out, or let the noise be inferred",
        )
    return known.of_columns([3 * list(markers).index(name) + axis for name in recordings.markers for axis in range(3)])


class PositionNoise(dist.Distribution):
    """Measured marker positions of one recording, given the simulated positions."""

    support = dist.constraints.independent(dist.constraints.real, 3)

    def __init__(
        self,
        position: Float[Array, "time marker 3"],
        noise: Noise | Autoregression,
        time: Float[Array, " time"],
        line: Timeline,
        *,
        validate_args: bool | None = None,
    ) -> None:
        self.position, self.noise, self.time, self.line = position, noise, time, line
        super().__init__((), position.shape, validate_args=validate_args)

    def sample(self, key: PRNGKeyArray, sample_shape: tuple[int, ...] = ()) -> Array:
        """Simulated positions plus one realisation of the noise."""
        keys = jax.random.split(key, int(np.prod(sample_shape)))
        if isinstance(self.noise, Autoregression):
            noise = jax.vmap(partial(self.noise.draw_rows, rows=len(self.time), time=self.time))(keys)
        else:
            draw = partial(draw_noise, time=self.time, markers=self.position.shape[1], noise=self.noise)
            noise = jax.vmap(draw)(keys)
        return self.position + noise.reshape(sample_shape + self.position.shape)

    def log_prob(self, value: Float[Array, "time marker 3"]) -> Float[Array, ""]:
        """Log density of all valid rows."""
        if isinstance(self.noise, Autoregression):
            valid = np.repeat(np.asarray(self.line.valid), 3, axis=-1)
            return jnp.sum(self.noise.row_log_density((value - self.position).reshape(1, len(value), -1), valid[None]))
        return jnp.sum(row_log_density(value - self.position, self.noise, self.line))


def _flat(series: Float[Any, "recording time marker 3"]) -> Float[Any, "recording time column"]:
    return series.reshape(*series.shape[:2], -1)
