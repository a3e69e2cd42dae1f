"""Commands around policies."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from rfdropo_bayes.cli.options import (
    ExperimentFile,
    OutFolder,
    Overrides,
    Overwrite,
    Resume,
    folder_for,
    see_calibration,
)
from rfdropo_bayes.errors import InputError


def train(
    experiment: Annotated[
        Path | None, typer.Argument(metavar="EXPERIMENT.toml", help="the experiment file; not needed with --from")
    ] = None,
    fit: Annotated[
        Path | None,
        typer.Option("--from", help="folder of a calibration, whose model and posterior are used for training"),
    ] = None,
    task: Annotated[str | None, typer.Option("--task", help="reach or push; by default from the experiment")] = None,
    goal: Annotated[
        str | None, typer.Option("--goal", help="X,Y,Z [m] in the frame of the base; by default from the task")
    ] = None,
    out: OutFolder = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
    overrides: Overrides = None,
) -> None:
    """Train a policy and play it. Writes report.html, policy.onnx, its card and its learning curve."""
    if (experiment is None) == (fit is None):
        raise InputError(
            "the command needs an experiment file or --from DIR, not both", where="train", remedy="give one of them"
        )
    see_calibration(fit, "--from")
    if fit is not None:
        experiment, out = fit / "config.toml", out or fit.with_name(f"{fit.name}_train")
    assert experiment is not None
    overrides = [*(overrides or []), *_task_and_goal(task, goal)]
    folder = folder_for("train", experiment, out, overrides, resume=resume, overwrite=overwrite)
    from rfdropo_bayes.model.model import Model
    from rfdropo_bayes.verbs.make_vec import with_training
    from rfdropo_bayes.verbs.train import PAGE, POLICY, training_sentence
    from rfdropo_bayes.verbs.train import train as learn

    model = Model.read(experiment, overrides)
    if fit is not None:
        model = with_training(model, {"randomisation": "posterior"})
    summary = learn(model, folder, fit=fit, resume=resume, overwrite=overwrite)
    done = f"after {summary['steps']} steps in {summary['seconds']:.0f} s: {training_sentence(summary)}"
    ahead = shlex.join(["rfdropo", "evaluate", str(folder / "config.toml"), "--policy", str(folder)])
    typer.echo(f"{done}\npolicy: {folder / POLICY}\npage: {folder / PAGE}\nnext: {ahead}")


def _task_and_goal(task: str | None, goal: str | None) -> list[str]:
    """Overrides of an experiment file by the options --task and --goal."""
    overrides = []
    if task is not None:
        if task not in TASKS:
            raise InputError(f"unknown task {task!r}", where="--task", remedy=f"use {' or '.join(TASKS)}")
        overrides.append(f'training.task="{TASKS[task]}"')
    if goal is not None:
        parts = goal.split(",")
        try:
            place = [float(part) for part in parts]
        except ValueError:
            place = []
        if len(place) != 3:
            raise InputError(f"{goal!r} is not X,Y,Z", where="--goal", remedy="e.g. --goal 0.02,-0.03,0.13, in metres")
        overrides.append(f"training.goals={[place, place]}")
    return overrides


def evaluate(
    experiment: ExperimentFile,
    policy: Annotated[
        list[Path],
        typer.Option("--policy", metavar="FILE|DIR", help="policy.onnx, or the folder of a training; may be repeated"),
    ],
    out: OutFolder = None,
    episodes: Annotated[int, typer.Option(help="number of episodes of each policy, the same for all")] = 200,
    overwrite: Overwrite = False,
    overrides: Overrides = None,
) -> None:
    """Play policies on the same episodes. Writes success with intervals, every episode, a figure and animations."""
    folder = folder_for("evaluate", experiment, out, overrides, overwrite=overwrite)
    from rfdropo_bayes.model.model import Model
    from rfdropo_bayes.verbs.evaluate import TABLE, evaluation_table
    from rfdropo_bayes.verbs.evaluate import evaluate as play

    model = Model.read(experiment, overrides)
    evaluation = play(model, policy, folder, episodes=episodes, overwrite=overwrite)
    typer.echo(f"{evaluation_table(evaluation)}\ntable: {folder / TABLE}")


TASKS = {"reach": "TrunkReach-v0", "push": "TrunkPush-v0"}
