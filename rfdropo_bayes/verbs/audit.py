"""The effects that a simulator lacks, by name: ``audit``."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from pydantic import field_validator

from rfdropo_bayes.bayes.channels import Series
from rfdropo_bayes.bayes.channels.tension import TENSION_GAIN
from rfdropo_bayes.bayes.lanes import Lanes, RoutedLanes
from rfdropo_bayes.bayes.noise.stacked import Stacked
from rfdropo_bayes.bayes.recordings import commands_of
from rfdropo_bayes.bayes.trajectory_model import TrajectoryModel
from rfdropo_bayes.cautions import Caution
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.discrepancy.audit_problem import AuditProblem
from rfdropo_bayes.discrepancy.audit_record import next_experiment, record
from rfdropo_bayes.discrepancy.candidates import Candidate
from rfdropo_bayes.discrepancy.coordinates import Coordinates
from rfdropo_bayes.discrepancy.deadline import Deadline
from rfdropo_bayes.discrepancy.differences import Groups, with_differences
from rfdropo_bayes.discrepancy.extension import DISCRETISATION, Rules
from rfdropo_bayes.discrepancy.fit import widening
from rfdropo_bayes.discrepancy.fixed_quantities import OwnParameter, with_fixed_quantities
from rfdropo_bayes.discrepancy.journal import Journal
from rfdropo_bayes.discrepancy.law_words import law_tables
from rfdropo_bayes.discrepancy.pipeline import Answer
from rfdropo_bayes.discrepancy.pipeline import audit as ask
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference.progress import say_lines
from rfdropo_bayes.mechanisms import REGISTRY, mechanisms_named
from rfdropo_bayes.mechanisms.ports import PortMap, port_map
from rfdropo_bayes.mechanisms.registry import source_of
from rfdropo_bayes.model.assembly import (
    AnySimulator,
    build_model,
    build_simulator,
    expand_groups,
    measurement_specs,
    stated_noise,
)
from rfdropo_bayes.model.experiment import AuditTable, NoiseTable
from rfdropo_bayes.model.experiment_file import code_placed, describe, self_contained
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.model.run_folder import hashes, run_folder
from rfdropo_bayes.report import software_versions
from rfdropo_bayes.report.audit_page import render_audit, shown
from rfdropo_bayes.report.residual_file import residual_dataset
from rfdropo_bayes.report.run_files import SUMMARY
from rfdropo_bayes.report.summary import combined_hash, read_summary
from rfdropo_bayes.results.audited import Audit
from rfdropo_bayes.results.calibrated import Calibration
from rfdropo_bayes.robots import Robot, robot_shape
from rfdropo_bayes.signatures import as_options, stated
from rfdropo_bayes.simulators.black_box import BlackBox
from rfdropo_bayes.simulators.commands import Commands, stack_commands
from rfdropo_bayes.simulators.mechanisms import BLACK_BOX, BodyMechanism, Mechanism, obstacle
from rfdropo_bayes.simulators.parameters import ParameterSpec
from rfdropo_bayes.simulators.trunk import TrunkSimulator
from rfdropo_bayes.tables import changed, nearest, parse_table
from rfdropo_bayes.verbs.arguments import given_model
from rfdropo_bayes.verbs.between import Between, confine_laws, extend_groups, find_groups, groups_at_hand
from rfdropo_bayes.verbs.motion_direction import Paths
from rfdropo_bayes.verbs.recording_doubts import cautions_of_audit

Workshop = dict[str, Lanes]

JOURNAL = "checkpoints/audit"
FINER = 2


@as_options
class AuditOptions(AuditTable):
    """Options of `rb.audit`: keys of an experiment file's [audit]. Candidates may be classes of one's own."""

    @field_validator("candidates", mode="before")
    @classmethod
    def _sources(cls, given: Sequence[Any]) -> list[str]:
        return [source_of(candidate) for candidate in given]


def audit(
    model: Model,
    runs: Sequence[Trajectory] | None = None,
    options: AuditOptions | None = None,
    *,
    test: Sequence[Trajectory] | None = None,
    seed: int | None = None,
    fit: Calibration | Path | None = None,
    noise: Mapping[str, float] | None = None,
    out: Path | str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    workshop: Workshop | None = None,
    show: bool | None = None,
    between: Between | None = None,
) -> Audit:
    """Name the effects that a model lacks, and measure the gain of adding them. Missing arguments are taken from the
    model's experiment file.

    Args:
        model: simulator and inferred parameters.
        runs: recordings to fit and test candidates on.
        options: keys of [audit], which override the model's own file.
        test: unseen recordings that measure the gain.
        seed: seed of all random numbers; 0 without a file. The same seed gives the same answer.
        fit: an earlier calibration, or its folder, from whose posterior means the base model starts.
        noise: ``{"standard_deviation": m}`` of the positions, perhaps with a ``correlation_time`` [s]; it is used if
            nothing was repeated.
        out: folder for audit.json, extended.toml and report.html; None writes nothing.
        resume: continue an interrupted audit in ``out``.
        overwrite: replace an earlier run in ``out``.
        workshop: see `build_problem`.
        show: whether to show progress, as in `calibrate`.
        between: two groups of recordings to compare: which parameters or mechanisms differ, all else being shared. Two
            names of [model.groups], or ``{name: recordings}``, these as names, wildcards or `Trajectory` objects.
            Effects that both lack are also named.

    Raises:
        InputError: bad input, before anything long has started.
    """
    model = _asked(given_model(model, "audit"), noise, stated(options, AuditOptions))
    runs, test = model.runs(runs, test)
    chosen, spec, table = model.settings.seed if seed is None else seed, model.spec, model.settings.audit
    deadline = Deadline(table.minutes)
    if between is None:
        groups = groups_at_hand(spec.groups, runs, test)
    else:
        groups, runs, test = find_groups(between, spec.groups, runs, test)
    start = start_values(fit)
    problem = build_problem(spec, table, runs, test, chosen, start=start, workshop=workshop, groups=groups)
    tables = model.record({"title": model.title, "seed": chosen}, {})
    doubts = cautions_of_audit(model, [*runs, *test], fitted_paths(problem, start or {}))

    def audited(out: Path | None) -> Audit:
        journal, report = None if out is None else Journal(out / JOURNAL, resume=resume), say_lines(show)
        report(f"takes at most {table.minutes:g} minutes ([audit] minutes), or ends earlier")
        answer = ask(problem, report, journal, deadline)
        data = combined_hash([trajectory.sha256 for trajectory in [*runs, *test]])
        return _audited(answer, model, tables, data, out, doubts)

    if out is None:
        return audited(None)
    settings: dict[str, Any] = {"tables": tables, "folder": model.folder, "data": hashes([*runs, *test])}
    given: dict[str, Any] = {"from": fit.folder if isinstance(fit, Calibration) else fit, "seed": chosen}
    if groups is not None and groups.compared:
        given |= {"between": {name: list(own) for name, own in groups.members.items()}}
    settings |= {"options": given, "texts": model.texts()}
    with run_folder(Path(out), "audit", **settings, resume=resume, overwrite=overwrite) as place:
        answered = audited(place)
        answered.save(place)
    return answered


def fitted_paths(problem: AuditProblem, start: Mapping[str, float]) -> list[Paths]:
    """The fitted recordings beside the model at the start of the audit: nominal, but for values of an earlier fit.

    Empty if an object is pushed, or a rollout fails.
    """
    if "object_pose" in problem.lanes.fields:
        return []
    recordings = problem.model.recordings.of(range(len(problem.trajectories)))
    values = {**problem.coordinates.nominal, **start}
    theta = np.tile([values[name] for name in problem.lanes.physical], (len(recordings.names), 1))
    fields, status = problem.lanes.roll(theta, np.zeros((len(theta), 7)), recordings.commands)
    valid = np.asarray(recordings.line.valid)
    paths = zip(fields["position"], recordings.position, valid, strict=True)
    return [] if np.any(status) else [Paths(*each) for each in paths]


def _audited(
    answer: Answer,
    model: Model,
    tables: Mapping[str, Any],
    data_sha256: str,
    out: Path | None,
    doubts: Sequence[Caution],
) -> Audit:
    """Result of an audit as an object, with its page; ``doubts`` are cautions on its recordings."""
    versions, following = software_versions(), next_experiment(answer)
    given: dict[str, Any] = {"versions": versions, "data_sha256": data_sha256, "next_experiment": following}
    content = record(answer, **given, doubts=doubts)
    seen, shape = shown(answer), robot_shape(model.robot) if isinstance(model.robot, Robot) else None
    page = render_audit(seen, content, model.title, describe(tables), shape)
    extended = extended_tables(dict(tables), answer, model.folder, out, model.texts())
    made = None if model.spec.named else model.robot
    residuals = residual_dataset(answer) if answer.fitted else None
    return Audit(content, extended, page, made, out or model.folder, out, seen, answer, residuals)


def _asked(model: Model, noise: Mapping[str, float] | None, options: Mapping[str, Any]) -> Model:
    """The model with the tables [audit] and [noise] of a call."""
    if not options and noise is None:
        return model
    spec, settings = model.spec, model.settings
    if options:
        chosen = {**settings.audit.model_dump(exclude_unset=True), **options}
        settings = replace(settings, audit=parse_table(AuditTable, chosen, where="audit"))
    if noise is not None:
        spec = replace(spec, stated=parse_table(NoiseTable, noise, where="audit, noise"))
    return Model.of(spec, settings)


def build_problem(
    spec: ModelSpec,
    table: AuditTable,
    fitted: Sequence[Trajectory],
    tested: Sequence[Trajectory],
    seed: int,
    *,
    start: dict[str, float] | None = None,
    workshop: Workshop | None = None,
    names: Sequence[str] | None = None,
    groups: Groups | None = None,
) -> AuditProblem:
    """The base model with every candidate of the library in it, at its null value.

    ``table`` is [audit]; ``workshop`` keeps compiled simulators for further data sets of the same experiment; ``names``
    are the candidates, all by default; ``groups`` of recordings are compared, or have candidates of their own.

    Raises:
        InputError: [audit] leaves no candidate.
    """
    spreads, robot = spec.per_group, spec.robot
    if groups is not None and groups.compared:  # the difference between the groups is to be found
        spec = replace(spec, per_group={})
    trajectories = [*fitted, *tested]
    left_out: dict[str, str] = {}
    whole = names is None
    if whole and not table.library:
        _something_asked(table, groups)
    if names is None:
        names = candidate_names(spec, table)
        left_out = obstacles(spec, names, trajectories[0])
        names = [name for name in names if name not in left_out]
    simulator = build_simulator(spec.with_mechanisms(*names))
    model, base = _model(spec, simulator, trajectories, len(fitted))
    added, specs = simulator.mechanisms[len(spec.mechanisms) :], simulator.parameters
    candidates = _named(table, model, names, added)
    if whole and table.library:
        of_candidates = {spec.name for mechanism in added for spec in mechanism.parameters}
        plain, stated = [s for s in specs if s.name not in of_candidates], expand_groups(spreads, specs)
        model, candidates = _with_own(model, base, plain, candidates, groups, stated)
        candidates = [c for c in candidates if c.name not in table.exclude]
    coordinates = Coordinates(model.scopes, base, tuple(spec.name for spec in specs))
    workshop = {} if workshop is None else workshop
    lanes = partial(_lanes, names=names, model=model, coordinates=coordinates, workshop=workshop)

    def half(robot: Robot) -> tuple[Lanes, Commands]:
        finer = _finer(spec, robot)
        whole = build_simulator(finer.with_mechanisms(*names))
        commands = stack_commands([commands_of(whole, trajectory) for trajectory in trajectories])
        return lanes(finer, whole), commands

    matters = None if table.matters_mm is None else 1e-3 * table.matters_mm
    return AuditProblem(
        lanes(spec, simulator),
        None if isinstance(robot, BlackBox) else half(robot),
        coordinates,
        model,
        list(fitted),
        candidates,
        _stated(spec, model, fitted[0]),
        start,
        Rules(bootstraps=table.bootstraps, minutes=table.minutes, matters=matters),
        seed,
        {name: why for name, why in left_out.items() if name not in table.exclude},
        groups,
        _ports(simulator, model, fitted) if whole and table.ports else None,
    )


def _ports(simulator: AnySimulator, model: TrajectoryModel, fitted: Sequence[Trajectory]) -> PortMap:
    """Ports of a simulator; without delays if rows have no times."""
    ports = port_map(simulator, model.recordings.markers)
    if all(trajectory.timed for trajectory in fitted):
        return ports
    return ports._replace(ports=tuple(port for port in ports.ports if port.unit != "s"))


def _something_asked(table: AuditTable, groups: Groups | None) -> None:
    """Refuse an audit without the library, laws at ports or user candidates."""
    ports = table.ports and (groups is None or not groups.compared)
    if not (ports or table.candidates):
        raise InputError(
            "no candidates: the library and laws at ports are both excluded",
            where="[audit] library",
            remedy="set library = true, or ports = true without --between",
        )


def _named(
    table: AuditTable, model: TrajectoryModel, names: Sequence[str], added: Sequence[Mechanism]
) -> list[Candidate]:
    """Mechanisms as candidates, without the exclusions of [audit]."""
    index = {p.spec.name: i for i, p in enumerate(model.scopes.parameters)}
    return [
        Candidate(m.name, tuple(index[spec.name] for spec in m.parameters if spec.name in index), m, name)
        for name, m in zip(names, added, strict=True)
        if name not in table.exclude
    ]


def _with_own(
    model: TrajectoryModel,
    base: int,
    plain: Sequence[ParameterSpec],
    candidates: list[Candidate],
    groups: Groups | None,
    spreads: Mapping[str, float],
) -> tuple[TrajectoryModel, list[Candidate]]:
    """The model with the robot's own parameters among its candidates, and all that may differ between groups."""
    space, own = with_fixed_quantities(model.scopes, plain, tuple(model.scopes.fixed))
    if groups is not None:
        space, candidates = with_differences(
            space, base, plain, candidates, groups, spreads=spreads, fixed=tuple(model.scopes.fixed)
        )
    return replace(model, scopes=space), [*candidates, *own]


def candidate_names(spec: ModelSpec, table: AuditTable) -> list[str]:
    """Names of candidates: the registry, if requested, and the experiment's own, without mechanisms of the base model.

    Excluded candidates are included, so that the compiled program does not depend on exclusions.

    Raises:
        InputError: an unknown name to exclude.
    """
    known = [*REGISTRY, *(name for name in table.candidates if name not in REGISTRY)]
    own = spec.robot.parameter_table() if isinstance(spec.robot, Robot) else {}
    for name in table.exclude:
        if name not in known and not any(parameter.startswith(f"{name}_") for parameter in own):
            raise InputError(f"unknown mechanism {name!r}", where="[audit] exclude", remedy=nearest(name, known))
    asked = known if table.library else table.candidates
    return [name for name in asked if name not in spec.sources]


def obstacles(spec: ModelSpec, names: Sequence[str], recording: Trajectory) -> dict[str, str]:
    """Which of the candidates cannot run on the experiment's body and engine, and why.

    A mechanism of the library states its requirements; a user's mechanism is tried.
    """
    simulator = build_simulator(spec)
    engine = str(simulator.description["engine"])
    commands = stack_commands([commands_of(simulator, recording)])
    reasons = {}
    for name in names:
        (mechanism,) = mechanisms_named([name], spec.robot, folder=spec.folder, where="[audit] candidates")
        body = BLACK_BOX if isinstance(spec.robot, BlackBox) else spec.simulator.body
        cables = not isinstance(spec.robot, Robot) or bool(spec.robot.cables)
        why = obstacle(mechanism, body, engine, spec.simulator.motion, cables=cables, timed=recording.timed)
        if why is None and name not in REGISTRY:
            why = _refusal(build_simulator(spec.with_mechanisms(name)), commands)
        if why is not None:
            reasons[name] = why
    return reasons


def _refusal(simulator: AnySimulator, commands: Commands) -> str | None:
    """Reason why a simulator cannot run its mechanisms, found before any computation."""
    try:
        jax.eval_shape(jax.vmap(lambda given: simulator.rollout({}, given)), commands)
    except InputError as error:
        return error.what
    return None


def _lanes(
    spec: ModelSpec,
    whole: AnySimulator,
    *,
    names: Sequence[str],
    model: TrajectoryModel,
    coordinates: Coordinates,
    workshop: Workshop,
) -> Lanes:
    """The simulator with all candidates. Compiled engines run this simulator only for rollouts with candidates; other
    rollouts use a simulator without candidates, or a simulator without expensive ones. Lanes in the workshop are
    reused.
    """
    fields, markers = _fields(model), model.recordings.marker_index
    made = (spec.robot, spec.simulator, spec.drives, spec.sources, names)
    key = repr((*made, markers.tolist(), coordinates.space.fixed, fields))
    if key not in workshop:
        slow = {m.name: m for m in whole.mechanisms if isinstance(whole, TrunkSimulator) and _costly(whole, m)}
        costly = [each.name for m in slow.values() for each in m.parameters]
        lanes = Lanes(whole, markers, fields=fields, costly=costly)
        added = whole.mechanisms[len(spec.mechanisms) :]
        kept = [name for name, m in zip(names, added, strict=True) if m.name not in slow]
        null = coordinates.nominal | coordinates.named(coordinates.null)
        compiled = isinstance(whole, TrunkSimulator) and whole.engine.backend.name == "numba"
        for fewer in [kept, []] if compiled else []:
            if len(fewer) < len(names):
                fast = build_simulator(spec.with_mechanisms(*fewer))
                lanes = RoutedLanes(Lanes(fast, markers, fields=fields), lanes, null)
        workshop[key] = lanes
    return workshop[key]


def _costly(simulator: TrunkSimulator, mechanism: Mechanism) -> bool:
    """Whether a mechanism acts on the body in a way that slows the compiled engine down."""
    if simulator.pushes or not isinstance(mechanism, BodyMechanism) or simulator.engine.backend.name != "numba":
        return False
    values = simulator.complete({})
    plain = replace(simulator, mechanisms=()).material(values)
    return mechanism.embody(values, plain, simulator.assembly.system.body).effects.rubs


def _finer(spec: ModelSpec, robot: Robot) -> ModelSpec:
    """The model with half the time step, and twice the elements of a rod; a mesh stays as it is."""
    table, finer = spec.simulator, dict[str, Any]()
    if table.motion == "dynamic":
        finer["time_step"] = (table.time_step or robot.time_step_s) / FINER
    if table.body == "rod":
        finer["refine"] = min(FINER * table.refine, 16)
    elif table.tetrahedra is not None and table.tetrahedra.drive_rate is not None:  # which is per step
        rate = table.tetrahedra.drive_rate / FINER
        finer["tetrahedra"] = changed(table.tetrahedra, where="[simulator.tetrahedra]", drive_rate=rate)
    return replace(spec, simulator=changed(table, where="[simulator]", **finer))


def _model(
    spec: ModelSpec, simulator: AnySimulator, trajectories: Sequence[Trajectory], fitted: int
) -> tuple[TrajectoryModel, int]:
    """The model with all candidates, and the number of its first parameters, those of the base model.

    The noise of the channels is known, so noise parameters are not included.
    """
    added = simulator.mechanisms[len(spec.mechanisms) :]
    gains = [each for each in measurement_specs(spec.noise, spec.channels) if each == TENSION_GAIN]
    model = build_model(
        spec, simulator, trajectories, specs=(*simulator.parameters, *gains), fitted=fitted, later=added
    )
    # Evidences are compared at one spread between groups.
    model = replace(model, scopes=model.scopes.holding(model.scopes.typical_scales))
    of_candidates = {each.name for mechanism in added for each in mechanism.parameters}
    return model, sum(p.spec.name not in of_candidates for p in model.scopes.parameters)


def _fields(model: TrajectoryModel) -> list[str]:
    """Parts of an observation that are data."""
    series = [channel.name for channel in model.channels if isinstance(channel, Series)]
    return ["position" if name == "markers" else name for name in series]


def _stated(spec: ModelSpec, model: TrajectoryModel, first: Trajectory) -> Stacked | None:
    """The noise that the experiment states, for recordings without repeats: of the positions under [noise], of other
    channels under [model.fixed]; None if a channel lacks it.
    """
    if spec.stated is None or spec.stated.standard_deviation == 0.0:
        return None
    parts = [stated_noise(spec, model.recordings, first)]
    for channel in model.channels[1:]:
        if isinstance(channel, Series):
            known = [model.scopes.fixed.get(each.name) for each in channel.noise_specs]
            if any(value is None for value in known):
                return None
            parts.append(channel.stated(model.scopes.fixed, float(first.dataset.attrs["sample_time"])))
    return Stacked(tuple(parts))


def start_values(fit: Calibration | Path | None) -> dict[str, float] | None:
    """Posterior means of an earlier calibration, or of its folder."""
    if fit is None:
        return None
    content = fit.content if isinstance(fit, Calibration) else read_summary(Path(fit) / SUMMARY)
    return {name: float(row["mean"]) for name, row in content["parameters"].items()}


def extended_tables(
    tables: dict[str, Any], answer: Answer, folder: Path, out: Path | None = None, made: Container[str] = ()
) -> dict[str, Any]:
    """The experiment file with the mechanisms that the model adopts, for ``rfdropo calibrate``.

    ``out`` is the folder that it is written to, which gets copies of the user's own files; for ``made`` see
    `self_contained`.
    """
    extended = self_contained(tables, folder, out, made)
    model = extended.setdefault("model", {})
    simulator = extended.setdefault("simulator", {})
    for step in answer.adopted:
        if step.name == DISCRETISATION:
            assert answer.problem.finer is not None
            if simulator.get("body", "rod") == "rod":
                simulator["refine"] = FINER * int(simulator.get("refine", 1))
            elif "drive_rate" in simulator["tetrahedra"]:
                simulator["tetrahedra"]["drive_rate"] /= FINER
            if simulator.get("motion", "dynamic") == "dynamic":
                simulator["time_step"] = answer.problem.finer[0].simulator.description["time_step_s"]
            continue
        candidate = answer.problem.candidate(step.name)
        assert candidate is not None
        if candidate.group:
            extend_groups(model, answer, candidate)
        if isinstance(candidate.mechanism, OwnParameter):
            if not candidate.group:
                model.setdefault("priors", {}).update(sized_priors(answer, candidate))
            continue
        source = code_placed(candidate.source, folder, out)
        if source not in model.get("mechanisms", []):
            model["mechanisms"] = [*model.get("mechanisms", []), source]
        model.setdefault("priors", {}).update(sized_priors(answer, candidate))
    if laws := law_tables(answer):
        model["laws"] = [*model.get("laws", []), *laws]
        confine_laws(model, answer)
    if "minutes" in extended.get("inference", {}):  # a step of an optimisation takes rollouts for each parameter
        joined = [c for step in answer.adopted if (c := answer.problem.candidate(step.name)) is not None]
        added = sum(len(c.indices) for c in joined) + sum(len(law["terms"]) for law in laws)
        grown = 1.0 + added / max(len(answer.base.free), 1)
        extended["inference"]["minutes"] = float(f"{extended['inference']['minutes'] * grown:.2g}")
    audit = extended.get("audit", {})
    if "candidates" in audit:
        adopted = {step.name for step in answer.adopted}
        taken = {code_placed(c.source, folder, out) for c in answer.problem.candidates if c.name in adopted}
        audit["candidates"] = [source for source in audit["candidates"] if source not in taken]
    return extended


def sized_priors(answer: Answer, candidate: Candidate) -> dict[str, dict[str, Any]]:
    """Priors under which the sizes of a mechanism were fitted, at least as wide as the sizes, see `widened`."""
    coordinates = answer.problem.coordinates
    factor = widening(answer.extended, coordinates)
    priors = {}
    for index in candidate.indices:
        parameter = coordinates.space.parameters[index]
        if parameter.spec.name != parameter.physical:  # how far one group's value is off, of which no file has a prior
            continue
        table = dict(parameter.table)
        for key in ("loc", "low", "high"):  # a size in one group is measured from null
            if key in table and parameter.scope.added_to:
                table[key] += coordinates.space.specs[parameter.physical].nominal - parameter.spec.nominal
        if "scale" in table:
            table["scale"] = float(f"{table['scale'] * max(factor[index], 1.0):.3g}")
        priors[parameter.spec.name] = table
    return priors
