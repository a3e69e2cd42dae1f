"""The motion that commands produce, ``simulate``, and its distance to the recordings, ``simulate_all``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pandas as pd
from jaxtyping import Float

from rfdropo_bayes.bayes.noise import Noise, draw_noise
from rfdropo_bayes.bayes.recordings import commands_of
from rfdropo_bayes.data import Measured, Origin, SentCommands, Trajectory, shared_markers
from rfdropo_bayes.data.given_recordings import given_recordings
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import whole, write_json
from rfdropo_bayes.model.assembly import AnySimulator, physical_values
from rfdropo_bayes.model.experiment import CommandsTable, NoiseTable
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.run_folder import run_folder
from rfdropo_bayes.simulators.commands import Commands
from rfdropo_bayes.simulators.protocol import Result
from rfdropo_bayes.tables import nearest, parse_table
from rfdropo_bayes.verbs.arguments import given_model

# Number that the first marker's column carries in each source.
FIRST_COLUMN = {"sofa-csv": 0, "optitrack-csv": 1, "asl-csv": 1}
CUBE_COLUMNS = tuple(f"cube_{name}" for name in ("x", "y", "z", "qx", "qy", "qz", "qw"))
"""Columns of the cube's pose, as in recordings of SOFA and OptiTrack."""


class Simulated(NamedTuple):
    """A rollout of one recording's commands."""

    source: Trajectory
    markers: tuple[str, ...]
    position: Float[np.ndarray, "time marker 3"]
    pose: Float[np.ndarray, "time 7"] | None
    result: Result
    commands: Commands


def simulate(
    model: Model,
    commands: Sequence[Trajectory] | Mapping[str, Any],
    *,
    parameters: Mapping[str, float] | None = None,
    noise: Mapping[str, float] | None = None,
    seed: int = 0,
) -> list[Trajectory]:
    """Simulate a robot under commands.

    Args:
        model: simulated model; its fixed values hold, and other parameters are nominal.
        commands: recordings to replay; or the keys of an experiment file's [commands], for random commands.
        parameters: values in addition to the model's own.
        noise: ``{"standard_deviation": m}``, perhaps with a ``correlation_time`` [s], added to the positions.
        seed: seed of noise and random commands.

    Returns:
        recordings marked as synthetic, with the true parameters among their settings.

    Raises:
        InputError: bad input, or a diverged rollout.
    """
    model = given_model(model, "simulate")
    if not isinstance(commands, Mapping):
        commands = given_recordings(commands, "simulate, commands")
    spec, settings = replace(model.spec, fixed={**model.spec.fixed, **(parameters or {})}), model.settings
    if noise is not None:
        spec = replace(spec, stated=parse_table(NoiseTable, noise, where="simulate, noise"))
    settings = replace(settings, seed=seed)
    if not isinstance(commands, Sequence):
        settings = replace(settings, commands=parse_table(CommandsTable, commands, where="simulate, commands"))
    model = Model.of(spec, settings)
    values = physical_values(spec, model.simulator)
    sources = commands if isinstance(commands, Sequence) else _sources(model)
    return [
        _as_trajectory(rollout, model, values, index)
        for index, rollout in enumerate(_rollouts(model.simulator, values, sources))
    ]


def _rollouts(
    simulator: AnySimulator, values: Mapping[str, float], sources: Sequence[Trajectory]
) -> Iterator[Simulated]:
    """Roll out the commands of every recording."""
    rollout = jax.jit(simulator.rollout)
    for source in sources:
        markers = shared_markers([source], simulator.marker_names)
        commands = commands_of(simulator, source)
        observation = jax.device_get(rollout({k: np.asarray(v) for k, v in values.items()}, commands))
        chosen = [simulator.marker_names.index(name) for name in markers]
        result = Result(int(observation.status))
        if result is Result.DIVERGED:
            raise InputError(f"the rollout of {source.name} diverged", where="simulate", remedy=result.remedy)
        pose = None if observation.object_pose is None else np.asarray(observation.object_pose)
        yield Simulated(source, markers, np.asarray(observation.position)[:, chosen], pose, result, commands)


def simulate_all(model: Model, out: Path, *, overwrite: bool = False) -> dict[str, Any]:
    """Simulate into a folder each recording of a model's experiment, or the command sequences of its [commands] table.

    Writes, per recording, ``<name>.nc`` (`Trajectory`) and ``<name>.csv`` (time in s, markers in mm, in the source's
    column names), called ``trajectory`` if there is only one recording.

    Returns:
        per recording: result code, files, and the error against the measurement [mm]; and the error over all
        recordings. With a cube also the errors of its centre [mm] and its orientation [deg].

    Raises:
        InputError: bad input, a folder that holds a run, or a failed rollout.
    """
    settings: dict[str, Any] = {"tables": model.tables(), "folder": model.folder}
    settings |= {"texts": model.texts()}
    with run_folder(Path(out), "simulate", **settings, overwrite=overwrite) as out:
        return _simulate_into(out, model)


def _simulate_into(out: Path, model: Model) -> dict[str, Any]:
    simulator, measured = model.simulator, model.settings.data is not None
    values = physical_values(model.spec, simulator)
    sources = _sources(model)
    report: dict[str, Any] = {"simulator": simulator.description, "parameters": values, "recordings": {}}
    distances = []
    for index, rollout in enumerate(_rollouts(simulator, values, sources)):
        source, pose = rollout.source, rollout.pose
        stem = "trajectory" if len(sources) == 1 else source.name
        simulated = _as_trajectory(rollout, model, values, index)
        simulated.save(out / f"{stem}.nc")
        with whole(out / f"{stem}.csv") as partial:
            _table(source, simulated).to_csv(partial, index=False, float_format="%.6f")
        distances.append(_distance(source, rollout.position, rollout.markers))
        report["recordings"][source.name] = {
            "status": rollout.result.name.lower(),
            "files": [str(out / f"{stem}.nc"), str(out / f"{stem}.csv")],
            "error_mm": _errors([distances[-1]]) if measured else None,
        }
        if pose is not None and source.object_pose is not None:
            report["recordings"][source.name]["object_error"] = _object_errors(pose, source.object_pose)
    report["error_mm"] = _errors(distances) if measured else None
    write_json(out / "simulation.json", report)
    return report


def _sources(model: Model) -> Sequence[Trajectory]:
    table = model.settings.commands
    if table is None:
        return [*model.recordings("fit"), *model.recordings("test")]
    if model.settings.data is not None:
        raise InputError("the experiment has both [data] and [commands]", remedy="replay one or make the other")
    seeds = np.random.SeedSequence(model.settings.seed).spawn(len(table.recordings))
    return [
        _generated(table, name, model.simulator, np.random.default_rng(seed))
        for name, seed in zip(table.recordings, seeds, strict=True)
    ]


def _generated(table: CommandsTable, name: str, simulator: AnySimulator, rng: np.random.Generator) -> Trajectory:
    """A recording of random commands whose positions are still to be simulated."""
    command_time, command = random_walk(table, len(simulator.channel_names), rng)
    time = table.sample_time * np.arange(round(table.duration / table.sample_time) + 1)
    markers = _known_markers(table.markers or simulator.marker_names, simulator)
    places = simulator.marker_points()[[simulator.marker_names.index(name) for name in markers]]
    return Trajectory.build(
        Origin(name=name, robot=simulator.robot.name, format="netcdf", synthetic=True),
        SentCommands(
            command_time=command_time,
            command=command,
            command_unit=simulator.command_unit,
            cable_names=simulator.channel_names,
        ).trusted(),
        Measured(time=time, position=np.tile(places, (len(time), 1, 1)), marker_names=markers),
    )


def _known_markers(names: Sequence[str], simulator: AnySimulator) -> list[str]:
    for name in names:
        if name not in simulator.marker_names:
            remedy = nearest(name, simulator.marker_names)
            raise InputError(f"unknown marker {name!r}", where="[commands]", remedy=remedy)
    return [name for name in simulator.marker_names if name in names]


def _as_trajectory(rollout: Simulated, model: Model, values: Mapping[str, float], index: int) -> Trajectory:
    """The simulated motion as a recording with a note that it is synthetic, and how it was made."""
    source, position, simulator = rollout.source, rollout.position, model.simulator
    noise, seed = model.spec.stated, model.settings.seed
    if noise is not None:
        key = jax.random.fold_in(jax.random.key(seed), index)
        position = position + np.asarray(
            draw_noise(key, source.time, position.shape[1], Noise(noise.standard_deviation, noise.correlation_time))
        )
    settings: dict[str, Any] = {
        "simulator": simulator.description,
        "parameters": {spec.name: values.get(spec.name, spec.nominal) for spec in simulator.parameters},
        "noise": None if noise is None else noise.model_dump(),
        "seed": seed,
    }
    if model.settings.commands is not None and model.settings.commands.blind:
        settings = {}
    return Trajectory.build(
        Origin(
            name=source.name,
            robot=simulator.robot.name,
            format="netcdf",
            synthetic=True,
            provenance="synthetic: made by rfdropo simulate",
            settings=settings,
        ),
        SentCommands(
            command_time=source.command_time,
            command=source.command,
            command_unit=source.command_unit,
            cable_names=source.cable_names,
            initial_command=source.initial_command,
        ).trusted(),
        Measured(time=source.time, position=position, marker_names=rollout.markers, object_pose=rollout.pose),
    )


def _table(source: Trajectory, simulated: Trajectory) -> pd.DataFrame:
    """Time [s], markers [mm] and the cube's pose, if there is one [mm, -]: one row per recorded time."""
    first = FIRST_COLUMN.get(source.dataset.attrs["format"])
    columns: dict[str, np.ndarray] = {"time": simulated.time}
    for i, marker in enumerate(simulated.marker_names):
        for j, axis in enumerate("xyz"):
            name = f"{marker}_{axis}" if first is None else f"{axis}{first + i}"
            columns[name] = 1e3 * simulated.position[:, i, j]
    if simulated.object_pose is not None:
        pose = simulated.object_pose * np.array([1e3] * 3 + [1.0] * 4)
        columns |= dict(zip(CUBE_COLUMNS, pose.T, strict=True))
    return pd.DataFrame(columns)


def _distance(source: Trajectory, position: np.ndarray, names: Sequence[str]) -> Float[np.ndarray, "time marker"]:
    """Distance between simulated and measured markers [mm]; NaN if the measurement is masked."""
    chosen = [source.marker_names.index(name) for name in names]
    distance = 1e3 * np.linalg.norm(np.asarray(position) - source.position[:, chosen], axis=2)
    return np.where(source.position_mask[:, chosen], distance, np.nan)


def _errors(distances: Sequence[np.ndarray]) -> dict[str, float]:
    """Mean and largest distance over markers and time, and the root mean square over time of the last marker's [mm]."""
    every = np.concatenate([distance.ravel() for distance in distances])
    last = np.concatenate([distance[:, -1] for distance in distances])
    return {
        "mean": float(np.nanmean(every)),
        "max": float(np.nanmax(every)),
        "rms_last_marker": float(np.sqrt(np.nanmean(last**2))),
    }


def _object_errors(
    pose: Float[np.ndarray, "time 7"], measured: Float[np.ndarray, "time 7"]
) -> dict[str, dict[str, float]]:
    """Distance of the cube's centre [mm] and angle between the orientations [deg]: mean, largest and last."""
    distance = 1e3 * np.linalg.norm(pose[:, :3] - measured[:, :3], axis=1)
    cosine = np.abs(np.sum(pose[:, 3:] * measured[:, 3:], axis=1))
    angle = np.degrees(2.0 * np.arccos(np.clip(cosine / np.linalg.norm(measured[:, 3:], axis=1), 0.0, 1.0)))
    return {
        name: {"mean": float(np.nanmean(error)), "max": float(np.nanmax(error)), "last": float(error[-1])}
        for name, error in (("position_mm", distance), ("orientation_deg", angle))
    }


def random_walk(
    table: CommandsTable, channels: int, rng: np.random.Generator
) -> tuple[Float[np.ndarray, " command"], Float[np.ndarray, "command channel"]]:
    """Every ``interval`` one channel, chosen at random, moves by ``step`` up or down, reflected at the limits.

    This is how the paper's data were collected: each action pulls or releases one cable.

    Returns:
        times [s] and cumulative commands [the robot's command unit].

    Raises:
        InputError: a step larger than the range.
    """
    if table.high - table.low < table.step:
        raise InputError(
            f"a step of {table.step:g} does not fit between {table.low:g} and {table.high:g}",
            where="[commands]",
            remedy="widen the limits or shorten the step",
        )
    count = int(np.floor(table.duration / table.interval + 1e-9))
    level = np.clip(np.zeros(channels), table.low, table.high)
    value = np.empty((count, channels))
    for row in range(count):
        channel = rng.integers(channels)
        move = table.step * rng.choice([-1.0, 1.0])
        if not table.low <= level[channel] + move <= table.high:
            move = -move
        level[channel] += move
        value[row] = level
    return table.interval * np.arange(count), value
