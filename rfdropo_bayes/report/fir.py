"""Finite-impulse-response regression: positions as a ridge regression on the recent commands and their powers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.data.sample_times import sample_time

SPANS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0)  # history that is looked at [s]
LAGS = 11  # at most, evenly spaced over the span


PENALTIES = 10.0 ** np.arange(-6.0, 1.5, 1.0)  # per row, of standardised features
BLOCKS = 5


@dataclass(frozen=True)
class FirRegression:
    """A trained regression."""

    lags: Float[np.ndarray, " lag"]  # ages of its input commands [s]
    degree: int  # highest power of a command
    # low, high: range of each feature in training; features are cut there, so that powers do not run away
    low: Float[np.ndarray, " feature"]
    high: Float[np.ndarray, " feature"]
    # centre, scale: constants that standardise the features
    centre: Float[np.ndarray, " feature"]
    scale: Float[np.ndarray, " feature"]
    offset: Float[np.ndarray, "marker 3"]  # mean pose
    weights: Float[np.ndarray, "marker feature 3"]  # weights of the standardised features
    error: float  # cross-validated root mean square distance, all markers [m]

    def predict(self, recording: Trajectory) -> Float[np.ndarray, "time marker 3"]:
        """Positions [m] from the commands alone."""
        features = np.clip(_features(recording, self.lags, self.degree), self.low, self.high)
        standard = (features - self.centre) / self.scale
        return self.offset + np.moveaxis(standard @ self.weights, 0, 1)


def fit_fir(fit: Sequence[Trajectory], groups: Sequence[Sequence[int]], *, degree: int) -> FirRegression:
    """Train on recordings; the span of the history and the penalty are chosen by cross-validation.

    One group of repeats is left out at a time, or one of `BLOCKS` stretches of time if all recordings share their
    commands.

    Args:
        fit: recordings.
        groups: indices of recordings with identical commands.
        degree: highest power of a command, 1 for a linear regression.
    """
    rows = [len(t.time) for t in fit]
    if len(groups) > 1:
        group_of = {index: number for number, group in enumerate(groups) for index in group}
        fold = np.concatenate([np.full(n, group_of[i]) for i, n in enumerate(rows)])
    else:
        fold = np.concatenate([np.arange(n) * BLOCKS // n for n in rows])
    step = sample_time(*(t.time for t in fit))
    trained = [_train(fit, fold, _lags(span, step), degree) for span in _distinct_spans(step)]
    return min(trained, key=lambda regression: regression.error)


def _distinct_spans(step: float) -> list[float]:
    """Spans that are the same at this sample time count once."""
    return list({tuple(np.round(_lags(span, step) / step)): span for span in reversed(SPANS)}.values())


def _lags(span: float, step: float) -> Float[np.ndarray, " lag"]:
    return np.unique(np.round(np.linspace(0.0, span, LAGS) / step)) * step


def _features(recording: Trajectory, lags: Float[np.ndarray, " lag"], degree: int) -> Float[np.ndarray, "time feature"]:
    time = recording.time
    history = recording.command_at((time[:, None] - lags[None]).reshape(-1)).reshape(len(time), -1)
    return np.concatenate([history**power for power in range(1, degree + 1)], axis=1)


def _train(
    fit: Sequence[Trajectory], fold: Int[np.ndarray, " row"], lags: Float[np.ndarray, " lag"], degree: int
) -> FirRegression:
    features = np.concatenate([_features(t, lags, degree) for t in fit])
    centre, deviation = features.mean(axis=0), features.std(axis=0)
    scale = np.where(
        deviation > 1e-12 * np.maximum(np.abs(centre), 1e-12), deviation, np.inf
    )  # constants weigh nothing
    standard = (features - centre) / scale
    position = np.concatenate([t.position for t in fit])
    mask = np.concatenate([t.position_mask for t in fit])
    alike = [(usable, np.flatnonzero((mask == usable[:, None]).all(axis=0))) for usable in np.unique(mask, axis=1).T]
    squares, total = np.zeros(len(PENALTIES)), 0
    for usable, markers in alike:  # one factorisation serves all markers that are usable in the same rows
        for number in np.unique(fold):
            tested, used = usable & (fold == number), usable & (fold != number)
            if tested.any() and used.any():
                offset, weights = _ridge(standard[used], position[used][:, markers], PENALTIES)
                predicted = offset[:, None] + (standard[tested] @ weights.reshape(*weights.shape[:2], -1)).reshape(
                    len(PENALTIES), -1, len(markers), 3
                )
                residual = position[tested][:, markers] - predicted
                squares += (residual**2).sum(axis=(1, 2, 3))
                total += int(tested.sum()) * len(markers)
    best = int(np.argmin(squares))
    offset, weights = np.zeros(position.shape[1:]), np.zeros((position.shape[1], standard.shape[1], 3))
    for usable, markers in alike:
        if usable.any():
            pose, slope = _ridge(standard[usable], position[usable][:, markers], PENALTIES[best : best + 1])
            offset[markers], weights[markers] = pose[0], np.moveaxis(slope[0], 0, 1)
    return FirRegression(
        lags,
        degree,
        features.min(axis=0),
        features.max(axis=0),
        centre,
        scale,
        offset,
        weights,
        float(np.sqrt(squares[best] / total)) if total else np.inf,
    )


def _ridge(
    features: Float[np.ndarray, "row feature"],
    position: Float[np.ndarray, "row marker 3"],
    penalties: Float[np.ndarray, " penalty"],
) -> tuple[Float[np.ndarray, "penalty marker 3"], Float[np.ndarray, "penalty feature marker 3"]]:
    """Offset and weights for every penalty, from one eigendecomposition of the normal equations.

    The offset takes up the mean of the features over these rows, and is not penalised.
    """
    rows, shape = len(features), position.shape[1:]
    shift, mean = features.mean(axis=0), position.mean(axis=0)
    centred, target = features - shift, (position - mean).reshape(rows, -1)
    values, vectors = np.linalg.eigh(centred.T @ centred / rows)
    projected = vectors.T @ (centred.T @ target) / rows
    shrunk = projected / (np.maximum(values, 0.0)[:, None] + penalties[:, None, None])
    weights = (vectors @ shrunk).reshape(len(penalties), features.shape[1], *shape)
    return mean - np.tensordot(weights, shift, axes=(1, 0)), weights
