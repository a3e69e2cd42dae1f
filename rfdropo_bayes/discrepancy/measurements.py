"""Measurements with repeats of a command sequence joined: their mean is fitted, their spread is noise."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from rfdropo_bayes.bayes.channels import Channel, Series, WeighedParts
from rfdropo_bayes.bayes.noise.autoregression import REPEATS, RESIDUALS, estimate_noise, steps_of
from rfdropo_bayes.bayes.noise.stacked import Stacked, side_by_side
from rfdropo_bayes.bayes.recordings import RecordingSet
from rfdropo_bayes.bayes.repeat_noise import (
    Groups,
    departures_from_mean,
    deviations,
    group_recordings,
    mean_error,
    mean_of,
    repeat_shift,
    repeated,
    repeats_apart,
)
from rfdropo_bayes.data import Trajectory


@dataclass(frozen=True)
class Measurements:
    """Recordings as groups of repeats; columns are of all channels side by side, the markers' first."""

    names: tuple[str, ...]  # name of the first recording of each group
    members: Groups  # indices of the recordings in each group
    time: Float[np.ndarray, "group time"]  # time of each row [s]
    channels: tuple[Series, ...]  # channels with means over the repeats
    single: tuple[Series, ...]  # channels with every recording separate
    weighed: WeighedParts | None  # weighed parts; None without
    count: Float[np.ndarray, "group time column"]  # number of valid repeats of each value
    # every recording less the mean of its group, in the unit of the noise
    departures: Float[np.ndarray, "recording time column"]
    # recordings that repeat commands of another recording but are not joined with it, as their rows or clocks differ
    apart: tuple[str, ...] = ()

    @property
    def valid(self) -> Bool[np.ndarray, "group time column"]:
        """Mask of existing values."""
        return self.count > 0

    @property
    def steps(self) -> Float[np.ndarray, " group"]:
        """Time between rows of each group [s]."""
        return steps_of(self.time)

    @property
    def single_steps(self) -> Float[np.ndarray, " recording"]:
        """Time between rows of each recording [s]."""
        steps = np.empty(len(self.single_valid))
        for group, step in zip(self.members, self.steps, strict=True):
            steps[list(group)] = step
        return steps

    @property
    def single_valid(self) -> Bool[np.ndarray, "recording time column"]:
        """Mask of usable values of each recording."""
        return np.concatenate([channel.valid for channel in self.single], axis=-1)

    @property
    def markers(self) -> int:
        """Number of columns that are coordinates of markers."""
        return self.channels[0].valid.shape[-1]

    @property
    def size(self) -> int:
        """Number of residuals."""
        return self.count.size + (0 if self.weighed is None else len(self.weighed.entries))

    @property
    def has_repeats(self) -> bool:
        """Whether any command sequence was carried out twice."""
        return any(len(group) > 1 for group in self.members)

    @property
    def names_of_channels(self) -> tuple[str, ...]:
        """Names of the data channels."""
        further: tuple[Channel, ...] = () if self.weighed is None else (self.weighed,)
        return tuple(channel.name for channel in (*self.channels, *further))

    def series(self, white: Float[np.ndarray, "*batch n"]) -> Float[np.ndarray, "*batch group time column"]:
        """Residuals of the channels that have rows."""
        return white[..., : self.count.size].reshape(*white.shape[:-1], *self.count.shape)

    def whiten(
        self, errors: Float[np.ndarray, "*batch group time column"], noise: Stacked
    ) -> Float[np.ndarray, "*batch n"]:
        """Errors of the means as independent unit normals, flattened."""
        return noise.at(self.steps).whiten(errors, self.valid, self.count).reshape(*errors.shape[:-3], self.count.size)

    def mean_of(
        self, single: Float[np.ndarray, "*batch recording time column"]
    ) -> Float[np.ndarray, "*batch group time column"]:
        """Mean over repeats of errors of single recordings."""
        return mean_error(single, self.single_valid, self.members)

    def deviations(self, errors: Float[np.ndarray, "recording time column"]) -> tuple[np.ndarray, np.ndarray, float]:
        """See `repeats.deviations`."""
        return deviations(errors, self.single_valid, self.members)

    @property
    def shift(self) -> float | None:
        """See `repeat_shift`, of the markers; None without repeats."""
        if not self.has_repeats:
            return None
        deviations, valid, share = self.deviations(self.departures)
        steps = self.single_steps[repeated(self.members)]
        return repeat_shift(deviations[..., : self.markers], valid[..., : self.markers], share, steps)

    def noise(
        self, errors: Float[np.ndarray, "recording time column"], parameters: int, like: Stacked | None = None
    ) -> Stacked:
        """Noise from repeats if there are any, else from a model's residuals. Their correlation between columns is not
        used, since a discrepancy also correlates them.

        Args:
            errors: recordings less a model's predictions.
            parameters: number of fitted parameters of that model.
            like: an earlier estimate, whose order, pooling and sharing are kept.
        """
        departures, valid, steps = errors, self.single_valid, self.single_steps
        share, source = max(1.0 - parameters / max(valid.sum(), 1), 0.1), RESIDUALS
        if self.has_repeats:
            (departures, valid, share), source = self.deviations(errors), REPEATS
            steps = steps[repeated(self.members)]
        estimates = []
        for index, own in enumerate(self.columns):
            model = None if like is None else like.parts[index]
            shared = False if source == RESIDUALS else (None if model is None else model.correlation is not None)
            order, pooled = (None, None) if model is None else (model.order, bool(np.ptp(model.scale) == 0.0))
            estimates.append(
                estimate_noise(
                    departures[..., own],
                    valid[..., own],
                    share,
                    source=source,
                    steps=steps,
                    order=order,
                    pooled=pooled,
                    shared=shared,
                )
            )
        return Stacked(tuple(estimates))

    @property
    def columns(self) -> list[slice]:
        """Columns of each channel."""
        return side_by_side([channel.valid.shape[-1] for channel in self.channels])


def gather_measurements(
    recordings: RecordingSet,
    channels: Sequence[Channel],
    repeats: Sequence[Trajectory] = (),
    kinds: Sequence[Hashable] | None = None,
) -> Measurements:
    """Group recordings with identical commands.

    Args:
        recordings: recordings on the simulator's clock.
        channels: their channels.
        repeats: the same recordings as recorded; empty to join none.
        kinds: kind of each recording by its parameters; recordings of different kinds are not repeats; equal by
            default.
    """
    groups: Groups = tuple((index,) for index in range(len(recordings.names)))
    apart: tuple[str, ...] = ()
    if repeats:
        groups = group_recordings(recordings, repeats)
        apart = repeats_apart(recordings, repeats, groups)
        groups = _of_one_kind(groups, kinds or [None] * len(recordings.names))
    single = tuple(channel for channel in channels if isinstance(channel, Series))
    firsts, joined = [group[0] for group in groups], []
    for channel in single:
        counted = np.stack([channel.valid[list(group)].any(axis=0) for group in groups])
        joined.append(replace(channel.of_recordings(firsts), readings=mean_of(channel, groups), valid=counted))
    count = [np.stack([c.valid[list(group)].sum(axis=0).astype(float) for group in groups]) for c in single]
    return Measurements(
        tuple(recordings.names[index] for index in firsts),
        groups,
        recordings.time[firsts],
        tuple(joined),
        single,
        next((channel for channel in channels if isinstance(channel, WeighedParts)), None),
        np.concatenate(count, axis=-1),
        np.concatenate([departures_from_mean(channel, groups) for channel in single], axis=-1),
        apart,
    )


def _of_one_kind(groups: Groups, kinds: Sequence[Hashable]) -> Groups:
    """Groups of repeats, split if their recordings have different parameters."""
    groups_by_kind: dict[tuple[int, Hashable], tuple[int, ...]] = {}
    for number, group in enumerate(groups):
        for index in group:
            key = (number, kinds[index])
            groups_by_kind[key] = (*groups_by_kind.get(key, ()), index)
    return tuple(groups_by_kind.values())
