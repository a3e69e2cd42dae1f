"""Error figures: root mean square over time of the 3-D distance of a marker, in millimetres.

The LAST marker is the headline. A recording that ends at rest is also scored in two parts, since a long rest would
dominate the score: the moving part (all rows before the pose has settled) and the final pose (the mean of the last
rows).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

from rfdropo_bayes.data import Trajectory, group_repeats
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.posteriors import RecordingPrediction

MILLIMETRES = 1000.0
FINAL_ROWS = 10
SETTLED_DISTANCE = 0.002  # [m]
SETTLED_SHARE = 0.05  # of the largest distance from the final pose
LEAST_HELD = 0.25  # of the rows


@dataclass(frozen=True)
class MeasuredPath:
    """Measured marker positions of one recording."""

    name: str  # name of the recording
    time: Float[np.ndarray, " time"]  # [s]
    position: Float[np.ndarray, "time marker 3"]  # [m]
    mask: Bool[np.ndarray, "time marker"]  # True for usable positions
    marker_names: tuple[str, ...]  # base to tip
    repeat_group: int = -1  # equal numbers mark repeats of the same commands; -1 marks none

    @classmethod
    def of_prediction(cls, recording: RecordingPrediction) -> MeasuredPath:
        """The measured side of a prediction."""
        return cls(
            recording.name,
            recording.time,
            recording.observed,
            recording.mask,
            recording.marker_names,
            recording.repeat_group,
        )


def measured_paths(trajectories: Sequence[Trajectory]) -> list[MeasuredPath]:
    """Paths of recordings, with recordings of the same commands marked as repeats."""
    group_of = {index: number for number, group in enumerate(group_repeats(trajectories)) for index in group}
    return [
        MeasuredPath(t.name, t.time, t.position, t.position_mask, t.marker_names, group_of[index])
        for index, t in enumerate(trajectories)
    ]


@dataclass(frozen=True)
class RecordingErrors:
    """Errors of the last marker in one recording [mm]; None if there is nothing to score.

    ``rows_moving`` is the number of rows before the pose has settled, None if the recording does not end in a hold.
    """

    over_time: float | None
    moving: float | None
    final: float | None
    rows: int
    rows_moving: int | None


@dataclass(frozen=True)
class ErrorFigures:
    """Errors pooled over recordings [mm]; None if there is nothing to score."""

    over_time: dict[str, float | None]  # error of each marker over time
    # moving, final: errors of the last marker, over the recordings that end in a hold
    moving: float | None
    final: float | None
    recordings: dict[str, RecordingErrors] = field(default_factory=dict)  # last marker, each recording by itself

    @property
    def headline(self) -> float | None:
        """Error of the last marker over time."""
        return list(self.over_time.values())[-1] if self.over_time else None


def settled_rows(paths: Sequence[MeasuredPath]) -> list[int | None]:
    """First row after which the last marker of each recording stays at its final position; None without a hold.

    The final pose is the mean of the last `FINAL_ROWS` usable rows. The pose has settled at the first row after which
    the marker stays within `SETTLED_DISTANCE`, or `SETTLED_SHARE` of its largest distance from the final pose if that
    is more. A hold of less than `LEAST_HELD` of the rows counts as none. Repeats of equal length share the row of
    their mean path, so that all are cut at the same command.
    """
    groups: dict[tuple[int, int, int], list[int]] = {}
    for index, path in enumerate(paths):
        alone = index if path.repeat_group < 0 else -1
        groups.setdefault((path.repeat_group, alone, len(path.time)), []).append(index)
    rows: list[int | None] = [None] * len(paths)
    for members in groups.values():
        stack = np.stack([paths[i].position[:, -1] for i in members])
        weight = np.stack([paths[i].mask[:, -1] for i in members]).astype(float)
        count = weight.sum(axis=0)
        mean = (weight[..., None] * stack).sum(axis=0) / np.maximum(count, 1.0)[:, None]
        row = _settled_row(mean, count > 0)
        for i in members:
            rows[i] = row
    return rows


def _settled_row(position: Float[np.ndarray, "time 3"], usable: Bool[np.ndarray, " time"]) -> int | None:
    index = np.flatnonzero(usable)
    if len(index) < 2 * FINAL_ROWS:
        return None
    final = position[index[-FINAL_ROWS:]].mean(axis=0)
    distance = np.linalg.norm(position[index] - final, axis=1)
    outside = np.flatnonzero(distance > max(SETTLED_DISTANCE, SETTLED_SHARE * distance.max()))
    row = int(index[outside[-1]]) + 1 if len(outside) else 0
    count = len(usable) - row
    return row if row > 0 and count >= max(LEAST_HELD * len(usable), FINAL_ROWS) else None


def score(
    predictions: Mapping[str, Float[np.ndarray, "time marker 3"]], paths: Sequence[MeasuredPath]
) -> ErrorFigures | None:
    """Errors of predicted positions [m], by recording name; None without recordings.

    Raises:
        InputError: a recording without a prediction of its shape, or recordings with unlike markers.
    """
    if not paths:
        return None
    markers = paths[0].marker_names
    squares, counts = np.zeros(len(markers)), np.zeros(len(markers))
    recordings: dict[str, RecordingErrors] = {}
    pooled: dict[str, list[tuple[float, int]]] = {"moving": [], "final": []}
    for path, row in zip(paths, settled_rows(paths), strict=True):
        predicted = predictions.get(path.name)
        if path.marker_names != markers or predicted is None or np.shape(predicted) != np.shape(path.position):
            raise InputError("prediction and recording differ in rows or markers", where=path.name)
        square = np.sum((np.asarray(predicted) - path.position) ** 2, axis=-1) * path.mask
        squares += square.sum(axis=0)
        counts += path.mask.sum(axis=0)
        own = _recording_errors(square[:, -1], predicted[:, -1], path, row)
        recordings[path.name] = own
        if own.moving is not None and own.final is not None:
            pooled["moving"].append((own.moving, int(path.mask[:row, -1].sum())))
            pooled["final"].append((own.final, 1))
    over_time = {name: _root(s, c) for name, s, c in zip(markers, squares, counts, strict=True)}
    parts = {
        key: float(np.sqrt(np.average([e**2 for e, _ in values], weights=[n for _, n in values]))) if values else None
        for key, values in pooled.items()
    }
    return ErrorFigures(over_time, parts["moving"], parts["final"], recordings)


def _root(square: float, count: float) -> float | None:
    return float(MILLIMETRES * np.sqrt(square / count)) if count else None


def _recording_errors(
    square: Float[np.ndarray, " time"], predicted: Float[np.ndarray, "time 3"], path: MeasuredPath, row: int | None
) -> RecordingErrors:
    usable = path.mask[:, -1]
    over_time = _root(square.sum(), usable.sum())
    if row is None or not usable[:row].any():
        return RecordingErrors(over_time, None, None, len(usable), None)
    last = np.flatnonzero(usable)[-FINAL_ROWS:]
    final = MILLIMETRES * np.linalg.norm(predicted[last].mean(axis=0) - path.position[last, -1].mean(axis=0))
    return RecordingErrors(over_time, _root(square[:row].sum(), usable[:row].sum()), float(final), len(usable), row)
