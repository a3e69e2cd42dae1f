"""The command that describes an experiment before a long run."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rfdropo_bayes.cli.options import ExperimentFile, Overrides, experiment_name

if TYPE_CHECKING:
    from rfdropo_bayes.verbs.check import Check

PROBLEMS = 2


def check(
    experiment: ExperimentFile,
    out: Annotated[
        Path | None, typer.Option("--out", help="folder of the pictures; by default runs/EXPERIMENT-check")
    ] = None,
    overrides: Overrides = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="read only: skip the simulations that estimate what a fit can determine")
    ] = False,
) -> None:
    """Check an experiment before a fit. Names faults, draws every recording, and measures the errors of time step and
    mesh. Predicts which parameters a fit can determine, and its run time.
    """
    from rfdropo_bayes.verbs.check import run_check

    folder = out or Path("runs") / f"{experiment_name(experiment)}-check"
    result = run_check(experiment, folder, overrides or [], ahead=not quick)
    width = max(len(label) for label, _ in result.lines)
    for label, text in result.lines:
        typer.echo(f"{label:<{width}}  {text}")
    for note in result.notes:
        typer.echo(f"\nnote: {note}")
    for doubt in result.doubts:
        typer.echo(f"\nDOUBTFUL: {doubt}")
    if result.files:
        count = len(result.files)
        typer.echo(f"\npictures: {result.files[0]}" + (f" and {count - 1} more beside it" if count > 1 else ""))
    for problem in result.problems:
        typer.echo(f"\nPROBLEM: {problem}")
    if result.problems:
        raise typer.Exit(PROBLEMS)
    typer.echo(f"\n{ending(result)}")
    if not result.doubts:
        typer.echo(f"next: {shlex.join(['rfdropo', 'calibrate', str(experiment), '--out', 'OUT'])}")


def ending(result: Check) -> str:
    """The last line of a check without problems."""
    if not result.doubts:
        return "nothing keeps this experiment from running"
    count = len(result.doubts)
    lines = "the line above that is" if count == 1 else f"the {count} lines above that are"
    return f"this experiment would run, but something was probably misread: look first at {lines} marked DOUBTFUL"
