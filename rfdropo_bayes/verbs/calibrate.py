"""Recordings and a model in, a posterior out: ``calibrate``."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.calibration_problem import CalibrationProblem
from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.data import Trajectory, common_beginning, noise_floor
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.groups import gather_groups
from rfdropo_bayes.inference.method_options import options_table
from rfdropo_bayes.inference.methods import make_config, method_named, method_of, run
from rfdropo_bayes.inference.modes.mode_search import LaplaceConfig
from rfdropo_bayes.inference.progress import Progress, say_step
from rfdropo_bayes.inference.result import InferenceResult
from rfdropo_bayes.mechanisms.actuation import PerChannel
from rfdropo_bayes.model.experiment import ROLLOUTS, InferenceTable
from rfdropo_bayes.model.experiment_file import describe, read_tables
from rfdropo_bayes.model.fitted_integrator import stated_integrator
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.run_folder import CHECKPOINTS, CONFIG, LOG, hashes, run_folder
from rfdropo_bayes.posteriors import (
    FIXED,
    Derived,
    DrawsByOwner,
    LessMedian,
    PosteriorRecord,
    ProductOfPowers,
    RecordingPrediction,
    by_owner,
    central_interval,
    sharper_less_median,
)
from rfdropo_bayes.prediction.model_error import MODEL_ERROR, ModelError, model_error
from rfdropo_bayes.prediction.predictive import (
    BEGUN,
    FITTED,
    KNOWN_NOISE,
    NOISE,
    predict_fitted,
    predict_new,
    predicted_after_fit,
    thin,
    with_repeats_marked,
)
from rfdropo_bayes.prediction.session_error import (
    SESSION_ERROR,
    SessionError,
    left_out_sentence,
    recorded_session_error,
)
from rfdropo_bayes.report import (
    BaselineErrors,
    RecordingFacts,
    RunFacts,
    baseline_errors,
    build_summary,
    software_versions,
)
from rfdropo_bayes.report.baselines import with_fitted_commands
from rfdropo_bayes.report.object_scores import score_objects
from rfdropo_bayes.report.residuals import ResidualCheck, check_residuals, residual_cautions
from rfdropo_bayes.report.run_files import POSTERIOR, SUMMARY
from rfdropo_bayes.report.summary import read_summary
from rfdropo_bayes.results.audited import AUDIT, Audit
from rfdropo_bayes.results.calibrated import Calibration
from rfdropo_bayes.results.load import load
from rfdropo_bayes.robots import Robot, robot_shape
from rfdropo_bayes.robots.robot import implausible_values
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator
from rfdropo_bayes.verbs.arguments import given_model
from rfdropo_bayes.verbs.budget import MOST_DRAWS, budget_within, rollout_seconds
from rfdropo_bayes.verbs.left_out_sessions import (
    OPENINGS,
    Sessions,
    error_of_unseen_sessions,
    of_unseen_sessions,
    openings_of,
)
from rfdropo_bayes.verbs.recording_doubts import cautions_of_fit, recorded_doubts, with_doubts

PRIOR_DRAWS = 2000
LEAST_POSTERIOR = 200  # draws of a posterior, if its budget is small
PRIOR_PREDICTIVE_DRAWS = 64
START_DRAWS = 1000
PAYLOAD = "payload_mass"  # which recordings may have for themselves
OPTIMISING = ("laplace", "smc")  # smc if it starts at the optima


def calibrate(
    model: Model,
    runs: Sequence[Trajectory] | None = None,
    method: Any = None,
    *,
    test: Sequence[Trajectory] | None = None,
    seed: int | None = None,
    out: Path | str | None = None,
    fit: Calibration | Audit | Path | None = None,
    resume: bool = False,
    overwrite: bool = False,
    show: bool | None = None,
) -> Calibration:
    """Fit a model to recordings. Missing arguments are taken from the model's experiment file.

    Args:
        model: simulator, inferred parameters and data channels.
        runs: recordings to fit.
        method: options of a method, such as ``SMC(rollouts=5000)``; SMC with 20000 rollouts without a file.
        test: unseen recordings; the report scores their predictions.
        seed: seed of all random numbers; 0 without a file. The same seed gives the same draws.
        out: folder for posterior.nc, summary.json, report.html and checkpoints; None writes nothing.
        fit: an earlier calibration of the same robot, or its folder, perhaps with fewer mechanisms or other recordings:
            optimisations start from its optimum and draws. Or an audit, or its folder: they start from the values of
            its extended model. Parameters and data of the fit do not change.
        resume: continue from the checkpoint of an interrupted run of the same experiment in ``out``.
        overwrite: replace an earlier run in ``out``.
        show: whether to show progress, see `Progress`.

    Raises:
        InputError: bad input, before anything long has started.
    """
    model = given_model(model, "calibrate")
    runs, test = model.runs(runs, test)
    table = model.settings.inference
    config = make_config(table.method, inference_options(table)) if method is None else method
    name, chosen = method_of(config), model.settings.seed if seed is None else seed
    problem, draws = model.problem(runs, earlier_draws(fit, name)), MOST_DRAWS
    minutes = table.minutes if method is None and table.rollouts is None else None
    if minutes is not None:
        per_set = rollout_seconds(problem, jax.random.key(chosen))
        fitted, tested = (sum(len(run.time) for run in part) for part in (runs, test))
        budget = budget_within(minutes, per_set, (fitted + tested) / fitted)
        resumed = Path(out) if resume and out is not None else None
        config, draws = _budgeted(config, budget.rollouts, resumed), budget.draws
    said = {"method": name, **options_table(config)}
    tables = model.record(
        {"title": model.title, "seed": chosen, "inference": said},
        {"seed": seed, "inference": said if minutes is not None or method is not None else None},
    )
    work = partial(_fit, Fitting(model, problem, config, runs, test, chosen, draws))
    if out is None:
        return work(None, describe(tables), resume=False, show=show)
    settings: dict[str, Any] = {"tables": tables, "folder": model.folder, "data": hashes([*runs, *test])}
    settings |= {"options": {"from": fit.folder if isinstance(fit, Calibration) else fit}, "texts": model.texts()}
    with run_folder(Path(out), "calibrate", **settings, resume=resume, overwrite=overwrite) as folder:
        calibration = work(folder, (folder / CONFIG).read_text(encoding="utf-8"), resume=resume, show=show)
        say_step("the fit is done: writing posterior.nc and summary.json, and drawing report.html", show=show)
        calibration.save(folder)
    return calibration


def _budgeted(config: Any, rollouts: int, resumed: Path | None) -> Any:
    """Options of a method with a timed number of rollouts; a resumed run keeps the number that its folder states."""
    method, options = method_of(config), options_table(config) | {"rollouts": rollouts}
    if not hasattr(config, "rollouts"):
        remedy = "leave out minutes, and give the options of the method"
        raise InputError(f"method {method!r} has no budget", where="[inference] minutes", remedy=remedy)
    if resumed is not None and (resumed / CONFIG).is_file():
        kept = read_tables(resumed / CONFIG)["inference"]
        options = {key: value for key, value in kept.items() if key != "method"}
    elif isinstance(config, LaplaceConfig):  # its draws are simulated once more
        options["draws"] = min(config.draws, max(LEAST_POSTERIOR, rollouts))
    return make_config(method, options)


class Fitting(NamedTuple):
    """Model, recordings and method of a fit; see `calibrate`."""

    model: Model
    problem: CalibrationProblem
    config: Any
    runs: Sequence[Trajectory]
    test: Sequence[Trajectory]
    seed: int
    draws: int = MOST_DRAWS  # whose predictions are kept


def _fit(asked: Fitting, out: Path | None, text: str, *, resume: bool, show: bool | None) -> Calibration:
    """Run the method; ``text`` is the experiment as TOML, ``out`` the folder for log and checkpoints."""
    model, problem, config, runs, test, seed, _ = asked
    method = method_of(config)
    key, predicting = jax.random.split(jax.random.key(seed))
    log, kept = (None, None) if out is None else (out / LOG, out / CHECKPOINTS)
    with Progress(method, show=show, log=log, budget=getattr(config, "rollouts", None)) as progress:
        problem = problem.telling(progress.spend)
        result = run(problem, method, config, key, checkpoint_dir=kept, resume=resume, progress=progress)
    problem = problem.holding(result.fixed)
    attributes = {
        "seed": seed,
        "robot": model.name,
        "data_sha256": [trajectory.sha256 for trajectory in [*runs, *test]],
        "versions": software_versions(),
        **stated_integrator(model.spec),
        BEGUN: common_beginning(runs),
    }
    record, unmatched = record_posterior(asked, problem, result, predicting, attributes, show=show)
    record = with_doubts(record, cautions_of_fit(model, [*runs, *test], record.recordings))
    facts = gather_facts(model.title, seed, problem, result, runs, test, record, unmatched)
    return Calibration(record, build_summary(record, facts), text, model, out)


def earlier_draws(fit: Calibration | Audit | Path | None, method: str) -> DrawsByOwner | None:
    """Starts of optimisations from an earlier calibration or audit, or its folder; None without it.

    The first row is its optimum, if known, which is repeated as often as there are draws: in nonlinear problems with
    many parameters a draw may fit far worse than the optimum.

    Raises:
        InputError: a folder without a posterior, or a method without optimisation.
    """
    if fit is None:
        return None
    if method not in OPTIMISING:
        raise InputError(
            f"method {method!r} does not optimise, so it needs no start",
            where="--from",
            remedy=f"leave it out, or use one of {', '.join(OPTIMISING)}",
        )
    if not isinstance(fit, (Calibration, Audit)):
        folder = Path(fit)  # a report's folder may hold an audit beside its calibration
        fit = load(folder) if (folder / AUDIT).is_file() and not (folder / POSTERIOR).is_file() else folder
    if isinstance(fit, Audit):
        if "optimum" not in fit.content:
            raise InputError("this audit has no optimum", where="--from", remedy="audit again")
        values = fit.content["optimum"].items()
        return {name: {owner: np.array([value]) for owner, value in own.items()} for name, own in values}
    if isinstance(fit, Calibration):
        record, content = fit.record, fit.content
    else:
        record = PosteriorRecord.load(Path(fit) / POSTERIOR)
        content = read_summary(Path(fit) / SUMMARY) if (Path(fit) / SUMMARY).is_file() else {}
    draws = thin({info.name: record.posterior[info.name] for info in record.free}, START_DRAWS)
    optimum = content.get("optimum") or {}
    if set(draws) <= set(optimum):
        draws = {name: np.concatenate([np.full(len(own), optimum[name]), own]) for name, own in draws.items()}
    return by_owner(record.free, draws)


def inference_options(table: InferenceTable) -> dict[str, Any]:
    """Options of the method; the budget is among them if the method takes a budget."""
    options = table.options
    fields = {field.name for field in dataclasses.fields(method_named(table.method).config)}
    return {**options, "rollouts": table.rollouts or ROLLOUTS} if "rollouts" in fields else options


def record_posterior(
    asked: Fitting,
    problem: CalibrationProblem,
    result: InferenceResult,
    key: jax.Array,
    attributes: dict[str, Any],
    *,
    show: bool | None = None,
) -> tuple[PosteriorRecord, list[Caution]]:
    """Draws, prior draws and predictions of every recording, with the parameter combinations that rollouts depend on,
    and cautions on the predictions.
    """
    model, tested = asked.model, asked.test
    prior_key, fit_key, test_key = jax.random.split(key, 3)
    say_step(f"the fit is done: predicting the fitted recordings ({len(asked.runs)})", show=show)
    rows = row_log_likelihood(problem, result)
    prior = {name: np.asarray(v) for name, v in problem.sample_prior(prior_key, PRIOR_DRAWS).items()}
    values = thin(result.draws, asked.draws)
    drawn = min(PRIOR_PREDICTIVE_DRAWS, asked.draws)
    before = {name: column[:drawn] for name, column in prior.items()}
    predictions: list[RecordingPrediction] = predict_fitted(problem, values, fit_key, prior=before)
    fitted, scopes = list(problem.model.recordings.names), problem.model.scopes
    lasting = result.details.get("lasting", {}).get(problem.model.markers.name)
    residual = model_error(predictions, 1.0 if lasting is None else np.array(lasting["widened"]))
    slow = _unseen_sessions(asked, problem, result, predictions, residual, jax.random.fold_in(key, 3), show=show)
    cautions: list[Caution] = []
    if tested:
        say_step(f"the fit is done: predicting the test recordings ({len(tested)})", show=show)
        sessions, openings = list(gather_groups(fitted, model.spec.groups)), openings_of(asked.runs)
        unseen = [] if slow is None else of_unseen_sessions(tested, model.spec.groups, sessions, openings)
        new, cautions = predicted_after_fit(
            lambda: predict_new(
                problem.model,
                tested,
                values,
                test_key,
                chunk=problem.chunk,
                fitted=fitted,
                model_error=residual,
                groups=model.spec.groups,
                slow={} if slow is None else dict.fromkeys(unseen, slow),
            )
        )
        predictions += new
    record = PosteriorRecord(
        scopes.infos,
        result.draws,
        prior,
        tuple(with_repeats_marked(predictions, [*asked.runs, *tested])),
        trace=result.trace,
        block_scores=result.block_scores,
        log_likelihood=rows,
        attrs={
            **attributes,
            NOISE: problem.model.noise,
            FITTED: fitted,
            FIXED: [{"parameter": p.info.as_dict(), "value": result.fixed[p.name]} for p in scopes.known],
            MODEL_ERROR: None if residual is None else residual._asdict(),
            SESSION_ERROR: None if slow is None else slow.as_dict(),
            OPENINGS: openings_of(asked.runs),
            **known_noise(problem),
        },
    )
    return with_determined(record, scopes.names, families_of(problem)), cautions


def _unseen_sessions(
    asked: Fitting,
    problem: CalibrationProblem,
    result: InferenceResult,
    predictions: Sequence[RecordingPrediction],
    residual: ModelError | None,
    key: jax.Array,
    *,
    show: bool | None,
) -> SessionError | None:
    """The error of a day that the fit has not seen; None for a model without days, and for draws that are no
    posterior."""
    if residual is None or not method_named(result.method).posterior:
        return None
    draws = thin(result.draws, asked.draws)
    optimum = result.optimum or {}
    if set(draws) <= set(optimum):
        draws = {name: np.full(2, optimum[name]) for name in draws}
    start = by_owner(problem.model.scopes.infos, draws)
    return error_of_unseen_sessions(Sessions(asked.model, asked.runs, start, predictions, residual), key, show=show)


def row_log_likelihood(
    problem: CalibrationProblem, result: InferenceResult
) -> Float[np.ndarray, "chain draw row"] | None:
    """Log density of each row given the rows before it, at every draw; None if the draws are no posterior.

    Draws that the method stored without row densities are simulated again, outside the budget.
    """
    if not method_named(result.method).posterior or result.log_likelihood is not None:
        return result.log_likelihood
    flat = {name: np.ravel(values) for name, values in result.draws.items()}
    rows, _ = problem.row_log_likelihood(flat, problem.n_rows)
    return rows.reshape(*next(iter(result.draws.values())).shape, -1)


def check_fit(problem: CalibrationProblem, record: PosteriorRecord, counted: bool) -> dict[str, ResidualCheck]:
    """Comparison of the residuals at the most likely draw with the noise model; empty without a likelihood."""
    if record.log_likelihood is None:
        return {}
    best = int(np.argmax(record.log_likelihood.sum(axis=-1).ravel()))
    white = problem.white_positions({name: float(record.flat(name)[best]) for name in problem.names})
    return check_residuals(list(white), problem.model.recordings.markers, counted=counted)


def families_of(problem: CalibrationProblem) -> list[list[str]]:
    """Names of the parameters of each mechanism with one size for each channel."""
    mechanisms = getattr(problem.model.simulator, "mechanisms", ())
    return [[spec.name for spec in each.parameters] for each in mechanisms if isinstance(each, PerChannel)]


def with_determined(
    record: PosteriorRecord, names: Sequence[str], families: Sequence[Sequence[str]] = ()
) -> PosteriorRecord:
    """The record with the combinations of parameters that motion determines, if not the parameters themselves.

    Length-driven cables determine ratios of stiffnesses and masses, but not their common scale: stiffness over mass,
    and each payload over both; a payload that is zero in some draw is skipped. Members of a family (gains of single
    cables) may be determined less their median, see `sharper_less_median`.
    """
    scales = [(name, unit) for name, unit in (("young_modulus", "kg/Pa"), ("trunk_mass", "-")) if name in names]
    ratios = []
    if len(scales) == 2:
        powers = {"young_modulus": 1.0, "trunk_mass": -1.0}
        words = "stiffness over mass: determined by the motion of a trunk with length-driven cables"
        ratios.append(ProductOfPowers("young_modulus_over_trunk_mass", "Pa/kg", powers, words))
    for payload in (info for info in record.free if info.name in names and info.parameter == PAYLOAD):
        for name, unit in scales:
            powers = {payload.name: 1.0, name: -1.0}
            words = f"payload over {name.replace('_', ' ')}: determined by motion, independent of the common scale"
            ratios.append(ProductOfPowers(f"{PAYLOAD}_over_{name}", unit, powers, words, payload.scope.owner))
    drawn = [draws for draws in (record.posterior, record.prior) if draws]
    found: list[Derived] = [p for p in ratios if all(np.all(draws[n] > 0.0) for draws in drawn for n in p.powers)]
    units = {info.name: info.unit for info in record.free}
    for family in families:
        own = tuple(name for name in family if name in units)
        if len({units[name] for name in own}) != 1:
            continue
        if sharper_less_median(np.stack([record.flat(name) for name in own], axis=1)) is not None:
            words = "beside the others of its family: determined, if all of them together are not"
            found += [LessMedian(f"{name}_less_median", units[name], name, own, words) for name in own]
    return record.with_derived(found)


def gather_facts(
    title: str,
    seed: int,
    problem: CalibrationProblem,
    result: InferenceResult,
    fitted: Sequence[Trajectory],
    tested: Sequence[Trajectory],
    record: PosteriorRecord,
    unmatched: Sequence[Caution] = (),
    baselines: Mapping[str, BaselineErrors] | None = None,
) -> RunFacts:
    """Contents of the report beside the posterior; ``baselines`` are those of `baseline_errors` by default. Tested
    recordings without predictions are left out."""
    unseen = [prediction for prediction in record.recordings if prediction.split == "test"]
    names = {prediction.name for prediction in unseen}
    scored = [run for run in tested if run.name in names]
    description = problem.model.simulator.description
    simulator = problem.model.simulator
    robot = simulator.robot if isinstance(simulator, RobotSimulator) else None
    added: Any = description.get("mechanisms", ())
    checks = check_fit(problem, record, problem.model.markers.name in result.details.get("lasting", {}))
    floor = noise_floor([*fitted, *scored])
    slow = recorded_session_error(record) if record.attrs.get(SESSION_ERROR) else None
    strange = recorded_doubts(record)
    if robot is not None:
        strange += robot.unstated(run.name for run in (*fitted, *scored))
        strange += implausible_fit(robot, problem.model.scopes.fixed, record)
    return RunFacts(
        title=title,
        robot=str(description["robot"]),
        method=result.method,
        engine=f"{description['engine']} {description['precision']}",
        status="done",
        seed=seed,
        rollouts=float(result.rollouts),
        seconds=result.seconds,
        evaluations=result.evaluations,
        log_evidence=result.log_evidence,
        excluded=result.excluded,
        cautions=[*strange, *result.cautions, *unmatched, *residual_cautions(checks, problem.model.noise)],
        residuals=checks,
        recordings=[
            *(RecordingFacts.of_trajectory(t, "fit") for t in fitted),
            *(RecordingFacts.of_trajectory(t, "test") for t in scored),
        ],
        model={
            "noise": problem.model.noise,
            "mechanisms": ", ".join(added) or "none",
            "fixed": ", ".join(f"{k} = {v:g}" for k, v in problem.model.scopes.fixed.items())
            or "nothing beyond the nominal values",
            **{key: str(value) for key, value in description.items() if key not in ("mechanisms", "robot")},
        },
        baselines=baselines or baseline_errors(fitted, scored, markers=problem.model.simulator.marker_names),
        fitted_commands=with_fitted_commands(fitted, scored),
        noise_floor=floor,
        phi=result.phi,
        optimum=result.optimum,
        objects=score_objects(unseen, [*fitted, *scored]),
        versions=software_versions(),
        unseen_sessions={} if slow is None else {**slow.as_dict(), "sentence": left_out_sentence(slow)},
        details=result.details,
        outline=None if robot is None else robot_shape(robot),
    )


def implausible_fit(robot: Robot, fixed: Mapping[str, float], record: PosteriorRecord) -> list[Caution]:
    """A caution if 90 % of the draws, or a fixed value, are an implausible mass or stiffness."""
    drawn = {info.parameter: central_interval(record.flat(info.name)) for info in record.free}
    sentence = implausible_values(robot, {**{name: (value, value) for name, value in fixed.items()}, **drawn})
    return [] if sentence is None else [Caution(Code.IMPLAUSIBLE, sentence)]


def known_noise(problem: CalibrationProblem) -> dict[str, Any]:
    """The noise of the positions as an attribute of the posterior, if it is not a parameter."""
    known, markers = problem.model.markers.known, problem.model.recordings.markers
    return {} if known is None else {KNOWN_NOISE: {"markers": list(markers), **known.as_dict()}}
