"""Policies on the simulator of an experiment: ``train``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import write_json, write_text
from rfdropo_bayes.inference.progress import say_step
from rfdropo_bayes.model.fitted_integrator import INTEGRATOR
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.run_folder import command_of, run_folder
from rfdropo_bayes.policies.episodes import Episodes
from rfdropo_bayes.policies.evaluation import tension_sentence, without_end
from rfdropo_bayes.policies.onnx_export import ExportedPolicy, export_policy, latency
from rfdropo_bayes.policies.parity import difference, observations
from rfdropo_bayes.policies.policy_figures import curve_figure
from rfdropo_bayes.policies.policy_page import EPISODES, play_policy, render_policy
from rfdropo_bayes.policies.randomisation import Present, Randomisation
from rfdropo_bayes.policies.training import Trained
from rfdropo_bayes.policies.training import train as learn
from rfdropo_bayes.policies.training_config import TrainingOptions, TrainingTable
from rfdropo_bayes.policies.vec_env import TrunkVecEnv
from rfdropo_bayes.report import software_versions
from rfdropo_bayes.report.facts import LEARNING
from rfdropo_bayes.report.run_files import CONFIG
from rfdropo_bayes.results.calibrated import Calibration
from rfdropo_bayes.robots.policy_layout import (
    EVALUATED_EPISODES,
    PEAK_TENSION,
    STOPPED_EPISODES,
    TENSION_LIMIT,
    PolicyLayout,
)
from rfdropo_bayes.signatures import stated
from rfdropo_bayes.verbs.make_vec import (
    episode_settings,
    randomisation_of,
    source_of,
    steps_of,
    training_of,
    with_training,
)
from rfdropo_bayes.verbs.unsafe_posterior import posterior_caution

POLICY, CARD, SUMMARY, CURVE, PAGE = "policy.onnx", "card.md", "summary.json", "curve.png", "report.html"
SCHEMA_VERSION = 1
PLAYED = 64  # lanes in which the policy that is kept is played


def train(
    model: Model,
    out: Path | str,
    options: TrainingOptions | None = None,
    *,
    fit: Calibration | Path | None = None,
    seed: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
    show: bool | None = None,
    page: bool = True,
) -> dict[str, Any]:
    """Train a policy on a model, and export it.

    Args:
        model: simulated model; its fixed values hold.
        out: folder to write to: report.html, policy.onnx, card.md, summary.json, curve.png, episodes.jsonl,
            TensorBoard's files and checkpoints.
        options: keys of [training] that override the model's own file.
        fit: a calibration, or its folder, whose posterior provides the episodes' parameters.
        seed: seed of all random numbers; by default from the model's experiment.
        resume: continue from the checkpoint of an interrupted run in ``out``; overwrite: replace an earlier run.
        show: progress on the terminal, as in `calibrate`.
        page: whether to play the policy and draw report.html, which takes 20 s of processor time.

    Returns:
        the content of summary.json.

    Raises:
        InputError: bad input, before anything long has started.
    """
    if resume and command_of(Path(out)) is None:
        raise InputError("holds no run to go on with", where=str(out), remedy="correct --out, or leave out --resume")
    model = with_training(model, stated(options, TrainingOptions))
    tables = model.record({"seed": model.settings.seed}, {"seed": seed})
    seed = model.settings.seed if seed is None else seed
    table, task, simulator = training_of(model)
    randomisation = randomisation_of(table, model.spec, simulator, fit)
    cautions = _cautions(table, fit, model.folder, randomisation, show)
    settings = episode_settings(table)
    known = {"randomisation": randomisation.sha256, "simulator": simulator.description["content_sha256"]}

    def environments(lanes: int) -> TrunkVecEnv:
        return TrunkVecEnv(Episodes(simulator, task, lanes, randomisation, settings))

    record: dict[str, Any] = {"tables": tables, "folder": model.folder, "data": known, "texts": model.texts()}
    with run_folder(Path(out), "train", **record, resume=resume, overwrite=overwrite) as out:
        training = learn(
            environments, table, out, seed=seed, gamma=task.gamma, resume=resume, fingerprint=known, show=show
        )
        say_step("the training is done: exporting the policy", show=show)
        layout = training.model.get_env().get_attr("layout")[0]
        facts = {
            "rfdropo_version": software_versions()["rfdropo_bayes"],
            "randomisation": randomisation.kind,
            "posterior_sha256": randomisation.sha256,
            "simulator_sha256": str(known["simulator"]),
            INTEGRATOR: steps_of(simulator),
            "time_step_s": f"{simulator.time_step:g}",
            "seed": str(seed),
        }
        if "tension_largest" in training.best:
            facts |= _tension_facts(training.best, table)
        policy = ExportedPolicy(export_policy(training.model, training.normalisation, layout, out / POLICY, facts))
        _check_parity(policy, training)
        summary = _summary(table, training, policy, facts)
        summary["cautions"] = [caution.as_dict() for caution in cautions]
        curve_figure(training.curve).savefig(out / CURVE, dpi=150)
        write_text(out / CARD, policy_card(summary, layout))
        if page:
            say_step(f"playing the policy in {EPISODES} episodes, and filming the median and the worst", show=show)
            played = play_policy(policy, Episodes(simulator, task, PLAYED, randomisation, settings), seed)
            say_step("drawing report.html", show=show)
            text = (out / CONFIG).read_text(encoding="utf-8")
            write_text(out / PAGE, render_policy(summary, played, str(tables.get("title", task.name)), text))
        write_json(out / SUMMARY, summary, finite=True)
    return summary


def _cautions(
    table: TrainingTable, fit: Calibration | Path | None, folder: Path, randomisation: Randomisation, show: bool | None
) -> list[Caution]:
    """Cautions of earlier results on the posterior or phi of the parameters, and on values that no policy can meet;
    also printed on stderr.
    """
    source = fit
    if source is None and table.source is not None and table.randomisation in ("posterior", "phi"):
        source = source_of(table.source, folder)
    caution = None if source is None else posterior_caution(source, table.width)
    found = [] if caution is None else [caution]
    if isinstance(randomisation, Present):
        shares = {name: randomisation.share_changed(name) for name in randomisation.early}
        found += [
            Caution(
                Code.RECORDINGS_ONLY,
                f"{name} is below 0 s in {100.0 * share:.0f} % of the draws: time stamps of the recordings, which "
                "would show a policy the future; these draws have 0 s in training",
            )
            for name, share in shares.items()
            if share > 0.0
        ]
    for each in found:
        say_step(f"warning: {each.sentence}", show=show)
    return found


def _tension_facts(best: Mapping[str, float], table: TrainingTable) -> dict[str, str]:
    """Tensions in the evaluation of the policy, as metadata for a deployment."""
    limit = {} if table.tension_limit is None else {TENSION_LIMIT: f"{table.tension_limit:g}"}
    counts = {STOPPED_EPISODES: best["tension_stopped"], EVALUATED_EPISODES: table.evaluation_episodes}
    return {PEAK_TENSION: f"{best['tension_largest']:g}"} | limit | {name: f"{n:.0f}" for name, n in counts.items()}


def _check_parity(policy: ExportedPolicy, trained: Trained) -> None:
    """Raise if the exported policy acts differently from the trained policy on possible observations."""
    apart = difference(policy, trained.act, observations(trained.normalisation, policy.layout.size))
    if apart is not None:
        raise InputError(
            f"the exported policy acts otherwise than the trained one: {apart}",
            where=POLICY,
            remedy="report this as an error",
        )


def _summary(
    table: TrainingTable, training: Trained, policy: ExportedPolicy, facts: Mapping[str, str]
) -> dict[str, Any]:
    return {
        "task": table.task,
        "algorithm": "PPO",
        "steps": training.curve[-1]["steps"],
        "seconds": training.seconds,
        "diverged_episodes": training.diverged,
        "redrawn_parameters": training.redrawn,
        "evaluation": _plain({key: value for key, value in training.best.items() if key != "seconds"}),
        "curve": [_plain(row) for row in training.curve],
        "latency": latency(policy),
        "layout_sha256": policy.layout.sha256,
        "settings": table.model_dump(mode="json"),
        **facts,
        "versions": software_versions(LEARNING),
        "status": "done",
        "schema_version": SCHEMA_VERSION,
    }


def _plain(row: Mapping[str, float]) -> dict[str, float | None]:
    """A row of the curve for JSON: values that are not finite become None."""
    return {name: value if np.isfinite(value) else None for name, value in row.items()}


def training_sentence(summary: Mapping[str, Any]) -> str:
    """Evaluation of the kept policy, in one or two sentences."""
    best = summary["evaluation"]
    half, most = (best[f"distance_{name}"] for name in ("median", "q95"))
    counts = without_end(best.get("tension_stopped", 0), best.get("failed", 0))
    if half is None:
        words = f"fewer than half of the episodes reach an end: {counts}."
    elif most is None:
        ended = f"half of the episodes end within {1e3 * half:.2f} mm of the goal"
        words = f"{ended}; fewer than 95 % reach an end: {counts}."
    else:
        words = f"half of the episodes end within {1e3 * half:.2f} mm of the goal, 95 % within {1e3 * most:.2f} mm."
    pull = {name: best[f"tension_{name}"] for name in ("median", "largest", "stopped") if f"tension_{name}" in best}
    return f"{words} {tension_sentence(pull, summary['settings']['tension_limit'])}" if pull else words


def policy_card(summary: Mapping[str, Any], layout: PolicyLayout) -> str:
    """Facts for the users of a policy, as Markdown."""
    episodes = summary["settings"]["evaluation_episodes"]
    best, times, seed = summary["evaluation"], summary["latency"], summary["seed"]
    parts = "\n".join(f"| {part.name} | {part.size} | {part.unit} |" for part in layout.observation)
    what = (
        f"one of {len(layout.moves)} moves of a channel by {np.max(layout.moves):g} {layout.unit}"
        if layout.kind == "discrete"
        else f"change of each of {len(layout.channels)} commands, up to {np.max(layout.moves):g} {layout.unit}"
    )
    versions = ", ".join(f"{name} {version}" for name, version in summary["versions"].items())
    return f"""# A policy for {summary["task"]}

Trained in simulation by {summary["algorithm"]}: {summary["steps"]} steps in {summary["seconds"]:.0f} s, seed {seed}.
Time steps: {summary["integrator"]}, {1e3 * float(summary["time_step_s"]):g} ms.
Parameters of every episode: {summary["randomisation"]}, SHA-256 {summary["posterior_sha256"][:16]}.

This is the policy after {best["steps"]} steps, the best evaluated, in {episodes} episodes: {training_sentence(summary)}
One decision takes {1e3 * times["median_s"]:.3f} ms, {1e3 * times["p99_s"]:.3f} ms at the 99th percentile.

| Observation | Numbers | Unit |
|---|---|---|
{parts}

Action, every {layout.period_s:g} s: {what}. Layout SHA-256 {summary["layout_sha256"][:16]}.

It has seen a simulator only. `rfdropo evaluate` tests it on others; summary.json has its origin.
Made with {versions}.
"""
