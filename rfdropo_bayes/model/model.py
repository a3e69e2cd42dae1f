"""A model: its simulator, inferred parameters and data channels, from a file or a program."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import pandas as pd

from rfdropo_bayes.bayes.calibration_problem import CalibrationProblem
from rfdropo_bayes.bayes.noise.autoregression import STATED
from rfdropo_bayes.bayes.priors import table_of
from rfdropo_bayes.bayes.trajectory_model import TrajectoryModel
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.data.first_command import begun_alike
from rfdropo_bayes.data.given_recordings import given_recordings
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.assembly import (
    build_model,
    build_problem,
    build_simulator,
    check_spec,
    expand_groups,
    fixed_values,
    integrator_of,
    load_data,
    measurement_specs,
    model_specs,
)
from rfdropo_bayes.model.experiment import Experiment, ModelTable, load_experiment
from rfdropo_bayes.model.experiment_file import ROBOT_COPY, describe
from rfdropo_bayes.model.model_spec import ModelSpec, RunSettings, Workpiece, spec_of
from rfdropo_bayes.posteriors import DrawsByOwner
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.runtime import refuse_lost_threads
from rfdropo_bayes.signatures import with_keywords_of
from rfdropo_bayes.simulators.black_box import BlackBox, BlackBoxSimulator
from rfdropo_bayes.simulators.body_engine import QUASI_STATIC
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator
from rfdropo_bayes.tables import parse_table


class ExperimentFile(NamedTuple):
    """The file that a model was read from."""

    path: Path  # path of the file
    tables: Mapping[str, Any]  # its tables with the overrides applied


class Model:
    """Robot or black box, with mechanisms, priors and noise.

    Args:
        robot: name of a robot that comes with the package, path of a robot file or of a MuJoCo model, a `Robot`, or a
            `BlackBox`.
        priors: inferred parameters: {parameter: prior}. A prior is a numpyro distribution, a table such as
            ``{"distribution": "LogNormal", "median": 4.5e6, "sigma": 0.5}``, or ``{}`` for the parameter's default. For
            a black box, by default all parameters except `families`, with their priors.
        mechanisms: effects on top of the base simulator: names of the library, ``"file.py:ClassName"``, or your own
            mechanisms, as classes or objects.
        noise: noise of the positions, by name as in an experiment file; or, if it is known, ``{"standard_deviation":
            m}``, perhaps with a ``correlation_time`` [s].
        fixed: values of parameters that are not inferred.
        simulator: body, engine and discretisation: the keys of an experiment file's [simulator].
        folder: base of relative paths.
        title: heading of reports; the robot's name by default.
        more: further keys of an experiment file's [model], such as ``tension = True`` or ``per_recording``.

    Attributes:
        spec: specification of the model, as objects.
        settings: settings of the experiment outside the model.
        file: source file; None for a model that was changed or made in Python.

    Raises:
        InputError: an unknown robot, key, mechanism or parameter; or a prior that does not fit its parameter.
    """

    file: ExperimentFile | None = None

    @with_keywords_of(ModelTable)
    def __init__(
        self,
        robot: str | Path | Robot | BlackBox,
        *,
        priors: Mapping[str, Any] | None = None,
        mechanisms: Sequence[Any] = (),
        noise: str | Mapping[str, float] = "auto",
        fixed: Mapping[str, float] | None = None,
        simulator: Mapping[str, Any] | None = None,
        folder: Path | str = Path(),
        title: str = "",
        **more: Any,
    ) -> None:
        fixed = dict(fixed or {})
        given = {name: table_of(prior, where=f"priors, {name}") for name, prior in (priors or {}).items()}
        stated = dict(noise) if isinstance(noise, Mapping) else None
        described = {"priors": given, "noise": noise if stated is None else STATED, "fixed": fixed, **more}
        made = None if isinstance(robot, str | Path) else robot
        tables: dict[str, Any] = {"robot": str(robot) if made is None else "", "model": described}
        if stated is not None:
            tables["noise"] = stated
        if simulator:
            tables["simulator"] = dict(simulator)
        experiment = parse_table(Experiment, tables, where="Model")
        self.spec = spec_of(experiment, Path(folder), made, mechanisms)
        self.settings = RunSettings(title=title)
        check_spec(self.spec, self.simulator)

    @classmethod
    def of(cls, spec: ModelSpec, settings: RunSettings | None = None) -> Model:
        """The model of a specification, with the settings of its experiment."""
        model = cls.__new__(cls)
        model.spec, model.settings = spec, settings or RunSettings()
        return model

    @classmethod
    def of_experiment(cls, experiment: Experiment, folder: Path) -> Model:
        """The model that an experiment file describes; ``folder`` is the folder of the file."""
        return cls.of(spec_of(experiment, folder), RunSettings.of(experiment))

    @classmethod
    def read(cls, path: Path | str, overrides: Sequence[str] | None = None) -> Model:
        """The model of an experiment file, with its further settings: recordings, method, seed.

        Args:
            path: the file.
            overrides: assignments that replace entries of the file, as with ``--set``.

        Raises:
            InputError: no such file, an unknown key, or a bad value.
        """
        path = Path(path)
        experiment, tables = load_experiment(path, overrides or ())
        model = cls.of_experiment(experiment, path.resolve().parent)
        model.file = ExperimentFile(path, tables)
        return model

    @property
    def title(self) -> str:
        """Heading of reports: the experiment's title, or else the name of its file, or else the robot's name."""
        return self.settings.title or (self.name if self.file is None else self.file.path.stem)

    def recordings(self, role: Literal["fit", "test"]) -> list[Trajectory]:
        """The recordings that the experiment file names."""
        return load_data(self.settings.data, self.folder, role)

    @property
    def robot(self) -> Workpiece:
        """The robot, or the black box."""
        return self.spec.robot

    @property
    def folder(self) -> Path:
        """That paths are relative to."""
        return self.spec.folder

    @cached_property
    def simulator(self) -> RobotSimulator | BlackBoxSimulator:
        """The simulator, mechanisms included."""
        return build_simulator(self.spec)

    @property
    def name(self) -> str:
        """Name of the robot."""
        return self.robot.name

    @property
    def mechanisms(self) -> tuple[str, ...]:
        """Names of its mechanisms."""
        return tuple(mechanism.name for mechanism in self.simulator.mechanisms)

    @property
    def parameters(self) -> pd.DataFrame:
        """Every parameter of simulator and measurement: unit, hard bounds, nominal value, prior if inferred."""
        specs = model_specs(self.spec, self.simulator)
        given = expand_groups(self.spec.priors, specs)
        added = {spec.name for mechanism in self.simulator.mechanisms for spec in mechanism.parameters}
        added |= {spec.name for spec in measurement_specs(self.spec.noise, self.spec.channels)}
        fixed = fixed_values(self.spec, self.simulator)
        rows = {}
        for spec in specs:
            inferred = spec.name in given or (spec.name in added and spec.name not in fixed)
            prior = dict(given.get(spec.name) or spec.prior) if inferred else None
            value = None if inferred else fixed.get(spec.name, spec.nominal)
            rows[spec.name] = {"unit": spec.unit, "low": spec.low, "high": spec.high, "value": value, "prior": prior}
        return pd.DataFrame.from_dict(rows, orient="index")

    def with_mechanisms(self, *names: Any) -> Model:
        """The same model with more mechanisms."""
        return Model.of(self.spec.with_mechanisms(*names), self.settings)

    def numpyro(self, runs: Sequence[Trajectory]) -> TrajectoryModel:
        """The model of these recordings as a numpyro model: a callable with sample sites for all that is inferred.

        Raises:
            InputError: unknown names, priors outside the bounds, or a process in which JAX cannot compute.
        """
        refuse_lost_threads()
        return build_model(self.spec, self.simulator, runs)

    def problem(self, runs: Sequence[Trajectory], earlier: DrawsByOwner | None = None) -> CalibrationProblem:
        """The posterior given these recordings, as the inference methods see it."""
        return build_problem(self.numpyro(runs), earlier)

    def runs(
        self, fit: Sequence[Trajectory] | None, test: Sequence[Trajectory] | None = None
    ) -> tuple[Sequence[Trajectory], Sequence[Trajectory]]:
        """Recordings to fit and to test that a call gives, or else the recordings of the experiment file.

        Raises:
            InputError: the arguments are not recordings, or none to fit.
        """
        if fit is None:
            return self.recordings("fit"), self.recordings("test") if test is None else given_recordings(test, "test")
        runs = begun_alike(given_recordings(fit, "runs"))
        if not runs:
            raise InputError("the list of recordings is empty", where="runs", remedy="give at least one")
        return runs, begun_alike(given_recordings(test or (), "test"), runs)

    def record(self, meant: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
        """Tables for the record of a run, as an experiment file has them.

        Args:
            meant: keys that describe the run in a file; a model read from a file has them already.
            given: keys and values that replace the file's; None keeps the file's.
        """
        stated = {name: value for name, value in given.items() if value is not None}
        return {**self.tables(), **(meant if self.file is None else {}), **stated}

    def tables(self) -> dict[str, Any]:
        """Tables of the model's source file, or equivalent tables as far as a file allows. They state the integrator,
        so that a changed default does not alter their meaning.
        """
        if self.file is not None:
            found = dict(self.file.tables)
        else:
            robot = ROBOT_COPY if self.texts() else self.spec.named or self.name
            found = {"robot": robot, **self.settings.tables(), **self.spec.tables()}
        integrator = integrator_of(self.spec)
        if integrator is not None and integrator != QUASI_STATIC:
            found["simulator"] = {**found.get("simulator", {}), "integrator": integrator}
        return found

    def texts(self) -> dict[str, str]:
        """Files that the tables name and no folder holds: the description of a robot that was made in Python."""
        if isinstance(self.robot, Robot) and not self.spec.named:
            return {ROBOT_COPY: describe(self.robot.model_dump(mode="json", exclude_none=True))}
        return {}

    def __repr__(self) -> str:
        effects = ", ".join(choice.source for choice in self.spec.mechanisms)
        inferred = ", ".join(self.spec.priors)
        return f"<Model {self.name}: mechanisms {effects or 'none'}; priors {inferred or 'none'}>"

    def _repr_html_(self) -> str:
        rows = self.parameters
        inferred = rows[[prior is not None for prior in rows["prior"]]]
        return f"<p><b>{self.name}</b>, {len(inferred)} of {len(rows)} parameters inferred</p>{inferred.to_html()}"
