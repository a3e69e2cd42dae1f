"""Commands around the audit: effects that the simulator lacks, and the next experiment."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rfdropo_bayes.cli.options import (
    ExperimentFile,
    OutFolder,
    Overrides,
    Overwrite,
    Resume,
    folder_for,
    same_command,
    see_calibration,
)
from rfdropo_bayes.cli.terminal_summary import show_audit
from rfdropo_bayes.errors import Interrupted

if TYPE_CHECKING:
    pass


Fit = Annotated[
    Path | None, typer.Option("--from", help="folder of an earlier calibration, to start the base model from")
]


def audit(
    experiment: ExperimentFile,
    out: OutFolder = None,
    fit: Fit = None,
    between: Annotated[
        tuple[str, str] | None,
        typer.Option("--between", metavar="GROUP GROUP", help="name the difference between two of [model.groups]"),
    ] = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
    overrides: Overrides = None,
) -> None:
    """Name the effects that the simulator lacks. Writes audit.json, extended.toml and report.html."""
    see_calibration(fit, "--from")
    folder = folder_for("audit", experiment, out, overrides, resume=resume, overwrite=overwrite)
    from rfdropo_bayes.discrepancy.deadline import INTERRUPT
    from rfdropo_bayes.model.model import Model
    from rfdropo_bayes.verbs.audit import audit as ask
    from rfdropo_bayes.verbs.calibrate import OPTIMISING

    result = ask(
        Model.read(experiment, overrides),
        out=folder,
        fit=fit,
        between=between,
        resume=resume,
        overwrite=overwrite,
        show=True,
    )
    show_audit(result.content, folder, starts=result.extended.settings.inference.method in OPTIMISING)
    if result.content["stopped"] == INTERRUPT:
        raise Interrupted(str(folder), "--resume")
    if result.content["stopped"]:
        minutes = 2.0 * result.content["minutes"]
        typer.echo(f"to go on: {same_command('rfdropo', '--resume', '--set', f'audit.minutes={minutes:g}')}")


def design(
    experiment: ExperimentFile,
    out: OutFolder = None,
    fit: Fit = None,
    overwrite: Overwrite = False,
    overrides: Overrides = None,
) -> None:
    """Propose commands that distinguish causes. Writes next_commands.csv and design.json."""
    see_calibration(fit, "--from")
    folder = folder_for("design", experiment, out, overrides, overwrite=overwrite)
    from rfdropo_bayes.model.model import Model
    from rfdropo_bayes.results.designed import COMMANDS
    from rfdropo_bayes.verbs.design import design as propose

    result = propose(Model.read(experiment, overrides), fit=fit, out=folder, overwrite=overwrite, show=True)
    typer.echo(f"{result.sentence}\ncommands: {folder / COMMANDS}")
