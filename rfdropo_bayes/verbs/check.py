"""``rfdropo check``: description of an experiment's robot, recordings and model, in words and pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal, TypeVar

import jax
import numpy as np

from rfdropo_bayes.bayes.trajectory_model import TrajectoryModel
from rfdropo_bayes.data import Trajectory, check_channels, load_recordings, noise_floor, shared_markers
from rfdropo_bayes.data.repeats import group_repeats
from rfdropo_bayes.data.sample_times import sample_time
from rfdropo_bayes.data.thinning import looked_at, thinning_note
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import output_folder, write_json
from rfdropo_bayes.groups import unmatched
from rfdropo_bayes.inference.methods import make_config
from rfdropo_bayes.inference.progress import say_step
from rfdropo_bayes.mechanisms import mechanisms_named
from rfdropo_bayes.model.assembly import build_model, build_simulator, with_drives
from rfdropo_bayes.model.experiment import ROLLOUTS, AuditTable, Experiment, InferenceTable, load_experiment
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.model_spec import ModelSpec, Workpiece, find_robot, spec_of
from rfdropo_bayes.model.robot_listings import robot_facts, simulator_facts
from rfdropo_bayes.posteriors import central_interval
from rfdropo_bayes.report.rest_figure import rest_figure
from rfdropo_bayes.report.trajectory_figures import save_recording
from rfdropo_bayes.robots import Robot, Travel, robot_shape
from rfdropo_bayes.robots.robot import implausible_values
from rfdropo_bayes.simulators.body_engine import QUASI_STATIC
from rfdropo_bayes.tables import changed
from rfdropo_bayes.verbs.arguments import given_model
from rfdropo_bayes.verbs.at_rest import blocks_of
from rfdropo_bayes.verbs.audit import candidate_names
from rfdropo_bayes.verbs.calibrate import inference_options
from rfdropo_bayes.verbs.command_lag import lag_words
from rfdropo_bayes.verbs.motion_check import measure_motion
from rfdropo_bayes.verbs.motion_direction import AGREEING
from rfdropo_bayes.verbs.numerical_error import numerical_error_lines
from rfdropo_bayes.verbs.placement import far_from_rest
from rfdropo_bayes.verbs.preflight import PRIOR_DRAWS, Preflight, preflight
from rfdropo_bayes.verbs.recording_doubts import asked_pulls, drives_beyond, recording_cautions, shortened
from rfdropo_bayes.verbs.rest_fit import first_answer, misread, rest_lines, rest_notes

MILLIMETRES = 1e3
LONG = 60.0  # recordings of more seconds make whoever checks them wait for minutes
IRREGULAR = 1.5  # gaps longer than this multiple of the median sample time are reported

Result = TypeVar("Result")


@dataclass
class Check:
    """Result of `run_check`."""

    # facts, as pairs of a label and a text; an empty label continues the previous pair
    lines: list[tuple[str, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)  # valid facts worth knowing
    # valid but suspicious facts: the recordings or their description look wrong
    doubts: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)  # faults that keep the experiment from running
    files: list[Path] = field(default_factory=list)  # pictures, one per recording
    # combinations that a fit can determine; None if not requested, or if nothing can be fitted
    ahead: Preflight | None = None


def check(model: Model, runs: Sequence[Trajectory], *, seed: int = 0) -> Preflight:
    """Find, before a fit, the parameter combinations that recordings cannot determine, measurements that would,
    unexcited channels, and the cost of the fit; see `preflight`.

    Args:
        model: model to fit.
        runs: recordings to fit.
        seed: seed of the prior draws at which derivatives are taken.

    Raises:
        InputError: bad input, or a model that cannot be simulated.
    """
    model = given_model(model, "check")
    fitted = model.runs(runs)[0]
    if model.spec.simulator.motion != QUASI_STATIC:
        return preflight(model, fitted, seed=seed)
    # Poses at rest do not know of each other: some rows stand for all.
    fewer = [blocks_of(run) for run in fitted]
    share = sum(len(run.time) for run in fewer) / sum(len(run.time) for run in fitted)
    return preflight(model, fewer, seed=seed, share=share)


def run_check(path: Path, out: Path, overrides: Sequence[str] = (), *, ahead: bool = False) -> Check:
    """Read everything that an experiment names, and describe it.

    Args:
        path: the experiment file.
        out: folder for the pictures, ``NAME.png`` for each recording, and check.json.
        overrides: assignments that replace entries of the file.
        ahead: also measure errors of time step and mesh, and the combinations that a fit can determine, see `check`.

    Raises:
        InputError: the experiment file or the robot cannot be read; other faults are among the problems.
    """
    experiment, _ = load_experiment(path, overrides)
    folder = Path(path).resolve().parent
    robot = find_robot(experiment.robot, folder, experiment.adapter)
    report = Check()
    if isinstance(robot, Robot):
        robot = _try(report, partial(with_drives, robot, experiment.model.drives, experiment.model.groups)) or robot
    _say_robot(report, robot)
    recordings = {role: _read(report, experiment, folder, role) for role in ("fit", "test")}
    first: list[tuple[str, str]] = []
    for role, trajectories in recordings.items():
        for trajectory in trajectories:
            own = _of_recording(report, trajectory, role, robot)
            report.lines += _unlike(own, first)
            first = first or own
    named = [trajectory.name for trajectories in recordings.values() for trajectory in trajectories]
    columns = None if experiment.data is None else experiment.data.columns
    cautions = recording_cautions(robot, [*recordings["fit"], *recordings["test"]], columns)
    report.doubts += [caution.sentence for caution in cautions]
    if isinstance(robot, Robot):
        report.notes += [caution.sentence for caution in _try(report, partial(robot.unstated, named)) or []]
    _say_repeats(report, [*recordings["fit"], *recordings["test"]])
    if experiment.data is not None and experiment.data.fit and not experiment.data.test:
        report.notes.append(
            "no recording is kept for a test: predictions of unseen motions will not be scored; name one "
            "under test in [data]"
        )
    report.doubts += [
        f"[model.groups] {group}: {entry!r} matches no recording; the recordings are {shortened(named)}"
        for group, entry in unmatched(named, experiment.model.groups)
        if named
    ]
    _say_model(report, experiment, folder, recordings["fit"])
    notes = [thinning_note(trajectory) for trajectory in (*recordings["fit"], *recordings["test"])]
    report.notes += [note for note in notes if note is not None]
    if ahead and recordings["fit"] and not report.problems:
        rests = experiment.simulator.motion == QUASI_STATIC
        fewer = recordings["fit"] if rests else [looked_at(trajectory) for trajectory in recordings["fit"]]
        if isinstance(robot, Robot):
            _say_motion(report, experiment, folder, recordings, fewer, output_folder(out))
        _say_ahead(report, experiment, folder, fewer)
    if any(recordings.values()):
        out = output_folder(out)
    rest = robot_shape(robot) if isinstance(robot, Robot) else None
    for trajectory in (*recordings["fit"], *recordings["test"]):
        file = out / f"{trajectory.name.replace('/', '_')}.png"
        save_recording(trajectory, rest, file)
        report.files.append(file)
    if report.files:
        content = {key: getattr(report, key) for key in ("lines", "notes", "doubts", "problems")}
        ahead_of_fit = None if report.ahead is None else report.ahead.as_dict()
        write_json(out / "check.json", {**content, "preflight": ahead_of_fit})
    return report


def _say_motion(
    report: Check,
    experiment: Experiment,
    folder: Path,
    recordings: Mapping[str, Sequence[Trajectory]],
    fewer: Sequence[Trajectory],
    out: Path,
) -> None:
    """Report on the nominal model: numerical errors, another arrangement of the commands, and a fit at rest.

    ``fewer`` are the recordings to fit, thinned to the rows that their motion needs.
    """
    say_step(f"simulating {fewer[0].name} with a finer time step, more elements, and the other kind of motion")
    spec, runs = spec_of(experiment, folder), recordings["fit"]
    report.lines += _try(report, partial(numerical_error_lines, spec, fewer[0])) or []
    columns = None if experiment.data is None else experiment.data.columns
    rests = spec.simulator.motion == QUASI_STATIC
    if rests:
        lag = lag_words(runs, columns)
        report.lines.append(("row and pose", lag.words))
        report.doubts += [] if lag.doubt is None else [lag.doubt]
    compared = _try(report, partial(measure_motion, spec, runs, columns))
    if compared is None:
        return
    report.lines.append(("motion", compared.words))
    report.doubts += [caution.sentence for caution in compared.cautions]
    if compared.arrangement is not None:
        shown = (runs, recordings["test"]) if rests else (fewer, [looked_at(run) for run in recordings["test"]])
        fit = _try(report, partial(first_answer, spec, *shown, compared.arrangement))
        if fit is not None:
            report.lines += rest_lines(fit)
            report.notes += rest_notes(fit) if rests else []
            if (
                not report.doubts
                and compared.agreement < AGREEING
                and (words := misread(fit, moves=not rests)) is not None
            ):
                report.doubts.append(words)
            report.files.append(out / "at_rest.png")
            rest_figure(fit).savefig(report.files[-1])


def _say_ahead(report: Check, experiment: Experiment, folder: Path, runs: Sequence[Trajectory]) -> None:
    """Report on combinations that a fit can determine; a failed simulation is not counted as a problem."""
    seconds = sum(float(run.time[-1]) for run in runs)
    moves = experiment.simulator.motion != QUASI_STATIC
    patience = "; this takes minutes, and --quick leaves it out" if moves and seconds > LONG else ""
    say_step(f"simulating {seconds:.3g} s under draws of the prior, to estimate the result of a fit{patience}")
    try:
        report.ahead = check(Model.of_experiment(experiment, folder), runs, seed=experiment.seed)
    except InputError as error:
        report.doubts.append(str(error))
        return
    report.lines += report.ahead.lines()


def _try(report: Check, action: Callable[[], Result]) -> Result | None:
    """Result of an action; its InputError is added to the problems."""
    try:
        return action()
    except InputError as error:
        if str(error) not in report.problems:
            report.problems.append(str(error))
        return None


def _say_robot(report: Check, robot: Workpiece) -> None:
    facts = robot_facts(robot) if isinstance(robot, Robot) else simulator_facts(robot)
    for label in ("robot", "body", "gravity", "starts", "engine", "commands", "cables", "markers", "candidates"):
        if label in facts:
            report.lines.append((label, facts[label]))


def _read(report: Check, experiment: Experiment, folder: Path, role: Literal["fit", "test"]) -> list[Trajectory]:
    """The recordings of one role, without faulty recordings."""
    spec = experiment.data
    if spec is None:
        if role == "fit":
            report.lines.append(("recordings", "none: the experiment has no [data], and can only be simulated"))
        return []
    together = _try(report, partial(load_recordings, spec, folder, role=role))
    if together is not None:
        return together
    readable: dict[str, Trajectory] = {}
    for entry in spec.fit if role == "fit" else spec.test:
        alone = changed(spec, where="[data]", fit=[entry], test=[])
        for recording in _try(report, partial(load_recordings, alone, folder)) or []:
            readable.setdefault(recording.name, recording)
    return list(readable.values())


def _unlike(lines: list[tuple[str, str]], first: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """The lines of a recording that differ from the first recording's."""
    if not first:
        return lines
    known = {text for _, text in first}
    own = [lines[0], *(line for line in lines[1:] if line[1] not in known)]
    return own if len(own) == len(lines) else [*own, ("", f"all else as {first[0][0].partition(': ')[2]}")]


def _of_recording(report: Check, trajectory: Trajectory, role: str, robot: Workpiece) -> list[tuple[str, str]]:
    """Lines of one recording: rows, markers, masks and commands, compared with the robot's."""
    gaps = np.diff(trajectory.time)
    step = sample_time(trajectory.time)
    rows = f"{len(trajectory.time)} rows over {trajectory.time[-1]:.4g} s, one every {1e3 * step:.4g} ms"
    if gaps.max() > IRREGULAR * step:
        rows += f"; the longest gap is {1e3 * gaps.max():.4g} ms, at {trajectory.time[np.argmax(gaps)]:.4g} s"
    lines = [(f"{role}: {trajectory.name}", rows)]
    lines += [("", text) for text in (*_markers(report, trajectory, robot), *_commands(report, trajectory, robot))]
    further = [
        word
        for word, values in (
            ("cable tensions", trajectory.tension),
            ("motor angles", trajectory.motor_angle),
            ("poses of an object", trajectory.object_pose),
            ("orientations", trajectory.orientation),
        )
        if values is not None
    ]
    if further:
        lines.append(("", f"also {' and '.join(further)}"))
    if trajectory.missing:
        lines.append(("", f"left out: {trajectory.missing}"))
    return lines


def _markers(report: Check, trajectory: Trajectory, robot: Workpiece) -> Iterator[str]:
    shared = _try(report, lambda: shared_markers([trajectory], robot.marker_names))
    if shared is None:
        yield f"markers {shortened(trajectory.marker_names)}: NONE is the robot's"
        return
    unknown = [name for name in trajectory.marker_names if name not in shared]
    unseen = [name for name in robot.marker_names if name not in shared]
    words = f"markers {shortened(shared)}: as the robot's"
    if unknown:
        words += f"; {shortened(unknown)}: not the robot's, left out"
    yield words + (f"; the robot's {shortened(unseen)}: not measured" if unseen else "")
    usable = trajectory.position[trajectory.position_mask]
    if len(usable):
        ranges = ", ".join(
            f"{axis} {MILLIMETRES * low:.4g} to {MILLIMETRES * high:.4g}"
            for axis, low, high in zip("xyz", usable.min(axis=0), usable.max(axis=0), strict=True)
        )
        yield f"positions in mm, in the robot's frame: {ranges}"
    yield _masks(trajectory)
    if not isinstance(robot, Robot):
        return
    place = far_from_rest(robot, trajectory)
    if place is None:
        yield "first row: every position is masked"
        return
    distances = ", ".join(f"{name} {MILLIMETRES * value:.3g}" for name, value in place.items())
    yield f"first row, distance from the undeformed robot in mm: {distances}"


def _masks(trajectory: Trajectory) -> str:
    masked, every = int((~trajectory.position_mask).sum()), trajectory.position_mask.size
    if not masked:
        return "no position is masked"
    counts = trajectory.settings.get("faults", {})
    kinds = ", ".join(f"{sum(each)} {kind}" for kind, each in counts.items() if sum(each) and kind != "breaks")
    return f"{masked} of {every} positions are masked" + (f" (in the whole file: {kinds})" if kinds else "")


def _commands(report: Check, trajectory: Trajectory, robot: Workpiece) -> Iterator[str]:
    names, unit, command = trajectory.cable_names, trajectory.command_unit, trajectory.command
    yield f"{len(names)} commands in {unit}: {shortened(names)}; from {command.min():.4g} to {command.max():.4g}"
    yield f"command before the first row: {trajectory.first_command}"
    problems = len(report.problems)
    _try(report, lambda: check_channels(trajectory, robot.channel_names, robot.command_unit))
    if len(report.problems) > problems:
        return
    if tuple(names) != robot.channel_names:
        yield f"the robot calls them {shortened(robot.channel_names)}, in this order"
    if not isinstance(robot, Robot):
        return
    travel = _try(report, partial(robot.travel, trajectory.name, trajectory.initial_command))
    if travel is not None:
        yield from _travel(travel, robot)
    asked = asked_pulls(robot, trajectory)
    doubted = asked is None or (not robot.held_by_force and asked.max() > robot.length)
    beyond = "" if asked is None or doubted else drives_beyond(robot, asked)
    if beyond:
        limits = "drives are held at the limits of the robot file if commands ask for more"
        report.notes.append(f"{trajectory.name}: {limits}: {beyond}")


def _travel(travel: Travel, robot: Robot) -> Iterator[str]:
    """Lines on the stated limits of drives in one recording; channels with equal limits share a line."""
    alike: dict[str, list[str]] = {}
    for name, low, high, lost, kept in zip(robot.channel_names, *astuple(travel), strict=True):
        word = "lost" if lost else "kept" if kept else "clipped"
        if np.isfinite(low) or np.isfinite(high):
            alike.setdefault(f"{low:.4g} to {high:.4g} {robot.command_unit}, beyond: {word}", []).append(name)
    for text, names in alike.items():
        yield f"drives of {shortened(names)}: {text}"


def _say_repeats(report: Check, trajectories: Sequence[Trajectory]) -> None:
    groups = [group for group in group_repeats(trajectories) if len(group) > 1]
    for group in groups:
        report.lines.append(("repeats", shortened([trajectories[index].name for index in group])))
    floor = _try(report, lambda: noise_floor(trajectories)) if groups else None
    if floor:
        words = ", ".join(f"{name} {MILLIMETRES * value:.3g}" for name, value in floor.items())
        report.lines.append(("noise", f"spread of the repeats in mm: {words}"))
    elif trajectories:
        report.notes.append("no recording was repeated: noise cannot be distinguished from errors of the simulator")


def _budget(table: InferenceTable) -> str:
    """The budget of a fit in words."""
    if table.minutes is not None and table.rollouts is None:
        return f"as many rollouts as {table.minutes:g} min hold"
    return f"{table.rollouts or ROLLOUTS} rollouts"


def _say_model(report: Check, experiment: Experiment, folder: Path, fitted: list[Trajectory]) -> None:
    """Report on inferred parameters and method; a model that cannot be built is a problem."""
    method, named = experiment.inference.method, experiment.model.mechanisms
    _try(report, lambda: make_config(method, inference_options(experiment.inference)))
    report.lines.append(("method", f"{method}, {_budget(experiment.inference)}, seed {experiment.seed}"))
    report.lines.append(("mechanisms", ", ".join(named) or "none"))
    spec = _try(report, lambda: spec_of(experiment, folder))
    if spec is not None:
        _try(report, partial(_see_candidates, spec, experiment.audit))
    simulator = None if spec is None else _try(report, partial(build_simulator, spec))
    if spec is None or simulator is None or not fitted:
        return
    if simulator.integrator == QUASI_STATIC:
        report.lines.append(("motion", "quasi-static: every row is an equilibrium, without time step and damping"))
    else:
        step = float(simulator.description["time_step_s"])  # type: ignore[arg-type]
        report.lines.append(("time step", f"{1e3 * step:.4g} ms"))
    model = _try(report, lambda: build_model(spec, simulator, fitted))
    if model is not None:
        for index, parameter in enumerate(model.scopes.parameters):
            table = parameter.table
            words = ", ".join(f"{k} {v:g}" for k, v in table.items() if k != "distribution")
            text = f"{parameter.name} [{parameter.spec.unit}] ~ {table.get('distribution')}({words})"
            report.lines.append(("inferred" if index == 0 else "", text))
        doubt = implausible_values(spec.robot, _ranges(model)) if isinstance(spec.robot, Robot) else None
        report.doubts += [] if doubt is None else [doubt]
    recorded = {
        "tension": any(t.tension is not None for t in fitted),
        "motor_angle": any(t.motor_angle is not None and t.command_unit == "rad" for t in fitted),
        "object_pose": any(t.object_pose is not None for t in fitted),
        "orientation": any(t.orientation is not None for t in fitted),
    }
    for key, there in recorded.items():
        if there and not asdict(spec.channels)[key]:
            words = key.replace("_", " ")
            report.notes.append(f"{words} was recorded, and is no data: [model] {key} = true would make it so")


def _ranges(model: TrajectoryModel) -> dict[str, tuple[float, float]]:
    """Central 90 % range of every parameter under the prior, and fixed values."""
    drawn = model.scopes.sample(jax.random.key(0), PRIOR_DRAWS)
    known = {name: (value, value) for name, value in model.scopes.fixed.items()}
    return known | {p.spec.name: central_interval(np.asarray(drawn[p.name])) for p in model.scopes.parameters}


def _see_candidates(spec: ModelSpec, table: AuditTable) -> None:
    """Check that the mechanisms named in [audit] exist.

    Raises:
        InputError: a mechanism does not exist.
    """
    names = candidate_names(spec, table)
    mechanisms_named(names, spec.robot, folder=spec.folder, where="[audit] candidates")
