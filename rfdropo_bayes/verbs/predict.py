"""Predictions of a calibrated simulator for commands that were never run: ``predict``, and ``rfdropo predict``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import xarray as xr

from rfdropo_bayes.bayes.noise import Autoregression
from rfdropo_bayes.bayes.noise.autoregression import STATED
from rfdropo_bayes.bayes.scopes import Scopes
from rfdropo_bayes.bayes.trajectory_model import TrajectoryModel
from rfdropo_bayes.data import (
    Origin,
    SentCommands,
    Trajectory,
    commands_alone,
    first_row_only,
    load_unseen,
    start_is_known,
)
from rfdropo_bayes.data.given_recordings import given_recording
from rfdropo_bayes.data.sample_times import sample_time
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.groups import Patterns, group_of, in_group
from rfdropo_bayes.model.assembly import KNOWN, fixed_values, integrator_of, model_specs, with_groups
from rfdropo_bayes.model.fitted_integrator import check_fitted_integrator
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.model.run_folder import hashes, run_folder
from rfdropo_bayes.posteriors import PosteriorRecord, RecordingPrediction
from rfdropo_bayes.prediction.model_error import ADAPTED_TO, recorded_model_error
from rfdropo_bayes.prediction.predictive import BEGUN, FITTED, KNOWN_NOISE, NOISE, match_cautions, predict_new, thin
from rfdropo_bayes.prediction.session_error import SessionError, recorded_session_error, session_sentence
from rfdropo_bayes.report.run_files import CONFIG
from rfdropo_bayes.results.calibrated import Calibration
from rfdropo_bayes.results.predicted import LEVELS, OBJECT, Prediction
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator
from rfdropo_bayes.verbs.arguments import given_fit
from rfdropo_bayes.verbs.left_out_sessions import OPENINGS, of_unseen_sessions
from rfdropo_bayes.verbs.recording_doubts import cautions_after

DRAWS = 200
SCHEMA_VERSION = 1
POSE_UNITS = "m, m, m, and unit quaternion x, y, z, w"


def predict(
    fit: Calibration,
    commands: Trajectory | tuple[Any, Any] | Path | str,
    *,
    start: Any = None,
    episode: int | None = None,
    draws: int = DRAWS,
    seed: int | None = None,
    group: str | None = None,
    out: Path | str | None = None,
    overwrite: bool = False,
) -> Prediction:
    """Predict the motion of the markers under given commands, from at most the start pose.

    Args:
        fit: a calibration, with its model.
        commands: a recording, of which only the commands and the first row are used; the name of a file in the format
            of the model's experiment; or a pair of times [s] and commands (time, channel), in the robot's unit.
        start: positions of the markers in the first row [m], (marker, 3), if commands are a pair; if commands are a
            file without observations, the file that has them (see `load_unseen`); unknown by default.
        episode: number of the episode, if the file is a LeRobotDataset.
        draws: number of posterior draws to simulate.
        seed: seed of random numbers; by default from the model's experiment.
        group: session, robot or other group of the commands; by default the session of `adapt`, or else from
            [model.groups].
        out: folder for prediction.nc, prediction.csv and prediction.json, see `Prediction.save`; None writes nothing.
        overwrite: replace earlier files in ``out``.

    Raises:
        InputError: a calibration without its model, or commands of another robot.
    """
    model = model_of(given_fit(fit, "predict"))
    record = fit.record
    spec, path = model.spec, model.name if model.file is None else str(model.file.path)
    fitted_noise = record.attrs.get(NOISE, spec.noise)  # earlier posteriors lack it
    if spec.noise != fitted_noise:
        raise InputError(
            f"the posterior was fitted with noise = {fitted_noise!r}, the experiment says {spec.noise!r}",
            where="[model] noise",
            remedy=f"add --set model.noise={fitted_noise}, or predict with config.toml of the posterior's folder",
        )
    if isinstance(commands, tuple) and len(commands) == 2 and not isinstance(commands[0], Trajectory):
        times, values = (np.asarray(part, dtype=float) for part in commands)
        names, unit = model.simulator.channel_names, model.simulator.command_unit
        given = commands_alone(
            Origin("commands", model.name, "memory"),
            SentCommands(times, values, unit, names).trusted(),
            model.simulator.marker_names,
            start=None if start is None else np.asarray(start, dtype=float)[None],
        )
    elif isinstance(commands, str | Path):
        data = model.settings.data
        if data is None:
            remedy = "name the format of the commands"
            raise InputError("the experiment has no [data]", where=path, remedy=remedy)
        begun = record.attrs.get(BEGUN)
        given = load_unseen(data, model.folder, str(commands), start, begun=begun, episode=episode)
    else:
        given = given_recording(commands, "predict")
    unseen = first_row_only(given)  # a prediction knows no later row
    asked = {"group": group, "seed": seed, "episode": episode}
    group = record.attrs.get(ADAPTED_TO) if group is None else group
    groups = spec.groups if group is None else in_group(unseen.name, group, spec.groups)
    simulator = with_groups(model.simulator, groups)
    scopes = fitted_scopes(fit)
    noise = _known_noise(spec, record.attrs.get(KNOWN_NOISE), sample_time(unseen.time))
    program = TrajectoryModel.of_positions(simulator, scopes, [unseen], spec.noise, *noise)
    posterior = thin({info.name: record.posterior[info.name] for info in record.free}, draws)
    fitted = record.attrs.get(FITTED, sorted({info.scope.owner for info in record.free if info.scope.owner}))
    slow = _slow_error(record, unseen, groups, scopes)
    drawn = predict_new(
        program,
        [unseen],
        posterior,
        jax.random.key(model.settings.seed if seed is None else seed),
        chunk=simulator.lanes,
        fitted=fitted,
        model_error=recorded_model_error(record),
        groups=groups,
        slow=slow,
    )
    predicted = drawn.recordings[0]
    bands = summarise(predicted)
    bands.attrs |= {"frame": unseen.dataset.attrs["frame"], "robot": model.name, "recording": unseen.name}
    bands.attrs["draws_that_did_not_match_the_first_row"] = drawn.unmatched
    group = bands.attrs["group"] = group_of(unseen.name, groups)
    known = {p.scope.owner for p in scopes.deviating}
    cautions = cautions_after(record, model, [unseen]) + match_cautions(drawn)
    if isinstance(simulator, RobotSimulator):
        cautions += simulator.robot.unstated([unseen.name])
    said = [session_sentence(error) for error in slow.values() if not error.shown and group not in known]
    named = str(commands) if isinstance(commands, str | Path) else unseen.name
    facts = {
        "schema_version": SCHEMA_VERSION,
        "experiment": path,
        "posterior": None if fit.folder is None else str(fit.folder),
        "commands": named,
        "episode": episode,
        "start_pose_known": start_is_known(unseen),
        "first_command": unseen.first_command,
        "compared": compared(given, predicted, bands),
        "simulator": model.simulator.description,
    }
    prediction = Prediction(bands, predicted, group, group in known if known else None, cautions, "".join(said), facts)
    if out is None:
        return prediction
    options = {"posterior": fit.folder, "commands": named, "start": start, **asked}
    settings: dict[str, Any] = {"tables": model.tables(), "folder": model.folder, "data": hashes([unseen])}
    with run_folder(Path(out), "predict", **settings, options=options, overwrite=overwrite) as folder:
        prediction.save(folder)
    return prediction


def compared(measured: Trajectory, predicted: RecordingPrediction, bands: xr.Dataset) -> dict[str, Any] | None:
    """The prediction beside the rows that the file has after the first: root mean square distance [mm] of each marker,
    and share of the measured coordinates in the 90 % bands; None if no later row has a marker."""
    seen = measured.position_mask.copy()
    seen[0] = False
    if not seen.any():
        return None
    square = np.sum((measured.position - predicted.central) ** 2, axis=-1)
    rows = zip(predicted.marker_names, square.T, seen.T, strict=True)
    errors = {name: 1e3 * float(np.sqrt(np.mean(own[there]))) for name, own, there in rows if there.any()}
    inside = (measured.position >= bands["q05"].values) & (measured.position <= bands["q95"].values)
    return {"rms_mm": errors, "in_90_percent_bands": float(np.mean(inside[seen])), "rows": int(seen.any(axis=1).sum())}


def _slow_error(
    record: PosteriorRecord, unseen: Trajectory, groups: Patterns, scopes: Scopes
) -> dict[str, SessionError]:
    """The slow error of a recording's session, by name; empty if the fit has seen the session, or has no sessions."""
    sessions = {p.scope.owner for p in scopes.deviating}
    error = recorded_session_error(record) if sessions else None
    if error is None:
        return {}
    session = group_of(unseen.name, groups)
    if session == record.attrs.get(ADAPTED_TO):
        return {unseen.name: error}
    if not of_unseen_sessions([unseen], groups, list(sessions), record.attrs.get(OPENINGS)):
        return {}
    return {unseen.name: error._replace(shown=())}


def model_of(fit: Calibration) -> Model:
    """The model of a calibration.

    Raises:
        InputError: the files of the calibration do not describe the model, or the model has another integrator than the
        fit.
    """
    if fit.model is not None:
        integrator, where = integrator_of(fit.model.spec), f"posterior of {fit.model.name}"
        check_fitted_integrator(fit.record.attrs, fit.folder, integrator, where=where)
        return fit.model
    why = "no config.toml describes it"
    if fit.folder is not None and (fit.folder / CONFIG).is_file():
        try:
            return Model.read(fit.folder / CONFIG)
        except InputError as error:
            why = error.what
    raise InputError(
        f"the calibration has no model: {why}",
        where=str(fit.folder or "predict"),
        remedy="give the calibrated model: rb.load(folder, model=model)",
    )


def fitted_scopes(fit: Calibration) -> Scopes:
    """Inferred and fixed parameters of a calibration."""
    model, record = model_of(fit), fit.record
    fixed = fixed_values(model.spec, model.simulator)
    return Scopes.read(record.free, model_specs(model.spec, model.simulator), fixed, record.fixed)


def _known_noise(spec: ModelSpec, known: Mapping[str, Any] | None, step: float) -> tuple[Autoregression | None, Any]:
    """The noise stored in the posterior, and its markers; None for an inferred noise.

    Args:
        spec: the model; known: the noise as the posterior stores it.
        step: seconds between the rows to predict. A correlation time in [noise] replaces the stored autocorrelation.

    Raises:
        InputError: a noise that is neither inferred nor stored in the posterior.
    """
    if spec.noise not in KNOWN:
        return None, ()
    if known is None:
        raise InputError(
            "the posterior does not hold the noise of the positions",
            where="--from",
            remedy="predict with the experiment that was calibrated",
        )
    recalled = Autoregression.from_dict(known)
    lasts = spec.stated.correlation_time if spec.stated is not None and spec.noise == STATED else None
    if lasts is not None:
        recalled = replace(recalled, autocorrelation=np.array([1.0, np.exp(-step / lasts)]), step=None)
    return recalled, known["markers"]


def summarise(predicted: RecordingPrediction) -> xr.Dataset:
    """Mean and quantiles of the draws of one prediction."""
    dims = ("time", "marker", "axis")
    data: dict[str, Any] = {"mean": (dims, predicted.central)}
    quantiles = np.quantile(predicted.predicted, list(LEVELS.values()), axis=0)
    data |= {name: (dims, quantile) for name, quantile in zip(LEVELS, quantiles, strict=True)}
    coords = {"time": predicted.time, "marker": list(predicted.marker_names), "axis": list("xyz")}
    dataset = xr.Dataset(data, coords, {"schema_version": SCHEMA_VERSION, "unit": "m"})
    dataset["time"].attrs["units"] = "s"
    for name in data:
        dataset[name].attrs["units"] = "m"
    pose = predicted.object_pose
    if pose is None:
        return dataset
    centre = pose[..., :3]  # of the pushed object: mean and quantiles, beside every draw of its pose
    quantiles = np.quantile(centre, list(LEVELS.values()), axis=0)
    dataset[OBJECT] = xr.Variable(("draw", "time", "pose"), pose.astype(np.float32), {"units": POSE_UNITS})
    for name, value in (("mean", centre.mean(axis=0)), *zip(LEVELS, quantiles, strict=True)):
        dataset[f"{OBJECT}_{name}"] = xr.Variable(("time", "axis"), value, {"units": "m"})
    return dataset
