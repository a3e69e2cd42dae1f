"""A first fit in seconds: the model's parameters with their priors, fitted to some rows of a robot at rest.

Least squares by Gauss-Newton steps with a line search. The noise is estimated from the residuals, so that a prior has
little weight if the rows are informative. `first_answer` gives the fit in words, for ``rfdropo check``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import f as ratio_of_variances

from rfdropo_bayes.bayes.scopes import Scopes
from rfdropo_bayes.data import Trajectory, group_repeats, shared_markers
from rfdropo_bayes.model.assembly import build_model, build_simulator
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.report.baselines import mean_pose
from rfdropo_bayes.report.fir import fit_fir
from rfdropo_bayes.report.units import display_name
from rfdropo_bayes.verbs.arrangement import Arrangement
from rfdropo_bayes.verbs.at_rest import RestingRobot, Rows, resting, rows_of, spread_rows
from rfdropo_bayes.verbs.command_lag import best_delay
from rfdropo_bayes.verbs.order_finder import arranged

MISREAD = 2.0
"""Error over that of the best predictor without physics at or above which the description itself is doubted."""
DRIFTS, WAYS = 0.25, 0.1
"""Least shares of the residuals that a drift, and the direction of a command's last change, must explain."""
CHANCE = 1e-3  # largest probability of such a share of white residuals
SHOWN_UNITS = {"m": (1e3, "mm"), "rad": (180.0 / np.pi, "deg")}

FITTED, SHOWN = 60, 240  # rows that are fitted, and rows whose residuals are shown
ITERATIONS, SETTLED = 10, 1e-3  # most steps, and the least relative decrease of the cost by a step
STEP = 0.01  # step of derivatives, in standard deviations of the prior
DRAWS = 400  # number of prior draws for its location and size
SHORTEST = 1e-2  # shortest trial step, relative to the full step
KEPT = 0.7  # share of its prior standard deviation at or above which a parameter counts as undetermined
SMALLEST = 1e-5  # smallest noise [m]


class Scale(NamedTuple):
    """Location and size of a parameter's prior, of the logarithm if it has a scale."""

    name: str
    unit: str
    logarithmic: bool
    mean: float
    sd: float
    low: float
    high: float

    def value(self, z: Float[np.ndarray, " set"]) -> Float[np.ndarray, " set"]:
        """Values at a distance from the middle of the prior, in standard deviations."""
        x = self.mean + self.sd * np.asarray(z, float)
        return np.clip(np.exp(x) if self.logarithmic else x, self.low, self.high)


class Estimate(NamedTuple):
    """Result of a fit for a parameter."""

    name: str
    unit: str
    # value, prior: estimate, and middle of the prior, in its unit
    value: float
    prior: float
    sd: float  # its standard deviation, relative if ``logarithmic``
    logarithmic: bool
    kept: float  # posterior over prior standard deviation


class RestFit(NamedTuple):
    """A fit at rest."""

    estimates: tuple[Estimate, ...]  # results for the parameters
    markers: tuple[str, ...]  # names; errors are of the last marker, root mean square [m]
    # before, after: errors on the fitted rows
    before: float
    after: float
    unseen: Mapping[str, float]  # errors on unfitted rows of the fit and of predictors without physics, by name
    each: tuple[float, ...]  # error of every marker on the unfitted rows
    # fitted, other: numbers of fitted rows and of rows with these errors
    fitted: int
    other: int
    tested: bool  # whether these are rows of test recordings
    rows: Rows  # shown rows of all recordings
    residual: Float[np.ndarray, "row marker 3"]  # measured less computed [m]
    ways: Float[np.ndarray, "row channel"]  # whether each command was last changed upwards (1) or downwards (-1)
    recording: np.ndarray  # number of each row's recording


OWN = "own"  # key of the fitted robot among errors


def scales_of(scopes: Scopes, known: Sequence[str]) -> list[Scale]:
    """Priors of the inferred parameters of a robot at rest, without parameters of single recordings."""
    drawn = scopes.sample(jax.random.key(0), DRAWS)
    scales = []
    for parameter in scopes.parameters:
        draws, spec = np.asarray(drawn[parameter.name]), parameter.spec
        if parameter.name not in known or not np.ptp(draws) > 0.0:
            continue
        family = parameter.table.get("distribution")
        logarithmic = family in ("LogNormal", "LogUniform") and bool(np.all(draws > 0.0))
        inside = np.log(draws) if logarithmic else draws
        middle, sd = float(np.median(inside)), float(np.std(inside))
        scales.append(Scale(spec.name, spec.unit, logarithmic, middle, sd, spec.low, spec.high))
    return scales


def least_squares(
    predict: Callable[[Float[np.ndarray, "set parameter"]], Float[np.ndarray, "set number"]],
    measured: Float[np.ndarray, " number"],
    count: int,
) -> tuple[Float[np.ndarray, " parameter"], Float[np.ndarray, "parameter parameter"]]:
    """Parameters in standard deviations of their priors, and their covariance.

    Args:
        predict: predictions for sets of parameters, one set more than parameters; NaN without an equilibrium.
        measured: the measured values; NaN if missing.
        count: number of parameters.
    """
    z, information = np.zeros(count), np.eye(count)
    seen = np.isfinite(measured)
    size = float(np.std(measured[seen])) or 1.0

    def residuals(made: Float[np.ndarray, "set number"]) -> Float[np.ndarray, "set number"]:
        residual = measured[seen] - made[:, seen]
        return np.where(np.isfinite(residual), residual, size)

    for _ in range(ITERATIONS):
        residual = residuals(predict(z + STEP * np.vstack([np.zeros(count), np.eye(count)])))
        noise = max(float(np.sqrt(np.mean(residual[0] ** 2))), SMALLEST)
        slope = (residual[0] - residual[1:]) / STEP / noise
        information = np.eye(count) + slope @ slope.T
        step = np.linalg.solve(information, slope @ residual[0] / noise - z)
        tried = z + np.geomspace(1.0, SHORTEST, count + 1)[:, None] * step
        cost = np.sum((residuals(predict(tried)) / noise) ** 2, axis=1) + np.sum(tried**2, axis=1)
        before = float(np.sum((residual[0] / noise) ** 2) + np.sum(z**2))
        if cost.min() >= before:
            break
        z = tried[int(np.argmin(cost))]
        if cost.min() > (1.0 - SETTLED) * before:
            break
    return z, np.linalg.inv(information)


def fit_at_rest(
    robot: RestingRobot,
    scopes: Scopes,
    fit: Sequence[Trajectory],
    test: Sequence[Trajectory],
    late: float,
    sent: Callable[[np.ndarray], np.ndarray],
) -> RestFit:
    """Fit a robot at rest.

    Args:
        robot: robot with the markers of all recordings.
        scopes: scopes of the inferred parameters.
        fit: recordings to fit.
        test: unseen recordings; without these, errors are computed on the fitted recordings.
        late: delay [s] of the body behind its commands.
        sent: map from recorded commands to commands of the channels.
    """
    scales = scales_of(scopes, [spec.name for spec in robot.simulator.parameters])
    every = rows_of(fit, robot.shown, late)
    rows = every.of(spread_rows(every, FITTED))

    def made(z: Float[np.ndarray, "set parameter"], of: Rows) -> Float[np.ndarray, "set row marker 3"]:
        values = {scale.name: scale.value(z[:, k]) for k, scale in enumerate(scales)}
        return robot.markers(sent(of.command), values)

    z, covariance = least_squares(
        lambda sets: made(sets, rows).reshape(len(sets), -1), rows.position.reshape(-1), len(scales)
    )
    whole = rows_of([*fit, *test], robot.shown, late)
    counts = [len(run.time) for run in (*fit, *test)]
    number = np.repeat(np.arange(len(counts)), counts)
    ways = np.concatenate([_ways(run.command_at(run.time - late)) for run in (*fit, *test)])
    tested = number >= len(fit) if test else np.ones(len(number), dtype=bool)
    index = np.unique(
        np.concatenate([_even(np.flatnonzero(tested), SHOWN), _even(np.flatnonzero(~tested), SHOWN // 2)])
    )
    shown, rated = whole.of(index), tested[index]
    residual = shown.position - made(z[None], shown)[0]
    without = {
        name: _rms(shown.position - path[index], rated) for name, path in _without_physics(fit, test, robot).items()
    }
    start, end = (rows.position - each[0] for each in (made(np.zeros((1, len(z))), rows), made(z[None], rows)))
    fitted = np.ones(len(rows.time), dtype=bool)
    return RestFit(
        tuple(_estimate(scale, z[k], float(np.sqrt(covariance[k, k]))) for k, scale in enumerate(scales)),
        robot.shown,
        _rms(start, fitted),
        _rms(end, fitted),
        {OWN: _rms(residual, rated), **without},
        tuple(_rms(residual[:, : k + 1], rated) for k in range(len(robot.shown))),
        len(rows.time),
        int(rated.sum()),
        bool(test),
        shown,
        residual,
        ways[index],
        number[index],
    )


def _without_physics(
    fit: Sequence[Trajectory], test: Sequence[Trajectory], robot: RestingRobot
) -> dict[str, Float[np.ndarray, "row marker 3"]]:
    """Predictions of all rows without physics, by name of the predictor."""
    groups = [list(group) for group in group_repeats(fit)]
    predictors = {
        "cubic FIR": fit_fir(fit, groups, degree=3).predict,
        "linear FIR": fit_fir(fit, groups, degree=1).predict,
        "mean pose": mean_pose(fit),
    }
    predictions = {}
    for name, predict in predictors.items():
        paths = []
        for run in (*fit, *test):
            chosen = [run.marker_names.index(marker) for marker in robot.shown]
            paths.append(predict(run)[:, chosen])
        predictions[name] = np.concatenate(paths)
    return predictions


def _estimate(scale: Scale, z: float, kept: float) -> Estimate:
    value, prior = scale.value(np.array([z, 0.0]))
    return Estimate(scale.name, scale.unit, float(value), float(prior), kept * scale.sd, scale.logarithmic, kept)


def _ways(command: Float[np.ndarray, "row channel"]) -> Float[np.ndarray, "row channel"]:
    """Direction of each command's last change; zero before its first change."""
    change = np.sign(np.diff(command, axis=0, prepend=command[:1]))
    last = np.maximum.accumulate(np.where(change != 0.0, np.arange(len(command))[:, None], 0), axis=0)
    return np.take_along_axis(change, last, axis=0)


def _even(rows: np.ndarray, most: int) -> np.ndarray:
    """At most ``most`` of the rows, evenly spaced."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int))] if len(rows) else rows


def _rms(residual: Float[np.ndarray, "row marker 3"], counted: Bool[np.ndarray, " row"]) -> float:
    """Root mean square distance of the last marker [m] over the given rows."""
    square = np.sum(residual[counted, -1] ** 2, axis=-1)
    square = square[np.isfinite(square)]
    return float(np.sqrt(np.mean(square))) if len(square) else float("nan")


def first_answer(
    spec: ModelSpec, fit: Sequence[Trajectory], test: Sequence[Trajectory], arrangement: Arrangement
) -> RestFit:
    """Fit the model's parameters by a robot at rest, see `fit_at_rest`.

    Args:
        spec: the model.
        fit: recordings to fit.
        test: unseen recordings, possibly none.
        arrangement: arrangement of the commands.
    """
    model = build_model(spec, build_simulator(spec), fit)
    robot = arranged(resting(spec), arrangement)
    robot = robot.showing(shared_markers([*fit, *test], robot.simulator.marker_names))
    return fit_at_rest(robot, model.scopes, fit, test, best_delay(fit), arrangement.commands)


def rest_lines(fit: RestFit) -> list[tuple[str, str]]:
    """Lines on errors, with predictors without physics and for every marker, and on every parameter."""
    without = {name: value for name, value in fit.unseen.items() if name != OWN}
    listed = ", ".join(f"{name} {_millimetres(value)}" for name, value in without.items())
    marker, which = fit.markers[-1], "test rows" if fit.tested else "rows of the fitted recordings"
    lines = [
        f"a robot at rest, fitted to {fit.fitted} rows, is off by {_millimetres(fit.unseen[OWN])} mm at {marker} in "
        f"{fit.other} {which} (before the fit {_millimetres(fit.before)}); without physics: {listed}"
    ]
    if len(fit.markers) > 1:
        lines.append(f"by marker: {', '.join(map(_named, zip(fit.markers, fit.each, strict=True)))}")
    known = [each for each in fit.estimates if each.kept < KEPT]
    free = [each.name for each in fit.estimates if each.kept >= KEPT]
    lines += [", ".join(map(estimate_words, known))] if known else []
    lines += [f"hardly determined by these rows at rest: {', '.join(free)}"] if free else []
    return [("at rest" if k == 0 else "", words) for k, words in enumerate(lines)]


def rest_notes(fit: RestFit) -> list[str]:
    """Notes on residuals at rest: worse than without physics, a drift, or hysteresis."""
    notes = [] if (words := misread(fit, moves=False)) is None else [words]
    return [*notes, *_drifts(fit), *_by_way(fit)]


def misread(fit: RestFit, *, moves: bool) -> str | None:
    """What is likely wrong with a recording that a map without physics explains better; None if it does not. In motion
    the map, which knows earlier commands, may follow a delay and a swing.
    """
    best = min((name for name in fit.unseen if name != OWN), key=lambda name: fit.unseen[name])
    if not fit.tested or fit.unseen[OWN] <= fit.unseen[best]:  # regressions fit their own rows better
        return None
    cause = (
        "a unit, an order of commands or markers, a length or a frame is likely wrong"
        if fit.unseen[OWN] > MISREAD * fit.unseen[best]
        else f"{'delay, swing, ' if moves else ''}friction, stretch of cables or another effect is missing, or some "
        "cables end or run elsewhere"
    )
    return (
        f"a fitted robot at rest is off by {_millimetres(fit.unseen[OWN])} mm, the {best} without any physics by "
        f"{_millimetres(fit.unseen[best])} mm: {cause}"
    )


def _drifts(fit: RestFit) -> list[str]:
    """Recordings whose residual changes steadily over time."""
    drifts = []
    for number in np.unique(fit.recording):
        own = fit.recording == number
        time, residual = fit.rows.time[own], fit.residual[own, -1]
        whole = np.isfinite(residual).all(axis=1)
        if whole.sum() < 8:
            continue
        time, residual = time[whole] - time[whole].mean(), residual[whole] - residual[whole].mean(axis=0)
        slope = time @ residual / max(float(time @ time), 1e-300)
        if np.sum(np.outer(time, slope) ** 2) > DRIFTS * np.sum(residual**2):
            way = _millimetres(float(np.linalg.norm(slope) * np.ptp(time)))
            drifts.append(
                f"what a fit at rest leaves drifts by {way} mm over the recording: cables that creep, or a frame"
            )
    return drifts[:1]


def _by_way(fit: RestFit) -> list[str]:
    """The channel whose direction of motion explains most of the residual, beside a parabola of its command: a command
    that rose is high on average.
    """
    residual = fit.residual[:, -1]
    whole = np.isfinite(residual).all(axis=1)
    command = fit.rows.command[whole]
    freedom = len(command) - 1 - 2 * command.shape[1]
    if freedom < 8:
        return []
    scaled = command / np.maximum(np.abs(command).max(axis=0), 1e-300)
    shape = np.concatenate([np.ones((len(scaled), 1)), scaled, scaled**2], axis=1)
    both = np.concatenate([residual[whole], fit.ways[whole]], axis=1)
    residual, ways = np.split(both - shape @ np.linalg.lstsq(shape, both, rcond=None)[0], [residual.shape[1]], axis=1)
    size = np.maximum(np.sum(ways**2, axis=0), 1e-300)
    slope = ways.T @ residual / size[:, None]
    share = np.sum(slope**2, axis=1) * size / max(float(np.sum(residual**2)), 1e-300)
    most = int(np.argmax(share))
    times = share[most] / max(1.0 - share[most], 1e-300) * (freedom - 1)
    # Of white residuals, at any channel.
    chance = len(share) * ratio_of_variances.sf(times, 3, 3 * (freedom - 1))
    if share[most] < WAYS or chance > CHANCE:
        return []
    apart = _millimetres(2.0 * float(np.linalg.norm(slope[most])))
    return [f"poses differ by {apart} mm between commands {most + 1} that rose and that fell: friction or backlash"]


def estimate_words(estimate: Estimate) -> str:
    """A parameter with its standard deviation, in the displayed unit."""
    if estimate.logarithmic:
        return f"{display_name(estimate.name)} {estimate.value:.3g} {estimate.unit} (to {100.0 * estimate.sd:.2g} %)"
    factor, unit = SHOWN_UNITS.get(estimate.unit, (1.0, "" if estimate.unit == "-" else estimate.unit))
    words = f"{display_name(estimate.name)} {factor * estimate.value:.3g} +- {factor * estimate.sd:.2g} {unit}"
    return words.rstrip()


def _named(pair: tuple[str, float]) -> str:
    return f"{pair[0]} {_millimetres(pair[1])} mm"


def _millimetres(metres: float) -> str:
    return f"{1e3 * metres:.3g}"
