"""Before a fit: parameter combinations that recordings cannot determine, measurements that would, and the cost of the
fit.

The derivatives of the measurements at prior draws give the Fisher information at these draws. In coordinates in which
the prior is a standard normal distribution (logarithms of scale parameters), with information :math:`F_d` at draw
:math:`d`, a direction :math:`v` keeps the share :math:`\\sqrt{\\overline{v^T (1 + F_d)^{-1} v}}` of its prior standard
deviation. Directions that keep most of it are undetermined. Further measurements add information. Posterior
variances are averaged, not informations: a draw with a snap-through may have more information than all others together.
"""

from __future__ import annotations

import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from rfdropo_bayes.bayes.batches import chunk_sizes
from rfdropo_bayes.bayes.calibration_problem import CalibrationProblem
from rfdropo_bayes.bayes.noise import LASTING_NOISE, NOISE_CORRELATION_TIME, OBSERVATION_NOISE
from rfdropo_bayes.data import Trajectory, noise_floor
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.experiment import ROLLOUTS
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.report.identifiability import DETERMINED, FREE, NEGLIGIBLE, WELL_AWAY
from rfdropo_bayes.simulators.black_box import BlackBox
from rfdropo_bayes.simulators.protocol import Observation, Result
from rfdropo_bayes.tables import changed
from rfdropo_bayes.verbs.budget import budget_within

# Step of a derivative, in prior standard deviations. A quarter of the draws of the paper's trunk snap within 2e-3,
# which hides the scale of its modulus and mass; 2e-4 and 2e-5 give the same slopes to five digits.
STEP = 2e-4
SETS = 128  # parameter sets that are rolled out in all, about
PATIENCE = 10.0  # [s]: no more rollouts are begun after these
FEWEST, MOST = 4, 16  # draws of the prior
PRIOR_DRAWS = 2000
KNOWN = 0.01  # relative error with which a part is weighed, or a parameter measured by itself
TENSION_ERROR = 0.05  # relative error of tensions that are not measured yet
TURNS, STILL = 200, 1e-10  # of the rotation to readable directions
NAMES, REMEDIES = 6, 3  # most parameters and most remedies in a sentence
BY_ITSELF = "measured by itself"


@dataclass(frozen=True)
class Direction:
    """A combination of parameters that recordings leave undetermined."""

    # relative changes of the parameters, logarithmic for scale parameters; the largest is 1 in prior standard
    # deviations
    together: dict[str, float]
    kept: float  # posterior over prior standard deviation
    # measurements that would determine it, with the remaining share of the deviation, best first
    ended_by: dict[str, float]
    sentence: str  # the same in words

    @property
    def needs_own_measurement(self) -> bool:
        """Whether the direction is a single parameter that only a separate measurement would determine."""
        return len(self.together) == 1 and bool(self.ended_by) and all(BY_ITSELF in what for what in self.ended_by)


@dataclass(frozen=True)
class Preflight:
    """Information of recordings on a model's parameters, before a fit."""

    directions: list[Direction]  # undetermined combinations, the worst first
    # share of the prior standard deviation that remains for each parameter: ``alone`` with all other parameters known,
    # and ``kept``
    parameters: pd.DataFrame
    channels: dict[str, list[str]]  # constant command channels of each recording
    noise: str  # assumed noise of the positions, in words
    draws: int  # number of prior draws
    failed: int  # number of failed rollouts
    rollout_seconds: float  # time to simulate one parameter set, all recordings
    rollouts: int  # budget of the fit
    minutes: float  # its run time
    method: str  # method of the fit
    seconds: float  # run time of this analysis
    notes: list[str] = field(default_factory=list)

    def lines(self) -> list[tuple[str, str]]:
        """Pairs of a label and a text, an empty label continues the previous pair."""
        undetermined = self._undetermined() or ["every combination, more or less"]
        rows = [
            ("undetermined" if self.directions else "determined", undetermined[0]),
            *(("", text) for text in undetermined[1:]),
        ]
        rows += [("" if index else "excited", text) for index, text in enumerate(self._excitation())]
        cost = (
            f"{self.method}: {self.rollouts} rollouts of {1e3 * self.rollout_seconds:.3g} ms, {minutes(self.minutes)}"
        )
        rows += [("cost", cost), ("assumed", self.noise)]
        return rows

    def _undetermined(self) -> list[str]:
        """Sentences; parameters that only separate measurements would determine share one sentence."""
        lonely = [each for each in self.directions if each.needs_own_measurement]
        if len(lonely) < 2:
            return [direction.sentence for direction in self.directions]
        names = ", ".join(name for direction in lonely for name in direction.together)
        least = min(direction.kept for direction in lonely)
        words = f"{names} (each keeps at least {100 * least:.0f} % of its prior spread; {_OWN})"
        return [words, *(direction.sentence for direction in self.directions if direction not in lonely)]

    def _excitation(self) -> list[str]:
        blind = [name for name, row in self.parameters.iterrows() if row["alone"] > FREE]
        words = [f"{', '.join(map(str, blind))}: hardly changes the motion, even were all else known"] if blind else []
        words += [f"{run}: {', '.join(names)} never moved" for run, names in self.channels.items() if names]
        return words or ["all parameters change the motion by more than the noise, and all channels move"]

    def as_dict(self) -> dict[str, Any]:
        """For a JSON file."""
        rest = {k: v for k, v in vars(self).items() if k not in ("directions", "parameters")}
        return {
            **rest,
            "directions": [vars(direction) for direction in self.directions],
            "parameters": {str(k): dict(row) for k, row in self.parameters.iterrows()},
        }

    def __str__(self) -> str:
        width = max(len(label) for label, _ in self.lines())
        return "\n".join(f"{label:<{width}}  {text}" for label, text in self.lines())

    def _repr_html_(self) -> str:
        body = "".join(f"<tr><th>{label}</th><td>{text}</td></tr>" for label, text in self.lines())
        return f"<table>{body}</table>{self.parameters.to_html(float_format='%.3g')}"


def minutes(value: float) -> str:
    """A duration in words."""
    return f"about {60.0 * value:.0f} s" if value < 1.5 else f"about {value:.0f} min"


class _Coordinates(NamedTuple):
    """Coordinates in which the prior is about a standard normal distribution."""

    names: tuple[str, ...]
    logarithmic: np.ndarray
    mean: Float[np.ndarray, " parameter"]
    sd: Float[np.ndarray, " parameter"]
    masses: np.ndarray

    def values(self, x: Float[np.ndarray, "n parameter"]) -> dict[str, np.ndarray]:
        scaled = self.mean + self.sd * x
        return {
            name: np.exp(scaled[:, k]) if self.logarithmic[k] else scaled[:, k] for k, name in enumerate(self.names)
        }


class _Noise(NamedTuple):
    """Assumed noise of the positions: deviations [m], correlation time [s]."""

    white: float
    lasting: float
    time: float
    words: str


def preflight(model: Model, runs: Sequence[Trajectory], *, seed: int = 0, share: float = 1.0) -> Preflight:
    """Estimate within seconds the combinations that a fit of these recordings can determine.

    Args:
        model: model to fit.
        runs: recordings to fit.
        seed: seed of the prior draws.
        share: number of rows in ``runs`` divided by the number in the fit.

    Raises:
        InputError: no parameter to infer, or no prior draw whose rollouts succeed.
    """
    begun = clock.perf_counter()
    model = _precise(model)
    problem = model.problem(runs)
    problem = problem.holding(problem.typical_scales)
    key, second = jax.random.split(jax.random.key(seed))
    drawn = {name: np.asarray(values) for name, values in problem.sample_prior(key, PRIOR_DRAWS).items()}
    coordinates = _coordinates(problem, drawn)
    if not coordinates.names:
        raise InputError("no parameter of the simulator is inferred", where="check", remedy="add [model.priors]")
    count = int(np.clip(SETS // (2 * len(coordinates.names)), FEWEST, MOST))
    start = np.asarray(jax.random.permutation(second, PRIOR_DRAWS))[:count]
    noise = _noise(model, problem, drawn, runs)
    noise = noise._replace(white=float(np.sqrt(share)) * noise.white)  # fewer rows know as much
    slopes, good, per_set, observed = _slopes(problem, coordinates, drawn, start)
    per_set /= share
    if not good.any():
        raise InputError("no draw of the prior can be simulated", where="check", remedy=observed.remedy)
    whiten = _Whitening(problem, noise)
    measured = whiten.positions(slopes.position[good])
    tension = whiten.tensions(slopes.tension[good], slopes.level[good])
    weighed = _weighed(model, problem, coordinates, drawn)
    known = _information(measured) + _information(weighed[None])
    if model.spec.channels.tension:
        known = known + _information(tension)
    more = _further(model, coordinates, tension)
    settings = model.settings.inference
    budget, stated = settings.rollouts or ROLLOUTS, None
    if not settings.rollouts and settings.minutes is not None:
        budget, stated = budget_within(settings.minutes, per_set, 1.0).rollouts, settings.minutes
    return Preflight(
        _directions(coordinates, known, more),
        _shares(coordinates, known),
        {run.name: _constant_channels(run) for run in runs},
        noise.words,
        len(good),
        int(np.sum(~good)),
        per_set,
        budget,
        budget * per_set / 60.0 if stated is None else stated,
        settings.method,
        clock.perf_counter() - begun,
    )


def _precise(model: Model) -> Model:
    """The model in double precision: differences of rounded motions would count as information."""
    if isinstance(model.robot, BlackBox) or model.spec.simulator.precision == "float64":
        return model
    table = changed(model.spec.simulator, where="[simulator]", precision="float64")
    return Model.of(replace(model.spec, simulator=table), model.settings)


def _coordinates(problem: CalibrationProblem, drawn: Mapping[str, np.ndarray]) -> _Coordinates:
    names = tuple(name for name in problem.physical_names if np.ptp(drawn[name]) > 0.0)
    logarithmic = np.array([_has_scale(problem, name, drawn[name]) for name in names], dtype=bool)
    columns = [np.log(drawn[n]) if log else drawn[n] for n, log in zip(names, logarithmic, strict=True)]
    own = [problem.model.scopes[name] for name in names]
    masses = np.array([p.spec.unit == "kg" and not (p.scope.spread or p.scope.added_to) for p in own], dtype=bool)
    mean, sd = (np.array([getattr(column, of)() for column in columns]) for of in ("mean", "std"))
    return _Coordinates(names, logarithmic, mean, sd, masses)


def _has_scale(problem: CalibrationProblem, name: str, draws: np.ndarray) -> bool:
    family = problem.model.scopes[name].table.get("distribution")
    return bool(
        np.all(draws > 0.0) and (family in ("LogNormal", "LogUniform") or draws.std() < WELL_AWAY * draws.mean())
    )


def _noise(
    model: Model, problem: CalibrationProblem, drawn: Mapping[str, np.ndarray], runs: Sequence[Trajectory]
) -> _Noise:
    stated, floor = model.spec.stated, noise_floor(runs)
    if stated is not None and stated.standard_deviation > 0.0:
        sd, lasts = stated.standard_deviation, stated.correlation_time
        words = f"noise of {1e3 * sd:.3g} mm, as [noise] states it"
        return _Noise(sd, 0.0, 1.0, words) if lasts is None else _Noise(0.01 * sd, sd, lasts, words)
    if floor:
        sd = float(np.sqrt(np.mean(np.square(list(floor.values())))))
        return _Noise(sd, 0.0, 1.0, f"noise of {1e3 * sd:.3g} mm, the spread of the repeats")

    def typical(name: str, otherwise: float) -> float:
        return float(np.median(drawn[name])) if name in drawn else problem.model.scopes.fixed.get(name, otherwise)

    white = typical(OBSERVATION_NOISE.name, 1e-3)
    lasting = typical(LASTING_NOISE.name, 0.0) if model.spec.noise == "auto" else 0.0
    words = f"noise of {1e3 * white:.3g} mm" + (f", and {1e3 * lasting:.3g} mm that lasts" if lasting else "")
    return _Noise(white, lasting, typical(NOISE_CORRELATION_TIME.name, 1.0), f"{words}: medians of the priors")


class _Slopes(NamedTuple):
    """Derivatives along the coordinates, and tensions at the draws."""

    position: Float[np.ndarray, "draw parameter recording time marker 3"]
    tension: Float[np.ndarray, "draw parameter recording time cable"]
    level: Float[np.ndarray, "draw recording time cable"]


def _slopes(
    problem: CalibrationProblem, coordinates: _Coordinates, drawn: Mapping[str, np.ndarray], start: np.ndarray
) -> tuple[_Slopes, np.ndarray, float, Result]:
    """Derivatives at draws of the prior, which draws succeeded, seconds of a parameter set, and the worst result."""
    dimension, count = len(coordinates.names), len(start)
    rows = [
        np.log(drawn[n][start]) if log else drawn[n][start]
        for n, log in zip(coordinates.names, coordinates.logarithmic, strict=True)
    ]
    x = (np.stack(rows, axis=1) - coordinates.mean) / coordinates.sd
    steps = STEP * np.concatenate([np.eye(dimension), -np.eye(dimension)])
    moved = (x[:, None] + steps).reshape(-1, dimension)
    values = coordinates.values(moved)
    for name, own in values.items():
        low, high = problem.bounds[name]
        values[name] = np.clip(own, low, high)
    rest = {n: np.repeat(drawn[n][start], 2 * dimension) for n in problem.names if n not in values}
    seen, per_set = _observed(problem, {**rest, **values}, 2 * dimension)
    count = len(seen.status) // (2 * dimension)
    status = np.asarray(seen.status).reshape(count, -1)
    ended = (status == Result.OK).all(axis=1) & np.isfinite(np.asarray(seen.position)).all(axis=(1, 2, 3, 4)).reshape(
        count, -1
    ).all(axis=1)

    def slope(part: Any) -> np.ndarray:
        both = np.asarray(part).reshape(count, 2, dimension, *part.shape[1:])
        return (both[:, 0] - both[:, 1]) / (2.0 * STEP)

    level = np.asarray(seen.tension).reshape(count, 2 * dimension, *seen.tension.shape[1:])[:, 0]
    return _Slopes(slope(seen.position), slope(seen.tension), level), ended, per_set, Result(int(status.max()))


def _observed(problem: CalibrationProblem, every: Mapping[str, np.ndarray], whole: int) -> tuple[Observation, float]:
    """Simulated observations of parameter sets, and seconds per set, in batches of equal size to save compilations.

    Sets beyond the time `PATIENCE` are not simulated; the result is a multiple of ``whole`` sets.
    """
    count = len(next(iter(every.values())))
    size = max(each for each in chunk_sizes(problem.chunk) if each <= max(count, min(chunk_sizes(problem.chunk))))
    parts: list[Observation] = []
    seconds: list[float] = []
    for first in range(0, count, size):
        if sum(seconds) > PATIENCE and first >= whole:
            count = first // whole * whole
            break
        rows = np.arange(first, first + size) % count
        begun = clock.perf_counter()
        parts.append(problem.observe({name: column[rows] for name, column in every.items()}))
        seconds.append(clock.perf_counter() - begun)
    if len(parts) == 1:
        begun = clock.perf_counter()
        problem.observe({name: column[:size] for name, column in every.items()})
        seconds.append(clock.perf_counter() - begun)
    seen = jax.tree.map(lambda *each: np.concatenate(each)[:count], *parts)
    return seen, float(np.min(seconds[1:])) / size


class _Whitening:
    """Derivatives of measurements divided by their noise."""

    def __init__(self, problem: CalibrationProblem, noise: _Noise) -> None:
        self.noise, recordings = noise, problem.model.recordings
        self.rows = [int(n) for n in recordings.rows]
        self.valid, self.time = np.asarray(recordings.line.valid), np.asarray(recordings.time)

    def positions(self, slope: Float[np.ndarray, "draw parameter recording time marker 3"]) -> np.ndarray:
        """Derivatives of positions, whitened by their noise; masked positions count for nothing."""
        parts = []
        for index, rows in enumerate(self.rows):
            own = np.moveaxis(slope[:, :, index, :rows], 2, 0)
            white = innovations(own, self.time[index, :rows], self.valid[index, :rows], self.noise)
            parts.append(np.moveaxis(white, 0, 2).reshape(*slope.shape[:2], -1))
        return np.concatenate(parts, axis=-1)

    def tensions(self, slope: np.ndarray, level: np.ndarray) -> np.ndarray:
        """Derivatives of tensions, divided by their noise, which is a share of the typical tension."""
        typical = np.sqrt(np.mean(level**2, axis=(1, 2), keepdims=True))[:, None]
        error = TENSION_ERROR * np.where(typical > 0.0, typical, np.inf)
        parts = [(slope / error)[:, :, index, :rows] for index, rows in enumerate(self.rows)]
        return np.concatenate([part.reshape(*part.shape[:2], -1) for part in parts], axis=-1)


def innovations(
    series: Float[np.ndarray, "time *many marker 3"],
    time: Float[np.ndarray, " time"],
    valid: Bool[np.ndarray, "time marker"],
    noise: _Noise,
) -> Float[np.ndarray, "time *many marker 3"]:
    """Series whitened under white plus correlated noise: innovations of a Kalman filter; zero for invalid rows."""
    whitened = np.zeros_like(series)
    mean, variance = np.zeros(series.shape[1:]), np.full(valid.shape[1], noise.lasting**2)
    for row, seen in enumerate(valid):
        if row:
            kept = np.exp(-(time[row] - time[row - 1]) / noise.time)
            mean, variance = kept * mean, kept**2 * variance + (1.0 - kept**2) * noise.lasting**2
        whole = variance + noise.white**2
        innovation = np.where(seen[:, None], series[row] - mean, 0.0)
        whitened[row] = innovation / np.sqrt(whole)[:, None]
        gain = np.where(seen, variance / whole, 0.0)
        mean, variance = mean + gain[:, None] * innovation, (1.0 - gain) * variance
    return whitened


def _information(white: Float[np.ndarray, "draw parameter row"]) -> Float[np.ndarray, "draw parameter parameter"]:
    """Fisher information at each draw."""
    return white @ np.moveaxis(white, 1, 2)


def _covariance(information: Float[np.ndarray, "draw parameter parameter"]) -> Float[np.ndarray, "parameter parameter"]:
    """Posterior covariance, averaged over draws."""
    return np.mean(np.linalg.inv(np.eye(information.shape[-1]) + information), axis=0)


def _weighed(
    model: Model, problem: CalibrationProblem, coordinates: _Coordinates, drawn: Mapping[str, np.ndarray]
) -> Float[np.ndarray, "parameter row"]:
    """Derivatives of weighed masses divided by their error."""
    derivatives = np.zeros((len(coordinates.names), len(model.spec.weighed)))
    for column, entry in enumerate(model.spec.weighed):
        for name in set(entry.parameters) & set(coordinates.names):
            k = coordinates.names.index(name)
            slope = np.median(drawn[name]) if coordinates.logarithmic[k] else 1.0
            derivatives[k, column] = coordinates.sd[k] * slope / entry.sd
    return derivatives


def _further(model: Model, coordinates: _Coordinates, tension: np.ndarray) -> dict[str, np.ndarray]:
    """Information of possible further measurements, by name."""
    information: dict[str, np.ndarray] = {}
    if tension.shape[-1] and not model.spec.channels.tension:
        information[f"tensions of the cables (to {100 * TENSION_ERROR:g} %)"] = _information(tension)
    for k, name in enumerate(coordinates.names):
        weight = np.zeros((1, *(len(coordinates.names),) * 2))
        size = 1.0 if coordinates.logarithmic[k] else max(abs(coordinates.mean[k]), coordinates.sd[k])
        weight[0, k, k] = (coordinates.sd[k] / (KNOWN * size)) ** 2
        word = "weighed" if coordinates.masses[k] else BY_ITSELF
        information[f"{name} {word} (to {100 * KNOWN:g} %)"] = weight
    return information


def _directions(coordinates: _Coordinates, information: np.ndarray, more: Mapping[str, np.ndarray]) -> list[Direction]:
    """Directions that keep most of their prior standard deviation."""
    covariance = _covariance(information)
    with_more = {what: _covariance(information + extra) for what, extra in more.items()}
    values, vectors = np.linalg.eigh(covariance)
    directions = []
    for vector in _readable(vectors[:, values > FREE**2]).T:
        kept = _kept(covariance, vector)
        ended = {what: _kept(own, vector) for what, own in with_more.items()}
        ended = dict(sorted(((w, s) for w, s in ended.items() if s < DETERMINED), key=lambda each: each[1]))
        vector = vector / vector[np.argmax(np.abs(vector))]
        names = _named(information, vector)
        sign = 1.0 if vector[names[0]] > 0.0 else -1.0
        together = {coordinates.names[k]: float(sign * vector[k] * coordinates.sd[k]) for k in names}
        logs = all(coordinates.logarithmic[k] for k in names)
        leading = sorted(sorted(names, key=lambda k: -abs(vector[k]))[:NAMES])
        parts = {coordinates.names[k]: together[coordinates.names[k]] for k in leading}
        directions.append(
            Direction(together, kept, ended, _sentence(parts, len(names) - len(parts), logs, kept, ended))
        )
    return sorted(directions, key=lambda direction: -direction.kept)


def _named(information: np.ndarray, vector: np.ndarray) -> list[int]:
    """Parameters that describe a direction: all with a large component, and further parameters in order of size. Enough
    are named that recordings could not determine the direction with all others known.
    """
    names: list[int] = []
    for k in np.argsort(-np.abs(vector)):
        part = np.zeros_like(vector)
        part[names] = vector[names] / max(np.linalg.norm(vector[names]), 1e-300)
        if names and abs(vector[k]) < NEGLIGIBLE and np.mean(1.0 / (1.0 + part @ information @ part)) > FREE**2:
            break
        names.append(int(k))
    return sorted(names)


def _kept(covariance: np.ndarray, vector: np.ndarray) -> float:
    """Posterior over prior standard deviation along a unit vector."""
    return float(np.sqrt(vector @ covariance @ vector))


def _readable(vectors: Float[np.ndarray, "parameter direction"]) -> Float[np.ndarray, "parameter direction"]:
    """The same directions turned among themselves until each has few parameters (varimax, Kaiser 1958)."""
    rotation, size = np.eye(vectors.shape[1]), 0.0
    for _ in range(TURNS if vectors.shape[1] > 1 else 0):
        turned = vectors @ rotation
        gradient = vectors.T @ (turned**3 - turned * np.mean(turned**2, axis=0))
        first, values, second = np.linalg.svd(gradient)
        rotation = first @ second
        if values.sum() < size * (1.0 + STILL):
            break
        size = values.sum()
    return vectors @ rotation


_OWN = f"nothing but the parameter {BY_ITSELF} would end it"


def _sentence(parts: Mapping[str, float], smaller: int, logs: bool, kept: float, ended: Mapping[str, float]) -> str:
    """A direction in words: the largest parts, and the number of smaller parts."""
    names = list(parts)
    if len(names) == 1:
        subject = names[0]
    elif logs and all(value > 0.0 for value in parts.values()):
        subject = f"the common scale of {', '.join(names[:-1])} and {names[-1]}"
    else:
        up = [name for name, value in parts.items() if value > 0.0]
        down = [name for name, value in parts.items() if value < 0.0]
        subject = f"{' and '.join(up)} up" + (f" with {' and '.join(down)} down" if down else " together")
    if smaller:
        subject += f", and {smaller} smaller part{'s' if smaller > 1 else ''}"
    best = [f"{what}: {100 * share:.0f} %" for what, share in list(ended.items())[:REMEDIES]]
    remedy = f"ended by {', or '.join(best)}" if best else "nothing that was tried here would end it"
    if len(names) == 1 and ended and all(BY_ITSELF in what for what in ended):
        remedy = _OWN
    return f"{subject} (keeps {100 * kept:.0f} % of its prior spread; {remedy})"


def _shares(coordinates: _Coordinates, information: np.ndarray) -> pd.DataFrame:
    alone = np.sqrt(np.mean(1.0 / (1.0 + np.diagonal(information, axis1=1, axis2=2)), axis=0))
    kept = np.sqrt(np.diag(_covariance(information)))
    return pd.DataFrame({"alone": alone, "kept": kept}, index=list(coordinates.names))


def _constant_channels(run: Trajectory) -> list[str]:
    """Channels whose command never changes."""
    sent = np.concatenate([np.asarray(run.initial_command)[None], np.asarray(run.command)])
    return [name for name, extent in zip(run.cable_names, np.ptp(sent, axis=0), strict=True) if extent == 0.0]
