"""``rfdropo train`` and ``rfdropo evaluate``: policies on the simulator of an experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import whole, write_json, write_text
from rfdropo_bayes.model.assembly import build_robot_simulator, physical_values
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.model.run_folder import run_folder
from rfdropo_bayes.policies.episodes import Episodes, Settings
from rfdropo_bayes.policies.evaluation import (
    Case,
    Episode,
    draw_cases,
    episode_table,
    interquartile_mean,
    median_episode,
    play,
    success,
)
from rfdropo_bayes.policies.onnx_export import ExportedPolicy, export_policy, latency
from rfdropo_bayes.policies.parity import difference, observations
from rfdropo_bayes.policies.policy_figures import curve_figure, save_animation, success_figure
from rfdropo_bayes.policies.randomisation import (
    Layers,
    Point,
    Randomisation,
    Uniform,
    drawn_rows,
    read_phi,
    read_posterior,
)
from rfdropo_bayes.policies.rendering import picture
from rfdropo_bayes.policies.tasks import Task, observed_of, task_named
from rfdropo_bayes.policies.training import Trained, train
from rfdropo_bayes.policies.training_config import TrainingTable
from rfdropo_bayes.policies.vec_env import TrunkVecEnv
from rfdropo_bayes.report import software_versions
from rfdropo_bayes.report.facts import LEARNING
from rfdropo_bayes.results.calibrated import Calibration
from rfdropo_bayes.robots import OBJECT
from rfdropo_bayes.robots.policy_layout import PolicyLayout
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator
from rfdropo_bayes.tables import changed, parse_table

POLICY, CARD, SUMMARY, CURVE = "policy.onnx", "card.md", "summary.json", "curve.png"
EVALUATION, TABLE, CSV, FIGURE = "evaluation.json", "evaluation.md", "episodes.csv", "success.png"
THRESHOLDS = (0.005, 0.01, 0.01525, 0.02157, 0.030)  # m; the last three are the paper's
EVALUATION_SEED = 2_000_003  # none of the seeds that training or its evaluations use
SCHEMA_VERSION = 1


def make_vec(
    task: str, model: Model, *, posterior: Calibration | Path | None = None, n: int = 64, **options: Any
) -> TrunkVecEnv:
    """Environments of a task, side by side, for Stable-Baselines3.

    Args:
        task: "TrunkReach-v0" or "TrunkPush-v0".
        model: that is simulated; its fixed values hold.
        posterior: whose draws the episodes' parameters are, or its folder; nominal values without.
        n: how many environments.
        options: further keys of an experiment file's [training], such as ``observation`` or ``period``.

    Raises:
        InputError: an unknown task or key, or a posterior of another robot.
    """
    model = _with_training(model, {"task": task, **options})
    table, chosen, simulator = _training(model)
    randomisation = _randomisation(table, model.spec, simulator, posterior)
    return TrunkVecEnv(Episodes(simulator, chosen, n, randomisation, _settings(table)))


def train_policy(
    model: Model,
    out: Path | str,
    *,
    posterior: Calibration | Path | None = None,
    seed: int = 0,
    resume: bool = False,
    overwrite: bool = False,
    show: bool | None = None,
    tables: Mapping[str, Any] | None = None,
    **options: Any,
) -> dict[str, Any]:
    """Train a policy on a model, and export it.

    Args:
        model: that is simulated; its fixed values hold.
        out: folder to write to: policy.onnx, card.md, summary.json, curve.png, episodes.jsonl, TensorBoard's files and
            checkpoints.
        posterior: whose draws the episodes' parameters are, or its folder.
        seed: of all that is random.
        resume: go on from the checkpoint of an interrupted run in ``out``; overwrite: start anew whatever it holds.
        show: progress on the terminal, as in `calibrate`.
        tables: of the experiment file that the model was read from, for the record.
        options: keys of an experiment file's [training].

    Returns:
        the content of summary.json.

    Raises:
        InputError: bad input, before anything long has started.
    """
    model = _with_training(model, options)
    if tables is None:
        tables = {**model.tables(), "seed": seed}
    table, task, simulator = _training(model)
    randomisation = _randomisation(table, model.spec, simulator, posterior)
    settings = _settings(table)
    known = {"randomisation": randomisation.sha256, "simulator": simulator.description["content_sha256"]}

    def environments(lanes: int) -> TrunkVecEnv:
        return TrunkVecEnv(Episodes(simulator, task, lanes, randomisation, settings))

    record: dict[str, Any] = {"tables": tables, "folder": model.folder, "data": known, "texts": model.texts()}
    with run_folder(Path(out), "train", **record, resume=resume, overwrite=overwrite) as out:
        found = train(
            environments, table, out, seed=seed, gamma=task.gamma, resume=resume, fingerprint=known, show=show
        )
        layout = found.model.get_env().get_attr("layout")[0]
        facts = {
            "rfdropo_version": software_versions()["rfdropo_bayes"],
            "randomisation": randomisation.kind,
            "posterior_sha256": randomisation.sha256,
            "simulator_sha256": str(known["simulator"]),
            "seed": str(seed),
        }
        policy = ExportedPolicy(export_policy(found.model, found.normalisation, layout, out / POLICY, facts))
        _check_parity(policy, found)
        summary = _summary(table, found, policy, facts)
        curve_figure(found.curve).savefig(out / CURVE, dpi=150)
        write_text(out / CARD, policy_card(summary, layout))
        write_json(out / SUMMARY, summary)
    return summary


def run_training(path: Path, out: Path, *, overrides: Sequence[str] = (), **options: Any) -> dict[str, Any]:
    """`train_policy` on what an experiment file with a table [training] says."""
    model, tables = Model.read(path, overrides)
    return train_policy(model, out, seed=model.settings.seed, tables=tables, **options)


def _with_training(model: Model, options: Mapping[str, Any]) -> Model:
    """The model with further keys of [training]."""
    if not options:
        return model
    own = model.settings.training
    known = {} if own is None else own.model_dump(exclude_unset=True)
    table = parse_table(TrainingTable, {**known, **options}, where="training")
    return Model.of(model.spec, replace(model.settings, training=table))


def _settings(table: TrainingTable) -> Settings:
    return Settings(actions=table.actions, observed=table.observation, period=table.period, noise=table.noise)


def evaluate_policies(
    model: Model,
    policies: Sequence[Path],
    out: Path | str,
    *,
    posterior: Calibration | Path | None = None,
    episodes: int = 200,
    lanes: int = 64,
    seed: int = 0,
    film: bool = True,
    overwrite: bool = False,
    tables: Mapping[str, Any] | None = None,
    **options: Any,
) -> dict[str, Any]:
    """Play exported policies on the same episodes of a model.

    Args:
        model: that is simulated.
        posterior: whose draws the episodes' parameters are, or its folder.
        policies: policy.onnx, or folders that hold one; named after their folders, with those above
            where two folders are called the same.
        out: folder to write to: evaluation.json, evaluation.md, episodes.csv, success.png, and a GIF of each policy's
            median episode.
        episodes: of each policy.
        lanes: episodes that are simulated at once.
        seed: of the cases.
        film: whether to draw the animations.
        overwrite: start anew whatever ``out`` holds.
        tables: of the experiment file that the model was read from, for the record.
        options: keys of an experiment file's [training], such as the task.

    Returns:
        the content of evaluation.json.

    Raises:
        InputError: bad input, a policy for another layout, or one that is given twice.
    """
    model = _with_training(model, options)
    if tables is None:
        tables = model.tables()
    table, task, simulator = _training(model)
    randomisation = _randomisation(table, model.spec, simulator, posterior)
    opened = [ExportedPolicy(p / POLICY if p.is_dir() else p) for p in policies]
    loaded = dict(zip(_names(policies), opened, strict=True))
    chosen = {"episodes": episodes, "seed": seed}
    record: dict[str, Any] = {"tables": tables, "folder": model.folder, "options": chosen, "texts": model.texts()}
    with run_folder(Path(out), "evaluate", **record, overwrite=overwrite) as out:
        cases: list[Case] = []
        found: dict[str, list[Episode]] = {}
        for name, policy in loaded.items():
            batch = _episodes_for(policy.layout, simulator, task, min(lanes, episodes), randomisation, table, name)
            venv = TrunkVecEnv(batch)
            cases = cases or draw_cases(venv, episodes, EVALUATION_SEED + seed)
            found[name] = play(policy.act, venv, cases, seed)
            if film:
                _film(batch, found[name], cases, out / f"{name}.gif")
        content = _judged(found, cases, seed)
        with whole(out / CSV) as partial:
            episode_table(found, cases).to_csv(partial, index=False)
        success_figure(found, THRESHOLDS).savefig(out / FIGURE, dpi=150)
        write_text(out / TABLE, evaluation_table(content))
        write_json(out / EVALUATION, content, finite=True)
    return content


def run_evaluation(
    path: Path, policies: Sequence[Path], out: Path, *, overrides: Sequence[str] = (), **options: Any
) -> dict[str, Any]:
    """`evaluate_policies` on what an experiment file with a table [training] says."""
    model, tables = Model.read(path, overrides)
    return evaluate_policies(model, policies, out, tables=tables, **options)


def _training(model: Model) -> tuple[TrainingTable, Task, RobotSimulator]:
    table = model.settings.training
    if table is None:
        raise InputError(
            "the experiment has no table [training]", where="training", remedy='add it, with task = "TrunkReach-v0"'
        )
    task = task_named(table.task)
    if table.goals is not None:
        task = replace(task, goal_low=table.goals[0], goal_high=table.goals[1])
    pushing = changed(model.spec.simulator, where="[simulator]", push=task.push)
    return table, task, build_robot_simulator(replace(model.spec, simulator=pushing))


def _randomisation(
    table: TrainingTable,
    spec: ModelSpec,
    simulator: RobotSimulator,
    posterior: Calibration | Path | None = None,
) -> Randomisation:
    """Where parameters come from: values that are held, what is randomised, and what differs between episodes.

    A task without a cube has no use for what the experiment says of one.
    """
    absent = () if "cube_mass" in {spec.name for spec in simulator.parameters} else OBJECT
    held = replace(spec, fixed={name: value for name, value in spec.fixed.items() if name not in absent})
    parts: list[Randomisation] = [Point(physical_values(held, simulator))]
    if isinstance(posterior, Calibration):
        parts.append(drawn_rows(posterior.record, simulator.parameters, robot=simulator.robot))
    elif posterior is not None:
        parts.append(read_posterior(Path(posterior), simulator.parameters, simulator.robot))
    elif table.randomisation != "none":
        parts.append(_randomised(table, simulator, spec.folder))
    kind = parts[-1].kind
    start = {name: ends for name, ends in table.start.items() if name not in absent}
    return Layers((*parts, Uniform(start)), kind) if start or len(parts) > 1 else parts[0]


def _randomised(table: TrainingTable, simulator: RobotSimulator, folder: Path) -> Randomisation:
    """What [training] randomises over."""
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
    beside = folder / table.source
    source = beside if beside.exists() else Path(table.source)
    if table.randomisation == "phi":
        return read_phi(source, simulator.parameters, simulator.robot)
    return read_posterior(source, simulator.parameters, simulator.robot)


def _episodes_for(
    layout: PolicyLayout,
    simulator: RobotSimulator,
    task: Task,
    lanes: int,
    randomisation: Randomisation,
    table: TrainingTable,
    name: str,
) -> Episodes:
    """Lanes that show a policy what it was trained to see."""
    settings = Settings(
        actions=layout.kind,
        observed=observed_of(layout),
        period=table.period,
        step=float(np.max(layout.moves)),
        noise=table.noise,
    )
    batch = Episodes(simulator, task, lanes, randomisation, settings)
    batch.layout.require(layout, where=name)
    return batch


def _names(policies: Sequence[Path]) -> list[str]:
    """Names of policies: of their folders, with as many folders above as it takes to tell them apart."""
    places = [p if p.is_dir() else (p.parent if p.stem == "policy" else p.with_suffix("")) for p in policies]
    parts = [place.resolve().parts for place in places]
    if len(set(parts)) < len(parts):
        raise InputError("a policy is given twice", where="--policy", remedy="name each once")
    depth = next(d for d in range(1, 1 + max(map(len, parts))) if len({own[-d:] for own in parts}) == len(parts))
    return ["_".join(part.strip("/") for part in own[-depth:]) for own in parts]


def _check_parity(policy: ExportedPolicy, trained: Trained) -> None:
    """Raise if the exported policy does not act as the trained one does, on what it may see."""
    apart = difference(policy, trained.act, observations(trained.normalisation, policy.layout.size))
    if apart is not None:
        raise InputError(
            f"the exported policy acts otherwise than the trained one: {apart}",
            where=POLICY,
            remedy="report this as an error",
        )


def _summary(table: TrainingTable, found: Trained, policy: ExportedPolicy, facts: Mapping[str, str]) -> dict[str, Any]:
    return {
        "task": table.task,
        "algorithm": table.algorithm,
        "steps": found.curve[-1]["steps"],
        "seconds": found.seconds,
        "diverged_episodes": found.diverged,
        "redrawn_parameters": found.redrawn,
        "evaluation": {key: value for key, value in found.best.items() if key != "seconds"},
        "curve": found.curve,
        "latency": latency(policy),
        "layout_sha256": policy.layout.sha256,
        "settings": table.model_dump(mode="json"),
        **facts,
        "versions": software_versions(LEARNING),
        "status": "done",
        "schema_version": SCHEMA_VERSION,
    }


def policy_card(summary: Mapping[str, Any], layout: PolicyLayout) -> str:
    """What somebody needs to know before using a policy, as Markdown."""
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
Parameters of every episode: {summary["randomisation"]}, SHA-256 {summary["posterior_sha256"][:16]}.

This is the policy after {best["steps"]} steps, the best evaluated: half of {episodes} episodes end within
{1e3 * best["distance_median"]:.2f} mm of the goal, 95 % within {1e3 * best["distance_q95"]:.2f} mm.
One decision takes {1e3 * times["median_s"]:.3f} ms, {1e3 * times["p99_s"]:.3f} ms at the 99th percentile.

| Observation | Numbers | Unit |
|---|---|---|
{parts}

Action, every {layout.period_s:g} s: {what}. Layout SHA-256 {summary["layout_sha256"][:16]}.

It has seen a simulator only. `rfdropo evaluate` says how it does on others; summary.json says what made it.
Made with {versions}.
"""


def _film(batch: Episodes, episodes: Sequence[Episode], cases: Sequence[Case], path: Path) -> None:
    """The median episode again, as an animation."""
    episode = median_episode(episodes)
    case = cases[episode.case]
    option = {"parameters": dict(case.parameters), "goal": list(case.goal)}
    batch.reset(np.arange(batch.lanes), [option] * batch.lanes)
    frames = [picture(batch, 0)]
    for action in episode.actions:
        batch.act(np.repeat(np.asarray(action)[None], batch.lanes, axis=0))
        frames.append(picture(batch, 0))
    save_animation(frames, path, batch.layout.period_s)


def _judged(found: Mapping[str, Sequence[Episode]], cases: Sequence[Case], seed: int) -> dict[str, Any]:
    policies = {}
    for name, episodes in found.items():
        middle = interquartile_mean([episodes], seed)
        rates = {f"{1e3 * t:g}": success(episodes, t) for t in THRESHOLDS}
        policies[name] = {
            "success_mm": {key: {"share": s, "low": low, "high": high} for key, (s, low, high) in rates.items()},
            "interquartile_mean_mm": dict(zip(("value", "low", "high"), map(_millimetres, middle), strict=True)),
            "median_mm": _millimetres(float(np.median([episode.distance for episode in episodes]))),
            "diverged": int(np.sum([episode.diverged for episode in episodes])),
        }
    return {"episodes": len(cases), "policies": policies, "seed": seed, "schema_version": SCHEMA_VERSION}


def _millimetres(distance: float) -> float | None:
    """None where simulations failed, which is no distance."""
    return 1e3 * distance if np.isfinite(distance) else None


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def evaluation_table(content: Mapping[str, Any]) -> str:
    """Success of every policy within each distance, with 95 % Wilson intervals, as Markdown."""
    names = next(iter(content["policies"].values()))["success_mm"]
    lines = [
        f"Share of {content['episodes']} episodes, the same for all policies, that end within a distance of the goal,",
        "with 95 % Wilson intervals; median and interquartile mean of the final distance.",
        "",
        f"| policy | {' | '.join(f'{name} mm' for name in names)} | median [mm] | IQM [mm] | diverged |",
        f"|{'---|' * (len(names) + 4)}",
    ]
    for name, row in content["policies"].items():
        cells = [
            f"{100 * r['share']:.0f} % [{100 * r['low']:.0f}, {100 * r['high']:.0f}]"
            for r in row["success_mm"].values()
        ]
        middle = row["interquartile_mean_mm"]
        cells += [
            _shown(row["median_mm"]),
            f"{_shown(middle['value'])} [{_shown(middle['low'])}, {_shown(middle['high'])}]",
            str(row["diverged"]),
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"
