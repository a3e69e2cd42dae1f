"""Scores of the predicted final position of a pushed object, as a distribution, compared with its repeats.

The energy score E|X - y| - E|X - X'| / 2 of a predicted distribution X and an outcome y is smallest in expectation for
the true distribution (Gneiting and Raftery 2007, eq. 21), and the distance |x - y| if X is a point. Contact is chaotic,
so that no point prediction is possible. Both expectations are unbiased averages over draws, so that ensembles of
different sizes compare (Ferro 2014).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.distance import cdist, pdist

from rfdropo_bayes.data import Trajectory, group_repeats
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.posteriors import RecordingPrediction
from rfdropo_bayes.report.scores import FINAL_ROWS, MILLIMETRES


@dataclass(frozen=True)
class ObjectScore:
    """Scores of the final position of one recording's object."""

    energy_score_mm: float  # energy score of the predictive draws
    error_mm: float  # distance of their mean from the object's final position
    # energy score of the other repeats of the same commands, mean over leave-one-out; None with fewer than three
    repeats_mm: float | None
    held_mm: float  # distance between its first and final position, the score of predicting no motion


def energy_score(draws: Float[np.ndarray, "n d"], outcome: Float[np.ndarray, " d"]) -> float:
    """Energy score of a sample of at least two draws, in their unit.

    Raises:
        InputError: fewer than two draws.
    """
    if len(draws) < 2:
        raise InputError("a single draw is not a distribution", where="energy score", remedy="give two or more")
    return float(np.mean(cdist(draws, outcome[None])) - 0.5 * np.mean(pdist(draws)))


def final_position(pose: Float[np.ndarray, "... time 7"]) -> Float[np.ndarray, "... 3"]:
    """Mean position [m] over the last `FINAL_ROWS` rows; rows that were not seen do not count."""
    return np.nanmean(pose[..., -FINAL_ROWS:, :3], axis=-2)


def score_objects(
    predictions: Sequence[RecordingPrediction], trajectories: Sequence[Trajectory]
) -> dict[str, ObjectScore]:
    """Scores of every predicted recording whose object was measured, the repeats taken from all trajectories."""
    seen = [t for t in trajectories if t.object_pose is not None and np.isfinite(t.object_pose[-FINAL_ROWS:]).any()]
    ended = {t.name: final_position(np.asarray(t.object_pose)) for t in seen}
    repeats: dict[str, float | None] = {}
    for group in group_repeats(seen):
        ends = np.stack([ended[seen[index].name] for index in group])
        alone = [energy_score(np.delete(ends, i, axis=0), ends[i]) for i in range(len(ends))] if len(ends) > 2 else []
        for index in group:
            repeats[seen[index].name] = MILLIMETRES * float(np.mean(alone)) if alone else None
    start = {t.name: np.asarray(t.object_pose)[0, :3] for t in seen}
    object_scores = {}
    for prediction in predictions:
        if prediction.object_pose is None or prediction.name not in ended:
            continue
        draws, outcome = final_position(prediction.object_pose), ended[prediction.name]
        object_scores[prediction.name] = ObjectScore(
            MILLIMETRES * energy_score(draws, outcome),
            MILLIMETRES * float(np.linalg.norm(draws.mean(axis=0) - outcome)),
            repeats[prediction.name],
            MILLIMETRES * float(np.linalg.norm(start[prediction.name] - outcome)),
        )
    return object_scores
