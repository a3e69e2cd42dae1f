"""Arguments and options that several commands share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

ExperimentFile = Annotated[Path, typer.Argument(metavar="EXPERIMENT.toml", help="the experiment file")]
OutFolder = Annotated[Path | None, typer.Option("--out", help="folder to write to; reports/<experiment> by default")]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", help="name=value: a parameter's value, or table.key=value of the experiment file"),
]
Seed = Annotated[int | None, typer.Option(help="seed; that of the experiment file by default")]
Resume = Annotated[bool, typer.Option(help="go on from the checkpoint of an interrupted run")]


def folder_for(experiment: Path, out: Path | None) -> Path:
    """The folder that was asked for, or the one named after the experiment."""
    return out or Path("reports") / experiment.stem


def say_progress() -> Callable[[str], None]:
    """Lines of progress on the standard error stream, so that results alone are on the standard output."""
    return lambda line: typer.echo(f"  {line}", err=True)
