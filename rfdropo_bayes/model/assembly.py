"""Assembly of a model: from its specification to simulator, probabilistic program and problem."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

import jax

from rfdropo_bayes.bayes.calibration_problem import CalibrationProblem
from rfdropo_bayes.bayes.channels import (
    Channel,
    Markers,
    MotorAngle,
    ObjectPose,
    Orientation,
    Series,
    Tension,
    WeighedParts,
)
from rfdropo_bayes.bayes.channels.motor_angle import MOTOR_ANGLE_NOISE
from rfdropo_bayes.bayes.channels.object_pose import OBJECT_CORRELATION_TIME, OBJECT_NOISE, OBJECT_TURN_NOISE
from rfdropo_bayes.bayes.channels.orientation import FRAME_TURNS, ORIENTATION_NOISE
from rfdropo_bayes.bayes.channels.tension import TENSION_GAIN, TENSION_NOISE
from rfdropo_bayes.bayes.inferred_parameter import Pooled
from rfdropo_bayes.bayes.noise import (
    NOISE_CORRELATION_TIME,
    NOISE_MODELS,
    OBSERVATION_NOISE,
    Autoregression,
    noise_specs,
)
from rfdropo_bayes.bayes.noise.autoregression import REPEATS, STATED
from rfdropo_bayes.bayes.priors import prior_from_table
from rfdropo_bayes.bayes.recordings import RecordingSet, gather_recordings
from rfdropo_bayes.bayes.repeat_noise import group_recordings, with_noise_of_repeats
from rfdropo_bayes.bayes.scopes import Scopes, build_scopes
from rfdropo_bayes.bayes.trajectory_model import TrajectoryModel
from rfdropo_bayes.data import DataSpec, Trajectory, find_data_file, load_recordings
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.groups import Patterns, gather_groups
from rfdropo_bayes.mechanisms import mechanisms_named
from rfdropo_bayes.mechanisms.drift import rates_over
from rfdropo_bayes.mechanisms.laws import LawChoice, make_law
from rfdropo_bayes.mechanisms.ports import port_map
from rfdropo_bayes.mechanisms.registry import REGISTRY
from rfdropo_bayes.model.experiment import SimulatorTable, matching
from rfdropo_bayes.model.model_spec import DataChannels, ModelSpec
from rfdropo_bayes.posteriors import DrawsByOwner, ParameterInfo
from rfdropo_bayes.robots import DriveTravel, Robot
from rfdropo_bayes.robots.meshes import read_tetrahedra
from rfdropo_bayes.simulators.black_box import BlackBox, BlackBoxSimulator
from rfdropo_bayes.simulators.body_engine import QUASI_STATIC, Backend, Engine
from rfdropo_bayes.simulators.mechanisms import Mechanism
from rfdropo_bayes.simulators.mesh_body import MeshTrunkSimulator, assemble_mesh
from rfdropo_bayes.simulators.parameters import ParameterSpec, check_names, check_value, specs_of
from rfdropo_bayes.simulators.robot_simulator import DAMPING, RobotSimulator
from rfdropo_bayes.simulators.trunk import Discretisation, TrunkSimulator, assemble
from rfdropo_bayes.tables import nearest

Entry = TypeVar("Entry")
AnySimulator = RobotSimulator | BlackBoxSimulator

KNOWN = (REPEATS, STATED)  # noise of the positions that is not inferred

SWITCHED = {  # channels beside the markers, by the key of [model] that makes their readings data
    "tension": (TENSION_NOISE, TENSION_GAIN),
    "motor_angle": (MOTOR_ANGLE_NOISE,),
    "object_pose": (OBJECT_NOISE, OBJECT_TURN_NOISE, OBJECT_CORRELATION_TIME),
    "orientation": (ORIENTATION_NOISE, *FRAME_TURNS),
}
GAINS = (TENSION_GAIN, *FRAME_TURNS)  # parameters of channels that are known unless they have a prior
REST_CLOCK = 0.05  # step [s] of drives and cameras of a body at rest, which has no time step itself


def robot_of(spec: ModelSpec) -> Robot:
    """The robot of a model that must have a robot.

    Raises:
        InputError: the model is a black box.
    """
    if isinstance(spec.robot, BlackBox):
        raise InputError("a black box has no body", where=spec.robot.name, remedy="use a robot")
    return spec.robot


def integrator_of(spec: ModelSpec) -> str | None:
    """Integrator of time steps: from [simulator], or else from the robot; "quasi-static" for a body at rest, None for a
    black box."""
    if isinstance(spec.robot, BlackBox):
        return None
    if spec.simulator.motion == QUASI_STATIC:
        return QUASI_STATIC
    return spec.simulator.integrator or spec.robot.integrator


def build_simulator(spec: ModelSpec) -> AnySimulator:
    """The simulator of a model, mechanisms included."""
    if isinstance(spec.robot, BlackBox):
        return _with_mechanisms(BlackBoxSimulator(spec.robot), spec)
    return build_robot_simulator(spec)


def build_robot_simulator(spec: ModelSpec) -> RobotSimulator:
    """The simulator (body, engine and mechanisms) of a model; the model must have a robot.

    Raises:
        InputError: the model is a black box.
    """
    table, robot = spec.simulator, with_drives(robot_of(spec), spec.drives, spec.groups)
    if table.drives == "direct":
        robot = robot.without_command_timing()
    rests = table.motion == QUASI_STATIC
    time_step = REST_CLOCK if rests else table.time_step or robot.time_step_s
    integrator = QUASI_STATIC if rests else table.integrator or robot.integrator
    trunk: TrunkSimulator | MeshTrunkSimulator
    if table.body == "tetrahedra" and table.tetrahedra is not None:
        options = table.tetrahedra
        mesh = read_tetrahedra(find_data_file(options.mesh, spec.folder), options.unit)
        bound = assemble_mesh(robot, mesh, options)
        engine = Engine(bound, time_step, backend(table, False), integrator=integrator)
        trunk = MeshTrunkSimulator(robot, engine, bound, options, time_step)
    else:
        discretisation = Discretisation(time_step, table.refine)
        assembly = assemble(robot, discretisation)
        settled = rests or robot.initial_state == "equilibrium"
        engine = Engine(assembly, time_step, backend(table, True), settled, integrator=integrator)
        trunk = TrunkSimulator(robot, engine, assembly, discretisation)
    return _with_mechanisms(trunk.pushing() if table.push else trunk, spec)


Extended = TypeVar("Extended", bound=AnySimulator)


def _with_mechanisms(simulator: Extended, spec: ModelSpec) -> Extended:
    """A simulator with the mechanisms of a model, laws at its ports among them.

    Raises:
        InputError: a port that the simulator does not have.
    """
    made: list[Mechanism] = []
    for choice in spec.mechanisms:
        if isinstance(choice.kind, LawChoice):
            ports = port_map(simulator, simulator.marker_names)
            made.append(make_law(choice.kind, ports, simulator.channel_names, simulator.command_unit))
        else:
            made.append(choice.made_for(simulator.robot))
    return replace(simulator, mechanisms=tuple(made))  # type: ignore[type-var]


def with_drives(robot: Robot, drives: Sequence[DriveTravel], groups: Patterns) -> Robot:
    """A robot with the drives that an experiment states, and their groups.

    Raises:
        InputError: a cable that the robot does not have.
    """
    stated = (*robot.drives, *drives)
    return robot.with_changes(drives=stated).grouped(groups) if stated else robot


def with_groups(simulator: AnySimulator, groups: Patterns) -> AnySimulator:
    """The same simulator, with drives as stated for the given groups of recordings."""
    if isinstance(simulator, BlackBoxSimulator) or not simulator.robot.drives:
        return simulator
    return replace(simulator, robot=simulator.robot.grouped(groups))  # type: ignore[type-var]


def measurement_specs(noise: str, channels: DataChannels) -> tuple[ParameterSpec, ...]:
    """Parameters of the channels that are data: the noise of the positions and of other measured channels."""
    own = () if noise in KNOWN else noise_specs(noise)
    further = [spec for key, chosen in asdict(channels).items() if chosen for spec in SWITCHED[key]]
    if noise == "white":
        further = [spec for spec in further if spec != OBJECT_CORRELATION_TIME]
    return (*own, *(s for s in further if noise != REPEATS or s in GAINS))


def measured_parameters() -> set[str]:
    """Names of all parameters that some channel or some noise may have."""
    noise = (spec.name for model in NOISE_MODELS for spec in noise_specs(model))
    return {*noise, *(spec.name for found in SWITCHED.values() for spec in found)}


def model_specs(spec: ModelSpec, simulator: AnySimulator) -> tuple[ParameterSpec, ...]:
    """Every parameter of a model: of the simulator, and of the channels that are data."""
    return simulator.parameters + measurement_specs(spec.noise, spec.channels)


def fixed_values(spec: ModelSpec, simulator: AnySimulator) -> dict[str, float]:
    """Values of [model.fixed], checked against names and hard bounds."""
    specs = model_specs(spec, simulator)
    check_used(spec.fixed, spec, simulator, where="[model.fixed]")
    by_name = {each.name: each for each in specs}
    given = expand_groups(spec.fixed, specs)
    return {name: check_value(by_name[name], value, where="[model.fixed]") for name, value in given.items()}


def physical_values(spec: ModelSpec, simulator: AnySimulator) -> dict[str, float]:
    """The part of `fixed_values` that belongs to the simulator."""
    known = {each.name for each in simulator.parameters}
    return {name: value for name, value in fixed_values(spec, simulator).items() if name in known}


def check_used(names: Iterable[str], spec: ModelSpec, simulator: AnySimulator, *, where: str) -> None:
    """Raise InputError for a parameter that the model does not have, and name the mechanism that has it."""
    specs = model_specs(spec, simulator)
    known = [each.name for each in specs]
    unknown = [name for name in names if name not in known and not any(each.startswith(f"{name}_") for each in known)]
    further = parameters_elsewhere(spec, simulator) if unknown else {}
    for name in unknown:
        for remedy, absent in further.items():
            if name in [each.name for each in absent]:
                raise InputError(f"the model has no parameter {name!r}", where=where, remedy=f"{remedy}, or remove it")
        check_names([name], specs, where=where)


def parameters_elsewhere(spec: ModelSpec, simulator: AnySimulator) -> dict[str, Sequence[ParameterSpec]]:
    """Parameters that a model could have, by the change of the model that adds them."""
    chosen = asdict(spec.channels)
    further: dict[str, Sequence[ParameterSpec]] = {
        f"set [model] {key} = true": found for key, found in SWITCHED.items() if not chosen[key]
    }
    if spec.simulator.motion == QUASI_STATIC:
        damping = {name: found for name, found in robot_of(spec).parameters.items() if name in DAMPING}
        further['set [simulator] motion = "dynamic"'] = specs_of(damping)
    further['let the noise last, [model] noise = "auto"'] = (OBJECT_CORRELATION_TIME,)
    further |= {f'set [model] noise = "{model}"': noise_specs(model) for model in NOISE_MODELS}
    for mechanism in mechanisms_named(REGISTRY, simulator.robot):
        further[f"add {mechanism.name!r} to [model] mechanisms"] = mechanism.parameters
    return further


def check_spec(spec: ModelSpec, simulator: AnySimulator) -> None:
    """See that all that a model names are its parameters, and that priors can be priors of them.

    Raises:
        InputError: a parameter that the model does not have, or a prior or a value that does not suit its parameter.
    """
    specs = model_specs(spec, simulator)
    for key in ("priors", "per_recording", "per_group", "only_in"):
        check_used(getattr(spec, key), spec, simulator, where=f"[model.{key}]")
    fixed_values(spec, simulator)
    by_name = {each.name: each for each in specs}
    for name, table in expand_groups(spec.priors, specs).items():
        if table:
            prior_from_table(by_name[name], dict(table), where=f"[model.priors] {name}")


def load_data(data: DataSpec | None, folder: Path, role: Literal["fit", "test"]) -> list[Trajectory]:
    """The recordings of one role, ``"fit"`` or ``"test"``; InputError without [data]."""
    if data is None:
        raise InputError("the experiment has no [data]", remedy="name the recordings to fit")
    return load_recordings(data, folder, role=role)


def expand_groups(table: Mapping[str, Entry], specs: Sequence[ParameterSpec]) -> dict[str, Entry]:
    """Expand keys for several parameters: ``offset`` for ``offset_x``, ``offset_y``, ``offset_z``."""
    known = [spec.name for spec in specs]
    expanded: dict[str, Entry] = {}
    for name, entry in table.items():
        members = [name] if name in known else [spec for spec in known if spec.startswith(f"{name}_")]
        expanded |= dict.fromkeys(members or [name], entry)
    return expanded


def pooling(
    spec: ModelSpec, specs: Sequence[ParameterSpec], fitted: Sequence[str], others: Sequence[str] = ()
) -> dict[str, Pooled]:
    """The parameters of [model.per_group], with the recordings of each fitted group.

    Raises:
        InputError: a name outside ``specs``, the simulator's parameters: noise is the same for all recordings.
    """
    groups = gather_groups([*fitted, *others], spec.groups)
    known = {group: members for group, members in groups.items() if set(members) & set(fitted)}
    found: dict[str, Pooled] = {}
    for family, spread in spec.per_group.items():
        members = expand_groups({family: spread}, specs)
        check_names(members, specs, where="[model.per_group]")
        found |= {name: Pooled(spread, known, family) for name in members}
    return found


def scoping(
    spec: ModelSpec, simulator: AnySimulator, fitted: Sequence[str], others: Sequence[str] = ()
) -> dict[str, dict[str, tuple[str, ...]]]:
    """The parameters of [model.only_in], with the recordings of each of their groups that has one to fit.

    Raises:
        InputError: a name that the simulator does not have, a name that has another scope or a fixed value as
            well, or a group that [model.groups] lacks.
    """
    check_used(spec.only_in, spec, simulator, where="[model.only_in]")
    specs, groups = simulator.parameters, gather_groups([*fitted, *others], spec.groups)
    known = {group: members for group, members in groups.items() if set(members) & set(fitted)}
    others_of = {"per_recording": spec.per_recording, "per_group": spec.per_group, "fixed": spec.fixed}
    found = {}
    for name, given in expand_groups(spec.only_in, specs).items():
        check_names([name], specs, where="[model.only_in]")
        for key, table in others_of.items():
            if name in expand_groups(table, specs):
                remedy = "keep it in one of them"
                raise InputError(f"{name} is also in [model.{key}]", where="[model.only_in]", remedy=remedy)
        asked = [given] if isinstance(given, str) else list(given)
        for group in asked:
            if group not in spec.groups:
                remedy = f"{nearest(group, list(spec.groups))}; [model.groups] names recordings of one day or one robot"
                raise InputError(f"unknown group {group!r}", where=f"[model.only_in] {name}", remedy=remedy)
        found[name] = {group: known[group] for group in asked if group in known}
    return found


def build_model(
    spec: ModelSpec,
    simulator: AnySimulator,
    trajectories: Sequence[Trajectory],
    *,
    specs: Sequence[ParameterSpec] | None = None,
    fitted: int | None = None,
    later: Sequence[Mechanism] = (),
) -> TrajectoryModel:
    """The probabilistic program of a model for the given recordings.

    Args:
        spec: the model; simulator: with all mechanisms.
        trajectories: the recordings.
        specs: parameters that may be inferred; all by default.
        fitted: number of recordings, the first ones, that are fitted; all by default.
        later: see `model_scopes`.

    Raises:
        InputError: unknown names, priors outside the bounds, a parameter both fixed and inferred.
    """
    recordings = gather_recordings(simulator, trajectories)
    count = len(trajectories) if fitted is None else fitted
    longest = max(float(run.time[-1] - run.time[0]) for run in trajectories[:count])
    chosen = model_specs(spec, simulator) if specs is None else specs
    if longest > 0.0:
        chosen = rates_over(longest, chosen, simulator.mechanisms)
    groups = recordings.names[:count], recordings.names[count:]
    scopes = model_scopes(spec, simulator, chosen, *groups, later)
    channels = gather_channels(spec, simulator, trajectories, recordings, scopes.infos, fitted)
    return TrajectoryModel(simulator, scopes, recordings, channels)


def model_scopes(
    spec: ModelSpec,
    simulator: AnySimulator,
    specs: Sequence[ParameterSpec],
    fitted: Sequence[str],
    others: Sequence[str] = (),
    later: Sequence[Mechanism] = (),
) -> Scopes:
    """Space of inferred parameters: the model's, followed by the parameters of ``later`` mechanisms.

    The noise parameters are always inferred, unless [model.fixed] holds them; the gain of tensions with a prior only.

    Args:
        spec: specification with the priors.
        simulator: simulator with all mechanisms.
        specs: parameters that may be inferred.
        fitted: names of the fitted recordings; others: names of other recordings, which may belong to groups.
        later: mechanisms whose parameters come last, such as candidates of an audit.

    Raises:
        InputError: unknown names, priors outside the bounds, a parameter both fixed and inferred.
    """
    fixed = fixed_values(spec, simulator)
    check_used(spec.priors, spec, simulator, where="[model.priors]")
    check_used(spec.per_recording, spec, simulator, where="[model.per_recording]")
    known, last = {each.name for each in specs}, [each.name for m in later for each in m.parameters]
    added = [each.name for mechanism in simulator.mechanisms if mechanism not in later for each in mechanism.parameters]
    measured = [s.name for s in specs if s not in simulator.parameters and s not in GAINS]
    every = model_specs(spec, simulator)
    given = {name: entry for name, entry in expand_groups(spec.priors, every).items() if name in known}
    both = sorted(set(fixed) & set(given))
    if both:
        raise InputError(f"{both[0]!r} has a prior and a fixed value", where="[model]", remedy="remove one of them")
    shared = expand_groups(spec.per_recording, every)
    groups = scoping(spec, simulator, fitted, others)
    defaults = [name for name in (*added, *shared, *groups, *measured) if name not in fixed and name not in given]
    priors: dict[str, Any] = {name: given.get(name, {}) for name in (*given, *defaults) if name not in last}
    priors |= {name: given.get(name, {}) for name in last if name not in fixed and name not in priors}
    alone = {
        name: matching(fitted, patterns, where=f"[model.per_recording] {name}") for name, patterns in shared.items()
    }
    pooled = pooling(spec, simulator.parameters, fitted, others)
    return build_scopes(specs, priors, alone, fitted, pooled=pooled, only_in=groups, fixed=fixed)


def gather_channels(
    spec: ModelSpec,
    simulator: AnySimulator,
    trajectories: Sequence[Trajectory],
    recordings: RecordingSet,
    inferred: Sequence[ParameterInfo],
    fitted: int | None = None,
) -> tuple[Channel, ...]:
    """Data channels in use, markers first and weighed parts last.

    Some ``inferred`` parameters may be weighed. The first ``fitted`` recordings must have the channels that [model]
    requires; all by default.
    """
    chosen, length = spec.channels, recordings.time.shape[1]
    stated = stated_noise(spec, recordings, trajectories[0]) if spec.noise == STATED else None
    channels: list[Channel] = [Markers.gather(recordings, spec.noise, stated)]
    if chosen.tension:
        channels.append(Tension.gather(simulator, trajectories, length, fitted))
    if chosen.motor_angle:
        channels.append(MotorAngle.gather(trajectories, length, fitted))
    if chosen.orientation:
        channels.append(Orientation.gather(simulator, trajectories, length, fitted))
    if chosen.object_pose:
        channels.append(ObjectPose.gather(simulator, trajectories, length, lasting=spec.noise != "white"))
    if spec.noise == REPEATS:
        groups = group_recordings(recordings, trajectories)
        rates = recordings.steps
        channels = [with_noise_of_repeats(each, groups, rates) for each in channels if isinstance(each, Series)]
    if spec.weighed:
        channels.append(WeighedParts(spec.weighed).named(inferred))
    return tuple(channels)


def stated_noise(spec: ModelSpec, recordings: RecordingSet, first: Trajectory) -> Autoregression:
    """The noise of the positions that is stated.

    Raises:
        InputError: none is stated.
    """
    noise = spec.stated
    if noise is None or noise.standard_deviation == 0.0:
        raise InputError("no noise is stated", where='[model] noise = "stated"', remedy="give [noise]")
    values = {OBSERVATION_NOISE.name: noise.standard_deviation}
    if noise.correlation_time is not None:
        values[NOISE_CORRELATION_TIME.name] = noise.correlation_time
    step = float(first.dataset.attrs["sample_time"])
    return Markers.gather(recordings, STATED).stated(values, step).at(recordings.steps)


def build_problem(model: TrajectoryModel, earlier: DrawsByOwner | None = None) -> CalibrationProblem:
    """The model as the inference methods see it, in chunks that suit its engine; ``earlier``: see the problem."""
    lanes = model.simulator.lanes
    return CalibrationProblem(model, chunk=max(1, lanes // len(model.recordings.names)), earlier=earlier or {})


def backend(table: SimulatorTable, rod: bool) -> Backend:
    """The backend that [simulator] asks for.

    "auto" is the compiled backend for meshes, which JAX lacks, and for rods if JAX has only a CPU.
    """
    compiled = table.engine == "numba"
    if table.engine == "auto":
        compiled = not rod or jax.default_backend() == "cpu"
    return Backend("numba", table.precision, table.threads) if compiled else Backend("jax")
