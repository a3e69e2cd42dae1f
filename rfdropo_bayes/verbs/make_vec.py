"""The tasks of an experiment as environments: ``make_vec``, and the common set-up of training and evaluation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.assembly import (
    AnySimulator,
    build_robot_simulator,
    build_simulator,
    measured_parameters,
    physical_values,
)
from rfdropo_bayes.model.fitted_integrator import check_fitted_integrator
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.policies.episodes import Episodes, Settings
from rfdropo_bayes.policies.randomisation import (
    Draws,
    Layers,
    Point,
    Present,
    Randomisation,
    Sessions,
    Uniform,
    drawn_rows,
    read_phi,
    read_posterior,
    with_width,
)
from rfdropo_bayes.policies.tasks import Task, task_named
from rfdropo_bayes.policies.training_config import TrainingOptions, TrainingTable
from rfdropo_bayes.policies.vec_env import TrunkVecEnv
from rfdropo_bayes.posteriors import PosteriorRecord
from rfdropo_bayes.prediction.session_deviation import session_deviations
from rfdropo_bayes.report.run_files import POSTERIOR
from rfdropo_bayes.results.calibrated import Calibration
from rfdropo_bayes.robots import OBJECT, Robot
from rfdropo_bayes.signatures import stated
from rfdropo_bayes.simulators.black_box import BlackBox
from rfdropo_bayes.tables import changed, parse_table
from rfdropo_bayes.verbs.arguments import given_model

LONGER = 0.15
"""Largest relative difference in length from a task's robot that keeps its goals. The goals are 115 to 150 mm from the
base of a trunk whose tip rests at 184 mm.
"""


def make_vec(
    task: str,
    model: Model,
    options: TrainingOptions | None = None,
    *,
    fit: Calibration | Path | None = None,
    n: int = 64,
) -> TrunkVecEnv:
    """Environments of a task, side by side, for Stable-Baselines3.

    Args:
        task: "TrunkReach-v0" or "TrunkPush-v0".
        model: the simulated model, with its fixed values.
        options: further keys of [training], such as ``observation`` or ``period``.
        fit: a calibration, or its folder, of whose posterior the episodes' parameters are draws;
            nominal values without.
        n: number of environments.

    Raises:
        InputError: an unknown task or key, or a posterior of another robot.
    """
    model = with_training(model, {**stated(options, TrainingOptions), "task": task})
    table, chosen, simulator = training_of(model)
    randomisation = randomisation_of(table, model.spec, simulator, fit)
    return TrunkVecEnv(Episodes(simulator, chosen, n, randomisation, episode_settings(table)))


def with_training(model: Model, options: Mapping[str, Any]) -> Model:
    """The model with further keys of [training]."""
    model = given_model(model, "training")
    if not options:
        return model
    own = model.settings.training
    known = {} if own is None else own.model_dump(exclude_unset=True)
    table = parse_table(TrainingTable, {**known, **options}, where="training")
    return Model.of(model.spec, replace(model.settings, training=table))


def training_of(model: Model) -> tuple[TrainingTable, Task, AnySimulator]:
    """The table [training], the task, and its simulator.

    Raises:
        InputError: no such table, or no box of goals for a black box or a robot of another length than the task's.
    """
    table = model.settings.training
    if table is None:
        raise InputError(
            "the experiment has no table [training]", where="training", remedy='add it, with task = "TrunkReach-v0"'
        )
    task = task_named(table.task)
    if table.goals is not None:
        task = replace(task, goal_low=table.goals[0], goal_high=table.goals[1])
    else:
        _check_length(task, model.robot)
    if isinstance(model.robot, BlackBox):
        return table, task, build_simulator(model.spec)
    pushing = changed(model.spec.simulator, where="[simulator]", push=task.push)
    return table, task, build_robot_simulator(replace(model.spec, simulator=pushing))


def _check_length(task: Task, robot: Robot | BlackBox) -> None:
    """Check that a robot is about as long as a task's own, so that the task's goals are within reach.

    Raises:
        InputError: the lengths differ too much.
    """
    remedy = "give goals = [[x, y, z], [x, y, z]] [m] under [training], the corners of a box; or --goal X,Y,Z"
    if isinstance(robot, BlackBox):
        raise InputError("the task has no goals for this robot", where="[training]", remedy=remedy)
    wanted, own = (float(each.body.station_m[-1]) for each in (Robot.load(task.robot), robot))
    if abs(own - wanted) > LONGER * wanted:
        lengths = f"for a trunk of {1e3 * wanted:.0f} mm, but {robot.name} has {1e3 * own:.0f} mm"
        raise InputError(f"the goals of {task.name} are {lengths}", where="[training]", remedy=remedy)


def episode_settings(table: TrainingTable) -> Settings:
    """Settings of episodes in [training]."""
    return Settings(
        table.actions, table.observation, table.period, table.step, table.noise, tension_limit=table.tension_limit
    )


def steps_of(simulator: AnySimulator) -> str:
    """Integrator of time steps: the integrator, or the engine of a black box."""
    return simulator.integrator or str(simulator.description["engine"])


def randomisation_of(
    table: TrainingTable, spec: ModelSpec, simulator: AnySimulator, fit: Calibration | Path | None = None
) -> Randomisation:
    """Sources of parameters: fixed values, randomised parameters, and parameters that differ between episodes.

    A task without a cube ignores the experiment's cube parameters.

    Raises:
        InputError: a posterior together with another ``randomisation`` of [training]; a fixed value of a parameter that
            is randomised; or a posterior that was fitted with another integrator.
    """
    stated = table.randomisation if "randomisation" in table.model_fields_set else None
    if fit is not None and stated not in (None, "posterior"):
        raise InputError(
            f"a calibration was given, and randomisation = {stated!r}",
            where="[training]",
            remedy='leave one of them out, or set randomisation = "posterior"',
        )
    absent = () if "cube_mass" in {spec.name for spec in simulator.parameters} else OBJECT
    fixed = replace(spec, fixed={name: value for name, value in spec.fixed.items() if name not in absent})
    parts: list[Randomisation] = [Point(physical_values(fixed, simulator))]
    if isinstance(fit, Calibration):
        rows = drawn_rows(fit.record, simulator.parameters, robot=simulator.robot)
        parts.append(_of_record(rows, fit.record, fit.folder, simulator, where="fit"))
    elif fit is not None:
        parts.append(_of_run(Path(fit), simulator))
    elif table.randomisation != "none":
        parts.append(_randomised(table, simulator, spec.folder))
    both = sorted(set(parts[0].names) & {name for part in parts[1:] for name in part.names})
    if both:
        raise InputError(
            f"{both[0]} is fixed, but randomisation = {parts[-1].kind!r} varies it",
            where="[model.fixed]",
            remedy="leave one of them out",
        )
    if table.width != 1.0:
        parts[-1] = with_width(parts[-1], table.width, simulator.parameters)
    kind = parts[-1].kind
    start = {name: ends for name, ends in table.start.items() if name not in absent}
    whole = Layers((*parts, Uniform(start)), kind) if start or len(parts) > 1 else parts[0]
    early = tuple(name for m in simulator.mechanisms for name in getattr(m, "shows_future", ()) if name in whole.names)
    return Present(whole, early) if early and kind in ("posterior", "phi") else whole


def _randomised(table: TrainingTable, simulator: AnySimulator, folder: Path) -> Randomisation:
    """The randomisation of [training]."""
    if table.randomisation == "uniform":
        if not table.ranges:
            raise InputError(
                "no ranges", where="[training.ranges]", remedy="give name = [low, high] for each parameter"
            )
        return Uniform(table.ranges)
    if table.source is None:
        raise InputError(
            f"randomisation = {table.randomisation!r} without a source",
            where="[training]",
            remedy="name the folder of a calibration: source = ...",
        )
    return _of_run(source_of(table.source, folder), simulator, phi=table.randomisation == "phi")


def source_of(source: str, folder: Path) -> Path:
    """The run that [training] source names, relative to the experiment's folder or to the working directory."""
    beside = folder / source
    return beside if beside.exists() else Path(source)


def _of_run(source: Path, simulator: AnySimulator, *, phi: bool = False) -> Randomisation:
    """The posterior, or phi, of a run's folder or file, of which parameters are drawn.

    Raises:
        InputError: the posterior was fitted with another integrator than the simulator's.
    """
    folder = source if source.is_dir() else source.parent
    file = source if source.is_file() and not phi else folder / POSTERIOR
    own = (source, simulator.parameters, simulator.robot)
    found: Randomisation = read_phi(*own) if phi else read_posterior(*own)
    record = None if phi and not file.is_file() else PosteriorRecord.load(file)
    return _of_record(found, record, folder, simulator, where=str(source))


def _of_record(
    found: Randomisation, record: PosteriorRecord | None, folder: Path | None, simulator: AnySimulator, *, where: str
) -> Randomisation:
    """A posterior or phi on the session that it describes, together with the fixed values of its fit; ``record`` is
    None for phi without a posterior.

    Raises:
        InputError: a parameter that the simulator lacks, or another integrator than the simulator's.
    """
    attributes = {} if record is None else record.attrs
    check_fitted_integrator(attributes, folder, simulator.integrator, where=where)
    if record is None:
        return found
    _check_parameters(record, simulator, where=where)
    if isinstance(found, Draws):
        found = _in_its_session(found, record, simulator)
    known = {spec.name for spec in simulator.parameters}
    fixed = {info.name: value for info, value in record.fixed if info.name in known}
    return Layers((Point(fixed), found), found.kind) if fixed else found


def _check_parameters(record: PosteriorRecord, simulator: AnySimulator, *, where: str) -> None:
    """Check that the simulator has the parameters of a posterior, including user laws and mechanisms. Noise, parameters
    of single recordings and an absent cube are ignored.

    Raises:
        InputError: a parameter that the simulator lacks.
    """
    known = {spec.name for spec in simulator.parameters} | measured_parameters() | set(OBJECT)
    of_all = [info.name for info in record.free if not info.scope.owner and not info.scope.spread]
    lacking = [name for name in of_all if name not in known]
    if lacking:
        raise InputError(
            f"has {lacking[0]}, which the simulator lacks",
            where=where,
            remedy="use the experiment that was calibrated, with its laws and mechanisms, or calibrate without them",
        )


def _in_its_session(rows: Draws, record: PosteriorRecord, simulator: AnySimulator) -> Randomisation:
    """A posterior's rows on the session it was adapted to, else each on a session that no fit has seen, as predictions
    are.

    Policies meet neither the mean of the fitted sessions nor one of them, but the next session. The sum of a shared
    value and a session's deviation ends at the hard bounds, as in the fit.
    """
    own = {name: each for name, each in session_deviations(record, simulator.parameters).items() if name in rows.names}
    if not own:
        return rows
    shifts = np.stack([own[name].shift if name in own else np.zeros(len(rows.rows)) for name in rows.names], axis=1)
    ends = {spec.name: (spec.low, spec.high) for spec in simulator.parameters if spec.name in own}
    low, high = np.transpose([ends.get(name, (-np.inf, np.inf)) for name in rows.names])
    moved = replace(rows, rows=np.clip(rows.rows + shifts, low, high))
    spreads = {name: each.spread for name, each in own.items() if each.spread.any()}
    return Sessions(moved, spreads, {name: ends[name] for name in spreads}) if spreads else moved
