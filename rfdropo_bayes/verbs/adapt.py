"""Adaptation to another session by one short recording, with a fixed body: ``adapt``, and ``rfdropo adapt``."""

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
from rfdropo_bayes.bayes.inferred_parameter import InferredParameter
from rfdropo_bayes.bayes.noise import noise_specs
from rfdropo_bayes.bayes.noise.autoregression import STATED
from rfdropo_bayes.bayes.scopes import Scopes
from rfdropo_bayes.bayes.trajectory_model import TrajectoryModel
from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.data import RecordingEntry, Trajectory, load_recordings, one_at_a_time
from rfdropo_bayes.data.given_recordings import given_recording, given_recordings
from rfdropo_bayes.data.sample_times import sample_time
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.groups import gather_groups, group_of, in_group, whole
from rfdropo_bayes.inference.progress import Progress, say_step
from rfdropo_bayes.inference.result import InferenceResult
from rfdropo_bayes.model.assembly import pooling
from rfdropo_bayes.model.experiment import NoiseTable
from rfdropo_bayes.model.experiment_file import describe
from rfdropo_bayes.model.fitted_integrator import stated_integrator
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.run_folder import hashes, run_folder
from rfdropo_bayes.posteriors import PosteriorRecord, RecordingPrediction
from rfdropo_bayes.prediction.model_error import ADAPTED_TO, ModelError, recorded_model_error
from rfdropo_bayes.prediction.own_fit import MOST_STEPS
from rfdropo_bayes.prediction.predictive import (
    FITTED,
    KNOWN_NOISE,
    NOISE,
    Batch,
    predict_fitted,
    predict_new,
    predicted_after_fit,
    thin,
    with_repeats_marked,
    without_cautions,
)
from rfdropo_bayes.prediction.session_error import SESSION_ERROR, SessionError, reach_of, recorded_session_error
from rfdropo_bayes.prediction.session_fit import SessionFit, fit_session
from rfdropo_bayes.report import BaselineErrors, build_summary
from rfdropo_bayes.report.baselines import session_baselines
from rfdropo_bayes.report.coverage import predictive_bands
from rfdropo_bayes.report.run_files import CONFIG, POSTERIOR
from rfdropo_bayes.report.scores import MeasuredPath
from rfdropo_bayes.results.calibrated import Calibration
from rfdropo_bayes.tables import changed
from rfdropo_bayes.verbs.arguments import given_fit
from rfdropo_bayes.verbs.calibrate import families_of, gather_facts, with_determined
from rfdropo_bayes.verbs.left_out_sessions import OPENINGS
from rfdropo_bayes.verbs.predict import fitted_scopes, model_of
from rfdropo_bayes.verbs.recording_doubts import cautions_after, with_doubts

DRAWS = 100
MUCH_WORSE = 2.0**0.5  # above this, more than half of the squared error exceeds the residuals of the fitted sessions


def adapt(
    fit: Calibration,
    recording: Trajectory | RecordingEntry,
    *,
    seconds: float | None = None,
    group: str | None = None,
    test: Sequence[Trajectory] = (),
    draws: int = DRAWS,
    seed: int | None = None,
    out: Path | str | None = None,
    overwrite: bool = False,
    show: bool | None = None,
) -> Calibration:
    """Fit the parameters of a new session to one short recording; the body keeps its posterior.

    The fitted parameters are deviations of [model.per_group] and parameters of [model.per_recording]. A parameter that
    was shared in the fit may be added to [model.per_group]. The noise has the size and the correlation time of the
    residuals of the fitted recordings.

    Args:
        fit: a calibration, with its model.
        recording: a recording of the new session, or its entry in [data].
        seconds: length of the beginning that is used; all by default. The report then shows the prediction of the rest.
        group: name of the session; by default the recording's group in [model.groups], or else its name.
        test: other recordings of the session, of which only the first row is used; the report scores their predictions.
        draws: number of posterior draws.
        seed: seed of all random numbers; by default from the model's experiment.
        out: folder for the files of a calibration; None writes nothing.
        overwrite: replace an earlier run in ``out``.
        show: whether to show progress, see `Progress`.

    Raises:
        InputError: no parameter varies between sessions, or the fit has no residuals.
    """
    fit = given_fit(fit, "adapt")
    if isinstance(recording, RecordingEntry):
        fit, recording = _recorded(fit, recording)
    model = model_of(fit)
    recording, test = given_recording(recording, "adapt"), given_recordings(test, "adapt, test")
    head, rest = _parted(recording, seconds)
    session = group_of(recording.name, model.spec.groups) if group is None else group
    model_error = model_error_of(fit.record)
    moved = _adapted(model, model_error, recording, group)
    say_step(f"adapting to {session}: {len(head.time)} rows of {recording.name}", show=show)
    scopes = session_scopes(fit, moved, [head.name], session)
    own = _own_of_session(fit.record, scopes, recording.name, session)
    settings: dict[str, Any] = {"tables": moved.tables(), "folder": model.folder, "texts": moved.texts()}
    settings |= {"data": hashes([recording, *test]), "options": {"run": fit.folder, "seconds": seconds, "group": group}}
    tested = [*([] if rest is None else [rest]), *test]
    asked = SessionTask(fit, moved, scopes, own, head, tested, "" if rest is None else rest.name, session, model_error)
    run = partial(_adapt, asked, draws, model.settings.seed if seed is None else seed, show)
    if out is None:
        return run(None, describe(moved.tables()))
    with run_folder(Path(out), "adapt", **settings, overwrite=overwrite) as folder:
        adaptation = run(folder, (folder / CONFIG).read_text(encoding="utf-8"))
        say_step("the session is done: writing posterior.nc and summary.json, and drawing report.html", show=show)
        adaptation.save(folder)
    return adaptation


class SessionTask(NamedTuple):
    """A session to which a calibration is adapted."""

    fit: Calibration  # the calibration
    model: Model  # model of the adapted run
    scopes: Scopes  # parameters of the body, the session and its recordings
    own: Sequence[InferredParameter]  # parameters of the session
    head: Trajectory  # the used part of the recording
    tested: Sequence[Trajectory]  # predicted recordings
    rest: str  # name of the unused part of the recording among ``tested``; empty without it
    name: str  # name of the session
    model_error: ModelError  # residuals of the model on the fitted recordings


def _adapt(asked: SessionTask, draws: int, seed: int, show: bool | None, out: Path | None, text: str) -> Calibration:
    """Fit the session and predict its recording; ``text`` is the experiment as TOML."""
    began, key = time.monotonic(), jax.random.key(seed)
    before_key, fit_key = jax.random.split(key)
    if asked.tested:
        say_step(f"predicting from first rows alone, to compare: {_named(asked.tested)}", show=show)
    before = _from_first_rows(asked, draws, before_key)
    adapted = _fitted(asked, draws, fit_key, show)
    checks = _checks(before, adapted.predictions)
    known = gather_groups(asked.fit.record.attrs[FITTED], model_of(asked.fit).spec.groups)
    cautions = without_cautions(fitted_scopes(asked.fit), [asked.name], known)
    check = checks.get(asked.rest)
    if check and check["adapted"]["error_mm"] > check["from_first_row"]["error_mm"]:
        cautions.append(_kept_caution(check))
        say_step("the rest of the recording is predicted worse: fitting the session to the first row alone", show=show)
        adapted = _fitted(asked._replace(head=_first_row(asked.head)), draws, fit_key, show)
        checks = _checks(before, adapted.predictions)
    fit = adapted.fit
    result = InferenceResult(
        method="adapt",
        draws={name: column[None] for name, column in fit.values.items()},
        rollouts=adapted.rollouts,
        evaluations=round(adapted.rollouts),
        cautions=[*adapted.cautions, *cautions],
        seconds=time.monotonic() - began,
        details={**_details(fit, asked.name, asked.own), "checks": checks, "compared": check_sentences(checks)},
    )
    prior = _prior(asked.scopes, asked.own, adapted.body, seed)
    record = _record(
        asked, adapted, result, {p.name: d for p, d in zip(asked.own, prior, strict=True)} | adapted.body, seed
    )
    facts = gather_facts(
        f"{asked.fit.content.get('title', asked.model.name)}: {asked.name}",
        seed,
        adapted.problem,
        result,
        [asked.head],
        asked.tested,
        record,
        baselines=_without_a_model(asked),
    )
    return Calibration(record, build_summary(record, facts), text, asked.model, out)


def _without_a_model(asked: SessionTask) -> dict[str, BaselineErrors]:
    """Errors of predictions from the first row and from copies of the fitted recordings."""
    record = asked.fit.record
    earlier = [MeasuredPath.of_prediction(each) for each in record.recordings if each.split == "fit"]
    return session_baselines(asked.head, asked.tested, earlier, record.attrs.get(OPENINGS, {}))


class Adapted(NamedTuple):
    """A fitted session."""

    fit: SessionFit  # draws of body and session
    body: Batch  # earlier draws of the body
    problem: CalibrationProblem  # problem of the recording, with the fitted noise
    predictions: list[RecordingPrediction]  # predictions of the recording and of the unused data
    cautions: list[Caution]  # reasons to doubt them
    rollouts: float  # number of rollouts
    slow: SessionError | None  # remaining error of the session for motion beyond the used recording


def _fitted(asked: SessionTask, draws: int, key: jax.Array, show: bool | None) -> Adapted:
    """Fit the session to the used part of the recording, and predict the rest."""
    fit, _, scopes, own, head, _, _, session, model_error = asked
    simulator = asked.model.simulator
    spread_key, fit_key, fitted_key, rest_key = jax.random.split(key, 4)
    posterior = fit.record.posterior
    body = thin({name: posterior[name] for name in scopes.names if name in posterior}, draws)
    body |= _drawn_spreads(scopes, body, spread_key)
    noise = model_error.lasting(sample_time(head.time), len(head.time))
    program = TrajectoryModel.of_positions(simulator, scopes, [head], STATED, noise, model_error.markers)
    evaluations: list[float] = []
    problem = CalibrationProblem(program, chunk=simulator.lanes).telling(evaluations.append)
    with Progress("adapt", show=show) as progress:
        words = {"draws": len(next(iter(body.values()))), "parameters": len(own)}
        fitted = fit_session(
            problem,
            body,
            own,
            fit_key,
            lambda step, done: progress.stage(max(done, step / MOST_STEPS), **words),
            share=model_error.share,
        )
    noise = replace(noise, scale=fitted.excess * noise.scale)
    program = TrajectoryModel.of_positions(simulator, scopes, [head], STATED, noise, model_error.markers)
    problem = CalibrationProblem(program, chunk=simulator.lanes)
    say_step(f"the session is fitted: predicting {_named([head, *asked.tested])}", show=show)
    predictions = predict_fitted(problem, fitted.values, fitted_key)
    cautions = _cautions(fitted)
    slow = _error_beyond(fit.record, predictions[0])
    if asked.tested:
        names = [run.name for run in asked.tested]
        new, more = predicted_after_fit(
            lambda: predict_new(
                problem.model,
                asked.tested,
                fitted.values,
                rest_key,
                chunk=simulator.lanes,
                fitted=[head.name],
                model_error=model_error,
                groups={session: [head.name, *names]},
                slow=None if slow is None else dict.fromkeys(names, slow),
            )
        )
        predictions, cautions = predictions + new, cautions + more
    return Adapted(fitted, body, problem, predictions, cautions, float(np.sum(evaluations)), slow)


def _named(recordings: Sequence[Trajectory]) -> str:
    """Unique names; both parts of a divided recording have the same name."""
    return ", ".join(dict.fromkeys(whole(recording.name) for recording in recordings))


def _error_beyond(record: PosteriorRecord, shown: RecordingPrediction) -> SessionError | None:
    """The slow error of the session, for markers that move farther than in the used recording."""
    slow = recorded_session_error(record)
    if slow is None:
        return None
    far = dict(zip(shown.marker_names, reach_of(shown.central)[-1].tolist(), strict=True))
    return slow._replace(shown=tuple(far.get(name, 0.0) for name in slow.markers))


def _from_first_rows(asked: SessionTask, draws: int, key: jax.Array) -> list[RecordingPrediction]:
    """Predictions of the tested recordings by the original fit, from their commands and first rows alone."""
    record, model, names = asked.fit.record, model_of(asked.fit), [run.name for run in asked.tested]
    if not names:
        return []
    rest = [run if run.position_mask[0].any() else _with_first_row(run, asked.head) for run in asked.tested]
    simulator, noise = asked.model.simulator, asked.model_error.every(sample_time(rest[0].time))
    slow = recorded_session_error(record)
    values = thin({info.name: record.posterior[info.name] for info in record.free}, draws)
    return predict_new(
        TrajectoryModel.of_positions(
            simulator, fitted_scopes(asked.fit), rest, STATED, noise, asked.model_error.markers
        ),
        rest,
        values,
        key,
        chunk=model.simulator.lanes,
        fitted=record.attrs[FITTED],
        model_error=asked.model_error,
        groups={asked.name: names},
        slow=None if slow is None else dict.fromkeys(names, slow._replace(shown=())),
    ).recordings


def _first_row(head: Trajectory) -> Trajectory:
    """Two rows, the fewest that a recording has, of which only the measured first row counts."""
    rows = head.slice_rows(0, 1).with_attributes(name=head.name)
    mask = rows.position_mask.copy()
    mask[1] &= not mask[0].any()
    return _masked(rows, mask)


def _with_first_row(rest: Trajectory, head: Trajectory) -> Trajectory:
    """The unused part of a recording with the first row of the used part."""
    mask = rest.position_mask.copy()
    mask[0] = head.position_mask[0]
    return _masked(rest, mask)


def _masked(recording: Trajectory, mask: np.ndarray) -> Trajectory:
    dataset = recording.dataset.copy()
    dataset["position_mask"] = dataset["position_mask"].copy(data=mask)
    return Trajectory(dataset)


def _own_of_session(fit: PosteriorRecord, scopes: Scopes, recording: str, session: str) -> list[InferredParameter]:
    """The parameters that are the session's.

    Raises:
        InputError: nothing is the session's.
    """
    own = [p for p in scopes.parameters if p.name not in fit.posterior and p.name not in scopes.scales]
    if not own and session in {info.scope.owner for info in fit.free}:
        raise InputError(
            f"{recording} belongs to {session}, which was fitted",
            where="adapt",
            remedy="predict it as it is, or give its session a new --group",
        )
    if not own:
        raise InputError(
            "no parameter of the model differs between sessions",
            where="[model.per_group]",
            remedy=(
                "name the parameters that do, e.g. --set model.per_group.initial_displacement=0.002, and a new --group"
            ),
        )
    return own


def _recorded(fit: Calibration, entry: RecordingEntry) -> tuple[Calibration, Trajectory]:
    """The recording of a file in the format of the fit's experiment, without lost markers, and the fit with it as data.

    Raises:
        InputError: an experiment without [data], or several recordings.
    """
    model = model_of(fit)
    read = model.settings
    if read.data is None:
        where = model.name if model.file is None else str(model.file.path)
        raise InputError("the experiment has no [data]", where=where, remedy="name the format of the recordings")
    data = changed(read.data, where="[data]", fit=[entry], test=[], missing="mask")
    recordings = load_recordings(data, model.folder)
    if len(recordings) > 1:
        raise one_at_a_time(read.data, entry.observations, len(recordings), "adapt to")
    return replace(fit, model=Model.of(model.spec, replace(read, data=data))), recordings[0]


def fitted_model(run: Path, overrides: Sequence[str] | None = None) -> Model:
    """The model of a run's folder.

    Raises:
        InputError: no file describes the model.
    """
    if not (run / CONFIG).is_file():
        raise InputError(f"holds no {CONFIG}", where=str(run), remedy="name the folder of a calibration")
    return Model.read(run / CONFIG, overrides)


def _parted(recording: Trajectory, seconds: float | None) -> tuple[Trajectory, Trajectory | None]:
    """The first seconds, and the whole recording without their measurements; None if nothing is left.

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
    """Residuals of the fit's model, from its file or from its predictions of the fitted recordings.

    Raises:
        InputError: it holds neither.
    """
    model_error = recorded_model_error(record)
    if model_error is None:
        raise InputError(
            "the posterior has no residuals of the fitted recordings",
            where=POSTERIOR,
            remedy="calibrate again: it was written by an earlier version",
        )
    return model_error


def _adapted(model: Model, model_error: ModelError, recording: Trajectory, group: str | None) -> Model:
    """The model of the adapted run, with known noise, and with the names of its group and recording."""
    groups = model.spec.groups if group is None else in_group(recording.name, group, model.spec.groups)
    noise = NoiseTable(
        standard_deviation=float(np.sqrt(np.mean(np.square(model_error.scale)))),
        correlation_time=model_error.correlation_time,
    )
    return Model.of(replace(model.spec, noise=STATED, stated=noise, groups=groups), model.settings)


def session_scopes(fit: Calibration, model: Model, recordings: Sequence[str], session: str) -> Scopes:
    """The body's parameters without the noise of the fit, and the parameters of a session, with or without draws."""
    noise = {spec.name for name in ("auto", "white", "ar1", "student-t") for spec in noise_specs(name)}
    pooled = pooling(model.spec, model.simulator.parameters, recordings)
    scopes = fitted_scopes(fit).of_session(session, recordings, fit.record.attrs[FITTED], pooled)
    return replace(scopes, parameters=tuple(p for p in scopes.parameters if p.spec.name not in noise))


def _drawn_spreads(scopes: Scopes, body: Batch, key: jax.Array) -> Batch:
    """Draws from the prior of spreads that the fit did not have."""
    count, drawn = len(next(iter(body.values()))), {}
    for i, name in enumerate(scopes.scales):
        if name not in body:
            drawn[name] = np.asarray(scopes[name].prior.sample(jax.random.fold_in(key, i), (count,)))
    return drawn


def _prior(scopes: Scopes, own: Sequence[InferredParameter], body: Mapping[str, np.ndarray], seed: int) -> list[Any]:
    """Draws of the session's parameters from their priors."""
    drawn = scopes.sample(jax.random.key(seed), len(next(iter(body.values()))))
    return [drawn[p.name] for p in own]


def _details(fit: SessionFit, session: str, own: Sequence[InferredParameter]) -> dict[str, Any]:
    fitted = {name: getattr(fit, name) for name in ("power", "excess", "steps", "unconverged")}
    return {**fitted, "session": session, "moved": [p.name for p in own]}


def _cautions(fit: SessionFit) -> list[Caution]:
    cautions = []
    if fit.excess > MUCH_WORSE:
        sentence = (
            f"the session is fitted {fit.excess:.2g} times worse than the fitted sessions, and no parameter of the "
            "session explains most of its squared error; check the recording and its commands, name more parameters in "
            "[model.per_group], or calibrate with the recording"
        )
        cautions.append(Caution(Code.SESSION_UNMATCHED, sentence))
    if fit.unconverged:
        sentence = (
            f"the session's parameters did not converge in {MOST_STEPS} steps under {fit.unconverged} of "
            f"{len(fit.chosen)} draws of the body; these count as far as they explain the recording"
        )
        cautions.append(Caution(Code.SESSION_UNMATCHED, sentence, grave=fit.unconverged > len(fit.chosen) // 2))
    if fit.power < 1.0:
        sentence = (
            "few of the body's draws explain the recording: their evidences were raised to the power "
            f"{fit.power:.2g}, so that a tenth of the draws is left; the model lacks an effect of this "
            "session"
        )
        cautions.append(Caution(Code.SESSION_UNMATCHED, sentence))
    return cautions


def _record(
    asked: SessionTask, adapted: Adapted, result: InferenceResult, prior: Mapping[str, np.ndarray], seed: int
) -> PosteriorRecord:
    """The draws, with the data needed to predict further recordings."""
    problem, attrs = adapted.problem, asked.fit.record.attrs
    recordings, noise = problem.model.recordings, problem.model.markers.known
    elsewhere, drawn = _of_other_groups(asked, len(adapted.fit.chosen))
    infos = (*problem.model.scopes.infos, *(p.info for p in elsewhere))
    draws = result.draws | {name: column[adapted.fit.chosen][None] for name, column in drawn.items()}
    known: dict[str, Any] = (
        {NOISE: STATED, KNOWN_NOISE: {"markers": list(recordings.markers), **noise.as_dict()}} if noise else {}
    )
    known |= {SESSION_ERROR: None if adapted.slow is None else adapted.slow.as_dict()}
    known |= stated_integrator(asked.model.spec)
    attributes = {**attrs, **known, FITTED: list(recordings.names), ADAPTED_TO: asked.name, "seed": seed}
    predictions = with_repeats_marked(adapted.predictions, [asked.head, *asked.tested])
    record = PosteriorRecord(infos, draws, {**prior, **drawn}, tuple(predictions), attrs=attributes)
    doubts = cautions_after(asked.fit.record, asked.model, [asked.head, *asked.tested])
    return with_doubts(with_determined(record, problem.names, families_of(problem)), doubts)


def _of_other_groups(asked: SessionTask, draws: int) -> tuple[list[InferredParameter], Batch]:
    """Parameters of other groups and recordings, and their values under each draw of the body. With them the folder of
    a session also predicts recordings of other sessions.
    """
    known = asked.scopes.names
    others = [p for p in fitted_scopes(asked.fit).parameters if p.scope.owner and p.name not in known]
    return others, thin({p.name: asked.fit.record.posterior[p.name] for p in others}, draws) if others else {}


def _checks(
    before: Sequence[RecordingPrediction], after: Sequence[RecordingPrediction]
) -> dict[str, dict[str, dict[str, float]]]:
    """Prediction errors of unused recordings before and after the adaptation, by recording."""
    adapted = {p.name: p for p in after if p.split == "test" and p.mask[:, -1].any()}
    return {
        p.name: {
            "from_first_row": _outcome(replace(p, mask=adapted[p.name].mask)),
            "adapted": _outcome(adapted[p.name]),
        }
        for p in before
        if p.name in adapted
    }


def _outcome(prediction: RecordingPrediction) -> dict[str, float]:
    """Error of the last marker [mm], and shares of the measured coordinates in the 90 % bands."""
    bands, mask = predictive_bands(prediction.predicted), prediction.mask
    inside = (prediction.observed >= bands.low90) & (prediction.observed <= bands.high90)
    tip = (prediction.central - prediction.observed)[mask[:, -1], -1]
    return {
        "error_mm": 1e3 * float(np.sqrt(np.mean(np.sum(tip**2, axis=-1)))),
        "held": float(inside[mask].mean()),
        "tip_held": float(inside[mask[:, -1], -1].mean()),
    }


def check_sentences(checks: Mapping[str, Mapping[str, Mapping[str, float]]]) -> list[str]:
    """Sentence on each unused recording: its prediction error before and after the adaptation."""
    sentences = []
    for name, check in checks.items():
        words = [
            f"{row['error_mm']:.3g} mm off, its 90 % bands held {100.0 * row['held']:.0f} %" for row in check.values()
        ]
        sentences.append(f"{name}, as far as it was not shown: from the first row {words[0]}; adapted {words[1]}.")
    return sentences


def _kept_caution(check: Mapping[str, Mapping[str, float]]) -> Caution:
    before, after = check["from_first_row"]["error_mm"], check["adapted"]["error_mm"]
    sentence = (
        f"the session's data worsen the prediction of the rest of the recording: {after:.3g} mm, but "
        f"{before:.3g} mm from the first row alone; the result therefore uses the first row alone, a "
        "choice made on the rest"
    )
    return Caution(Code.SESSION_UNMATCHED, sentence)
