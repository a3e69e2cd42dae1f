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

OPTIMISATION = LaplaceConfig(starts=1, prior_draws=8, blocks=1, max_steps=10, draws=200)  # from the optimum of all days
DRAWS = 100
OPENINGS = "command_openings"  # of each fitted recording, among the attributes of a posterior


class Days(NamedTuple):
    """The sessions of a fit.

    Attributes:
        model: fitted model; ``runs``: the recordings.
        start: starts of optimisations, the optimum first.
        predictions: predictions of the fitted recordings.
        left: residuals of the fitted recordings.
    """

    model: Model
    runs: Sequence[Trajectory]
    start: DrawsByOwner
    predictions: Sequence[RecordingPrediction]
    left: ModelError


def error_of_unseen_days(days: Days, key: jax.Array, *, show: bool | None = None) -> DayError | None:
    """The slow error of an unseen session; None for a model without sessions.

    Each session is left out of the fit once. The parameters are optimised again from the fit to all sessions, and
    predict the session from its commands and first rows. With a single session the result is the prior
    (`prior_day_error`). A session without which the others cannot be fitted is listed as missed.

    Args:
        days: sessions of the fit.
        key: random key of the draws.
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
    result = run(problem, "laplace", OPTIMISATION, fit_key)
    held = problem.holding(result.fixed)
    return predict_new(
        held.model,
        left_out,
        thin(result.draws, DRAWS),
        new_key,
        chunk=held.chunk,
        fitted=list(held.model.recordings.names),
        model_error=days.left,
        groups=model.spec.groups,
    ).recordings


def openings_of(runs: Sequence[Trajectory]) -> dict[str, dict[str, str]]:
    """First commands of each recording, by name; see `command_openings`."""
    return {recording.name: command_openings(recording) for recording in runs}


def of_unseen_days(
    recordings: Sequence[Trajectory],
    groups: Mapping[str, str | Sequence[str]],
    fitted: Sequence[str],
    openings: Mapping[str, Mapping[str, str]] | None,
) -> list[str]:
    """Names of recordings of unseen sessions, and of fitted sessions under commands with another beginning, to which
    parameters were not fitted.

    Args:
        recordings: recordings to predict.
        groups: patterns of the sessions.
        fitted: fitted sessions.
        openings: see `openings_of`; without them, only sessions are compared.
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
