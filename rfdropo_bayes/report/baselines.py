"""The predictors a sceptic would use instead of a simulator: a held pose, a copy of repeats or of earlier sessions, a
regression on the commands.

They use no model of the robot. A calibrated simulator that does not beat them has not earned its keep.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.data import Trajectory, command_openings, group_repeats, same_opening
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.report.fir import FirRegression, fit_fir
from rfdropo_bayes.report.scores import ErrorFigures, MeasuredPath, measured_paths, score

Predictor = Callable[[Trajectory], Float[np.ndarray, "time marker 3"]]
Predictors = Mapping[str, tuple[str, str, Predictor]]
"""Title, description and predictor, by name."""
Openings = Mapping[str, Mapping[str, str]]


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


def held_pose(shown: Trajectory) -> Predictor:
    """The first usable position of each marker of a recording, held constant."""
    first = np.argmax(shown.position_mask, axis=0)
    pose = shown.position[first, np.arange(shown.position.shape[1])]
    return lambda recording: np.broadcast_to(pose, recording.position.shape)


def mean_pose(fit: Sequence[Trajectory]) -> Predictor:
    """The mean position of each marker over all rows of the fit recordings, held constant."""
    weight = np.concatenate([t.position_mask for t in fit]).astype(float)
    total = np.einsum("tm,tma->ma", weight, np.concatenate([t.position for t in fit]))
    pose = total / np.maximum(weight.sum(axis=0), 1.0)[:, None]
    return lambda recording: np.broadcast_to(pose, recording.position.shape)


def repeated_mean(earlier: Sequence[MeasuredPath], openings: Openings) -> Predictor:
    """The mean of other recordings of the same commands at the same time; their last pose is held after their end.

    The predictor raises InputError if no other recording has the commands, or none of these shows a marker.

    Args:
        earlier: recordings to copy.
        openings: first commands of each, by name, see `command_openings`.
    """

    def predict(recording: Trajectory) -> Float[np.ndarray, "time marker 3"]:
        own, mean = command_openings(recording), np.zeros(recording.position.shape)
        alike = [p for p in earlier if p.name != recording.name and same_opening(own, openings.get(p.name, {}))]
        if not alike:
            raise InputError("no other fitted recording has the same commands", where=recording.name)
        for column, marker in enumerate(recording.marker_names):
            seen = [p for p in alike if marker in p.marker_names and p.mask[:, p.marker_names.index(marker)].any()]
            if not seen:
                what = f"{marker} was lost in all fitted recordings with the same commands"
                raise InputError(what, where=recording.name)
            for path in seen:
                index = path.marker_names.index(marker)
                time, position = path.time[path.mask[:, index]], path.position[path.mask[:, index], index]
                mean[:, column] += np.stack([np.interp(recording.time, time, axis) for axis in position.T], axis=-1)
            mean[:, column] /= len(seen)
        return mean

    return predict


def scaled_copy(shown: Trajectory, copied: Predictor) -> Predictor:
    """A copy, with a scale and a shift of each marker by least squares on the known part of the session."""

    def predict(recording: Trajectory) -> Float[np.ndarray, "time marker 3"]:
        copy, scaled = copied(shown), copied(recording)
        for marker in range(scaled.shape[1]):
            rows = shown.position_mask[:, marker]
            there, here = copy[rows, marker], shown.position[rows, marker]
            middle, about = there.mean(axis=0), here.mean(axis=0)
            power = float(np.sum((there - middle) ** 2))
            scale = float(np.sum((there - middle) * (here - about))) / power if power > 0.0 else 1.0
            scaled[:, marker] = about + scale * (scaled[:, marker] - middle)
        return scaled

    return predict


def session_baselines(
    shown: Trajectory, tested: Sequence[Trajectory], earlier: Sequence[MeasuredPath], openings: Openings
) -> dict[str, BaselineErrors]:
    """Errors of predictions of a session without a model.

    Args:
        shown: the known part of the session.
        tested: the predicted part.
        earlier: fitted recordings.
        openings: first commands of each, see `command_openings`.
    """
    copied = repeated_mean(earlier, openings)
    predictors: Predictors = {
        "first_row": (
            "first row of the session held",
            "the first known pose of the session, held constant",
            held_pose(shown),
        ),
        "copied": (
            "earlier sessions copied",
            "mean of the fitted recordings of the same commands at the same time",
            copied,
        ),
        "scaled_copy": (
            "earlier sessions copied and scaled",
            "the same copy, with a scale and a shift of each marker fitted to the known part of the session",
            scaled_copy(shown, copied),
        ),
    }
    return _scored(predictors, [shown], tested)


def with_fitted_commands(fit: Sequence[Trajectory], test: Sequence[Trajectory]) -> list[str]:
    """Names of the test recordings whose commands were also fitted, in the same or another recording."""
    openings = [command_openings(source) for source in fit]
    return [t.name for t in test if any(same_opening(command_openings(t), begun) for begun in openings)]


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
    repeated = repeated_mean(measured_paths(fit), {t.name: command_openings(t) for t in fit})
    predictors: Predictors = {
        "initial_pose": (
            "initial pose held",
            "each recording's own first pose, held constant",
            lambda recording: held_pose(recording)(recording),
        ),
        "mean_pose": ("constant mean pose", f"mean pose of the fit recordings ({trained_on})", mean_pose(fit)),
        "repeated_mean": (
            "mean of fitted repeats",
            "mean of the fit recordings of the same commands at the same time",
            repeated,
        ),
        "fir_linear": ("linear FIR", _describe(linear, trained_on), linear.predict),
        "fir_cubic": ("cubic FIR", _describe(cubic, trained_on), cubic.predict),
    }
    return _scored(predictors, fit, test)


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


def _scored(predictors: Predictors, fit: Sequence[Trajectory], test: Sequence[Trajectory]) -> dict[str, BaselineErrors]:
    """Errors of predictors on the fitted and the test recordings, or the reason if one cannot predict."""
    errors = {}
    for name, (title, description, predict) in predictors.items():
        figures: list[ErrorFigures | None] = []
        reason = ""
        for recordings in (fit, test):
            try:
                figures.append(score({t.name: predict(t) for t in recordings}, measured_paths(recordings)))
            except InputError as error:
                figures.append(None)
                reason = str(error)
        errors[name] = BaselineErrors(name, title, description, figures[0], figures[1], reason)
    return errors
