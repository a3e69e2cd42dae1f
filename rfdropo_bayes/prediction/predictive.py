"""Predictions under a posterior: of fitted and of new recordings.

A pushed cube starts at its measured pose in a new recording.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from rfdropo_bayes.bayes.calibration_problem import CalibrationProblem
from rfdropo_bayes.bayes.channels.markers import noise_of_markers
from rfdropo_bayes.bayes.channels.object_pose import (
    OBJECT_CORRELATION_TIME,
    OBJECT_NOISE,
    OBJECT_TURN_NOISE,
    OFFSETS,
    draw_object_error,
)
from rfdropo_bayes.bayes.inferred_parameter import InferredParameter
from rfdropo_bayes.bayes.recordings import gather_recordings
from rfdropo_bayes.bayes.scopes import Extension, Scopes
from rfdropo_bayes.bayes.trajectory_model import TrajectoryModel
from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.data import Trajectory, group_repeats
from rfdropo_bayes.data.sample_times import sample_time
from rfdropo_bayes.errors import NoRolloutError
from rfdropo_bayes.groups import Patterns, gather_groups, whole
from rfdropo_bayes.posteriors import RecordingPrediction, Scope
from rfdropo_bayes.prediction.first_row import first_row_distances, match_first_row, resampled_by_first_row
from rfdropo_bayes.prediction.model_error import ModelError
from rfdropo_bayes.prediction.session_error import SessionError
from rfdropo_bayes.simulators.protocol import Result
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator

# Keys of a posterior's attributes.
FITTED = "fitted_recordings"
NOISE, BEGUN = "noise_model", "fitted_recordings_begin"
KNOWN_NOISE = "known_noise"  # of the positions, if its parameters are not inferred
SIZES = (OBJECT_NOISE, OBJECT_TURN_NOISE, OBJECT_CORRELATION_TIME)
PLACE = ("cube_x", "cube_y", "cube_z", "cube_yaw")

Batch = dict[str, Float[np.ndarray, " n"]]


class NewPredictions(NamedTuple):
    """Predictions of recordings that no fit has seen."""

    recordings: list[RecordingPrediction]  # the predictions
    unmatched: int  # number of draws that did not converge on a first row
    # distance of the measured from the simulated first row in units of the model error, by recording, if it exceeds
    # chance
    far: dict[str, float]
    without: list[Caution]  # cautions on groups that no fit has seen, see `without_cautions`


def predicted_after_fit(predict: Callable[[], NewPredictions]) -> tuple[list[RecordingPrediction], list[Caution]]:
    """Predictions of recordings that a finished fit has not seen, and cautions. If no draw can be simulated under their
    commands, they are left out with a caution, so that the fit is not lost."""
    try:
        new = predict()
    except NoRolloutError as error:
        return [], [Caution(Code.NOT_PREDICTED, f"test recordings are not predicted: {error}", grave=True)]
    return new.recordings, match_cautions(new)


def match_cautions(new: NewPredictions) -> list[Caution]:
    """Cautions on draws that did not converge on a first row, on distant first rows, and on groups that lack parameters
    of others.
    """
    cautions = list(new.without)
    if new.unmatched:
        sentence = (
            f"{new.unmatched} draws of a new group's parameters did not converge in matching its first row, and "
            "count as they are: the prediction may miss its bands; adapt to a recording of that session"
        )
        cautions.append(Caution(Code.FIRST_ROW_UNMATCHED, sentence))
    for name, times in new.far.items():
        sentence = (
            f"the first row of {name} is {times:.2g} times as far from the simulated row as the model "
            "error in the fitted recordings: check that frame, units and start match the fitted "
            "recordings, or adapt to a recording of that session"
        )
        cautions.append(Caution(Code.FIRST_ROW_FAR, sentence))
    return cautions


def without_cautions(scopes: Scopes, groups: Sequence[str], known: Container[str]) -> list[Caution]:
    """Cautions on groups that no fit has seen, if only some fitted groups have a parameter.

    Args:
        scopes: scopes of the fit.
        groups: groups to predict; known: groups of the fitted recordings.
    """
    owners = scopes.groups_alone
    names = "; ".join(f"{name} in {' and '.join(own)}" for name, own in owners.items())
    sentence = (
        "{0} is predicted without ({1}), which only some of the fitted groups have; if {0} may have it, "
        "name {0} in [model.only_in] and calibrate with a recording of {0}"
    )
    unseen = [group for group in groups if group not in known]
    return [Caution(Code.GROUP_WITHOUT, sentence.format(group, names)) for group in unseen if owners]


def thin(draws: Mapping[str, Float[np.ndarray, "chain draw"]], count: int) -> Batch:
    """At most ``count`` draws, evenly spread over chains."""
    flat = {name: np.asarray(values).reshape(-1) for name, values in draws.items()}
    size = len(next(iter(flat.values())))
    index = np.unique(np.linspace(0, size - 1, min(count, size)).round().astype(int))
    return {name: values[index] for name, values in flat.items()}


def predict_fitted(
    problem: CalibrationProblem, values: Batch, key: PRNGKeyArray, *, prior: Batch | None = None
) -> list[RecordingPrediction]:
    """Predictions of the recordings a problem was made from."""
    return _predictions(problem, values, key, "fit", prior)


def predict_new(
    model: TrajectoryModel,
    trajectories: Sequence[Trajectory],
    values: Batch,
    key: PRNGKeyArray,
    *,
    chunk: int,
    fitted: Sequence[str],
    model_error: ModelError | None = None,
    groups: Patterns | None = None,
    slow: Mapping[str, SessionError] | None = None,
) -> NewPredictions:
    """Predictions of recordings that no fit has seen, from their commands and at most their first row.

    A parameter that was free per recording takes, for a new recording, its value in a random fitted recording, chosen
    anew for every draw. A parameter of a group takes, for a new group, values from the spread between groups. The
    offset of the measuring frame and the deviations of a new group are then conditioned on the first row
    (`match_first_row`), and for a new recording of a known group draws are weighted by its first row
    (`resampled_by_first_row`). A further piece of a fitted recording keeps the parameters of that recording.

    A parameter of some fitted recordings only, such as a payload, applies only to these recordings. A parameter that
    only some groups have also applies to their new recordings; an unseen group lacks it. A cube starts at its measured
    pose in the first row.

    Args:
        fitted: names of the fitted recordings.
        model_error: residuals of the model on the fitted recordings, its error in new recordings if its noise is white;
            without it, all markers have equal weight in a first row.
        groups: recordings that belong together, by name or wildcard; by default each recording is a group.
        slow: error of the session of each unseen recording, by name.
    """
    names = [t.name for t in trajectories]
    own_key, row_key, noise_key = jax.random.split(key, 3)
    extension = model.scopes.extended(names, fitted, groups or {})
    scopes, extended = extension.scopes, draw_extended(extension, values, names, own_key)
    recordings = gather_recordings(model.simulator, trajectories)
    markers = model.markers.like(recordings)
    if (
        model_error
        and markers.known is None
        and markers.independent
        and set(recordings.markers) <= set(model_error.markers)
    ):
        step = sample_time(*(t.time for t in trajectories))
        noise = noise_of_markers(model_error.every(step), model_error.markers, recordings)
        markers = replace(markers, known=noise.at(recordings.steps))
    fresh = replace(model, scopes=scopes, recordings=recordings, channels=(markers,))
    problem = CalibrationProblem(fresh, chunk=chunk)
    own = model.scopes.recordings_known(fitted)
    drawn = [p for p in scopes.deviating if p.name not in values]
    new = [n for n in names if whole(n) not in own]
    extended, unmatched = match_first_row(problem, extended, new, drawn, model_error, row_key)
    placed, extended = with_measured_starts(fresh, trajectories, extended)
    if placed is not fresh:
        problem = CalibrationProblem(placed, chunk=chunk)
    matched = {member for p in drawn for member in p.members}
    unseen = [n for n in new if n not in matched]
    predictions = _predictions(problem, extended, noise_key, "test", unseen=unseen, model_error=model_error)
    keys = jax.random.split(jax.random.fold_in(noise_key, 2), len(predictions))
    predictions = [
        with_session_error(p, slow[p.name], k) if slow and p.name in slow else p
        for p, k in zip(predictions, keys, strict=True)
    ]
    patterns = groups or {}
    known = {*gather_groups(fitted, patterns), *(p.scope.owner for p in model.scopes.parameters if p.scope.group)}
    without = without_cautions(model.scopes, list(gather_groups(names, patterns)), known)
    return NewPredictions(predictions, unmatched, first_row_distances(predictions, model_error), without)


def with_session_error(prediction: RecordingPrediction, slow: SessionError, key: PRNGKeyArray) -> RecordingPrediction:
    """A prediction whose draws have the slow error of an unseen session; markers outside the fit are unchanged."""
    known = [i for i, name in enumerate(prediction.marker_names) if name in slow.markers]
    if not known:
        return prediction
    path = prediction.central[:, known]
    unit = slow.unit(path, [prediction.marker_names[i] for i in known])
    predicted = prediction.predicted.copy()
    predicted[:, :, known] += slow.draw(key, len(predicted), prediction.time, unit).astype(predicted.dtype)
    return replace(prediction, predicted=predicted, mean=prediction.central)


def with_repeats_marked(
    predictions: Sequence[RecordingPrediction], trajectories: Sequence[Trajectory]
) -> list[RecordingPrediction]:
    """Predictions with repeats of the same commands marked within each split.

    Args:
        predictions: predictions of recordings.
        trajectories: the same recordings as trajectories, in the same order.
    """
    marked, number = list(predictions), 0
    for split in ("fit", "test"):
        own = [index for index, prediction in enumerate(predictions) if prediction.split == split]
        for group in group_repeats([trajectories[index] for index in own]):
            if len(group) > 1:
                for index in (own[member] for member in group):
                    marked[index] = replace(predictions[index], repeat_group=number)
                number += 1
    return marked


def draw_extended(extension: Extension, values: Batch, names: Sequence[str], key: PRNGKeyArray) -> Batch:
    """Values of the parameters of new recordings, from draws of the fitted parameters.

    For each draw, all parameters of a new recording come from one fitted recording, so that the values are consistent.
    """
    count, extended = len(next(iter(values.values()))), {}
    chosen = {
        name: np.asarray(jax.random.randint(jax.random.fold_in(key, index), (count,), 0, 2**31 - 1))
        for index, name in enumerate(names)
    }
    for number, parameter in enumerate(extension.scopes.parameters):
        like = extension.like[parameter.name]
        if not like:
            # the deviation of an unseen group, from each draw's spread between groups
            own_key, spread = jax.random.fold_in(key, len(names) + number), parameter.info.spread_of(values, count)
            extended[parameter.name] = np.asarray(jax.random.normal(own_key, (count,))) * spread
        elif len(like) == 1:
            extended[parameter.name] = values[like[0]]
        else:
            pool = np.stack([values[name] for name in like])
            extended[parameter.name] = pool[chosen[parameter.scope.owner] % len(like), np.arange(count)]
    return extended


def _predictions(
    problem: CalibrationProblem,
    values: Batch,
    key: PRNGKeyArray,
    split: str,
    prior: Batch | None = None,
    *,
    unseen: Sequence[str] = (),
    model_error: ModelError | None = None,
) -> list[RecordingPrediction]:
    """Predictions of the recordings of a problem; draws of ``unseen`` recordings are weighted by the first row."""
    recordings = problem.model.recordings
    position, pose, fine = _ended_well(problem, values)
    key, choice, again_key = jax.random.split(key, 3)
    if pose is not None:
        pose = measured_objects(problem, pose, fine, jax.random.fold_in(key, 1))
    chosen = resampled_by_first_row(recordings, position[:, :, 0], unseen, model_error, choice)
    noisy = position + problem.draw_noise(key, fine)
    before = None
    if prior is not None:
        clean, _, drawn = _ended_well(problem, prior)
        before = (clean + problem.draw_noise(key, drawn)).astype(np.float32)
    for i, name in enumerate(recordings.names):
        if name in unseen:  # noise of their own for draws that count more than once
            again = {parameter: column[chosen[:, i]] for parameter, column in fine.items()}
            noise = problem.draw_noise(jax.random.fold_in(again_key, i), again)[:, i]
            position[:, i] = position[chosen[:, i], i]
            noisy[:, i] = position[:, i] + noise
            if pose is not None:
                pose[:, i] = pose[chosen[:, i], i]
    return [
        RecordingPrediction(
            name,
            split,
            recordings.time[i, :rows],
            recordings.markers,
            recordings.position[i, :rows],
            recordings.line.valid[i, :rows],
            noisy[:, i, :rows].astype(np.float32),
            position[:, i, :rows].mean(axis=0),
            None if before is None else before[:, i, :rows],
            object_pose=None if pose is None else pose[:, i, :rows],
        )
        for i, (name, rows) in enumerate(zip(recordings.names, recordings.rows, strict=True))
    ]


def _ended_well(problem: CalibrationProblem, values: Batch) -> tuple[np.ndarray, np.ndarray | None, Batch]:
    """Noise-free positions and poses of the object, of the rollouts that succeeded, and their values."""
    position, pose, ended = problem.predict_scene(values)
    status = np.asarray(ended)
    fine = status == Result.OK
    if not fine.any():
        counts = ", ".join(f"{Result(kind).name.lower()} {count}" for kind, count in sorted(Counter(status).items()))
        names = ", ".join(problem.model.recordings.names)
        what = f"no draw of the posterior could be simulated under these commands ({counts})"
        raise NoRolloutError(what, where=names, remedy="cut the rows at which the robot leaves the fitted motion")
    return (
        position[fine],
        None if pose is None else pose[fine],
        {name: np.asarray(column)[fine] for name, column in values.items()},
    )


def with_measured_starts(
    model: TrajectoryModel, trajectories: Sequence[Trajectory], values: Batch
) -> tuple[TrajectoryModel, Batch]:
    """Let the cube of every recording start at its measured pose in the first row, standing on the plate.

    Its pose in the values is replaced for these recordings, less the measuring frame's offset of each draw. A recording
    without a measured cube keeps the pose of the values.
    """
    simulator = model.simulator
    if not isinstance(simulator, RobotSimulator) or not simulator.pushes:
        return model, values
    specs = {spec.name: spec for spec in simulator.parameters}
    inferred = {p.spec.name for p in model.scopes.parameters}
    parameters = [p for p in model.scopes.parameters if p.spec.name not in PLACE]
    placed = {p.name: values[p.name] for p in parameters}
    count = len(next(iter(values.values())))
    for run in trajectories:
        known, measured = model.scopes.values_in(run.name, values), dict[str, np.ndarray]()
        if run.object_pose is not None and np.isfinite(run.object_pose[0]).all():
            start = simulator.with_object_at(known, run.object_pose[0])
            measured = {name: np.broadcast_to(np.asarray(start[name]), (count,)) for name in PLACE}
        known = {**known, **measured}
        for name in (name for name in PLACE if name in measured or (name in inferred and name in known)):
            own = InferredParameter.of(specs[name], {}, Scope(run.name), (run.name,), where="prediction")
            parameters.append(own)
            placed[own.name] = np.asarray(known[name])
    return replace(model, scopes=replace(model.scopes, parameters=tuple(parameters))), placed


def measured_objects(
    problem: CalibrationProblem, pose: Float[np.ndarray, "n recording time 7"], values: Batch, key: PRNGKeyArray
) -> Float[np.ndarray, "n recording time 7"]:
    """Simulated poses of the cube as they would be measured: with the offset of the measuring frame and, if measured
    poses were data, with the fitted model error.
    """
    model = problem.model
    shifted = np.array(pose)
    count = len(shifted)
    for index, name in enumerate(model.recordings.names):
        known = model.scopes.values_in(name, values)
        for axis, offset in enumerate(OFFSETS):  # zero if no offset is a parameter
            shifted[:, index, :, axis] += np.broadcast_to(np.asarray(known.get(offset, 0.0), dtype=float), (count,))[
                :, None
            ]
        sizes = {s.name: np.broadcast_to(known[s.name], (count,)) for s in SIZES if s.name in known}
        if sizes:
            keys = jax.random.split(jax.random.fold_in(key, index), count)
            draw = jax.vmap(draw_object_error, in_axes=(0, 0, None, 0))
            time = jnp.asarray(model.recordings.time[index])
            shifted[:, index] = draw(keys, jnp.asarray(shifted[:, index]), time, sizes)
    return shifted
