"""From an experiment's tables to the objects they stand for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, TypeVar, overload

from rfdropo_bayes.bayes.calibration import Batch, CalibrationProblem
from rfdropo_bayes.bayes.channels import (
    Channel,
    Markers,
    MotorAngle,
    ObjectPose,
    Series,
    Tension,
    Weighed,
    WeighedParts,
)
from rfdropo_bayes.bayes.channels.motor_angle import MOTOR_ANGLE_NOISE
from rfdropo_bayes.bayes.channels.object_pose import OBJECT_CORRELATION_TIME, OBJECT_NOISE, OBJECT_TURN_NOISE
from rfdropo_bayes.bayes.channels.tension import TENSION_GAIN, TENSION_NOISE
from rfdropo_bayes.bayes.model import TrajectoryModel
from rfdropo_bayes.bayes.noise import (
    NOISE_CORRELATION_TIME,
    NOISE_MODELS,
    OBSERVATION_NOISE,
    Autoregression,
    noise_specs,
)
from rfdropo_bayes.bayes.noise.autoregression import REPEATS, STATED
from rfdropo_bayes.bayes.pooling import Pooled
from rfdropo_bayes.bayes.recordings import RecordingSet, gather_recordings
from rfdropo_bayes.bayes.repeats import group_recordings, with_noise_of_repeats
from rfdropo_bayes.bayes.space import ParameterSpace, build_space
from rfdropo_bayes.data import Trajectory, find_data_file, load_recordings
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.groups import Patterns, gather_groups
from rfdropo_bayes.mechanisms import mechanisms_named
from rfdropo_bayes.mechanisms.registry import REGISTRY
from rfdropo_bayes.robots import Robot, load_robot
from rfdropo_bayes.robots.meshes import read_tetrahedra
from rfdropo_bayes.simulators.black_box import BlackBox, BlackBoxSimulator
from rfdropo_bayes.simulators.engine import Engine
from rfdropo_bayes.simulators.mechanisms import Mechanism
from rfdropo_bayes.simulators.mesh_body import assemble_mesh
from rfdropo_bayes.simulators.mesh_trunk import MeshTrunkSimulator
from rfdropo_bayes.simulators.parameters import ParameterSpec, check_names, check_value
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator
from rfdropo_bayes.simulators.trunk import Discretisation, TrunkSimulator, assemble
from rfdropo_bayes.workflow.engines import backend
from rfdropo_bayes.workflow.experiment import Experiment, ModelTable, Workpiece, matching

Entry = TypeVar("Entry")
AnySimulator = RobotSimulator | BlackBoxSimulator

KNOWN = (REPEATS, STATED)  # noise of the positions that is not inferred

SWITCHED = {  # channels beside the markers, by the key of [model] that makes their readings data
    "tension": (TENSION_NOISE, TENSION_GAIN),
    "motor_angle": (MOTOR_ANGLE_NOISE,),
    "object_pose": (OBJECT_NOISE, OBJECT_TURN_NOISE, OBJECT_CORRELATION_TIME),
}


def find_workpiece(experiment: Experiment, folder: Path) -> Workpiece:
    """The robot an experiment names: one that comes with the package, or a file relative to the experiment's.

    One that was put together in Python holds its robot or black box itself.
    """
    if not isinstance(experiment.robot, str):
        return experiment.robot
    beside = folder / experiment.robot
    return load_robot(beside if beside.suffix == ".toml" and beside.is_file() else experiment.robot)


def find_robot(experiment: Experiment, folder: Path) -> Robot:
    """The same where only a robot will do.

    Raises:
        InputError: a black box.
    """
    found = find_workpiece(experiment, folder)
    if isinstance(found, BlackBox):
        raise InputError("a black box has no body", where=found.name, remedy="use a robot")
    return found


@overload
def build_simulator(experiment: Experiment, robot: Robot, folder: Path = Path()) -> RobotSimulator: ...


@overload
def build_simulator(
    experiment: Experiment, robot: Workpiece, folder: Path = Path()
) -> RobotSimulator | BlackBoxSimulator: ...


def build_simulator(
    experiment: Experiment, robot: Workpiece, folder: Path = Path()
) -> RobotSimulator | BlackBoxSimulator:
    """Robot, body, engine and mechanisms; ``folder`` is that of the experiment file, for the mesh of a body."""
    table = experiment.simulator
    if isinstance(robot, BlackBox):
        if experiment.model.drives:
            raise InputError("a black box has no drives", where="[[model.drives]]", remedy="let the box have them")
        return BlackBoxSimulator(robot, mechanisms_named(experiment.model.mechanisms, robot, folder=folder))
    robot = with_drives(robot, experiment.model)
    if table.drives == "direct":
        robot = robot.without_command_timing()
    time_step = table.time_step or robot.time_step_s
    mechanisms = mechanisms_named(experiment.model.mechanisms, robot, folder=folder)
    trunk: TrunkSimulator | MeshTrunkSimulator
    if table.body == "tetrahedra" and table.tetrahedra is not None:
        options = table.tetrahedra
        mesh = read_tetrahedra(find_data_file(options.mesh, folder), options.unit)
        bound = assemble_mesh(robot, mesh, options)
        engine = Engine(bound, time_step, backend(table, False), integrator=table.integrator)
        trunk = MeshTrunkSimulator(robot, engine, bound, options, time_step, mechanisms)
    else:
        discretisation = Discretisation(time_step, table.nodes_across, table.refine)
        assembly = assemble(robot, discretisation)
        settled = robot.initial_state == "equilibrium"
        engine = Engine(assembly, time_step, backend(table, True), settled, integrator=table.integrator)
        trunk = TrunkSimulator(robot, engine, assembly, discretisation, mechanisms)
    return trunk.pushing() if table.push else trunk


def with_drives(robot: Robot, table: ModelTable) -> Robot:
    """A robot with what the experiment states of its drives, and the groups that it states it for.

    Raises:
        InputError: a cable that the robot does not have.
    """
    stated = (*robot.drives, *table.drives)
    for drives in stated:
        drives.columns(robot.channel_names)
    return robot.model_copy(update={"drives": stated}).grouped(table.groups) if stated else robot


def with_groups(simulator: AnySimulator, groups: Patterns) -> AnySimulator:
    """The same simulator, whose drives take commands as is stated for these groups of recordings."""
    if isinstance(simulator, BlackBoxSimulator) or not simulator.robot.drives:
        return simulator
    return replace(simulator, robot=simulator.robot.grouped(groups))  # type: ignore[type-var]


def measurement_specs(table: ModelTable) -> tuple[ParameterSpec, ...]:
    """Parameters of the channels that are data: the noise of the positions, and of what else is measured."""
    noise = () if table.noise in KNOWN else noise_specs(table.noise)
    further = [spec for key, specs in SWITCHED.items() if getattr(table, key) for spec in specs]
    if table.noise == "white":
        further = [spec for spec in further if spec != OBJECT_CORRELATION_TIME]
    return (*noise, *(s for s in further if table.noise != REPEATS or s == TENSION_GAIN))


def fixed_values(experiment: Experiment, simulator: AnySimulator) -> dict[str, float]:
    """Values of [model.fixed], checked against names and hard bounds."""
    table = experiment.model
    specs = simulator.parameters + measurement_specs(table)
    check_used(table.fixed, experiment, simulator, where="[model.fixed]")
    by_name = {spec.name: spec for spec in specs}
    given = expand_groups(table.fixed, specs)
    return {name: check_value(by_name[name], value, where="[model.fixed]") for name, value in given.items()}


def check_used(names: Iterable[str], experiment: Experiment, simulator: AnySimulator, *, where: str) -> None:
    """Raise InputError for a parameter that the model does not have, and say what would bring it in."""
    table = experiment.model
    specs = simulator.parameters + measurement_specs(table)
    known = [spec.name for spec in specs]
    further = {f"set [model] {key} = true": found for key, found in SWITCHED.items() if not getattr(table, key)}
    further['let the noise last, [model] noise = "auto"'] = (OBJECT_CORRELATION_TIME,)
    further |= {f'set [model] noise = "{model}"': noise_specs(model) for model in NOISE_MODELS}
    for mechanism in mechanisms_named(REGISTRY, simulator.robot):
        further[f"add {mechanism.name!r} to [model] mechanisms"] = mechanism.parameters
    for name in names:
        if name in known or any(each.startswith(f"{name}_") for each in known):
            continue
        for remedy, absent in further.items():
            if name in [spec.name for spec in absent]:
                raise InputError(f"the model has no parameter {name!r}", where=where, remedy=f"{remedy}, or remove it")
        check_names([name], specs, where=where)


def load_data(experiment: Experiment, folder: Path, role: Literal["fit", "test"]) -> list[Trajectory]:
    """The recordings of one role, ``"fit"`` or ``"test"``."""
    if experiment.data is None:
        raise InputError("the experiment has no [data]", remedy="name the recordings to fit")
    return load_recordings(experiment.data, folder, role=role)


def expand_groups(table: Mapping[str, Entry], specs: Sequence[ParameterSpec]) -> dict[str, Entry]:
    """Write out the keys that stand for several parameters: ``offset`` for ``offset_x``, ``offset_y``, ``offset_z``."""
    known = [spec.name for spec in specs]
    expanded: dict[str, Entry] = {}
    for name, entry in table.items():
        members = [name] if name in known else [spec for spec in known if spec.startswith(f"{name}_")]
        expanded |= dict.fromkeys(members or [name], entry)
    return expanded


def pooling(
    experiment: Experiment, specs: Sequence[ParameterSpec], fitted: Sequence[str], others: Sequence[str] = ()
) -> dict[str, Pooled]:
    """The parameters of [model.per_group], with the recordings of each group that has one to fit.

    Raises:
        InputError: a name that is none of ``specs``, those of the simulator: noise is the same for all recordings.
    """
    groups = gather_groups([*fitted, *others], experiment.model.groups)
    known = {group: members for group, members in groups.items() if set(members) & set(fitted)}
    found: dict[str, Pooled] = {}
    for family, spread in experiment.model.per_group.items():
        members = expand_groups({family: spread}, specs)
        check_names(members, specs, where="[model.per_group]")
        found |= {name: Pooled(spread, known, family) for name in members}
    return found


def build_model(experiment: Experiment, simulator: AnySimulator, trajectories: Sequence[Trajectory]) -> TrajectoryModel:
    """The probabilistic program of an experiment for the given recordings.

    Raises:
        InputError: unknown names, priors outside the bounds, a parameter both fixed and inferred.
    """
    recordings = gather_recordings(simulator, trajectories)
    specs = simulator.parameters + measurement_specs(experiment.model)
    space = model_space(experiment, simulator, specs, recordings.names)
    channels = gather_channels(experiment, simulator, trajectories, recordings, space.names)
    return TrajectoryModel(simulator, space, fixed_values(experiment, simulator), recordings, channels)


def model_space(
    experiment: Experiment,
    simulator: AnySimulator,
    specs: Sequence[ParameterSpec],
    fitted: Sequence[str],
    others: Sequence[str] = (),
    later: Sequence[Mechanism] = (),
) -> ParameterSpace:
    """What is inferred: parameters of the model, those of ``later`` mechanisms after all others.

    The noise parameters are always inferred, unless [model.fixed] holds them; the gain of tensions with a prior only.

    Args:
        experiment: says which have a prior.
        simulator: with all mechanisms.
        specs: parameters that may be inferred.
        fitted: names of the recordings that are fitted; others: of those that are not, which may belong to groups.
        later: mechanisms whose parameters come last, such as the candidates of an audit.

    Raises:
        InputError: unknown names, priors outside the bounds, a parameter both fixed and inferred.
    """
    table, fixed = experiment.model, fixed_values(experiment, simulator)
    check_used(table.priors, experiment, simulator, where="[model.priors]")
    check_used(table.per_recording, experiment, simulator, where="[model.per_recording]")
    known, last = {spec.name for spec in specs}, [spec.name for m in later for spec in m.parameters]
    added = [spec.name for mechanism in simulator.mechanisms if mechanism not in later for spec in mechanism.parameters]
    measured = [s.name for s in specs if s not in simulator.parameters and s != TENSION_GAIN]
    every = simulator.parameters + measurement_specs(table)
    given = {name: entry for name, entry in expand_groups(table.priors, every).items() if name in known}
    both = sorted(set(fixed) & set(given))
    if both:
        raise InputError(f"{both[0]!r} has a prior and a fixed value", where="[model]", remedy="remove one of them")
    shared = expand_groups(table.per_recording, every)
    defaults = [name for name in (*added, *shared, *measured) if name not in fixed and name not in given]
    priors: dict[str, Any] = {name: given.get(name, {}) for name in (*given, *defaults) if name not in last}
    priors |= {name: given.get(name, {}) for name in last if name not in fixed and name not in priors}
    scopes = {
        name: matching(fitted, patterns, where=f"[model.per_recording] {name}") for name, patterns in shared.items()
    }
    return build_space(specs, priors, scopes, fitted, pooled=pooling(experiment, simulator.parameters, fitted, others))


def gather_channels(
    experiment: Experiment,
    simulator: AnySimulator,
    trajectories: Sequence[Trajectory],
    recordings: RecordingSet,
    inferred: Sequence[str],
    fitted: int | None = None,
) -> tuple[Channel, ...]:
    """What was measured and is to be used, markers first and weighed parts last.

    ``inferred`` are the names of parameters, of which some may be weighed; ``fitted`` is the number of recordings, the
    first ones, that need what [model] asks for; all by default.
    """
    table, length = experiment.model, recordings.time.shape[1]
    stated = stated_noise(experiment, recordings, trajectories[0]) if table.noise == STATED else None
    channels: list[Channel] = [Markers.gather(recordings, table.noise, stated)]
    if table.tension:
        channels.append(Tension.gather(simulator, trajectories, length, fitted))
    if table.motor_angle:
        channels.append(MotorAngle.gather(trajectories, length, fitted))
    if table.object_pose:
        channels.append(ObjectPose.gather(simulator, trajectories, length, lasting=table.noise != "white"))
    if table.noise == REPEATS:
        groups = group_recordings(recordings, trajectories)
        channels = [with_noise_of_repeats(channel, groups) for channel in channels if isinstance(channel, Series)]
    if table.weighed:
        entries = (Weighed(tuple(entry.parameters), entry.value, entry.sd) for entry in table.weighed)
        channels.append(WeighedParts(tuple(entries)).named(inferred))
    return tuple(channels)


def stated_noise(experiment: Experiment, recordings: RecordingSet, first: Trajectory) -> Autoregression:
    """The noise of the positions that the experiment file states.

    Raises:
        InputError: none is stated.
    """
    noise = experiment.noise
    if noise is None or noise.standard_deviation == 0.0:
        raise InputError("no noise is stated", where='[model] noise = "stated"', remedy="give [noise]")
    values = {OBSERVATION_NOISE.name: noise.standard_deviation}
    if noise.correlation_time is not None:
        values[NOISE_CORRELATION_TIME.name] = noise.correlation_time
    return Markers.gather(recordings, STATED).stated(values, float(first.dataset.attrs["sample_time"]))


def build_problem(model: TrajectoryModel, earlier: Batch | None = None) -> CalibrationProblem:
    """The model as the inference methods see it, in chunks that suit its engine; ``earlier``: see the problem."""
    lanes = model.simulator.lanes
    return CalibrationProblem(model, chunk=max(1, lanes // len(model.recordings.names)), earlier=earlier)
