"""The predictors a sceptic would use instead of a simulator: a held pose, a copied mean, repeats, a regression on the
commands.

They use no model of the robot. A calibrated simulator that does not beat them has not earned its keep.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.data import Trajectory, command_openings, group_repeats, same_opening
from rfdropo_bayes.data.sample_times import sample_time
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.report.fir import FirRegression, fit_fir
from rfdropo_bayes.report.scores import ErrorFigures, measured_paths, score

Predictor = Callable[[Trajectory], Float[np.ndarray, "time marker 3"]]


@dataclass(frozen=True)
class BaselineErrors:
    """Errors of one predictor."""

    name: str  # key in summary.json
    title: str  # name for people
    description: str  # the method, in one sentence
    # fit, test: errors on fitted and on test recordings; None without such recordings
    fit: ErrorFigures | None
    test: ErrorFigures | None
    reason: str = ""  # why it could not predict; empty if it could


def held_initial_pose(recording: Trajectory) -> Float[np.ndarray, "time marker 3"]:
    """The first usable position of each marker, held constant."""
    first = np.argmax(recording.position_mask, axis=0)
    pose = recording.position[first, np.arange(recording.position.shape[1])]
    return np.broadcast_to(pose, recording.position.shape)


def mean_pose(fit: Sequence[Trajectory]) -> Predictor:
    """The mean position of each marker over all rows of the fit recordings, held constant."""
    weight = np.concatenate([t.position_mask for t in fit]).astype(float)
    total = np.einsum("tm,tma->ma", weight, np.concatenate([t.position for t in fit]))
    pose = total / np.maximum(weight.sum(axis=0), 1.0)[:, None]
    return lambda recording: np.broadcast_to(pose, recording.position.shape)


def copied_mean(fit: Sequence[Trajectory]) -> Predictor:
    """The mean of the fit recordings at the same time after the start, for any command.

    A fit recording is predicted by the others. The predictor raises InputError if no other recording lasts as long.
    """

    def predict(recording: Trajectory) -> Float[np.ndarray, "time marker 3"]:
        others = [source for source in fit if source.sha256 != recording.sha256 or source.name != recording.name]
        total = np.zeros(recording.position.shape)
        count = np.zeros(recording.position.shape[:2])
        for source in others:
            within = recording.time <= source.time[-1] + _tolerance(source)
            for marker in range(recording.position.shape[1]):
                usable = source.position_mask[:, marker]
                if usable.any():
                    path, time = source.position[usable, marker], source.time[usable]
                    for axis in range(3):
                        total[:, marker, axis] += within * np.interp(recording.time, time, path[:, axis])
                    count[:, marker] += within
        if not count.all():
            raise InputError(
                f"no other fitted recording lasts {recording.time[-1]:.4g} s, as this recording does",
                where=recording.name,
            )
        return total / count[..., None]

    return predict


def repeated_mean(fit: Sequence[Trajectory]) -> Predictor:
    """The mean of the fitted repeats of the same commands at the same time; their last pose is held after their end.

    The predictor raises InputError if no other fit recording has the commands.
    """
    openings = [command_openings(source) for source in fit]

    def predict(recording: Trajectory) -> Float[np.ndarray, "time marker 3"]:
        own = command_openings(recording)
        repeats = [
            source
            for source, begun in zip(fit, openings, strict=True)
            if same_opening(own, begun) and (source.sha256 != recording.sha256 or source.name != recording.name)
        ]
        if not repeats:
            raise InputError("no other fitted recording has the same commands", where=recording.name)
        total, count = np.zeros(recording.position.shape), np.zeros(recording.position.shape[1])
        for source in repeats:
            for marker in np.flatnonzero(source.position_mask.any(axis=0)):
                usable = source.position_mask[:, marker]
                path, time = source.position[usable, marker], source.time[usable]
                total[:, marker] += np.stack([np.interp(recording.time, time, path[:, i]) for i in range(3)], axis=-1)
                count[marker] += 1
        if not count.all():
            raise InputError("a marker was lost in all fitted recordings with the same commands", where=recording.name)
        return total / count[:, None]

    return predict


def with_fitted_commands(fit: Sequence[Trajectory], test: Sequence[Trajectory]) -> list[str]:
    """Names of the test recordings whose commands were also fitted, in the same or another recording."""
    openings = [command_openings(source) for source in fit]
    return [t.name for t in test if any(same_opening(command_openings(t), begun) for begun in openings)]


def _tolerance(recording: Trajectory) -> float:
    """Repeats end a little apart, with the jitter of their clocks."""
    return 2.0 * sample_time(recording.time)


def baseline_errors(
    fit: Sequence[Trajectory], test: Sequence[Trajectory], *, markers: Sequence[str] | None = None
) -> dict[str, BaselineErrors]:
    """Train every predictor on the fit recordings and score it on both roles, by the markers that all of them have.

    Args:
        fit: recordings a fit may see.
        test: recordings no fit sees; may be empty.
        markers: markers to score, in the robot's order; by default the first recording's.

    Returns:
        By name; empty if no marker is in all recordings.
    """
    shared = [name for name in markers or fit[0].marker_names if all(name in t.marker_names for t in (*fit, *test))]
    if not shared:
        return {}
    fit, test = ([_with_markers(t, shared) for t in recordings] for recordings in (fit, test))
    seconds = sum(float(t.time[-1]) for t in fit)
    trained_on = f"{seconds:.4g} s in {len(fit)} recording{'s' if len(fit) != 1 else ''}"
    groups = [list(group) for group in group_repeats(fit)]
    linear, cubic = fit_fir(fit, groups, degree=1), fit_fir(fit, groups, degree=3)
    predictors: dict[str, tuple[str, str, Predictor]] = {
        "initial_pose": ("initial pose held", "each recording's own first pose, held constant", held_initial_pose),
        "mean_pose": ("constant mean pose", f"mean pose of the fit recordings ({trained_on})", mean_pose(fit)),
        "copied_mean": (
            "fit mean copied",
            f"mean of the fit recordings ({trained_on}) at the same time, whatever is commanded",
            copied_mean(fit),
        ),
        "repeated_mean": (
            "mean of fitted repeats",
            "mean of the fit recordings of the same commands at the same time",
            repeated_mean(fit),
        ),
        "fir_linear": ("linear FIR", _describe(linear, trained_on), linear.predict),
        "fir_cubic": ("cubic FIR", _describe(cubic, trained_on), cubic.predict),
    }
    return {
        name: scored(name, title, description, predict, fit, test)
        for name, (title, description, predict) in predictors.items()
    }


def _with_markers(recording: Trajectory, markers: Sequence[str]) -> Trajectory:
    """A recording restricted to the given markers, in the given order."""
    if recording.marker_names == tuple(markers):
        return recording
    return Trajectory(recording.dataset.sel(marker=list(markers)))


def _describe(fir: FirRegression, trained_on: str) -> str:
    powers = "commands" if fir.degree == 1 else f"commands and their powers up to {fir.degree}"
    history = f"of the last {fir.lags[-1]:.3g} s ({len(fir.lags)} lags)" if len(fir.lags) > 1 else "of the moment"
    return (
        f"ridge regression on the {powers} {history}, trained on "
        f"{trained_on}; history length and penalty by cross-validation there"
    )


def scored(
    name: str, title: str, description: str, predict: Predictor, fit: Sequence[Trajectory], test: Sequence[Trajectory]
) -> BaselineErrors:
    """Errors of a predictor on the fitted and the test recordings, or the reason if it cannot predict."""
    figures: list[ErrorFigures | None] = []
    reason = ""
    for recordings in (fit, test):
        try:
            figures.append(score({t.name: predict(t) for t in recordings}, measured_paths(recordings)))
        except InputError as error:
            figures.append(None)
            reason = str(error)
    return BaselineErrors(name, title, description, figures[0], figures[1], reason)
