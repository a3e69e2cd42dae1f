"""The error of a model on a session that it was not fitted to, found by leaving sessions out of its fit in turn."""

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
from rfdropo_bayes.prediction.model_error import ModelError
from rfdropo_bayes.prediction.predictive import predict_new, thin
from rfdropo_bayes.prediction.session_error import SessionError, prior_session_error, session_error

OPTIMISATION = LaplaceConfig(starts=1, prior_draws=8, blocks=1, max_steps=10, draws=200)  # from the common optimum
DRAWS = 100
OPENINGS = "command_openings"  # of each fitted recording, among the attributes of a posterior


class Sessions(NamedTuple):
    """The sessions of a fit.

    Attributes:
        model: fitted model; ``runs``: the recordings.
        start: starts of optimisations, the optimum first.
        predictions: predictions of the fitted recordings.
        model_error: residuals of the fitted recordings.
    """

    model: Model
    runs: Sequence[Trajectory]
    start: DrawsByOwner
    predictions: Sequence[RecordingPrediction]
    model_error: ModelError


def error_of_unseen_sessions(sessions: Sessions, key: jax.Array, *, show: bool | None = None) -> SessionError | None:
    """The slow error of an unseen session; None for a model without sessions.

    Each session is left out of the fit once. The parameters are optimised again from the fit to all sessions, and
    predict the session from its commands and first rows. With a single session the result is the prior
    (`prior_session_error`). A session without which the others cannot be fitted is listed as missed.

    Args:
        sessions: sessions of the fit.
        key: random key of the draws.
        show: whether to show progress, see `Progress`.
    """
    spec = sessions.model.spec
    if not spec.groups or not spec.per_group:
        return None
    prior = prior_session_error(sessions.model_error, sessions.predictions)
    groups = gather_groups([recording.name for recording in sessions.runs], spec.groups)
    if len(groups) < 2:
        return prior
    predictions: dict[str, list[RecordingPrediction]] = {}
    with Progress("sessions left out", show=show) as progress:
        for number, (group, members) in enumerate(groups.items()):
            # The fit is done and must not be lost.
            with suppress(InputError, np.linalg.LinAlgError):
                predictions[group] = _without(sessions, members, jax.random.fold_in(key, number))
            progress.stage((number + 1) / len(groups))
    return session_error(prior, predictions)._replace(
        missed=tuple(group for group in groups if group not in predictions)
    )


def _without(sessions: Sessions, members: Sequence[str], key: jax.Array) -> list[RecordingPrediction]:
    """Predictions of the recordings of a session by a fit to all others."""
    model = sessions.model
    kept = [recording for recording in sessions.runs if recording.name not in members]
    left_out = [recording for recording in sessions.runs if recording.name in members]
    problem = model.problem(kept, sessions.start)
    fit_key, new_key = jax.random.split(key)
    result = run(problem, "laplace", OPTIMISATION, fit_key)
    fixed = problem.holding(result.fixed)
    return predict_new(
        fixed.model,
        left_out,
        thin(result.draws, DRAWS),
        new_key,
        chunk=fixed.chunk,
        fitted=list(fixed.model.recordings.names),
        model_error=sessions.model_error,
        groups=model.spec.groups,
    ).recordings


def openings_of(runs: Sequence[Trajectory]) -> dict[str, dict[str, str]]:
    """First commands of each recording, by name; see `command_openings`."""
    return {recording.name: command_openings(recording) for recording in runs}


def of_unseen_sessions(
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
    names = []
    for recording in recordings:
        session = group_of(recording.name, groups)
        if session in fitted and (openings is None or whole(recording.name) in known):
            continue
        own = command_openings(recording)
        seen = (begun for name, begun in (openings or {}).items() if group_of(name, groups) == session)
        if session not in fitted or not any(same_opening(own, begun) for begun in seen):
            names.append(recording.name)
    return names
