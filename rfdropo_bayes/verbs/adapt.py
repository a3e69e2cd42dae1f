"""Another day: one short recording moves what a day changes, and the body stays: ``adapt``, and ``rfdropo adapt``."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from rfdropo_bayes.bayes.calibration_problem import CalibrationProblem
from rfdropo_bayes.bayes.channels import Markers
from rfdropo_bayes.bayes.channels.markers import noise_of_markers
from rfdropo_bayes.bayes.noise import noise_specs
from rfdropo_bayes.bayes.noise.autoregression import STATED
from rfdropo_bayes.bayes.recordings import gather_recordings
from rfdropo_bayes.bayes.space import SEPARATOR, InferredParameter, ParameterSpace, deviations, spread_of
from rfdropo_bayes.bayes.trajectory_model import TrajectoryModel
from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.data import DataSpec, Trajectory, load_recordings
from rfdropo_bayes.data.sample_times import sample_time
from rfdropo_bayes.data.spec import RecordingEntry
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.groups import group_of, in_group
from rfdropo_bayes.inference.progress import Progress
from rfdropo_bayes.inference.result import InferenceResult
from rfdropo_bayes.model.assembly import pooling
from rfdropo_bayes.model.experiment import NoiseTable
from rfdropo_bayes.model.experiment_file import describe
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.run_folder import hashes, run_folder
from rfdropo_bayes.posteriors import ParameterInfo, PosteriorRecord, RecordingPrediction
from rfdropo_bayes.prediction.day import DayFit, fit_day
from rfdropo_bayes.prediction.model_error import ModelError, recorded_model_error
from rfdropo_bayes.prediction.own_fit import MOST_STEPS
from rfdropo_bayes.prediction.predictive import (
    ADAPTED_TO,
    FITTED,
    KNOWN_NOISE,
    NOISE,
    Batch,
    match_cautions,
    predict_fitted,
    predict_new,
    thin,
)
from rfdropo_bayes.report import build_summary
from rfdropo_bayes.report.run_files import CONFIG, POSTERIOR
from rfdropo_bayes.results.calibrated import Calibration
from rfdropo_bayes.tables import changed
from rfdropo_bayes.verbs.calibrate import gather_facts, with_ratios
from rfdropo_bayes.verbs.predict import fitted_parts, model_of

DRAWS = 100
MUCH_WORSE = 2.0**0.5  # from here on more than half of the squared error is not what the model left of the fitted days


def adapt(
    fit: Calibration,
    recording: Trajectory,
    *,
    seconds: float | None = None,
    group: str | None = None,
    test: Sequence[Trajectory] = (),
    draws: int = DRAWS,
    seed: int = 0,
    out: Path | str | None = None,
    overwrite: bool = False,
    show: bool | None = None,
) -> Calibration:
    """Move what a day changes to one short recording of it; the body keeps its posterior.

    What moves are the deviations of the parameters in [model.per_group], and those in [model.per_recording]. A
    parameter may be put into [model.per_group] now that was shared in the fit. The noise is what the fitted recordings
    showed the model to leave, for as long as it lasted.

    Args:
        fit: a calibration, with its model.
        recording: of the new day.
        seconds: look at this much of it only, from its beginning; all by default. The report then shows how well the
            rest is predicted.
        group: name of the day; the group of [model.groups] that the recording belongs to by default, or else its name.
        test: other recordings of the day, of which nothing but the first row is looked at; the report says how well
            they are predicted.
        draws: of the posterior.
        seed: of all that is random.
        out: folder that gets what a calibration writes; None writes nothing.
        overwrite: start anew whatever ``out`` holds.
        show: whether to show progress, see `Progress`.

    Raises:
        InputError: nothing of the model differs between days, or the fit does not say what its model leaves.
    """
    model = model_of(fit)
    head, rest = _parted(recording, seconds)
    day = group_of(recording.name, model.spec.groups) if group is None else group
    left = model_error_of(fit.record)
    moved = _adapted(model, left, recording, group)
    space = day_space(fitted_parts(fit)[1], moved, [head.name], day, fit.record.attrs[FITTED])
    own = _own_of_day(fit.record, space, recording.name, day)
    settings: dict[str, Any] = {"tables": moved.tables(), "folder": model.folder, "texts": moved.texts()}
    settings |= {"data": hashes([recording, *test]), "options": {"run": fit.folder, "seconds": seconds, "group": group}}
    tested = [*([] if rest is None else [rest]), *test]
    run = partial(_adapt, Day(fit, moved, space, own, head, tested, day, left), draws, seed, show)
    if out is None:
        return run(None, describe(moved.tables()))
    with run_folder(Path(out), "adapt", **settings, overwrite=overwrite) as folder:
        found = run(folder, (folder / CONFIG).read_text(encoding="utf-8"))
        found.save(folder)
    return found


class Day(NamedTuple):
    """A day that a calibration is adapted to.

    Attributes:
        fit: the calibration; model: that of the adapted run.
        space: parameters of the body, the day and its recordings; own: those of the day.
        head: the recording, as far as it is looked at; tested: what is predicted.
        name: of the day.
        left: what the model leaves of the recordings that were fitted.
    """

    fit: Calibration
    model: Model
    space: ParameterSpace
    own: Sequence[InferredParameter]
    head: Trajectory
    tested: Sequence[Trajectory]
    name: str
    left: ModelError


def _adapt(asked: Day, draws: int, seed: int, show: bool | None, out: Path | None, text: str) -> Calibration:
    """Fit the day and predict its recording; ``text`` is the experiment as TOML."""
    fit, model, space, own, head, tested, day, left = asked
    began = time.monotonic()
    simulator, key = model.simulator, jax.random.key(seed)
    fixed, _ = fitted_parts(fit)
    recordings = gather_recordings(simulator, [head])
    noise = noise_of_markers(left.every(sample_time(head.time)), left.markers, recordings)
    spread_key, fit_key, fitted_key, rest_key = jax.random.split(key, 4)
    posterior = fit.record.posterior
    body = thin({p.name: posterior[p.name] for p in space.parameters if p.name in posterior}, draws)
    body |= _drawn_spreads(space, body, spread_key)
    channel = Markers.gather(recordings, STATED, noise)
    program = TrajectoryModel(simulator, space, fixed, recordings, (channel,))
    evaluations: list[float] = []
    problem = CalibrationProblem(program, chunk=simulator.lanes).telling(evaluations.append)
    with Progress("adapt", show=show) as progress:
        words = {"draws": len(next(iter(body.values()))), "parameters": len(own)}
        found = fit_day(
            problem, body, own, fit_key, lambda step, share: progress.stage(max(share, step / MOST_STEPS), **words)
        )
    noise = replace(noise, scale=found.excess * noise.scale)
    problem = CalibrationProblem(replace(program, channels=(replace(channel, known=noise),)), chunk=simulator.lanes)
    predictions = predict_fitted(problem, found.values, fitted_key)
    cautions = _cautions(found)
    if tested:
        known: dict[str, Any] = {"fitted": [head.name], "left": left}
        known |= {"groups": {day: [head.name, *(run.name for run in tested)]}, "chunk": simulator.lanes}
        new = predict_new(problem.model, tested, found.values, rest_key, **known)
        predictions, cautions = predictions + new.recordings, cautions + match_cautions(new)
    result = InferenceResult(
        method="adapt",
        draws={name: column[None] for name, column in found.values.items()},
        rollouts=float(np.sum(evaluations)),
        evaluations=round(float(np.sum(evaluations))),
        cautions=cautions,
        seconds=time.monotonic() - began,
        details=_details(found, day, own),
    )
    before = {p.name: np.asarray(v) for p, v in zip(own, _prior(space, own, body, seed), strict=True)} | body
    record = _record(fit.record, problem, result, before, predictions, noise.as_dict(), day, seed)
    facts = gather_facts(
        f"{fit.content.get('title', model.name)}: {day}", seed, problem, result, [head], tested, record
    )
    return Calibration(record, build_summary(record, facts), text, model, out)


def _own_of_day(fit: PosteriorRecord, space: ParameterSpace, recording: str, day: str) -> list[InferredParameter]:
    """The parameters that are the day's.

    Raises:
        InputError: nothing is the day's.
    """
    own = [p for p in space.parameters if p.name not in fit.posterior and p.name not in space.scales]
    if not own and day in {info.name.partition(SEPARATOR)[2] for info in fit.free}:
        raise InputError(
            f"{recording} belongs to {day}, which was fitted",
            where="adapt",
            remedy="predict it as it is, or give its day a new --group",
        )
    if not own:
        raise InputError(
            "nothing of the model differs between days",
            where="[model.per_group]",
            remedy="name what does, e.g. --set model.per_group.initial_displacement=0.002, and a new --group",
        )
    return own


def run_adaptation(
    run: Path,
    model: Model,
    recording: str,
    out: Path,
    *,
    commands: str | None = None,
    seconds: float | None = None,
    group: str | None = None,
    seed: int | None = None,
    overwrite: bool = False,
    show: bool | None = None,
) -> Calibration:
    """`adapt` a run's folder to a recording in the format of its experiment; lost markers are left out.

    Args:
        run: folder of a calibration, or of an earlier adaptation.
        model: that was fitted, with the [data] of its experiment, see `fitted_model`.
        recording: file of observations; ``commands``: that of the commands, where the format has one of its own.
        out, seconds, group, seed, overwrite, show: see `adapt`.

    Raises:
        InputError: bad input.
    """
    read = model.settings
    if read.data is None:
        where = model.name if model.file is None else str(model.file.path)
        raise InputError("the experiment has no [data]", where=where, remedy="say in which format recordings are")
    entry = RecordingEntry(observations=recording, commands=commands)
    found = load_recordings(_alone(read.data, entry), model.folder)
    if len(found) > 1:
        raise InputError(f"names {len(found)} files", where=recording, remedy="adapt to one at a time")
    fit = Calibration.of_posterior(run, model)
    fit = replace(fit, model=Model.of(model.spec, replace(read, data=_alone(read.data, entry))))
    chosen = read.seed if seed is None else seed
    options: dict[str, Any] = {"seconds": seconds, "group": group, "seed": chosen, "overwrite": overwrite, "show": show}
    return adapt(fit, found[0], out=out, **options)


def fitted_model(run: Path, experiment: Path | None = None, overrides: Sequence[str] | None = None) -> Model:
    """The model of a run's folder, or of the experiment file where the folder holds a posterior alone.

    Raises:
        InputError: no file says which model.
    """
    path = run / CONFIG if experiment is None else experiment
    if not path.is_file():
        raise InputError(f"{run} holds no {CONFIG}", where="RUN", remedy="name the experiment file with --experiment")
    return Model.read(path, overrides)


def _parted(recording: Trajectory, seconds: float | None) -> tuple[Trajectory, Trajectory | None]:
    """The first seconds, and the whole recording with their measurements taken out; None where none is left.

    Raises:
        InputError: less than two rows.
    """
    if seconds is None:
        return recording, None
    last = int(np.searchsorted(recording.time - recording.time[0], seconds, side="right")) - 1
    if last < 1:
        raise InputError(f"the first {seconds:g} s hold one row", where=recording.name, remedy="give more seconds")
    if last >= len(recording.time) - 1:
        return recording, None
    mask = recording.position_mask.copy()
    mask[: last + 1] = False
    if not mask.any():
        return recording.slice_rows(0, last), None
    dataset = recording.dataset.copy()
    dataset["position_mask"] = dataset["position_mask"].copy(data=mask)
    return recording.slice_rows(0, last), Trajectory(dataset)


def model_error_of(record: PosteriorRecord) -> ModelError:
    """What the fit's model leaves: as the fit says, or as its predictions of the fitted recordings show.

    Raises:
        InputError: it holds neither.
    """
    found = recorded_model_error(record)
    if found is None:
        raise InputError(
            "the posterior does not say what its model leaves of the fitted recordings",
            where=POSTERIOR,
            remedy="calibrate again: it was written by an earlier version",
        )
    return found


def _adapted(model: Model, left: ModelError, recording: Trajectory, group: str | None) -> Model:
    """The model of the adapted run: its noise is known, and its group and its recording are named."""
    groups = model.spec.groups if group is None else in_group(recording.name, group, model.spec.groups)
    noise = NoiseTable(
        standard_deviation=float(np.sqrt(np.mean(np.square(left.scale)))), correlation_time=left.correlation_time
    )
    return Model.of(replace(model.spec, noise=STATED, stated=noise, groups=groups), model.settings)


def _alone(data: DataSpec, entry: RecordingEntry) -> DataSpec:
    """[data] with one recording to fit, whose lost markers are left out."""
    return changed(data, where="[data]", fit=[entry], test=[], missing="mask")


def day_space(
    space: ParameterSpace, model: Model, recordings: Sequence[str], day: str, fitted: Sequence[str]
) -> ParameterSpace:
    """The body's parameters, and those of the day and of its recordings, whether they have draws or not."""
    noise = {spec.name for name in ("auto", "white", "ar1", "student-t") for spec in noise_specs(name)}
    shared = [p for p in space.parameters if not p.recording and p.spec.name not in noise]
    kinds = {p.spec.name: p for p in space.parameters if p.added_to}
    added = [replace(p, recording=day, members=tuple(recordings)) for p in kinds.values()]
    spreads: list[InferredParameter] = []
    for name, pooled in pooling(model.spec, model.simulator.parameters, recordings).items():
        if any(p.added_to == name for p in added):
            continue
        spec = next((p.spec for p in shared if p.spec.name == name), None)
        if spec is None:
            raise InputError(
                f"{name} differs between groups about a value that all share, and has none",
                where="[model.per_group]",
                remedy="give it a prior, and calibrate again",
            )
        known = [p.name for p in [*shared, *spreads]]
        spreads += [p for p in spread_of(spec, pooled) if p.name not in known]
        added += deviations(spec, replace(pooled, groups={day: tuple(recordings)}))
    families: dict[str, list[InferredParameter]] = {}
    for p in space.parameters:
        if p.recording and not p.added_to:
            families.setdefault(p.spec.name, []).append(p)
    # A parameter that some fitted recordings only had free, as the payload of one of them, is theirs alone.
    every = [ps[0] for ps in families.values() if len(ps) == len(fitted)]
    own = [replace(p, recording=recordings[0], members=tuple(recordings)) for p in every]
    return ParameterSpace((*shared, *spreads, *added, *own))


def _drawn_spreads(space: ParameterSpace, body: Batch, key: jax.Array) -> Batch:
    """Draws from the prior of spreads that the fit did not have."""
    count, drawn = len(next(iter(body.values()))), {}
    for i, name in enumerate(space.scales):
        if name not in body:
            drawn[name] = np.asarray(space[name].prior.sample(jax.random.fold_in(key, i), (count,)))
    return drawn


def _prior(
    space: ParameterSpace, own: Sequence[InferredParameter], body: Mapping[str, np.ndarray], seed: int
) -> list[Any]:
    """Draws of the day's parameters from their priors."""
    drawn = space.sample(jax.random.key(seed), len(next(iter(body.values()))))
    return [drawn[p.name] for p in own]


def _details(found: DayFit, day: str, own: Sequence[InferredParameter]) -> dict[str, Any]:
    fitted = {name: getattr(found, name) for name in ("power", "excess", "steps", "unconverged")}
    return {**fitted, "day": day, "moved": [p.name for p in own]}


def _cautions(found: DayFit) -> list[Caution]:
    cautions = []
    if found.excess > MUCH_WORSE:
        sentence = (
            f"the day is fitted {found.excess:.2g} times worse than the fitted days: most of its squared error is of a "
            "kind that these did not have, and that none of the day's parameters explains; see that the recording and "
            "its commands are right, name more in [model.per_group], or calibrate with it"
        )
        cautions.append(Caution(Code.DAY_UNMATCHED, sentence))
    if found.unconverged:
        sentence = (
            f"the day's parameters did not converge in {MOST_STEPS} steps under {found.unconverged} of "
            f"{len(found.chosen)} draws of the body; these count as far as they explain the recording"
        )
        cautions.append(Caution(Code.DAY_UNMATCHED, sentence, grave=found.unconverged > len(found.chosen) // 2))
    if found.power < 1.0:
        sentence = (
            f"few of the body's draws explain the recording: their evidences were raised to the power "
            f"{found.power:.2g}, so that a tenth of the draws is left; the model lacks what this day shows"
        )
        cautions.append(Caution(Code.DAY_UNMATCHED, sentence))
    return cautions


def _record(
    fit: PosteriorRecord,
    problem: CalibrationProblem,
    result: InferenceResult,
    prior: Mapping[str, np.ndarray],
    predictions: Sequence[RecordingPrediction],
    noise: dict[str, Any],
    day: str,
    seed: int,
) -> PosteriorRecord:
    """The draws, with what predictions of further recordings need."""
    recordings = problem.model.recordings
    infos = tuple(
        ParameterInfo(p.name, p.spec.unit, p.spec.low, p.spec.high, dict(p.table or {}), p.spec.description)
        for p in problem.model.space.parameters
    )
    known = {NOISE: STATED, KNOWN_NOISE: {"markers": list(recordings.markers), **noise}}
    attributes = {**fit.attrs, **known, FITTED: list(recordings.names), ADAPTED_TO: day, "seed": seed}
    record = PosteriorRecord(infos, result.draws, dict(prior), tuple(predictions), attrs=attributes)
    return with_ratios(record, problem.names)
