"""Doubts about recordings as read: reported by ``check``, and on the page of every later result."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.cautions import Caution, Code, read_cautions
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.data.named_columns import UNTIMED, CsvColumns
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.model_spec import Workpiece
from rfdropo_bayes.posteriors import PosteriorRecord, RecordingPrediction
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.verbs.command_lag import apart
from rfdropo_bayes.verbs.motion_check import Motion, motion_cautions
from rfdropo_bayes.verbs.motion_direction import Paths, direction_of
from rfdropo_bayes.verbs.motion_size import size_of
from rfdropo_bayes.verbs.placement import NEAR, placement_hints

DOUBTS = "doubts"  # attribute of a posterior: cautions of the recordings that it is of
MILLIMETRES = 1e3
MOST_NAMES = 12
FEWEST_DRAWS = 8  # least number of prior draws whose median may replace the nominal model


def recording_cautions(
    robot: Workpiece, recordings: Sequence[Trajectory], columns: CsvColumns | None = None
) -> list[Caution]:
    """Doubts about recordings: about columns and units, first rows, and commands.

    Args:
        robot: recorded robot.
        recordings: recordings as read.
        columns: table that maps the recordings' columns; None for formats without this table.
    """
    cautions = [
        Caution(Code.RECORDING_DOUBTFUL, f"{recording.name}: {note}")
        for recording in recordings
        for note in recording.notes
        if note != UNTIMED or apart(recording) is None
    ]
    for recording in recordings:
        cautions += _misnamed(recording, robot.marker_names)
    if isinstance(robot, Robot):
        for recording in recordings:
            cautions += _unasked(recording, robot) + _beyond_the_body(recording, robot)
        cautions += _placements(robot, recordings, columns)
    return cautions + _copies(recordings)


def cautions_of_fit(
    model: Model, recordings: Sequence[Trajectory], predictions: Iterable[RecordingPrediction]
) -> list[Caution]:
    """The same for fitted and test recordings, with doubts about frame, size and commands from the motion under the
    prior.

    Args:
        model: fitted model.
        recordings: fitted recordings first, then test recordings.
        predictions: their predictions, including predictions under the prior.
    """
    paths = [each for prediction in predictions for each in _prior_paths(prediction)]
    return [*_read(model, recordings), *_moved(model, recordings[:1], paths)]


def cautions_of_audit(model: Model, recordings: Sequence[Trajectory], paths: Sequence[Paths]) -> list[Caution]:
    """Doubts for an audit, with ``paths`` of the model that it starts from."""
    return [*_read(model, recordings), *_moved(model, recordings[:1], paths)]


def cautions_after(fit: PosteriorRecord, model: Model, recordings: Sequence[Trajectory]) -> list[Caution]:
    """Doubts about new recordings and about the recordings of a fit; each once."""
    return list(dict.fromkeys([*recorded_doubts(fit), *_read(model, recordings)]))


def with_doubts(record: PosteriorRecord, cautions: Sequence[Caution]) -> PosteriorRecord:
    """A posterior with the doubts about its recordings, which all later results repeat."""
    return replace(record, attrs={**record.attrs, DOUBTS: [caution.as_dict() for caution in cautions]})


def recorded_doubts(record: PosteriorRecord) -> list[Caution]:
    """Doubts about recordings stored in a posterior."""
    return read_cautions(record.attrs.get(DOUBTS, []))


def _read(model: Model, recordings: Sequence[Trajectory]) -> list[Caution]:
    return recording_cautions(model.spec.robot, recordings, columns_of(model))


def columns_of(model: Model) -> CsvColumns | None:
    """The table by which recordings of a model's experiment are read."""
    return None if model.settings.data is None else model.settings.data.columns


def _moved(model: Model, first: Sequence[Trajectory], paths: Sequence[Paths]) -> list[Caution]:
    """Doubts from motions; only for a robot, whose base has a z axis along the body."""
    if not (isinstance(model.spec.robot, Robot) and paths):
        return []
    motion = Motion(direction_of(paths), size_of(paths))
    return motion_cautions(motion, columns_of(model), first[0].command_unit)


def _prior_paths(prediction: RecordingPrediction) -> list[Paths]:
    """A fitted recording beside the median of its predictions under the prior; empty if there are too few."""
    drawn = prediction.prior_predicted
    if drawn is None:
        return []
    whole = np.asarray(drawn)[np.isfinite(drawn).all(axis=(1, 2, 3))]
    if len(whole) < FEWEST_DRAWS:
        return []
    return [Paths(np.median(whole, axis=0), np.asarray(prediction.observed), np.asarray(prediction.mask))]


def _misnamed(recording: Trajectory, markers: Sequence[str]) -> list[Caution]:
    """Markers of a recording under names that the robot does not have, while it lacks markers of the robot's."""
    unknown = [name for name in recording.marker_names if name not in markers]
    unseen = [name for name in markers if name not in recording.marker_names]
    if not (unknown and unseen) or len(unseen) == len(markers):
        return []
    sentence = (
        f"{recording.name}: {shortened(unknown)} of the recording is no marker of the robot, and "
        f"{shortened(unseen)} of the robot is not in the recording: if both are the same point, give it "
        "one name, in markers under [data.columns] or in the robot file"
    )
    return [Caution(Code.RECORDING_DOUBTFUL, sentence)]


def _unasked(recording: Trajectory, robot: Robot) -> list[Caution]:
    """Markers that move while no command changes: a step into the recording has come to rest by its middle."""
    if np.ptp(recording.command, axis=0).any():
        return []
    middle = len(recording.time) // 2
    late = np.where(recording.position_mask[middle:, :, None], recording.position[middle:], np.nan)
    seen = late[:, np.isfinite(late).any(axis=(0, 2))]
    way = float((np.nanmax(seen, axis=0) - np.nanmin(seen, axis=0)).max(initial=0.0))
    if way <= NEAR * robot.length:
        return []
    sentence = (
        f"{recording.name}: no command changes, and in the second half of the recording a marker still moves by "
        f"{MILLIMETRES * way:.3g} mm: look at the columns of the commands"
    )
    return [Caution(Code.RECORDING_DOUBTFUL, sentence)]


SHOWN = {"m": (1e3, "mm"), "N": (1.0, "N"), "Pa": (1e-3, "kPa")}
"""Factor and unit in which the drive of a cable or chamber is shown."""


def asked_pulls(robot: Robot, recording: Trajectory) -> Float[np.ndarray, "rows drive"] | None:
    """Demand on each cable and chamber, in SI units of its drive; None for commands that do not fit the robot."""
    if len(recording.cable_names) != len(robot.channel_names) or recording.command_unit != robot.command_unit:
        return None
    try:
        travel = robot.travel(recording.name, recording.initial_command)
    except InputError:
        return None
    command = recording.command if travel is None else travel.follow(recording.initial_command, recording.command)
    return np.asarray(command @ np.asarray(robot.channel_matrix({})).T)


def drives_beyond(robot: Robot, asked: Float[np.ndarray, "rows drive"]) -> str:
    """Cables and chambers with commands beyond their limits, in words; empty if there are none."""
    low, high = asked.min(axis=0), asked.max(axis=0)
    least, most = np.array(robot.drive_limits()).T
    words = []
    for k in np.flatnonzero((low < least - 1e-9) | (high > most + 1e-9)):
        factor, unit = SHOWN[robot.actuators[k].unit]
        asks, limits = (f"{factor * a[k]:.3g} to {factor * b[k]:.3g}" for a, b in ((low, high), (least, most)))
        words.append(f"{robot.actuators[k].name} {asks} {unit} (limits {limits})")
    return ", ".join(words)


def _beyond_the_body(recording: Trajectory, robot: Robot) -> list[Caution]:
    """Cables with commands longer than the body."""
    asked = asked_pulls(robot, recording)
    length = robot.length
    if robot.held_by_force or asked is None or asked.max(initial=0.0) <= length or not drives_beyond(robot, asked):
        return []
    sentence = (
        f"{recording.name}: cables are asked for pulls that no body of {MILLIMETRES * length:.3g} mm has: "
        f"{drives_beyond(robot, asked)}: look at command_unit, at counts_per_turn, and at spool_radius and gain of the "
        "robot file"
    )
    return [Caution(Code.UNIT_DOUBTFUL, sentence)]


def _placements(robot: Robot, recordings: Sequence[Trajectory], columns: CsvColumns | None) -> list[Caution]:
    """First rows far from the undeformed robot, with a cause; equal doubts about several recordings share one
    caution.
    """
    shared: dict[str, list[str]] = {}
    for recording in recordings:
        for hint in placement_hints(robot, recording, columns):
            shared.setdefault(hint, []).append(recording.name)
    return [Caution(Code.FRAME_DOUBTFUL, f"{shortened(names)}: {hint}") for hint, names in shared.items()]


def _copies(recordings: Sequence[Trajectory]) -> list[Caution]:
    """Recordings of the same content: noise never repeats, so one recording is a copy."""
    alike: dict[str, list[str]] = {}
    for recording in recordings:
        alike.setdefault(recording.sha256, []).append(recording.name)
    return [
        Caution(
            Code.RECORDING_DOUBTFUL,
            f"{shortened(names)} are the same to the last digit: a copy is no second measurement, and tests nothing; "
            "list one of them",
        )
        for names in alike.values()
        if len(names) > 1
    ]


def shortened(names: Sequence[str]) -> str:
    """Names with commas; of many the first and the last."""
    if len(names) <= MOST_NAMES:
        return ", ".join(names)
    return f"{', '.join(names[:3])}, ..., {names[-1]} ({len(names)})"
