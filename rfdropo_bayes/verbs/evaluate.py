"""Policies on the same episodes: ``evaluate``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import whole, write_json, write_text
from rfdropo_bayes.model.assembly import AnySimulator
from rfdropo_bayes.model.experiment_file import read_tables
from rfdropo_bayes.model.fitted_integrator import INTEGRATOR
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.run_folder import CONFIG, run_folder
from rfdropo_bayes.policies.episodes import Episodes, Settings
from rfdropo_bayes.policies.evaluation import (
    EVALUATION_SEED,
    THRESHOLDS,
    Case,
    Episode,
    draw_cases,
    episode_table,
    interquartile_mean,
    median_episode,
    peak_tension,
    play,
    success,
)
from rfdropo_bayes.policies.onnx_export import ExportedPolicy
from rfdropo_bayes.policies.policy_figures import save_animation, success_figure
from rfdropo_bayes.policies.randomisation import Randomisation
from rfdropo_bayes.policies.rendering import frames_of
from rfdropo_bayes.policies.tasks import Task, observed_of
from rfdropo_bayes.policies.training_config import TrainingOptions, TrainingTable
from rfdropo_bayes.policies.vec_env import TrunkVecEnv
from rfdropo_bayes.results.calibrated import Calibration
from rfdropo_bayes.robots.policy_layout import PolicyLayout
from rfdropo_bayes.signatures import stated
from rfdropo_bayes.verbs.make_vec import randomisation_of, steps_of, training_of, with_training
from rfdropo_bayes.verbs.train import POLICY

EVALUATION, TABLE, CSV, FIGURE = "evaluation.json", "evaluation.md", "episodes.csv", "success.png"
SCHEMA_VERSION = 1
OF_EPISODES = ("task", "goals", "start", "actions", "observation", "period", "noise", "tension_limit")
"""Keys of [training] that define an episode, for any simulator."""


def evaluate(
    model: Model,
    policies: Sequence[Path],
    out: Path | str,
    options: TrainingOptions | None = None,
    *,
    fit: Calibration | Path | None = None,
    episodes: int = 200,
    lanes: int = 64,
    seed: int = 0,
    film: bool = True,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Play exported policies on the same episodes of a model.

    Args:
        model: simulated model.
        options: keys of [training], such as the task. Without that table the settings of the first policy's training
            are used.
        fit: a calibration, or its folder, whose posterior provides the episodes' parameters.
        policies: policy.onnx, or folders that hold one; named after their folders, with parent folders if two names are
            equal.
        out: folder to write to: evaluation.json, evaluation.md, episodes.csv, success.png, and a GIF of each policy's
            median episode.
        episodes: number for each policy.
        lanes: episodes that are simulated at once.
        seed: seed of the cases.
        film: whether to draw the animations.
        overwrite: replace an earlier run in ``out``.

    Returns:
        the content of evaluation.json.

    Raises:
        InputError: bad input, a policy for another layout, or a policy given twice.
    """
    if episodes < 1:
        raise InputError(f"{episodes} episodes show nothing", where="--episodes", remedy="ask for at least one episode")
    keys = stated(options, TrainingOptions)
    opened = [ExportedPolicy(p / POLICY if p.is_dir() else p) for p in policies]
    inherited = _task_of(policies) if model.settings.training is None else {}
    unwatched = _drop_limit(inherited) if not model.robot.cable_names and "tension_limit" not in keys else []
    model = with_training(model, {**inherited, **keys})
    table, task, simulator = training_of(model)
    randomisation = randomisation_of(table, model.spec, simulator, fit)
    loaded = dict(zip(_names(policies), opened, strict=True))
    chosen = {"episodes": episodes, "seed": seed}
    record: dict[str, Any] = {
        "tables": model.tables(),
        "folder": model.folder,
        "options": chosen,
        "texts": model.texts(),
    }
    with run_folder(Path(out), "evaluate", **record, overwrite=overwrite) as out:
        cases: list[Case] = []
        played: dict[str, list[Episode]] = {}
        for name, policy in loaded.items():
            batch = _episodes_for(policy.layout, simulator, task, min(lanes, episodes), randomisation, table, name)
            venv = TrunkVecEnv(batch)
            cases = cases or draw_cases(venv, episodes, EVALUATION_SEED + seed)
            played[name] = play(policy.act, venv, cases, seed)
            if film:
                _film(batch, played[name], cases, out / f"{name}.gif")
        content = _rated(played, cases, seed) | {"tension_limit_n": table.tension_limit}
        content["otherwise_trained"] = [*_otherwise_trained(loaded, steps_of(simulator)), *unwatched]
        with whole(out / CSV) as partial:
            episode_table(played, cases).to_csv(partial, index=False)
        success_figure(played, THRESHOLDS).savefig(out / FIGURE, dpi=150)
        write_text(out / TABLE, evaluation_table(content))
        write_json(out / EVALUATION, content, finite=True)
    return content


def _task_of(policies: Sequence[Path]) -> dict[str, Any]:
    """Definition of an episode in the training of the first policy; empty if its folder lacks it."""
    first = policies[0] if policies[0].is_dir() else policies[0].parent
    if not (first / CONFIG).is_file():
        return {}
    return {key: value for key, value in read_tables(first / CONFIG).get("training", {}).items() if key in OF_EPISODES}


def _drop_limit(inherited: dict[str, Any]) -> list[str]:
    """Remove the tension limit from a training's definition of episodes, for a model without tensions. Returns a
    sentence about the limit; empty without a limit.
    """
    limit = inherited.pop("tension_limit", None)
    if limit is None:
        return []
    return [f"The training's tension_limit of {limit:g} N is left out: the model has no cables."]


def _episodes_for(
    layout: PolicyLayout,
    simulator: AnySimulator,
    task: Task,
    lanes: int,
    randomisation: Randomisation,
    table: TrainingTable,
    name: str,
) -> Episodes:
    """Episodes with the observations that a policy was trained on."""
    settings = Settings(
        actions=layout.kind,
        observed=observed_of(layout, len(simulator.marker_names)),
        period=table.period,
        step=np.max(layout.moves, axis=0).tolist(),
        noise=table.noise,
        tension_limit=table.tension_limit,
    )
    batch = Episodes(simulator, task, lanes, randomisation, settings)
    batch.layout.require(layout, where=name)
    return batch


def _otherwise_trained(policies: Mapping[str, ExportedPolicy], integrator: str) -> list[str]:
    """Sentences on policies that were trained with another integrator."""
    trained = {name: policy.facts.get(INTEGRATOR, integrator) for name, policy in policies.items()}
    return [
        f"{name} was trained with integrator {given!r}, and is evaluated with {integrator!r}."
        for name, given in trained.items()
        if given != integrator
    ]


def _names(policies: Sequence[Path]) -> list[str]:
    """Names of policies: folders, with enough parent folders to be distinct."""
    places = [p if p.is_dir() else (p.parent if p.stem == "policy" else p.with_suffix("")) for p in policies]
    parts = [place.resolve().parts for place in places]
    if len(set(parts)) < len(parts):
        raise InputError("a policy is given twice", where="--policy", remedy="name each once")
    depth = next(d for d in range(1, 1 + max(map(len, parts))) if len({own[-d:] for own in parts}) == len(parts))
    return ["_".join(part.strip("/") for part in own[-depth:]) for own in parts]


def _film(batch: Episodes, episodes: Sequence[Episode], cases: Sequence[Case], path: Path) -> None:
    """The median episode again, as an animation."""
    episode = median_episode(episodes)
    case = cases[episode.case]
    frames = frames_of(batch, episode.actions, case.parameters, case.goal)
    save_animation(frames, path, batch.layout.period_s)


def _rated(played: Mapping[str, Sequence[Episode]], cases: Sequence[Case], seed: int) -> dict[str, Any]:
    policies = {}
    for name, episodes in played.items():
        middle = interquartile_mean([episodes], seed)
        rates = {f"{1e3 * t:g}": success(episodes, t) for t in THRESHOLDS}
        policies[name] = {
            "success_mm": {key: {"share": s, "low": low, "high": high} for key, (s, low, high) in rates.items()},
            "interquartile_mean_mm": dict(zip(("value", "low", "high"), map(_millimetres, middle), strict=True)),
            "median_mm": _millimetres(float(np.median([episode.distance for episode in episodes]))),
            "diverged": int(np.sum([episode.diverged for episode in episodes])),
            "peak_tension_n": peak_tension(episodes),
        }
    return {"episodes": len(cases), "policies": policies, "seed": seed, "schema_version": SCHEMA_VERSION}


def _millimetres(distance: float) -> float | None:
    """A distance in millimetres; None after a failed simulation."""
    return 1e3 * distance if np.isfinite(distance) else None


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def evaluation_table(content: Mapping[str, Any]) -> str:
    """Success of every policy within each distance, with 95 % Wilson intervals, as Markdown."""
    names = next(iter(content["policies"].values()))["success_mm"]
    lines = [
        f"Share of {content['episodes']} episodes, the same for all policies, that end within a distance of the goal,",
        "with 95 % Wilson intervals; median and interquartile mean of the final distance; largest tension of a cable",
        "in an episode, and episodes that the limit on tension stopped.",
        "",
        f"| policy | {' | '.join(f'{name} mm' for name in names)} | median [mm] | IQM [mm] | diverged "
        "| tension, median [N] | largest [N] | stopped |",
        f"|{'---|' * (len(names) + 7)}",
    ]
    for name, row in content["policies"].items():
        cells = [
            f"{100 * r['share']:.0f} % [{100 * r['low']:.0f}, {100 * r['high']:.0f}]"
            for r in row["success_mm"].values()
        ]
        middle, pull = row["interquartile_mean_mm"], row["peak_tension_n"]
        cells += [
            _shown(row["median_mm"]),
            f"{_shown(middle['value'])} [{_shown(middle['low'])}, {_shown(middle['high'])}]",
            str(row["diverged"]),
            *(["-"] * 3 if pull is None else [f"{pull['median']:.3g}", f"{pull['largest']:.3g}", str(pull["stopped"])]),
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join([*lines, *(f"\n{sentence}" for sentence in content.get("otherwise_trained", []))]) + "\n"
