"""The error of a model on a day that it was not fitted to, found by leaving days out of its fit in turn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

import jax
import numpy as np

from rfdropo_bayes.data import Trajectory, command_openings, same_opening
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.groups import gather_groups, group_of, whole
from rfdropo_bayes.inference.methods import run
from rfdropo_bayes.inference.modes.mode_search import LaplaceConfig
from rfdropo_bayes.inference.progress import Progress
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.posteriors import DrawsByOwner, RecordingPrediction
from rfdropo_bayes.prediction.day_error import DayError, day_error, prior_day_error
from rfdropo_bayes.prediction.model_error import ModelError
from rfdropo_bayes.prediction.predictive import predict_new, thin

CLIMB = LaplaceConfig(starts=1, screen=8, blocks=1, max_steps=10, draws=200)  # from the optimum of all days
DRAWS = 100
OPENINGS = "command_openings"  # of each fitted recording, among the attributes of a posterior


class Days(NamedTuple):
    """The days of a fit.

    Attributes:
        model: what was fitted; ``runs``: the recordings.
        start: values that climbs start from, the optimum first.
        predictions: of the fitted recordings.
        left: what the model left of them.
    """

    model: Model
    runs: Sequence[Trajectory]
    start: DrawsByOwner
    predictions: Sequence[RecordingPrediction]
    left: ModelError


def error_of_unseen_days(days: Days, key: jax.Array, *, show: bool | None = None) -> DayError | None:
    """The slow error of a day that no fit has seen; None for a model without days.

    Each day's recordings are left out of the fit once. The parameters climb anew, from where all days put them, and
    predict the day from its commands and first rows. With one day alone it is the prior (`prior_day_error`); a day
    that the others cannot be fitted without is named as missed.

    Args:
        days: of the fit.
        key: of the draws.
        show: whether to show progress, see `Progress`.
    """
    spec = days.model.spec
    if not spec.groups or not spec.per_group:
        return None
    prior = prior_day_error(days.left, days.predictions)
    groups = gather_groups([recording.name for recording in days.runs], spec.groups)
    if len(groups) < 2:
        return prior
    found: dict[str, list[RecordingPrediction]] = {}
    with Progress("days left out", show=show) as progress:
        for number, (group, members) in enumerate(groups.items()):
            # The fit is done and must not be lost.
            with suppress(InputError, np.linalg.LinAlgError):
                found[group] = _without(days, members, jax.random.fold_in(key, number))
            progress.stage((number + 1) / len(groups))
    return day_error(prior, found)._replace(missed=tuple(group for group in groups if group not in found))


def _without(days: Days, members: Sequence[str], key: jax.Array) -> list[RecordingPrediction]:
    """Predictions of the recordings of a day by a fit to all others."""
    model = days.model
    kept = [recording for recording in days.runs if recording.name not in members]
    left_out = [recording for recording in days.runs if recording.name in members]
    problem = model.problem(kept, days.start)
    fit_key, new_key = jax.random.split(key)
    result = run(problem, "laplace", CLIMB, fit_key)
    held = problem.holding(result.held)
    return predict_new(
        held.model,
        left_out,
        thin(result.draws, DRAWS),
        new_key,
        chunk=held.chunk,
        fitted=list(held.model.recordings.names),
        left=days.left,
        groups=model.spec.groups,
    ).recordings


def openings_of(runs: Sequence[Trajectory]) -> dict[str, dict[str, str]]:
    """How the commands of each recording begin, by name; see `command_openings`."""
    return {recording.name: command_openings(recording) for recording in runs}


def of_unseen_days(
    recordings: Sequence[Trajectory],
    groups: Mapping[str, str | Sequence[str]],
    fitted: Sequence[str],
    openings: Mapping[str, Mapping[str, str]] | None,
) -> list[str]:
    """Names of recordings of days that no fit has seen, and of those that show a fitted day under commands that begin
    otherwise than its own: what parameters could follow there, they did not follow.

    Args:
        recordings: to be predicted.
        groups: patterns of the days.
        fitted: days that were fitted.
        openings: see `openings_of`; of a posterior that does not say, the days alone count.
    """
    known = {whole(name) for name in openings or {}}
    found = []
    for recording in recordings:
        day = group_of(recording.name, groups)
        if day in fitted and (openings is None or whole(recording.name) in known):
            continue
        own = command_openings(recording)
        seen = (begun for name, begun in (openings or {}).items() if group_of(name, groups) == day)
        if day not in fitted or not any(same_opening(own, begun) for begun in seen):
            found.append(recording.name)
    return found
