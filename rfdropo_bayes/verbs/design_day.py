"""The morning's calibration: the shortest command sequence that determines a day, ``design_day``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.calibration_problem import CalibrationProblem
from rfdropo_bayes.bayes.noise.autoregression import STATED
from rfdropo_bayes.bayes.trajectory_model import TrajectoryModel
from rfdropo_bayes.data import Measured, Origin, SentCommands, Trajectory, actions
from rfdropo_bayes.data.sample_times import sample_time
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.groups import Patterns, gather_groups, group_of, whole
from rfdropo_bayes.inference.progress import say_lines
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.run_folder import hashes, run_folder
from rfdropo_bayes.prediction.day import physical_of_normal
from rfdropo_bayes.prediction.own_fit import STEP
from rfdropo_bayes.prediction.predictive import Batch
from rfdropo_bayes.results.calibrated import Calibration
from rfdropo_bayes.results.designed import COMMANDS, Design
from rfdropo_bayes.tables import nearest
from rfdropo_bayes.verbs.adapt import day_scopes, model_error_of
from rfdropo_bayes.verbs.arguments import given_fit
from rfdropo_bayes.verbs.design import command_table, proposals, units_said
from rfdropo_bayes.verbs.predict import model_of

LONGEST = 10.0  # [s] of a proposal, unless more is asked for
DAY = "another day"
PER_ACTION = "displacement_per_action"  # among the settings of a recording whose commands are actions


class DayOutlook(NamedTuple):
    """Remaining uncertainty after a command sequence.

    Attributes:
        seconds: time after which the session's uncertainty is less than the model error at the last marker; infinite if
            never.
        left: deviation [m] of the last marker in the given recordings, from the remaining uncertainty of the session.
    """

    seconds: float
    left: float

    def as_dict(self) -> dict[str, float | None]:
        """For design.json."""
        return {
            "seconds": self.seconds if np.isfinite(self.seconds) else None,
            "tip_uncertain_after_mm": 1e3 * self.left,
        }


def design_day(
    fit: Calibration,
    runs: Sequence[Trajectory] | None = None,
    *,
    seconds: float = LONGEST,
    group: str | None = None,
    seed: int | None = None,
    out: Path | str | None = None,
    overwrite: bool = False,
    show: bool | None = None,
) -> Design:
    """Propose the shortest commands whose recording determines the parameters of a session.

    Proposals are random walks, holds, slow loops and chirps within the drives' limits, each evaluated for all lengths.
    A length suffices if the session's uncertainty at the last marker, under the given recordings' commands, is no
    larger than the model error. Noise and session parameters are as in `adapt`. Proposals stay within the commands of
    the given recordings and the stated limits. If commands are actions that pull or release one cable, proposals
    consist of actions.

    Args:
        fit: a calibration, with its model.
        runs: given recordings; by default from the model's experiment.
        seconds: longest proposal.
        group: group whose drives and commands the session shares; by default the last recording's.
        seed: seed of the proposals; by default from the model's experiment.
        out: folder for design.json and next_commands.csv; None writes nothing.
        overwrite: replace an earlier run in ``out``.
        show: whether to show progress, as in `calibrate`.

    Raises:
        InputError: no parameter varies between sessions, or the group has no recording.
    """
    model = model_of(given_fit(fit, "design_day"))
    runs, chosen = model.runs(runs, ())[0], model.settings.seed if seed is None else seed
    work = partial(_design_day, fit, runs, seconds, group, chosen, say_lines(show))
    if out is None:
        return work()
    options = {"from": fit.folder, "seed": chosen, "adapt": True, "seconds": seconds, "group": group}
    settings: dict[str, Any] = {"tables": model.tables(), "folder": model.folder, "data": hashes(runs)}
    settings |= {"texts": model.texts()}
    with run_folder(Path(out), "design", **settings, options=options, overwrite=overwrite) as folder:
        found = work()
        found.save(folder)
    return found


def _design_day(
    fit: Calibration,
    runs: Sequence[Trajectory],
    seconds: float,
    group: str | None,
    seed: int,
    report: Callable[[str], None],
) -> Design:
    """See `design_day`."""
    model, left = model_of(fit), model_error_of(fit.record)
    day, known = _of_group(runs, model.spec.groups, group)
    begun = _begun_like(known[0], seconds)
    tried = _followed_proposals(model, begun, known[0], runs, np.random.default_rng(seed))
    sequences = [_as_recording(begun, f"{begun.name}[proposal {k}]", *tried[k][1:]) for k in range(len(tried))]
    problem, names, at = _problem(fit, sequences)
    report(f"{len(sequences)} command sequences, {len(names)} parameters of a day")
    white = problem.residual_batch(at, problem.n_rows).reshape(2, len(names), len(sequences), problem.n_rows, -1)
    slope = (white[0] - white[1]) / (2.0 * STEP)
    report("how the recordings at hand depend on them")
    heads = [run.slice_rows(0, min(len(run.time) - 1, 2 * problem.n_rows)) for run in known[:2]]
    at_hand, _, at = _problem(fit, heads)
    position, _ = at_hand.predict(at)
    tip = position[:, :, :, -1].reshape(2, len(names), -1)
    weight = (tip[0] - tip[1]) / (2.0 * STEP)
    rows = weight.shape[1] / 3.0
    error = float(np.sqrt(np.sum(np.square(left.scale[-3:]))))

    def uncertain(information: Float[np.ndarray, "k k"]) -> float:
        covariance = np.linalg.inv(np.eye(len(names)) + information)
        return float(np.sqrt(np.sum(weight * (covariance @ weight)) / rows))

    found = [_outlook(slope[:, k], problem.model.recordings.time[k], uncertain, error) for k in range(len(sequences))]
    best = min(range(len(found)), key=lambda k: (found[k].seconds, found[k].left))
    kind, times, value = tried[best]
    length = min(found[best].seconds, float(begun.time[-1]))
    kept = times <= length
    before = uncertain(np.zeros((len(names), len(names))))
    content = {
        "sentence": _sentence(kind, found[best], length, before, error) + units_said(model.settings.data),
        "kind": kind,
        "group": day,
        "seconds": length,
        "determined": bool(np.isfinite(found[best].seconds)),
        "tip_uncertain_before_mm": 1e3 * before,
        "tip_uncertain_after_mm": 1e3 * found[best].left,
        "tip_error_of_the_model_mm": 1e3 * error,
        "parameters_of_a_day": names,
        "tried": [{"kind": k, **outlook.as_dict()} for (k, _, _), outlook in zip(tried, found, strict=True)],
        "seed": seed,
        "schema_version": 1,
    }
    table = command_table(model.settings.data, begun, times[kept], value[kept], length)
    if PER_ACTION in known[0].settings:
        table["action"] = actions.actions_of(value[kept], begun.initial_command)
    return Design(content, table)


def _problem(fit: Calibration, runs: Sequence[Trajectory]) -> tuple[CalibrationProblem, list[str], Batch]:
    """Problem of one session's recordings, names of its parameters, and values one step up and down along each, from
    the centre of its prior at the body's mean.
    """
    model, left = model_of(fit), model_error_of(fit.record)
    scopes, noise = day_scopes(fit, model, [run.name for run in runs], DAY), left.every(sample_time(runs[0].time))
    drawn = fit.record.posterior
    body = {name: value for name, value in scopes.typical_scales.items() if name not in drawn}
    body |= {p.name: float(np.mean(drawn[p.name])) for p in scopes.parameters if p.name in drawn}
    own = [p for p in scopes.parameters if p.name not in body]
    if not own:
        raise InputError(
            "no parameter of the model differs between sessions",
            where="[model.per_group]",
            remedy="name the parameters that vary between sessions, and calibrate",
        )
    points = STEP * np.concatenate([np.eye(len(own)), -np.eye(len(own))])
    values = {name: np.full(len(points), value) for name, value in body.items()}
    values |= {p.name: physical_of_normal(p, x, values) for p, x in zip(own, points.T, strict=True)}
    program = TrajectoryModel.of_positions(model.simulator, scopes, runs, STATED, noise, left.markers)
    return CalibrationProblem(program, chunk=max(1, model.simulator.lanes // len(runs))), [p.name for p in own], values


def _outlook(
    slope: Float[np.ndarray, "k row column"],
    time: Float[np.ndarray, " row"],
    uncertain: Callable[[np.ndarray], float],
    error: float,
) -> DayOutlook:
    """The first row at which a sequence has determined the day, by bisection: more rows never leave more unknown."""

    def left(row: int) -> float:
        seen = slope[:, : row + 1].reshape(len(slope), -1)
        return uncertain(seen @ seen.T)

    low, high = 0, len(time) - 1
    if left(high) > error:
        return DayOutlook(np.inf, left(high))
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if left(middle) <= error else (middle + 1, high)
    return DayOutlook(float(time[low]), left(low))


def _of_group(runs: Sequence[Trajectory], groups: Patterns, group: str | None) -> tuple[str, list[Trajectory]]:
    """The group of that name, of the last recording by default, and its recordings.

    Raises:
        InputError: no recording has this group.
    """
    found = gather_groups([run.name for run in runs], groups)
    day = group_of(runs[-1].name, groups) if group is None else group
    if day not in found:
        raise InputError(
            f"no given recording belongs to the group {day!r}", where="--group", remedy=nearest(day, found)
        )
    return day, [run for run in runs if run.name in found[day]]


def _begun_like(run: Trajectory, seconds: float) -> Trajectory:
    """A recording of length ``seconds`` with the start, rate and markers of another."""
    step = sample_time(run.time)
    time = step * np.arange(max(2, int(seconds / step + 1e-6) + 1))
    return _as_recording(run, whole(run.name), np.zeros(1), run.initial_command[None], time)


def _followed_proposals(
    model: Model, begun: Trajectory, like: Trajectory, runs: Sequence[Trajectory], rng: np.random.Generator
) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Proposals, in the order of their kinds, that the drives follow: within the commands of the given recordings, and
    made of actions if the commands of ``like`` are.
    """
    simulator = model.simulator

    def taken(run: Trajectory, value: np.ndarray) -> np.ndarray:
        return simulator.taken(run.name, run.initial_command, value)

    done = [
        Trajectory(run.dataset.assign(command=run.dataset["command"].copy(data=taken(run, run.command))))
        for run in runs
    ]
    found = []
    for kind, time, value in sorted(proposals(begun, done, rng), key=lambda proposal: proposal[0]):
        value = taken(begun, value)
        if PER_ACTION in like.settings:
            time, value = _as_actions(begun, float(np.median(np.diff(like.command_time))), time, value)
        if len(value):
            found.append((kind, time, value))
    return found


def _as_actions(begun: Trajectory, period: float, time: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same as far as actions can, one every ``period`` seconds."""
    initial = begun.initial_command
    due = period * np.arange(int(begun.time[-1] / period + 1e-6))
    target = value[np.maximum(np.searchsorted(time, due + 1e-9, side="right") - 1, 0)]
    sent = actions.actions_towards(target, initial)
    return due[: len(sent)], initial + actions.cumulative_displacement(sent)


def _as_recording(
    like: Trajectory, name: str, time: np.ndarray, value: np.ndarray, seen: np.ndarray | None = None
) -> Trajectory:
    """Commands as a recording with the start, observation times and markers of another."""
    observed = like.time if seen is None else seen
    return Trajectory.build(
        Origin(name=name, robot=like.robot, format="memory", settings={"unseen": True}),
        SentCommands(
            command_time=time,
            command=value,
            command_unit=like.command_unit,
            cable_names=like.cable_names,
            initial_command=like.initial_command,
        ).trusted(),
        Measured(
            time=observed, position=np.tile(like.position[:1], (len(observed), 1, 1)), marker_names=like.marker_names
        ),
    )


def _sentence(kind: str, outlook: DayOutlook, length: float, before: float, error: float) -> str:
    what = f"Record the first {length:.3g} s of the {kind} in {COMMANDS}"
    if length == 0.0:
        what = "The first row of a recording is enough, before anything moves"
    change = f"the remaining uncertainty of the session then moves the last marker by {1e3 * outlook.left:.2g} mm"
    change = f"{change}, and by {1e3 * before:.2g} mm without it"
    if np.isfinite(outlook.seconds):
        return f"{what}: {change}. The model's own error is {1e3 * error:.2g} mm."
    return f"{what}: {change}. The model's own error is smaller, {1e3 * error:.2g} mm: allow more --seconds."
