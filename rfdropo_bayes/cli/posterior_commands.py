"""Commands around a posterior: export it, check it, compare methods."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from rfdropo_bayes.cli.options import Overwrite, see_calibration
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.run_folder import check_folder


def export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="folder of a calibration")],
    phi: Annotated[bool, typer.Option("--phi", help="the distribution to randomise over")] = False,
    posterior: Annotated[bool, typer.Option("--posterior", help="a posterior.nc without its predictions")] = False,
    model: Annotated[
        bool, typer.Option("--model", help="the model of another simulator (MJCF), with posterior means in it")
    ] = False,
    out: Annotated[Path | None, typer.Option("--out", help="folder to write to; DIR by default")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace what an earlier export wrote")] = False,
) -> None:
    """Write parts of a calibration for other programs. The distribution to randomise over as tables with units, a
    posterior small enough to keep, or a calibrated model."""
    if not phi and not posterior and not model:
        raise InputError("nothing to export was named", where="export", remedy="add --phi, --posterior or --model")
    see_calibration(folder, "DIR")
    from rfdropo_bayes.verbs.export import export_model, export_phi, export_posterior

    paths = export_phi(folder, out, overwrite=overwrite) if phi else []
    if posterior:
        paths.append(export_posterior(folder, out, overwrite=overwrite))
    if model:
        paths.append(export_model(folder, out, overwrite=overwrite))
    for path in paths:
        typer.echo(str(path))


def check(path: Path, out: Path, name: str, datasets: int, overrides: list[str], resume: bool, overwrite: bool) -> None:
    """Run a check of an experiment's method and say what it found."""
    from rfdropo_bayes.model.model import Model
    from rfdropo_bayes.studies.method_check import run_check

    model = Model.read(path, overrides)
    found = run_check(model, out, name, datasets=datasets, resume=resume, overwrite=overwrite)
    typer.echo(found["sentence"])
    typer.echo(f"details: {out / f'{name}.json'}")


def table1(
    out: Annotated[Path, typer.Option("--out", help="folder to write to")] = Path("reports/table1"),
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
    check_folder(out, "benchmark table1", resume=resume or only_done, overwrite=overwrite)
    from rfdropo_bayes.studies.table1 import ROWS, TASKS, Table1Size, run_table1

    size = Table1Size(truths, rival_truths, budget, actions, seed, repeats)
    words = shlex.join(["rfdropo", *sys.argv[1:]])
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
