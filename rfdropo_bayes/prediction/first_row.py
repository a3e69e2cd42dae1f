"""Conditioning of parameters on the first row of a recording.

`match_first_row` fits the parameters of a recording or a new group to the row. `resampled_by_first_row` resamples draws
for recordings of a fitted group: nothing is free, but some draws fit the row better.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import jax
import numpy as np
from blackjax.smc import resampling
from jaxtyping import Float, Int, PRNGKeyArray
from scipy.special import softmax
from scipy.stats import chi2

from rfdropo_bayes.bayes.calibration_problem import CalibrationProblem
from rfdropo_bayes.bayes.channels.object_pose import OFFSETS
from rfdropo_bayes.bayes.inferred_parameter import InferredParameter
from rfdropo_bayes.bayes.recordings import RecordingSet
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference.smc.tempering import next_step
from rfdropo_bayes.posteriors import RecordingPrediction
from rfdropo_bayes.prediction.model_error import ModelError
from rfdropo_bayes.prediction.own_fit import fit_own

SMALLEST_ERROR = 1e-6  # [m]
LEAST_SHARE = 0.1  # of the draws: a row that leaves fewer shows a wrong model, not the right draw
SURE = 0.95  # probability of a smaller residual under the stated error, above which the error is taken as larger

Batch = dict[str, Float[np.ndarray, " n"]]


def match_first_row(
    problem: CalibrationProblem,
    values: Batch,
    names: Sequence[str],
    deviations: Sequence[InferredParameter],
    model_error: ModelError | None,
    key: PRNGKeyArray,
) -> tuple[Batch, int]:
    """Condition the parameters of recordings on their first rows: the frame's offset, and deviations of a new group.

    Offsets are set: each draw is shifted so that the mean over the markers agrees, weighted by the inverse squared
    model error of each marker. Deviations are drawn given the row, with the model error of the fitted recordings: each
    prior draw is moved to the optimum under a perturbed row and its prior (`fit_own`). The offset is removed from the
    row's error at every step. The first recording of a group with a first row is used.

    Args:
        problem: problem of the new recordings.
        values: draws of all parameters of the model.
        names: recordings with an unknown offset.
        deviations: deviations between groups, drawn from the prior.
        model_error: error of each marker; without it, offsets weight all markers equally, and deviations are unchanged.
        key: random key of the perturbations.

    Returns:
        the values, and the number of unconverged draws, which keep their best point.

    Raises:
        InputError: a first row that is masked throughout.
    """
    recordings = problem.model.recordings
    shifted = [p for p in problem.model.scopes.parameters if p.scope.owner in names and p.spec.name in OFFSETS]
    if shifted:
        values = _with_offsets(problem, values, shifted, model_error)
    if model_error is None or not deviations:
        return values, 0
    lost = 0
    for number, group in enumerate(dict.fromkeys(p.scope.owner for p in deviations)):
        own = [p for p in deviations if p.scope.owner == group]
        seen = [r for r in own[0].members if recordings.line.valid[recordings.names.index(r), 0].any()]
        if seen:
            free = any(p.scope.owner == seen[0] for p in shifted)
            own_key = jax.random.fold_in(key, number)
            values, unmatched = _with_deviations(problem, values, seen[0], own, model_error, own_key, shifted=free)
            lost += unmatched
    return (_with_offsets(problem, values, shifted, model_error) if shifted else values), lost


def resampled_by_first_row(
    recordings: RecordingSet,
    position: Float[np.ndarray, "n recording marker 3"],
    names: Sequence[str],
    model_error: ModelError | None,
    key: PRNGKeyArray,
) -> Int[np.ndarray, "n recording"]:
    """Indices of draws for each recording, resampled by the likelihood of its first row.

    The likelihood of a row is normal, with the model's own error for each marker. If the effective sample size were
    less than a tenth of the draws, the likelihood is raised to a power that keeps a tenth.

    Args:
        recordings: recordings to predict.
        position: simulated markers [m] in their first rows.
        names: recordings whose first row `match_first_row` has not used.
        model_error: error of each marker; without it, all draws have equal weight.
        key: random key of the resampling.
    """
    count = len(position)
    index = np.tile(np.arange(count)[:, None], (1, len(recordings.names)))
    sd = _errors(recordings.markers, model_error)[:, None] / np.sqrt(3.0)
    for place, name in enumerate(recordings.names):
        valid = recordings.line.valid[place, 0]
        if model_error is None or name not in names or not valid.any():
            continue
        error = ((recordings.position[place, 0] - position[:, place]) / sd)[:, valid]
        density = -0.5 * np.sum(error**2, axis=(1, 2))
        power, _ = next_step(partial(np.multiply, density), 1.0, LEAST_SHARE)
        index[:, place] = resampling.systematic(jax.random.fold_in(key, place), softmax(power * density), count)
    return index


def first_row_distances(predictions: Sequence[RecordingPrediction], model_error: ModelError | None) -> dict[str, float]:
    """Distance of measured from predicted first rows in units of the model error, if it exceeds chance among
    the first rows of all recordings.

    Errors of a row are assumed normal, with the sizes and the number of independent coordinates of the residuals
    (`ModelError.share`).
    """
    distances, chance = {}, SURE ** (1.0 / max(len(predictions), 1))
    for p in predictions:
        seen = [
            i for i, name in enumerate(p.marker_names) if p.mask[0, i] and model_error and name in model_error.markers
        ]
        if model_error is None or not seen:
            continue
        error = np.linalg.norm(p.observed[0, seen] - p.central[0, seen], axis=1)
        size = np.sqrt(model_error.share) * _errors([p.marker_names[i] for i in seen], model_error)
        times, count = float(np.sqrt(np.mean((error / size) ** 2))), 3.0 * model_error.share * len(seen)
        if count * times**2 > chi2.ppf(chance, count):
            distances[p.name] = times
    return distances


def _with_offsets(
    problem: CalibrationProblem, values: Batch, offsets: Sequence[InferredParameter], model_error: ModelError | None
) -> Batch:
    recordings = problem.model.recordings
    position = _first_rows(problem, values)
    precision = 1.0 / _errors(recordings.markers, model_error) ** 2
    shifted = dict(values)
    for index, name in enumerate(recordings.names):
        valid = recordings.line.valid[index, 0]
        own = [p for p in offsets if p.scope.owner == name]
        if not own or not recordings.line.valid[index].any():
            continue  # commands alone: the position of the frame is as uncertain as among the fitted recordings
        if not valid.any():
            raise InputError("the first row is masked throughout", where=name, remedy="start the recording later")
        error = recordings.position[index, 0, valid] - position[:, index, valid]
        for offset in own:
            axis = OFFSETS.index(offset.spec.name)
            shift = np.average(error[:, :, axis], axis=1, weights=precision[valid])
            # A draw that fails here is counted when all is rolled out.
            shifted[offset.name] = shifted[offset.name] + np.nan_to_num(shift)
    return shifted


def _with_deviations(
    problem: CalibrationProblem,
    values: Batch,
    recording: str,
    own: Sequence[InferredParameter],
    model_error: ModelError | None,
    key: PRNGKeyArray,
    *,
    shifted: bool,
) -> tuple[Batch, int]:
    """Each draw of the deviations, in units of their scale, at the optimum for a perturbed first row, and the number
    of unconverged draws. With ``shifted`` the frame may shift, and only the row's shape counts.
    """
    recordings = problem.model.recordings
    index = recordings.names.index(recording)
    valid = recordings.line.valid[index, 0]
    deviation_scale = np.stack([p.info.spread_of(values, len(values[p.name])) for p in own], axis=1)
    drawn = np.stack([values[p.name] for p in own], axis=1) / deviation_scale
    sd = _errors(recordings.markers, model_error)[valid, None] / np.sqrt(3.0)
    noise = np.asarray(jax.random.normal(key, (len(drawn), int(valid.sum()), 3)))
    measured = recordings.position[index, 0, valid] + sd * noise

    def residuals(deviation: np.ndarray, draw: np.ndarray) -> np.ndarray:
        given = {name: column[draw] for name, column in values.items()}
        given |= {p.name: column for p, column in zip(own, (deviation * deviation_scale[draw]).T, strict=True)}
        error = _first_rows(problem, given)[:, index, valid] - measured[draw]
        if shifted:
            error = error - np.average(error, axis=1, weights=1.0 / sd[:, 0] ** 2, keepdims=True)
        return (error / sd).reshape(len(draw), -1)

    optimum = fit_own(residuals, drawn)
    matched = zip([p.name for p in own], (optimum.point * deviation_scale).T, strict=True)
    return {**values, **dict(matched)}, int((~optimum.converged).sum())


def _first_rows(problem: CalibrationProblem, values: Batch) -> Float[np.ndarray, "n recording marker 3"]:
    """Simulated markers [m] in the first row of every recording; NaN for rollouts that do not reach it well."""
    rows, status = problem.rollouts(values, 1)
    rows = np.where((status == 0)[:, None, None], rows, np.nan)
    return rows.reshape(len(rows), problem.n_recordings, -1, 3)


def _errors(markers: Sequence[str], model_error: ModelError | None) -> Float[np.ndarray, " marker"]:
    """Error [m] of the model for each marker; a metre for one that was not fitted."""
    known = () if model_error is None else model_error.markers
    return np.array(
        [max(model_error.of_marker(name), SMALLEST_ERROR) if model_error and name in known else 1.0 for name in markers]
    )
