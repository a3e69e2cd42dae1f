"""What was measured, with repeats of one command sequence joined: their mean is fitted, their spread is noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.noise.autoregression import REPEATS, RESIDUALS, Autoregression, estimate_noise
from rfdropo_bayes.bayes.noise.repeat_shifts import repeat_shift
from rfdropo_bayes.bayes.recordings import RecordingSet
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.data.repeats import group_repeats

CLOCKS_AGREE = 0.1  # of a sample time: what the clocks of repeats may differ by


@dataclass(frozen=True)
class Measurements:
    """Recordings as groups of repeats; a channel is one coordinate of one marker.

    Attributes:
        names: of the first recording of each group.
        members: indices of the recordings in each group.
        time: of each row [s].
        position: mean over the repeats [m]; zero where nothing is valid.
        count: valid repeats behind each value.
        single: every recording on its own; single_valid: what may be used of it.
        apart: recordings that repeat the commands of another one and are not joined with it, as their rows or clocks
            differ.
    """

    names: tuple[str, ...]
    members: tuple[tuple[int, ...], ...]
    time: Float[np.ndarray, "group time"]
    position: Float[np.ndarray, "group time channel"]
    count: Float[np.ndarray, "group time channel"]
    single: Float[np.ndarray, "recording time channel"]
    single_valid: np.ndarray
    apart: tuple[str, ...] = ()

    @property
    def valid(self) -> np.ndarray:
        """Where there is a value."""
        return self.count > 0

    @property
    def has_repeats(self) -> bool:
        """Whether any command sequence was carried out twice."""
        return any(len(group) > 1 for group in self.members)

    def whiten(self, residual: np.ndarray, noise: Autoregression) -> Float[np.ndarray, "*batch n"]:
        """Residuals (..., group, time, channel) of the means as independent unit normals, flattened."""
        white = noise.separate(noise.innovations(residual, self.valid) * np.sqrt(self.count), self.valid)
        return white.reshape(*residual.shape[:-3], int(np.prod(residual.shape[-3:])))

    def mean_of(self, single: Float[np.ndarray, "recording time channel"]) -> Float[np.ndarray, "group time channel"]:
        """Mean over the repeats of series like the recordings."""
        return np.stack([self._mean(single, group) for group in self.members])

    def _mean(self, single: np.ndarray, group: tuple[int, ...]) -> np.ndarray:
        chosen, valid = single[list(group)], self.single_valid[list(group)]
        return np.where(valid, chosen, 0.0).sum(axis=0) / np.maximum(valid.sum(axis=0), 1)

    def deviations(self, single: Float[np.ndarray, "recording time channel"]) -> tuple[np.ndarray, np.ndarray, float]:
        """Repeats about their means, which of them count, and their degrees of freedom per value."""
        parts, valid, freedom, values = [], [], 0.0, 0
        for group in self.members:
            if len(group) > 1:
                own = self.single_valid[list(group)]
                own = own & (own.sum(axis=0) > 1)
                parts.append(np.where(own, single[list(group)] - self._mean(single, group), 0.0))
                valid.append(own)
                freedom += own.sum() * (1.0 - 1.0 / len(group))
                values += int(own.sum())
        return np.concatenate(parts), np.concatenate(valid), freedom / max(values, 1)

    @property
    def shift(self) -> float | None:
        """See `repeat_shift`; None without repeats."""
        return repeat_shift(*self.deviations(self.single)) if self.has_repeats else None

    def noise(
        self, residual: Float[np.ndarray, "recording time channel"], parameters: int, like: Autoregression | None = None
    ) -> Autoregression:
        """Noise from repeats where there are any, else from what a model leaves, of whose correlation between channels
        nothing says how much is noise: a discrepancy moves them together, too.

        Args:
            residual: recordings less what a model predicts for each.
            parameters: fitted by that model.
            like: an earlier estimate, whose order, pooling and sharing are kept.
        """
        order = None if like is None else like.order
        shared = None if like is None else like.correlation is not None
        pooled = None if like is None else bool(np.ptp(like.scale) == 0.0)
        if self.has_repeats:
            return estimate_noise(*self.deviations(residual), source=REPEATS, order=order, pooled=pooled, shared=shared)
        share = max(1.0 - parameters / max(self.single_valid.sum(), 1), 0.1)
        return estimate_noise(residual, self.single_valid, share, source=RESIDUALS, order=order, pooled=pooled)


def gather_measurements(recordings: RecordingSet, trajectories: Sequence[Trajectory], join: bool) -> Measurements:
    """Group recordings with identical commands.

    Args:
        recordings: the trajectories on the simulator's clock.
        trajectories: the same, as recorded.
        join: whether repeats may be joined; False where parameters differ from recording to recording.
    """
    count = len(trajectories)
    groups = _groups(recordings, trajectories) if join else [(index,) for index in range(count)]
    position = recordings.position.reshape(*recordings.position.shape[:2], -1)
    valid = np.repeat(np.asarray(recordings.line.valid), 3, axis=-1)
    measurements = Measurements(
        tuple(recordings.names[group[0]] for group in groups),
        tuple(groups),
        np.stack([recordings.time[group[0]] for group in groups]),
        np.zeros((0,)),
        np.stack([valid[list(group)].sum(axis=0).astype(float) for group in groups]),
        position,
        valid,
        _apart(recordings, trajectories, groups) if join else (),
    )
    object.__setattr__(measurements, "position", measurements.mean_of(position))
    return measurements


def _apart(
    recordings: RecordingSet, trajectories: Sequence[Trajectory], groups: Sequence[tuple[int, ...]]
) -> tuple[str, ...]:
    firsts = {group[0] for group in groups}
    repeats = [index for found in group_repeats(trajectories) for index in found[1:]]
    return tuple(recordings.names[index] for index in repeats if index in firsts)


def _groups(recordings: RecordingSet, trajectories: Sequence[Trajectory]) -> list[tuple[int, ...]]:
    groups: list[tuple[int, ...]] = []
    for found in group_repeats(trajectories):
        kept: list[list[int]] = []
        for index in found:
            for group in kept:
                first = group[0]
                step = trajectories[first].dataset.attrs["sample_time"]
                same = recordings.rows[first] == recordings.rows[index]
                if same and np.abs(recordings.time[first] - recordings.time[index]).max() < CLOCKS_AGREE * step:
                    group.append(index)
                    break
            else:
                kept.append([index])
        groups += [tuple(group) for group in kept]
    return groups
