"""Repeats, recordings of the same commands: their groups, means, noise and constant shifts: a different frame or start
of a repeat is not noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import chi2

from rfdropo_bayes.bayes.channels import Series
from rfdropo_bayes.bayes.noise.autoregression import REPEATS, Autoregression, estimate_noise
from rfdropo_bayes.bayes.recordings import RecordingSet
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.data.repeats import group_repeats
from rfdropo_bayes.errors import InputError

CLOCKS_AGREE = 0.1  # of a sample time: largest difference of the clocks of repeats
SURE = 1e-4  # p-value under the noise within recordings, below which shifts are there
LEAST = 0.5  # of the noise's standard deviation: smaller differences change no conclusion
ROWS = 10  # fewer rows do not distinguish a constant from slow noise

Groups = tuple[tuple[int, ...], ...]  # indices of the recordings in each group of repeats


def group_recordings(recordings: RecordingSet, trajectories: Sequence[Trajectory]) -> Groups:
    """Recordings with the same commands, rows and clock."""
    groups: list[tuple[int, ...]] = []
    for repeats in group_repeats(trajectories):
        kept: list[list[int]] = []
        for index in repeats:
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
    return tuple(groups)


def repeats_apart(recordings: RecordingSet, trajectories: Sequence[Trajectory], groups: Groups) -> tuple[str, ...]:
    """Recordings that repeat commands of another recording but are not grouped with it, as rows or clocks differ."""
    firsts = {group[0] for group in groups}
    repeats = [index for repeated_by in group_repeats(trajectories) for index in repeated_by[1:]]
    return tuple(recordings.names[index] for index in repeats if index in firsts)


def mean_of(channel: Series, groups: Groups) -> Float[np.ndarray, "group time *reading"]:
    """Mean of a channel's readings over each group."""
    readings = np.asarray(channel.measured)
    return np.stack([channel.mean(readings[list(group)], channel.valid[list(group)]) for group in groups])


def departures_from_mean(channel: Series, groups: Groups) -> Float[np.ndarray, "recording time column"]:
    """Each recording minus the mean of its group, in the unit of the noise; zero if not valid."""
    readings = np.asarray(channel.measured)
    about = np.empty_like(readings)
    for group, mean in zip(groups, mean_of(channel, groups), strict=True):
        about[list(group)] = mean
    return np.where(channel.valid, np.asarray(channel.deviation(readings, about)), 0.0)


def mean_error(
    errors: Float[np.ndarray, "*batch recording time column"],
    valid: Bool[np.ndarray, "recording time column"],
    groups: Groups,
) -> Float[np.ndarray, "*batch group time column"]:
    """Mean of errors over each group, zero if none is valid."""
    means = []
    for group in groups:
        own, index = valid[list(group)], list(group)
        total = np.where(own, errors[..., index, :, :], 0.0).sum(axis=-3)
        means.append(total / np.maximum(own.sum(axis=0), 1))
    return np.stack(means, axis=-3)


def deviations(
    errors: Float[np.ndarray, "recording time column"], valid: Bool[np.ndarray, "recording time column"], groups: Groups
) -> tuple[Float[np.ndarray, "repeat time column"], Bool[np.ndarray, "repeat time column"], float]:
    """Deviations of repeats from their means, a mask of valid values, and degrees of freedom per value."""
    parts, counted, freedom, values = [], [], 0.0, 0
    for group, mean in zip(groups, mean_error(errors, valid, groups), strict=True):
        if len(group) > 1:
            own = valid[list(group)]
            own = own & (own.sum(axis=0) > 1)
            parts.append(np.where(own, errors[list(group)] - mean, 0.0))
            counted.append(own)
            freedom += own.sum() - own.any(axis=0).sum()  # a mean for each row and column that has values
            values += int(own.sum())
    return np.concatenate(parts), np.concatenate(counted), freedom / max(values, 1)


def repeated(groups: Groups) -> list[int]:
    """Indices of the recordings that were repeated, in the order in which `deviations` has them."""
    return [index for group in groups if len(group) > 1 for index in group]


def with_noise_of_repeats(channel: Series, groups: Groups, steps: Float[np.ndarray, " recording"]) -> Series:
    """The channel under the noise between its repeats, in recordings with ``steps`` seconds between rows.

    Raises:
        InputError: nothing was repeated.
    """
    return replace(channel, known=noise_of_repeats(channel, groups, steps).at(steps))


def noise_of_repeats(channel: Series, groups: Groups, steps: Float[np.ndarray, " recording"]) -> Autoregression:
    """The noise that the repeats of a channel differ by.

    Raises:
        InputError: nothing was repeated.
    """
    if all(len(group) == 1 for group in groups):
        raise InputError(
            "no command sequence was carried out twice",
            where='[model] noise = "repeats"',
            remedy="repeat one, or let the noise be inferred",
        )
    departures = deviations(departures_from_mean(channel, groups), channel.valid, groups)
    return estimate_noise(*departures, source=REPEATS, steps=steps[repeated(groups)], shared=None)


def repeat_shift(
    deviations: Float[np.ndarray, "series time column"],
    valid: Bool[np.ndarray, "series time column"],
    share: float,
    steps: Float[np.ndarray, " series"],
) -> float | None:
    """Root mean square distance of a marker that constants, one for each repeat and column, make [m].

    The noise within recordings is an autoregression, which predicts the variance of recordings' means; the observed
    variance is a chi-squared multiple of it. Noise that is nearly constant within a recording counts as a constant.

    Args:
        deviations: deviations of repeats from their mean.
        valid: mask of usable values.
        share: degrees of freedom per value.
        steps: time between rows of each repeat [s].

    Returns:
        None if the noise within the recordings explains all or nearly all of the difference.
    """
    rows = valid.sum(axis=1, keepdims=True)
    if rows.max(initial=0) < ROWS:
        return None
    mean = np.where(valid, deviations, 0.0).sum(axis=1, keepdims=True) / np.maximum(rows, 1)
    within = np.where(valid, deviations - mean, 0.0)
    noise = estimate_noise(within, valid, share, source=REPEATS, steps=steps, shared=None)
    known = rows[:, 0] > 0
    predicted = np.stack(
        [_variance_of_mean(noise.resampled(step), int(own.max())) for step, own in zip(steps, rows[:, 0], strict=True)]
    )
    white = noise.separate(mean[:, 0] / np.sqrt(predicted), known)
    freedom = known.sum() * share
    if chi2.sf(np.sum(white[known] ** 2), freedom) > SURE:
        return None
    excess = float(np.sum(mean[:, 0] ** 2 * known)) / freedom - float(np.mean(predicted[known]))
    return float(np.sqrt(3.0 * excess)) if excess > LEAST**2 * float(np.mean(noise.scale**2)) else None


def _variance_of_mean(noise: Autoregression, rows: int) -> Float[np.ndarray, " column"]:
    """Variance of the mean of ``rows`` successive rows of the process."""
    memory = np.zeros(rows)
    memory[: len(noise.autocorrelation)] = noise.autocorrelation[:rows]
    coefficients = noise.predictors[0][-1][: noise.order]
    for lag in range(len(noise.autocorrelation), rows):
        memory[lag] = coefficients @ memory[lag - 1 : lag - 1 - noise.order : -1] if noise.order else 0.0
    weight = (rows - np.arange(rows)) / rows**2
    return noise.scale**2 * (weight[0] + 2.0 * float(weight[1:] @ memory[1:]))
