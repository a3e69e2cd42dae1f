"""Model error in a session that no fit has seen, beyond its draws: a slow error with heavy tails.

Parameters reduce the residuals of fitted recordings, but not the errors in another session. These errors are measured
on sessions left out of the fit, in units of the fitted residuals. They are assumed proportional to the fitted residuals
and to the distance that the robot moves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from rfdropo_bayes.posteriors import PosteriorRecord, RecordingPrediction
from rfdropo_bayes.prediction.model_error import ModelError, recorded_model_error

SESSION_ERROR = "session_error"  # among the attributes of a posterior

# The prior of `times`, used if no session was left out, and worth FREEDOM sessions otherwise. It rests on the sessions
# of two robots in docs/days.md.
TIMES, FREEDOM = 0.8, 3.0
CONSTANT = 0.6  # share of the variance that lasts for a whole recording: 0.5 to 0.66 in 8 recordings left out
CORRELATION_TIME = 1.0  # [s] of the rest: bands do not depend on it
SMALLEST_REACH = 1e-6  # [m]


class SessionError(NamedTuple):
    """The slow error of a model in an unseen session."""

    markers: tuple[str, ...]  # names of the markers
    residual: tuple[float, ...]  # root mean square residual [m] of each marker in the fitted recordings
    # root mean square of each marker's largest distance from its start [m]; empty if unknown: a recording is then
    # assumed to move as far as the fitted recordings
    reach: tuple[float, ...]
    times: float = TIMES  # scale of the error in units of ``residual``, for a marker at the distance ``reach``
    freedom: float = FREEDOM  # degrees of freedom: the error is Student's t
    constant: float = CONSTANT  # share of its variance that is constant over a recording
    correlation_time: float = CORRELATION_TIME  # correlation time of the other share [s]
    # error of the last marker [m] in each session left out, by group; empty without such sessions
    sessions: Mapping[str, float] = {}
    # share of the coordinates of these sessions in the 90 % bands, each widened by the other sessions; None without
    # such sessions
    covered: float | None = None
    # distance of each marker in the fitted recording of this session [m]: only motion beyond it adds error; empty
    # without such a recording
    shown: tuple[float, ...] = ()
    # sessions that could not be left out, because the others cannot be fitted without them
    missed: tuple[str, ...] = ()

    def unit(
        self, path: Float[np.ndarray, "time marker 3"], markers: Sequence[str]
    ) -> Float[np.ndarray, "time marker"]:
        """Unit of ``times`` [m] for each coordinate; it grows with the marker's largest distance from its start.

        Args:
            path: mean prediction [m].
            markers: names of the markers.
        """
        index = [self.markers.index(name) for name in markers]
        far = reach_of(path)
        known = np.array(self.shown)[index] if self.shown else 0.0
        whole = np.array(self.reach)[index] if self.reach else np.maximum(far[-1], SMALLEST_REACH)
        beyond = np.sqrt(np.maximum(far**2 - known**2, 0.0))
        return beyond * np.array(self.residual)[index] / (whole * np.sqrt(3.0))

    def draw(
        self, key: PRNGKeyArray, count: int, time: Float[np.ndarray, " time"], unit: Float[np.ndarray, "time marker"]
    ) -> Float[np.ndarray, "draw time marker 3"]:
        """Realisations [m]: each draw has one scale for all markers, and a constant and a slow part for each axis."""
        rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        scale = self.times * np.sqrt(self.freedom / rng.chisquare(self.freedom, size=count))
        shape = (count, *unit.shape, 3)
        slow = rng.standard_normal(shape)
        memory = np.exp(-np.diff(time) / self.correlation_time)
        for row, kept in enumerate(memory, start=1):
            slow[:, row] = kept * slow[:, row - 1] + np.sqrt(1.0 - kept**2) * slow[:, row]
        lasting = rng.standard_normal((count, 1, unit.shape[1], 3))
        series = np.sqrt(self.constant) * lasting + np.sqrt(1.0 - self.constant) * slow
        return scale[:, None, None, None] * unit[None, :, :, None] * series

    def as_dict(self) -> dict[str, Any]:
        """The error as plain values; `from_dict` is the inverse."""
        return {**self._asdict(), "sessions": dict(self.sessions)}

    @classmethod
    def from_dict(cls, given: Mapping[str, Any]) -> SessionError:
        """The error from plain values."""
        tuples = {name: tuple(given[name]) for name in ("markers", "residual", "reach", "shown", "missed")}
        return cls(**{**given, **tuples})


def reach_of(path: Float[np.ndarray, "time marker 3"]) -> Float[np.ndarray, "time marker"]:
    """Largest distance [m] of each marker from its start, up to each row."""
    return np.maximum.accumulate(np.linalg.norm(path - path[0], axis=-1), axis=0)


def prior_session_error(model_error: ModelError, fitted: Sequence[RecordingPrediction]) -> SessionError:
    """The slow error of a session if no session was left out of the fit.

    Args:
        model_error: residuals of the model on the fitted recordings.
        fitted: their predictions, if known.
    """
    scale = tuple(np.linalg.norm(np.reshape(model_error.scale, (-1, 3)), axis=1).tolist())
    if not fitted:
        return SessionError(model_error.markers, scale, ())
    squares = np.concatenate([reach_of(p.central) ** 2 for p in fitted])
    reach = np.maximum(np.sqrt(squares.mean(axis=0)), SMALLEST_REACH)
    return SessionError(model_error.markers, scale, tuple(reach.tolist()))


def session_error(prior: SessionError, sessions: Mapping[str, Sequence[RecordingPrediction]]) -> SessionError:
    """The slow error of a session by sessions that were left out of a fit each.

    Each session's scale is the excess of its squared error over the variance of its draws. The prior counts as
    `FREEDOM` sessions of `TIMES` (a scaled inverse chi-square distribution, to which sessions add).

    Args:
        prior: error without left-out sessions.
        sessions: predictions of recordings of each session by a fit without it, their slow error left out, by group.
    """
    squares = {group: _squared_times(prior, recordings) for group, recordings in sessions.items()}
    if not squares:
        return prior
    return _with_times(prior, list(squares.values()))._replace(
        sessions={group: _tip_error(recordings) for group, recordings in sessions.items()},
        constant=_constant_share(prior, [p for recordings in sessions.values() for p in recordings]),
        covered=_covered(prior, sessions, squares),
    )


def recorded_session_error(record: PosteriorRecord) -> SessionError | None:
    """The error from a fit's file, or its prior; None if the file has neither error nor residuals."""
    given = record.attrs.get(SESSION_ERROR)
    if given is not None:
        return SessionError.from_dict(given)
    model_error = recorded_model_error(record)
    if model_error is None:
        return None
    return prior_session_error(model_error, [p for p in record.recordings if p.split == "fit"])


def _with_times(prior: SessionError, squares: Sequence[float]) -> SessionError:
    freedom = FREEDOM + len(squares)
    times = float(np.sqrt((FREEDOM * TIMES**2 + sum(squares)) / freedom))
    return prior._replace(times=times, freedom=freedom)


def _squared_times(prior: SessionError, predictions: Sequence[RecordingPrediction]) -> float:
    """Mean over markers of the squared error less the variance of the draws, in squared units."""
    excess, units = np.zeros(len(predictions[0].marker_names)), np.zeros(len(predictions[0].marker_names))
    for p in predictions:
        error = (p.observed - p.central) ** 2 - p.predicted.var(axis=0)
        excess += np.sum(error.mean(axis=-1) * p.mask, axis=0)
        units += np.sum(prior.unit(p.central, p.marker_names) ** 2 * p.mask, axis=0)
    return max(float(np.mean(excess / np.maximum(units, SMALLEST_REACH**2))), 0.0)


def _constant_share(prior: SessionError, predictions: Sequence[RecordingPrediction]) -> float:
    """Share of the squared error, in units, that is constant over each recording."""
    constant, total = 0.0, 0.0
    for p in predictions:
        unit = prior.unit(p.central, p.marker_names)
        error = (p.observed - p.central) / np.maximum(unit, 0.1 * unit.max(axis=0))[..., None]
        error, weight = np.where(p.mask[..., None], error, 0.0), np.maximum(p.mask.sum(axis=0), 1)[:, None]
        constant += float(np.sum(np.sum(error, axis=0) ** 2 / weight))
        total += float(np.sum(error**2))
    return constant / total if total > 0.0 else CONSTANT


def _tip_error(predictions: Sequence[RecordingPrediction]) -> float:
    """Root mean square distance [m] of the last marker."""
    squares = [np.sum((p.observed - p.central)[p.mask[:, -1], -1] ** 2, axis=-1) for p in predictions]
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def _covered(
    prior: SessionError, sessions: Mapping[str, Sequence[RecordingPrediction]], squares: Mapping[str, float]
) -> float:
    """Share of the coordinates of left-out sessions in 90 % bands from the other sessions."""
    inside = []
    for number, (group, recordings) in enumerate(sessions.items()):
        other = _with_times(prior, [square for name, square in squares.items() if name != group])
        for place, p in enumerate(recordings):
            key = jax.random.fold_in(jax.random.fold_in(jax.random.key(0), number), place)
            slow = other.draw(key, len(p.predicted), p.time, other.unit(p.central, p.marker_names))
            low, high = np.quantile(p.predicted + slow, [0.05, 0.95], axis=0)
            inside.append(((p.observed >= low) & (p.observed <= high))[p.mask].ravel())
    return float(np.mean(np.concatenate(inside)))


def session_sentence(error: SessionError) -> str:
    """Sentence on the error in a session without a recording."""
    begin = "No recording of this session was seen."
    if not error.sessions:
        return (
            f"{begin} This run left no session out of its fit: its bands are widened by {error.times:.2g} "
            "times the residuals of fitted sessions, as found on two other robots."
        )
    return f"{begin} {left_out_sentence(error)}"


def left_out_sentence(error: SessionError) -> str:
    """Sentence on errors and coverage in sessions left out of the fit; empty without such sessions."""
    missed = f" It could not be fitted without {', '.join(error.missed)}." if error.missed else ""
    if not error.sessions:
        return missed.lstrip()
    low, high = 1e3 * min(error.sessions.values()), 1e3 * max(error.sessions.values())
    errors = f"{low:.2g}" if len(error.sessions) == 1 else f"{low:.2g} to {high:.2g}"
    coverage = "" if error.covered is None else f"; its 90 % bands held {100.0 * error.covered:.0f} %"
    return f"In sessions left out of its fit this model was {errors} mm off{coverage}.{missed}"
