"""Commands around policies."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from rfdropo_bayes.cli.options import AsJson, ExperimentFile, OutFolder, Overrides, Overwrite, Quiet, Resume, folder_for


def train(
    experiment: ExperimentFile,
    out: OutFolder = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
    overrides: Overrides = None,
) -> None:
    """Train a policy under the experiment's randomisation: writes policy.onnx, its card, and how it learnt."""
    folder = folder_for("train", experiment, out, overrides, resume=resume, overwrite=overwrite)
    from rfdropo_bayes.workflow.training import CARD, POLICY, run_training

    found = run_training(experiment, folder, overrides=overrides or [], resume=resume, overwrite=overwrite)
    if as_json:
        typer.echo(json.dumps(found, indent=2))
    elif not quiet:
        last = found["evaluation"]
        typer.echo(
            f"half of the episodes end within {1e3 * last['distance_median']:.2f} mm of the goal, 95 % within "
            f"{1e3 * last['distance_q95']:.2f} mm, after {found['steps']} steps in {found['seconds']:.0f} s"
        )
        typer.echo(f"policy: {folder / POLICY}\ncard: {folder / CARD}")


def evaluate(
    experiment: ExperimentFile,
    policy: Annotated[
        list[Path], typer.Option("--policy", help="policy.onnx, or the folder of a training; may be repeated")
    ],
    out: OutFolder = None,
    episodes: Annotated[int, typer.Option(help="of each policy, the same for all")] = 200,
    seed: Annotated[int, typer.Option(help="of the episodes' parameters and goals")] = 0,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
    overrides: Overrides = None,
) -> None:
    """Play policies on the same episodes: writes success with intervals, every episode, a figure and animations."""
    folder = folder_for("evaluate", experiment, out, overrides, overwrite=overwrite)
    from rfdropo_bayes.workflow.training import TABLE, evaluation_table, run_evaluation

    found = run_evaluation(
        experiment, policy, folder, episodes=episodes, seed=seed, overrides=overrides or [], overwrite=overwrite
    )
    if as_json:
        typer.echo(json.dumps(found, indent=2))
    elif not quiet:
        typer.echo(evaluation_table(found))
        typer.echo(f"table: {folder / TABLE}")
