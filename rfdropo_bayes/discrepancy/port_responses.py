"""First-order effect of a signal at each port on the data of a fitted model.

A signal is a sum of cubic B-splines in time, one set for each recording. The effect of each spline on the whitened data
is its response: by rollouts, all recordings at once and one lane a spline, at ports of actuation and of the body; by a
map of the simulated markers at ports of sensing. A misspecified model has responses similar to the truth: an arm with
half the layers and twice the step yields the same laws.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import BSpline

from rfdropo_bayes.bayes.lanes import STEP, Fields
from rfdropo_bayes.discrepancy.deadline import about
from rfdropo_bayes.discrepancy.fit import Fit, FitTarget
from rfdropo_bayes.discrepancy.inadequacy import noise_share, rewhitened
from rfdropo_bayes.discrepancy.port_rollouts import FeatureTable, as_sensed, signals_of
from rfdropo_bayes.discrepancy.score import span
from rfdropo_bayes.mechanisms.ports import Port, PortMap

KNOTS = 0.15
"""Time between knots [s]: faster signals do not move a body whose lowest mode has this period."""
MOST_SPLINES = 40
"""Splines in a recording, of which each takes a rollout at every port; longer recordings get wider knots."""
DEGREE = 3
SHARE = 1e-3
"""Share of a port's size by which a signal is perturbed."""
COARSE = 0.3
"""The same for an engine in single precision, or with rough motion."""


@dataclass(frozen=True)
class Splines:
    """B-splines over the steps of a simulator.

    Attributes:
        value: value of every spline at every step; row 0 is the initial state.
        centre: time of each spline's maximum [s].
        inverse: coefficients of the least-squares fit to a series.
    """

    value: Float[np.ndarray, "row spline"]
    centre: Float[np.ndarray, " spline"]
    inverse: Float[np.ndarray, "spline row"]


def splines(rows: int, time_step: float) -> Splines:
    """Cubic B-splines over ``rows`` rows, `KNOTS` apart or wider."""
    time = time_step * np.arange(rows)
    pieces = int(np.clip(round(time[-1] / KNOTS), 1, MOST_SPLINES - DEGREE))
    inner = np.linspace(0.0, time[-1], pieces + 1)
    knots = np.concatenate([np.full(DEGREE, inner[0]), inner, np.full(DEGREE, inner[-1])])
    value = BSpline.design_matrix(np.clip(time, 0.0, inner[-1]), knots, DEGREE).toarray()
    centre = np.array([knots[k + 1 : k + DEGREE + 1].mean() for k in range(value.shape[1])])  # Greville's abscissae
    return Splines(value, centre, np.linalg.pinv(value))


@dataclass(frozen=True)
class Responses:
    """Responses of a fitted model at all ports, and the fit itself as a linear model.

    Attributes:
        ports: ports of the simulator.
        basis: the splines.
        whitened: effect of each spline on a group's whitened data, by port, except ports with several members.
        residual: whitened residuals, by group.
        jacobian: derivatives by the fit's free coordinates, by group; columns in deviations of their priors.
        levels: commands that reach the ports, by group.
        begun: time of the recordings' first rows [s] on the simulator's clock, which begins with their commands.
        noise: mean square of the measurement's noise in these deviations; less than 1 if the model is misspecified.
        recordings: first recording of each group.
        pull: minus the gradient of the log prior at the mode, in these deviations; None for zero.
        of_motion: features of the motion, by group, if the body supports signals that depend on it.
        exact: exact effect of requested features, by port; see `with_exact_columns`.
    """

    ports: PortMap
    basis: Splines
    whitened: dict[Port, Float[np.ndarray, "group value spline"]]
    residual: Float[np.ndarray, "group value"]
    jacobian: Float[np.ndarray, "group value d"]
    levels: Float[np.ndarray, "group row channel"]
    begun: float
    noise: float = 1.0
    recordings: tuple[str, ...] = ()
    pull: Float[np.ndarray, " d"] | None = None
    of_motion: Float[np.ndarray, "group feature row"] | None = None
    exact: dict[Port, Float[np.ndarray, "group value feature"]] = field(default_factory=dict)

    @property
    def base(self) -> Float[np.ndarray, "n rank"]:
        """Orthonormal basis of the effects of the fit's parameters on all data."""
        return span(self.jacobian.reshape(-1, self.jacobian.shape[-1]))


def responses(
    target: FitTarget, fit: Fit, ports: PortMap, table: FeatureTable, report: Any = lambda line: None
) -> Responses:
    """Responses at every port around a fit.

    Args:
        target: data under the model's noise.
        fit: fit of the model, with residuals and slopes under that noise.
        ports: ports of the simulator.
        table: table of features, with the commands at the ports.
        report: called with a line of words.

    Raises:
        OutOfTime: the time is up.
    """
    forward = target.forward
    groups, rows = forward.count, forward.commands.step.shape[1] + 1
    basis = splines(rows, table.time_step)
    theta = forward.coordinates.physical_values(fit.x[None], forward.slots)[0]
    levels = table.levels(theta, forward.commands)
    single = [port for port in ports.ports if ports.members(port) == (port,)]
    simulated = [port for port in single if port.stage != "sensing"]
    rollouts = len(simulated) * basis.value.shape[1] * groups
    report(f"signals at {len(single)} ports: {rollouts} rollouts, {about(rollouts * forward.pace)}")
    whitened = {}
    shown = forward.observe_one(fit.x)
    signals = np.repeat(basis.value.T[:, None], groups, axis=1)
    for port in single:
        whitened[port] = _response(target, fit, ports, port, signals[:, :, None], shown)
    white = target.measurements.series(fit.residual).reshape(groups, -1)
    slopes = target.measurements.series(fit.jacobian.T) * forward.coordinates.prior_sd[fit.free][:, None, None, None]
    jacobian = np.moveaxis(slopes.reshape(len(fit.free), groups, -1), 0, 2)
    first = forward.commands.sample_step[:, 0] + forward.commands.sample_fraction[:, 0]
    begun = float(np.median(table.time_step * np.asarray(first)))
    moving = table.over_motion(theta, forward.commands, forward.deadline.check) if table.of_motion else None
    pull = -(forward.coordinates.prior_slopes(fit.x)[0] * forward.coordinates.prior_sd)[fit.free]
    noise = noise_share(target)
    return Responses(ports, basis, whitened, white, jacobian, levels, begun, noise, forward.recordings, pull, moving)


def _response(
    target: FitTarget,
    fit: Fit,
    ports: PortMap,
    port: Port,
    signals: Float[np.ndarray, "signal group member row"],
    shown: Fields,
) -> Float[np.ndarray, "group value signal"]:
    """Whitened responses to signals of the port's unit at all its members at once; kept in the journal."""

    def compute() -> dict[str, np.ndarray]:
        forward, count = target.forward, len(signals)
        step = port.size * (SHARE if forward.lanes.difference <= STEP else COARSE)
        lane = np.tile(np.arange(forward.count), count)
        w = np.moveaxis(step * signals.reshape(-1, *signals.shape[2:]), 1, 0)
        acting = list(zip(ports.members(port), w, strict=True))
        commands = forward.commands.of(lane)
        if port.stage == "sensing":
            shift = shown["offset"][lane][:, None, None]
            still = shown["position"][lane] - shift
            time_step: Any = forward.lanes.simulator.description["time_step_s"]
            parts = {"position": as_sensed(acting, still, commands, float(time_step)) + shift}
        else:
            theta = forward.coordinates.physical_values(fit.x[None], forward.slots)[0]
            commands = commands._replace(signals=signals_of(ports, acting))
            parts, _ = forward.lanes.roll(theta[lane], forward.start[lane], commands, forward.deadline.check)
            forward.rollouts += len(lane)
        named = {name: part.reshape(count, forward.count, *part.shape[1:]) for name, part in parts.items()}
        named = named if port.stage == "sensing" else forward.corrected(named)
        before, moved = target.shown_errors(shown), target.shown_errors({**shown, **named}, tuple(named))
        white = target.measurements.whiten(np.nan_to_num(before - moved) / step, target.noise)
        series = target.measurements.series(white).reshape(count, forward.count, -1)
        return {"response": np.moveaxis(series, 0, 2)}

    marked = np.frombuffer(port.name.encode(), dtype=np.uint8)
    return target.recall("port", [fit.x, marked, signals], compute)["response"]


def with_exact_columns(
    target: FitTarget,
    fit: Fit,
    linear: Responses,
    features: Mapping[Port, Float[np.ndarray, "group feature member row"]],
) -> Responses:
    """The same with exact effects of features at their ports, instead of their nearest splines.

    Effects faster than the knots matter: for a crosstalk of two cables under noise of autocorrelation .6 per row, whose
    whitening amplifies fast parts, splines show half.
    """
    shown = target.forward.observe_one(fit.x)
    exact = {
        port: _response(target, fit, linear.ports, port, np.moveaxis(own, 1, 0), shown)
        for port, own in features.items()
        if port not in linear.exact
    }
    return replace(linear, exact={**linear.exact, **exact})


def under(linear: Responses, fit_target: FitTarget, other: FitTarget) -> Responses:
    """The same responses in deviations of the noise of another target; residual and slopes are unchanged."""
    if fit_target.known is None:  # it has the measurement noise, which is kept
        return linear

    def each(part: Float[np.ndarray, "group value k"]) -> Float[np.ndarray, "group value k"]:
        white = rewhitened(fit_target, other, np.moveaxis(part, 2, 0).reshape(part.shape[2], -1))
        return np.moveaxis(white.reshape(part.shape[2], *part.shape[:2]), 0, 2)

    whitened = {port: each(part) for port, part in linear.whitened.items()}
    exact = {port: each(part) for port, part in linear.exact.items()}
    return replace(linear, whitened=whitened, exact=exact, noise=noise_share(other))


def on_splines(basis: Splines, values: Float[np.ndarray, "*batch row"]) -> Float[np.ndarray, "*batch spline"]:
    """Coefficients of the splines that come nearest to series over the steps."""
    return values @ basis.inverse.T


def feature_columns(
    linear: Responses, port: Port, features: Float[np.ndarray, "group feature member row"]
) -> Float[np.ndarray, "group value feature"]:
    """Effects of features on the whitened data at all members of a port, each as a signal of its own size."""
    if port in linear.exact:
        return linear.exact[port]
    near = np.moveaxis(on_splines(linear.basis, features), 1, 3)  # group, member, spline, feature
    return sum(linear.whitened[member] @ near[:, k] for k, member in enumerate(linear.ports.members(port)))
