"""Meaning of an experiment file: the model as objects, and the settings of verbs. The file has names and numbers.

A file is parsed once, by `spec_of` and `RunSettings.of`. Later changes are made to these objects with
`dataclasses.replace`, and checked again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel

from rfdropo_bayes.bayes.channels import Weighed
from rfdropo_bayes.data import DataSpec
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.groups import Patterns
from rfdropo_bayes.mechanisms.laws import LawChoice
from rfdropo_bayes.mechanisms.registry import MechanismChoice, choose_mechanisms
from rfdropo_bayes.model.experiment import (
    AuditTable,
    CommandsTable,
    DesignTable,
    Experiment,
    InferenceTable,
    LawTable,
    NoiseModel,
    NoiseTable,
    SimulatorTable,
)
from rfdropo_bayes.policies.training_config import TrainingTable
from rfdropo_bayes.robots import DriveTravel, Robot
from rfdropo_bayes.simulators.adapters import adapted, is_adapted
from rfdropo_bayes.simulators.black_box import BlackBox
from rfdropo_bayes.tables import nearest

Workpiece = Robot | BlackBox  # type of the simulated object


@dataclass(frozen=True)
class DataChannels:
    """Data channels of the recordings beside the markers: tensions, motor angles, poses of an object."""

    tension: bool = False
    motor_angle: bool = False
    object_pose: bool = False
    orientation: bool = False


@dataclass(frozen=True)
class ModelSpec:
    """Simulated robot, inferred parameters and data channels.

    Attributes:
        robot: robot or black box, without the ``drives`` that are stated here.
        named: name or path of the robot in a file; empty if it was made in Python.
        mechanisms: effects on top of the base simulator.
        simulator: body, engine and discretisation.
        priors: inferred parameters: tables of priors by parameter; an empty table is the parameter's default.
        fixed: values of parameters that are not inferred.
        noise: noise of the positions, by name.
        stated: noise of the positions of known size, which `simulate` adds.
        per_recording: parameters that are free in each matching recording.
        groups: recordings that share a set-up.
        per_group: scale of the spread between groups of parameters that differ between them, in their unit.
        only_in: groups that have a parameter, with one value each; it is neutral in other groups.
        drives: known properties of the drives, in addition to the robot's.
        channels: data channels beside the markers.
        weighed: sums of parameters that were measured.
        adapter: settings of a black box's adapter.
        folder: base of relative paths of the mesh and of user code.

    Raises:
        InputError: no robot, an unknown noise, or drives of unknown cables.
    """

    robot: Workpiece
    named: str = ""
    mechanisms: tuple[MechanismChoice, ...] = ()
    simulator: SimulatorTable = field(default_factory=SimulatorTable)
    priors: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    fixed: Mapping[str, float] = field(default_factory=dict)
    noise: str = "auto"
    stated: NoiseTable | None = None
    per_recording: Mapping[str, str | Sequence[str]] = field(default_factory=dict)
    groups: Patterns = field(default_factory=dict)
    per_group: Mapping[str, float] = field(default_factory=dict)
    only_in: Mapping[str, str | Sequence[str]] = field(default_factory=dict)
    drives: tuple[DriveTravel, ...] = ()
    channels: DataChannels = field(default_factory=DataChannels)
    weighed: tuple[Weighed, ...] = ()
    adapter: Mapping[str, Any] = field(default_factory=dict)
    folder: Path = Path()

    def __post_init__(self) -> None:
        if not isinstance(self.robot, Robot | BlackBox):
            raise InputError(
                f"{type(self.robot).__name__} is not a robot",
                where="Model",
                remedy="give a name, a path, a Robot or a BlackBox",
            )
        if self.noise not in get_args(NoiseModel):
            remedy = nearest(self.noise, get_args(NoiseModel))
            raise InputError(f"unknown noise {self.noise!r}", where="[model] noise", remedy=remedy)
        if self.drives and isinstance(self.robot, BlackBox):
            raise InputError("a black box has no drives", where="[[model.drives]]", remedy="let the box have them")
        for drives in self.drives:
            drives.columns(self.robot.channel_names)

    @property
    def sources(self) -> tuple[str, ...]:
        """Names under which a file would ask for the mechanisms."""
        return tuple(choice.source for choice in self.mechanisms)

    def with_mechanisms(self, *names: Any) -> ModelSpec:
        """The same with more mechanisms: names, classes or objects.

        Raises:
            InputError: an unknown name, or no mechanism.
        """
        return replace(self, mechanisms=(*self.mechanisms, *choose_mechanisms(names, folder=self.folder)))

    def tables(self) -> dict[str, Any]:
        """The tables [noise], [simulator] and [model] of a file with all content that a file can hold."""
        drives = [each.model_dump(mode="json", exclude_unset=True, exclude_none=True) for each in self.drives]
        weighed = [{"parameters": list(each.parameters), "value": each.value, "sd": each.sd} for each in self.weighed]
        given = {
            "priors": {name: dict(prior) for name, prior in self.priors.items()},
            "fixed": dict(self.fixed),
            "per_recording": dict(self.per_recording),
            "groups": dict(self.groups),
            "drives": drives,
            "per_group": dict(self.per_group),
            "only_in": dict(self.only_in),
            **vars(self.channels),
            "weighed": weighed,
        }
        model = {"noise": self.noise, **{key: value for key, value in given.items() if value}}
        rest = {"noise": self.stated, "simulator": self.simulator}
        told = {"adapter": dict(self.adapter)} if self.adapter else {}
        laws = [choice.kind for choice in self.mechanisms if isinstance(choice.kind, LawChoice)]
        if laws:
            model["laws"] = [{"port": law.port, "terms": [dict(term) for term in law.terms]} for law in laws]
        named = [choice.source for choice in self.mechanisms if not isinstance(choice.kind, LawChoice)]
        return {**told, **_dumped(rest), "model": {**model, "mechanisms": named}}


@dataclass(frozen=True)
class RunSettings:
    """Settings of an experiment beside its model: see the fields of the same names in `Experiment`."""

    seed: int = 0
    title: str = ""
    data: DataSpec | None = None
    commands: CommandsTable | None = None
    inference: InferenceTable = field(default_factory=InferenceTable)
    audit: AuditTable = field(default_factory=AuditTable)
    design: DesignTable = field(default_factory=DesignTable)
    training: TrainingTable | None = None

    @classmethod
    def of(cls, experiment: Experiment) -> RunSettings:
        """Settings of a file."""
        return cls(
            seed=experiment.seed,
            title=experiment.title,
            data=experiment.data,
            commands=experiment.commands,
            inference=experiment.inference,
            audit=experiment.audit,
            design=experiment.design,
            training=experiment.training,
        )

    def tables(self) -> dict[str, Any]:
        """The keys and tables of an equivalent file."""
        plain = {"seed": self.seed, "title": self.title}
        rest = {name: value for name, value in vars(self).items() if name not in plain}
        return {**{name: value for name, value in plain.items() if value}, **_dumped(rest)}


def _dumped(tables: Mapping[str, BaseModel | None]) -> dict[str, Any]:
    """The given keys of some tables, as in a file."""
    given = {
        name: table.model_dump(mode="json", exclude_unset=True, exclude_none=True)
        for name, table in tables.items()
        if table is not None
    }
    return {name: table for name, table in given.items() if table}


def spec_of(
    experiment: Experiment, folder: Path, robot: Workpiece | None = None, mechanisms: Sequence[Any] | None = None
) -> ModelSpec:
    """Specification of the model in a file.

    Args:
        experiment: the file.
        folder: base of relative paths.
        robot: replaces the robot of the file.
        mechanisms: names, classes or objects that replace the mechanisms of the file.

    Raises:
        InputError: as `ModelSpec`; or an unknown robot or mechanism.
    """
    table = experiment.model
    asked = table.mechanisms if mechanisms is None else mechanisms
    found = find_robot(experiment.robot, folder, experiment.adapter) if robot is None else robot
    return ModelSpec(
        robot=found,
        named=experiment.robot if robot is None else "",
        mechanisms=(*choose_mechanisms(asked, folder=folder), *(law_choice(law) for law in table.laws)),
        simulator=experiment.simulator,
        priors=table.priors or _own_priors(found, table.fixed),
        fixed=table.fixed,
        noise=table.noise,
        stated=experiment.noise,
        per_recording=table.per_recording,
        groups=table.groups,
        per_group=table.per_group,
        only_in=table.only_in,
        drives=tuple(table.drives),
        channels=DataChannels(table.tension, table.motor_angle, table.object_pose, table.orientation),
        weighed=tuple(Weighed(tuple(entry.parameters), entry.value, entry.sd) for entry in table.weighed),
        adapter=experiment.adapter,
        folder=folder,
    )


def _own_priors(robot: Workpiece, fixed: Mapping[str, float]) -> dict[str, dict[str, Any]]:
    """Default inferred parameters: a black box's parameters, less its families."""
    if not isinstance(robot, BlackBox):
        return {}
    return {name: {} for name in robot.parameters if name not in fixed and name not in robot.families}


def law_choice(table: LawTable) -> MechanismChoice:
    """A law of a file as one of the model's mechanisms."""
    terms = tuple(term.model_dump(exclude_none=True, exclude_defaults=True) for term in table.terms)
    return MechanismChoice(f"law at {table.port}", LawChoice(table.port, terms))


def find_robot(name: str, folder: Path, adapter: Mapping[str, Any] | None = None) -> Workpiece:
    """The robot that an experiment file names: a bundled robot, a file relative to the experiment's, or another
    simulator, whose adapter gets the keys of ``adapter``.

    Raises:
        InputError: no such robot, or an adapter for a robot without adapter.
    """
    if is_adapted(name):
        return adapted(name, folder, adapter or {})
    if adapter:
        raise InputError(f"the robot {name!r} has no adapter", where="[adapter]", remedy="remove the table")
    beside = folder / name
    own = beside.suffix == ".toml" and (beside.is_file() or not Path(name).is_file())
    return Robot.load(beside if own else name)
