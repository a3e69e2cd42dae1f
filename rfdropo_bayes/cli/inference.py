"""Commands around a posterior: export it, check it, compare methods."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rfdropo_bayes.errors import InputError


def export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="what a calibration has written")],
    phi: Annotated[bool, typer.Option("--phi", help="the distribution to randomise over")] = False,
    out: Annotated[Path | None, typer.Option("--out", help="folder to write to; DIR by default")] = None,
) -> None:
    """Write the distribution to randomise over as tables with units (CSV and JSON), for other simulators."""
    from rfdropo_bayes.workflow.export import export_phi

    if not phi:
        raise InputError("nothing to export was named", where="export", remedy="add --phi")
    for path in export_phi(folder, out):
        typer.echo(str(path))


def check(path: Path, out: Path, name: str, datasets: int, overrides: list[str], resume: bool) -> None:
    """Run a check of an experiment's method and say what it found."""
    from rfdropo_bayes.workflow.check import run_check

    found = run_check(path, out, name, datasets=datasets, overrides=overrides, resume=resume)
    typer.echo(found["sentence"])
    typer.echo(f"details: {out / f'{name}.json'}")
