"""The first answer of ``rfdropo check``: a fit at rest in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rfdropo_bayes.data import Trajectory, shared_markers
from rfdropo_bayes.model.assembly import build_model, build_simulator
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.report.units import display_name
from rfdropo_bayes.verbs.arrangement import Arrangement
from rfdropo_bayes.verbs.at_rest import resting
from rfdropo_bayes.verbs.command_lag import best_delay
from rfdropo_bayes.verbs.order_finder import arranged
from rfdropo_bayes.verbs.rest_fit import KEPT, OWN, Estimate, RestFit, fit_at_rest

MISREAD = 2.0
"""Error over that of the best predictor without physics at or above which the description itself is doubted."""
DRIFTS, WAYS = 0.25, 0.1
"""Least shares of the residuals that a drift, and the direction of a command's last change, must explain."""
SHOWN_UNITS = {"m": (1e3, "mm"), "rad": (180.0 / np.pi, "deg")}


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
    notes = []
    best = min((name for name in fit.unseen if name != OWN), key=lambda name: fit.unseen[name])
    if fit.tested and fit.unseen[OWN] > fit.unseen[best]:  # regressions fit their own rows better
        cause = (
            "a unit, an order, a length or a frame is likely wrong"
            if fit.unseen[OWN] > MISREAD * fit.unseen[best]
            else "friction, stretch of cables or another effect is missing, or some cables end or run elsewhere"
        )
        notes.append(
            f"a fitted robot at rest is off by {_millimetres(fit.unseen[OWN])} mm, the {best} without any physics by "
            f"{_millimetres(fit.unseen[best])} mm: {cause}"
        )
    return [*notes, *_drifts(fit), *_ways(fit)]


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


def _ways(fit: RestFit) -> list[str]:
    """The channel whose direction of motion explains most of the residual."""
    residual = fit.residual[:, -1]
    whole = np.isfinite(residual).all(axis=1)
    if whole.sum() < 8:
        return []
    residual, ways = residual[whole] - residual[whole].mean(axis=0), fit.ways[whole] - fit.ways[whole].mean(axis=0)
    size = np.maximum(np.sum(ways**2, axis=0), 1e-300)
    slope = ways.T @ residual / size[:, None]
    share = np.sum(slope**2, axis=1) * size / max(float(np.sum(residual**2)), 1e-300)
    most = int(np.argmax(share))
    if share[most] < WAYS:
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
