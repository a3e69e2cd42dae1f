"""``python -m studies``: studies that take hours. Each can be interrupted and resumed."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from rfdropo_bayes.cli.main import run
from rfdropo_bayes.cli.options import ExperimentFile, OutFolder, Overrides, Overwrite, Resume, folder_for
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.run_folder import check_folder
from rfdropo_bayes.runtime import keep_compilations
from studies import audit_study, engine_study
from studies.method_check import run_check
from studies.table1 import ROWS, TASKS, Table1Size, run_table1
from studies.table2 import Table2Size, run_table2

NAME = "python -m studies"
VIRTUAL = Path("experiments/virtual")


def table1(
    out: Annotated[Path, typer.Option("--out", help="folder to write to")] = Path("runs/table1"),
    truths: Annotated[int, typer.Option(help="number of true parameter sets of each kind, for our methods")] = 100,
    repeats: Annotated[
        int, typer.Option(help="number of data sets at the paper's true parameters, for our methods")
    ] = 20,
    rival_truths: Annotated[
        int, typer.Option(help="number of true parameter sets of each kind, for the other methods")
    ] = 5,
    budget: Annotated[int, typer.Option(help="number of rollouts of a posterior")] = 10000,
    actions: Annotated[int, typer.Option(help="length of a recording, in actions of 50 ms")] = 100,
    seed: Annotated[int, typer.Option(help="seed of all random numbers")] = 0,
    rows: Annotated[
        list[str] | None, typer.Option("--row", metavar="NAME", help="only this row; may be repeated")
    ] = None,
    tasks: Annotated[
        list[str] | None, typer.Option("--task", metavar="NAME", help="only this task; may be repeated")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="go on with an interrupted run")] = False,
    only_done: Annotated[
        bool, typer.Option("--only-done", help="write the tables of an interrupted run as far as it is done")
    ] = False,
    overwrite: Overwrite = False,
    cluster: Annotated[str | None, typer.Option(help="local, or HOST:PORT of a Dask scheduler")] = None,
) -> None:
    """Make the paper's Table I, with rivals. Writes table1.json, table1.md and table1.png."""
    check_folder(out, "table1", resume=resume or only_done, overwrite=overwrite)
    size = Table1Size(truths, rival_truths, budget, actions, seed, repeats)
    words = shlex.join([*NAME.split(), *sys.argv[1:]])
    content = run_table1(
        out,
        size,
        rows=rows or tuple(ROWS),
        tasks=tasks or tuple(TASKS),
        resume=resume,
        cluster=cluster,
        only_done=only_done,
        overwrite=overwrite,
        command=words,
    )
    for claim in content["claims"]:
        typer.echo(f"{'holds' if claim['holds'] else 'FAILS'}: {claim['task']}, {claim['claim']}: {claim['value']:.3g}")
    typer.echo(f"table: {out / 'table1.md'}")


def table2(
    experiments: Annotated[
        list[Path] | None, typer.Argument(metavar="EXPERIMENT.toml", help="one file for each task")
    ] = None,
    target: Annotated[Path, typer.Option(help="experiment file of the robot that policies are evaluated on")] = VIRTUAL
    / "truth.toml",
    audited: Annotated[Path, typer.Option("--audit", help="experiment file of the audit")] = VIRTUAL / "audit.toml",
    out: Annotated[Path, typer.Option("--out", help="folder to write to")] = Path("runs/table2"),
    seeds: Annotated[int, typer.Option(help="number of policies trained for each row")] = 3,
    steps: Annotated[int, typer.Option(help="number of environment steps of a training")] = 1_000_000,
    episodes: Annotated[int, typer.Option(help="number of episodes of an evaluation, the same for all policies")] = 200,
    budget: Annotated[int, typer.Option(help="number of rollouts of a fit")] = 10_000,
    minutes: Annotated[float, typer.Option(help="time limit of the audit, in minutes")] = 65.0,
    exact_oracle: Annotated[
        bool, typer.Option("--exact-oracle", help="train the oracle on the target's own mesh and time step; slower")
    ] = False,
    rows: Annotated[
        list[str] | None, typer.Option("--row", metavar="NAME", help="only this row; may be repeated")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="go on with an interrupted study")] = False,
    only_done: Annotated[
        bool, typer.Option("--only-done", help="write the tables of an interrupted study as far as it is done")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Make the paper's Table II. Plays policies of every method on a robot that they never touched."""
    check_folder(out, "table2", resume=resume or only_done, overwrite=overwrite)
    content = run_table2(
        experiments or [VIRTUAL / "push.toml", VIRTUAL / "reach.toml"],
        target,
        audited,
        out,
        Table2Size(seeds, steps, episodes, budget, minutes, exact_oracle),
        rows=rows or (),
        resume=resume,
        only_done=only_done,
        overwrite=overwrite,
        command=shlex.join([*NAME.split(), *sys.argv[1:]]),
    )
    for claim in content["claims"]:
        typer.echo(f"{'holds' if claim['holds'] else 'FAILS'}: {claim['task']}, {claim['claim']}: {claim['value']:.2f}")
    for cell, why in content["failed"].items():
        typer.echo(f"failed: {cell}: {why}")
    if content["not_done"]:
        typer.echo(f"{content['not_done']} cells are not done: go on with --resume")
    typer.echo(f"table: {out / 'table2.md'}")


def audit(
    datasets: Annotated[int, typer.Option(help="data sets per condition")] = 100,
    seed: Annotated[int, typer.Option(help="seed of the study")] = 0,
    condition: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="only this condition; may be repeated")
    ] = None,
    hide: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="mechanism to hide; may be repeated; all by default")
    ] = None,
    exclude: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="mechanism to leave out; may be repeated")
    ] = None,
    cluster: Annotated[str | None, typer.Option(help="local, or HOST:PORT of a Dask scheduler")] = None,
    truth: Annotated[
        str, typer.Option("--truth", help="engine that makes recordings: own, mujoco or pyelastica")
    ] = "own",
    out: Annotated[Path, typer.Option("--out", help="folder to write to")] = Path("runs/audits"),
) -> None:
    """Count how often audits are right. Effects are hidden in recordings; a study goes on where it was stopped."""
    if truth not in ("own", "mujoco", "pyelastica"):
        raise InputError(f"unknown engine {truth!r}", where="--truth", remedy="own, mujoco or pyelastica")
    if truth != "own":
        engine_study.run_engine_study(out, datasets, seed, engine=truth, effects=hide or [])
        typer.echo((out / engine_study.TABLE).read_text(encoding="utf-8"))
        return
    chosen = {"conditions": condition or [], "mechanisms": hide or [], "exclude": exclude or []}
    audit_study.run_study(out, datasets, seed, cluster=cluster, **chosen)
    typer.echo((out / audit_study.TABLE).read_text(encoding="utf-8"))


def sbc(
    experiment: ExperimentFile,
    out: OutFolder = None,
    datasets: Annotated[int, typer.Option(help="number of data sets")] = 200,
    resume: Resume = False,
    overwrite: Overwrite = False,
    overrides: Overrides = None,
) -> None:
    """Check an experiment's method by simulation-based calibration. Writes sbc.json."""
    folder = folder_for("sbc", experiment, out, overrides, resume=resume, overwrite=overwrite)
    found = run_check(Model.read(experiment, overrides), folder, datasets=datasets, resume=resume, overwrite=overwrite)
    typer.echo(found["sentence"])
    typer.echo(f"details: {folder / 'sbc.json'}")


app = typer.Typer(
    help="Studies that take hours. Each can be interrupted and resumed.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
for command in (table1, table2, audit, sbc):
    app.command()(command)

if __name__ == "__main__":
    keep_compilations()
    run(app, NAME)
