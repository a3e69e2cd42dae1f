"""Predictors of a new session without a model: its first row, earlier sessions with the same commands, and scaled
copies.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.data import Trajectory, command_openings, same_opening
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.report.baselines import BaselineErrors, Predictor, scored
from rfdropo_bayes.report.scores import MeasuredPath


def session_baselines(
    shown: Trajectory,
    tested: Sequence[Trajectory],
    earlier: Sequence[MeasuredPath],
    openings: Mapping[str, Mapping[str, str]],
) -> dict[str, BaselineErrors]:
    """Errors of predictions of a session without a model.

    Args:
        shown: the known part of the session.
        tested: the predicted part.
        earlier: fitted recordings.
        openings: first commands of each, see `command_openings`.
    """
    scaled = scaled_copy(shown, earlier, openings)
    predictors: dict[str, tuple[str, str, Predictor]] = {
        "first_row": (
            "first row of the session held",
            "the first known pose of the session, held constant",
            _held(shown),
        ),
        "copied": (
            "earlier sessions copied",
            "mean of the fitted recordings of the same commands at the same time",
            lambda recording: copied(recording, earlier, openings),
        ),
        "scaled_copy": (
            "earlier sessions copied and scaled",
            "the same copy, with a scale and a shift of each marker fitted to the known part of the session",
            scaled,
        ),
    }
    return {
        name: scored(name, title, description, predict, [shown], tested)
        for name, (title, description, predict) in predictors.items()
    }


def _held(shown: Trajectory) -> Predictor:
    first = np.argmax(shown.position_mask, axis=0)
    pose = shown.position[first, np.arange(shown.position.shape[1])]
    return lambda recording: np.broadcast_to(pose, recording.position.shape)


def copied(
    recording: Trajectory, earlier: Sequence[MeasuredPath], openings: Mapping[str, Mapping[str, str]]
) -> Float[np.ndarray, "time marker 3"]:
    """The mean of earlier recordings of the same commands, at the same time.

    Raises:
        InputError: no recording has the same commands, or none of these shows a marker.
    """
    own = command_openings(recording)
    alike = [path for path in earlier if same_opening(own, openings.get(path.name, {}))]
    if not alike:
        raise InputError("no fitted recording has the same commands", where=recording.name)
    mean = np.zeros(recording.position.shape)
    for column, marker in enumerate(recording.marker_names):
        seen = [p for p in alike if marker in p.marker_names and p.mask[:, p.marker_names.index(marker)].any()]
        if not seen:
            raise InputError(f"{marker} was lost in all fitted recordings with the same commands", where=recording.name)
        for path in seen:
            index = path.marker_names.index(marker)
            usable = path.mask[:, index]
            time, position = path.time[usable], path.position[usable, index]
            mean[:, column] += np.stack([np.interp(recording.time, time, axis) for axis in position.T], axis=-1)
        mean[:, column] /= len(seen)
    return mean


def scaled_copy(
    shown: Trajectory, earlier: Sequence[MeasuredPath], openings: Mapping[str, Mapping[str, str]]
) -> Predictor:
    """`copied`, with a scale and a shift of each marker by least squares on the known part of the session."""

    def predict(recording: Trajectory) -> Float[np.ndarray, "time marker 3"]:
        copy, scaled = copied(shown, earlier, openings), copied(recording, earlier, openings)
        for marker in range(scaled.shape[1]):
            rows = shown.position_mask[:, marker]
            there, here = copy[rows, marker], shown.position[rows, marker]
            middle, about = there.mean(axis=0), here.mean(axis=0)
            power = float(np.sum((there - middle) ** 2))
            scale = float(np.sum((there - middle) * (here - about))) / power if power > 0.0 else 1.0
            scaled[:, marker] = about + scale * (scaled[:, marker] - middle)
        return scaled

    return predict
