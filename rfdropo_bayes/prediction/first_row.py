"""What the first row of a recording says of the parameters that are its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import jax
import numpy as np
from blackjax.smc import resampling
from jaxtyping import Float, Int, PRNGKeyArray
from scipy.special import softmax

from rfdropo_bayes.bayes.calibration import CalibrationProblem
from rfdropo_bayes.bayes.channels.object_pose import OFFSETS
from rfdropo_bayes.bayes.recordings import RecordingSet
from rfdropo_bayes.bayes.space import SEPARATOR, Parameter
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference import next_step

SMALLEST_ERROR = 1e-6  # [m]
STEP = 0.05  # of a central difference, in prior deviations
ROUNDS = 2  # of linearisation: the pose at rest is all but linear in what is found from it
LEAST_SHARE = 0.1  # of the draws: a row that leaves fewer says that the model is wrong, not which draw is right

Batch = dict[str, Float[np.ndarray, " n"]]


def match_first_row(
    problem: CalibrationProblem,
    values: Batch,
    names: Sequence[str],
    deviations: Sequence[Parameter],
    errors: Mapping[str, float],
    key: PRNGKeyArray,
) -> Batch:
    """Condition what is a recording's own on its first row: the frame's offset, and deviations of a new group.

    Offsets are set: each draw is shifted so that the weighted mean over the markers agrees, and a marker weighs as
    little as the model is wrong about it. Deviations are drawn given the row, in which the model is as wrong as it was
    in the fitted recordings: each draw from their prior is moved to the optimum under perturbed data, which for a
    linear model is a draw from the posterior (randomised maximum likelihood, Oliver, He & Reynolds 1996). Of a group's
    recordings the first that has a first row is used.

    Args:
        problem: of the new recordings.
        values: draws of all its parameters.
        names: recordings whose offset is to be found.
        deviations: those that were drawn from their prior.
        errors: how far [m] the model was off for each marker; without, offsets weigh all markers the same, and
            deviations stay as they were drawn.
        key: of the perturbations.

    Raises:
        InputError: a first row that is masked throughout.
    """
    recordings = problem.model.recordings
    shifted = [p for p in problem.model.space.parameters if p.recording in names and p.spec.name in OFFSETS]
    if shifted:
        values = _with_offsets(problem, values, names, errors)
    if not errors or not deviations:
        return values
    for number, group in enumerate(dict.fromkeys(p.recording for p in deviations)):
        own = [p for p in deviations if p.recording == group]
        seen = [r for r in own[0].members if recordings.line.valid[recordings.names.index(r), 0].any()]
        if seen:
            values = _with_deviations(problem, values, seen[0], own, errors, jax.random.fold_in(key, number))
    return _with_offsets(problem, values, names, errors) if shifted else values


def weighed_by_first_row(
    recordings: RecordingSet,
    position: Float[np.ndarray, "n recording marker 3"],
    names: Sequence[str],
    errors: Mapping[str, float],
    key: PRNGKeyArray,
) -> Int[np.ndarray, "n recording"]:
    """Draws to predict each recording with: resampled by how well they predict its first row.

    The likelihood of a row is normal, with the model's own error for each marker. Where it would leave less than a
    tenth of the draws (in effective sample size), it is raised to a power that leaves as many.

    Args:
        recordings: those to predict.
        position: simulated markers [m] in their first rows.
        names: those among them whose first row no draw has seen yet.
        errors: how far [m] the model was off for each marker; without, all draws count the same.
        key: of the resampling.
    """
    count = len(position)
    index = np.tile(np.arange(count)[:, None], (1, len(recordings.names)))
    sd = _errors(recordings.markers, errors)[:, None] / np.sqrt(3.0)
    for place, name in enumerate(recordings.names):
        valid = recordings.line.valid[place, 0]
        if not errors or name not in names or not valid.any():
            continue
        error = ((recordings.position[place, 0] - position[:, place]) / sd)[:, valid]
        density = -0.5 * np.sum(error**2, axis=(1, 2))
        power, _ = next_step(partial(np.multiply, density), 1.0, LEAST_SHARE)
        index[:, place] = resampling.systematic(jax.random.fold_in(key, place), softmax(power * density), count)
    return index


def _with_offsets(
    problem: CalibrationProblem, values: Batch, names: Sequence[str], errors: Mapping[str, float]
) -> Batch:
    recordings = problem.model.recordings
    position = _first_rows(problem, values)
    precision = 1.0 / _errors(recordings.markers, errors) ** 2
    shifted = dict(values)
    for index, name in enumerate(recordings.names):
        valid = recordings.line.valid[index, 0]
        if name not in names or not recordings.line.valid[index].any():
            continue  # commands alone: where the frame lies is as uncertain as it was among the fitted recordings
        if not valid.any():
            raise InputError("the first row is masked throughout", where=name, remedy="start the recording later")
        error = recordings.position[index, 0, valid] - position[:, index, valid]
        for axis, offset in enumerate(OFFSETS):
            key = f"{offset}{SEPARATOR}{name}"
            if key in shifted:
                shift = np.average(error[:, :, axis], axis=1, weights=precision[valid])
                # A draw that fails here is counted when all is rolled out.
                shifted[key] = shifted[key] + np.nan_to_num(shift)
    return shifted


def _with_deviations(
    problem: CalibrationProblem,
    values: Batch,
    recording: str,
    own: Sequence[Parameter],
    errors: Mapping[str, float],
    key: PRNGKeyArray,
) -> Batch:
    """Each draw of the deviations (in units of their spread) at the optimum for a perturbed first row."""
    recordings = problem.model.recordings
    index = recordings.names.index(recording)
    valid = recordings.line.valid[index, 0]
    spread = np.array([float((p.table or {})["scale"]) for p in own])
    drawn = np.stack([values[p.name] for p in own], axis=1) / spread
    sd = np.repeat(_errors(recordings.markers, errors)[valid] / np.sqrt(3.0), 3)
    noise = np.asarray(jax.random.normal(key, (len(drawn), len(sd))))
    measured = recordings.position[index, 0, valid].reshape(-1) / sd + noise

    def at(deviation: np.ndarray) -> Batch:
        return {**values, **{p.name: column for p, column in zip(own, (deviation * spread).T, strict=True)}}

    def row(deviation: np.ndarray) -> np.ndarray:
        return _first_rows(problem, at(deviation))[:, index, valid].reshape(len(deviation), -1) / sd

    unit = STEP * np.eye(len(own))
    found = drawn
    for _ in range(ROUNDS):
        slope = np.stack([(row(found + e) - row(found - e)) / (2.0 * STEP) for e in unit], axis=2)
        missing = measured - row(found) + np.einsum("nij,nj->ni", slope, found)
        normal = np.einsum("nij,nik->njk", slope, slope) + np.eye(len(own))
        right = np.einsum("nij,ni->nj", slope, missing) + drawn
        fine = np.isfinite(normal).all(axis=(1, 2)) & np.isfinite(right).all(axis=1)
        found = found.copy()
        found[fine] = np.linalg.solve(normal[fine], right[fine][..., None])[..., 0]
    return at(found)


def _first_rows(problem: CalibrationProblem, values: Batch) -> Float[np.ndarray, "n recording marker 3"]:
    """Simulated markers [m] in the first row of every recording; NaN for rollouts that do not reach it well."""
    rows, status = problem.rollouts(values, 1)
    rows = np.where((status == 0)[:, None, None], rows, np.nan)
    return rows.reshape(len(rows), problem.n_recordings, -1, 3)


def _errors(markers: Sequence[str], errors: Mapping[str, float]) -> Float[np.ndarray, " marker"]:
    return np.array([max(errors.get(name, 1.0), SMALLEST_ERROR) for name in markers])
