"""Commands around the audit: effects that the simulator lacks, and the next experiment.

The command that describes an experiment before a long run. Commands that predict, and that take a calibration to
another day.
"""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rfdropo_bayes.cli.options import (
    ExperimentFile,
    OutFolder,
    Overrides,
    Overwrite,
    Resume,
    experiment_name,
    folder_for,
    same_command,
    see_calibration,
)
from rfdropo_bayes.cli.terminal_summary import show_audit
from rfdropo_bayes.errors import Interrupted

if TYPE_CHECKING:
    from rfdropo_bayes.verbs.check import Check

from rfdropo_bayes.cli.terminal_summary import show_calibration, show_prediction
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.experiment_file import look_through
from rfdropo_bayes.model.run_folder import check_folder

Group = Annotated[
    str | None,
    typer.Option("--group", help="group of the commands (a session or robot); by default from [model.groups]"),
]
PredictedGroup = Annotated[
    str | None,
    typer.Option("--group", help="group (a session or robot); by default from adapt, or else from [model.groups]"),
]

Episode = Annotated[int | None, typer.Option("--episode", help="number of the episode, of a LeRobotDataset")]

PROBLEMS = 2

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

    result = ask(
        Model.read(experiment, overrides),
        out=folder,
        fit=fit,
        between=between,
        resume=resume,
        overwrite=overwrite,
        show=True,
    )
    show_audit(result.content, folder)
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


def predict(
    experiment: Annotated[
        Path, typer.Argument(metavar="EXPERIMENT.toml|DIR", help="the calibrated experiment, or a run's folder")
    ],
    commands: Annotated[str, typer.Option("--commands", help="file of commands, in the format of the experiment")],
    out: Annotated[Path, typer.Option("--out", help="folder to write to")],
    fit: Annotated[Path | None, typer.Option("--from", help="folder of the calibration; DIR by default")] = None,
    start: Annotated[
        str | None, typer.Option("--start", help="file whose first row is the start pose, if --commands has none")
    ] = None,
    episode: Episode = None,
    group: PredictedGroup = None,
    overwrite: Overwrite = False,
    overrides: Overrides = None,
) -> None:
    """Predict the motion under new commands. Writes mean, 50 and 90 % bands as NetCDF and CSV (m, base frame)."""
    if experiment.is_dir():
        fit, experiment = fit or experiment, experiment / "config.toml"
    if fit is None:
        raise InputError("no calibration was named", where="predict", remedy="add --from, or give a run's folder")
    see_calibration(fit, "--from")
    look_through(experiment, overrides or [])
    check_folder(out, "predict", overwrite=overwrite)
    from rfdropo_bayes.inference.progress import say_step
    from rfdropo_bayes.model.model import Model
    from rfdropo_bayes.results.calibrated import Calibration
    from rfdropo_bayes.verbs.predict import predict as predict_motion

    say_step(f"predicting {commands} with draws of {fit}")
    prediction = predict_motion(
        Calibration.of_posterior(fit, Model.read(experiment, overrides)),
        _from_here(commands),
        out=out,
        start=None if start is None else _from_here(start),
        episode=episode,
        group=group,
        overwrite=overwrite,
    )
    show_prediction(prediction.content, [out / "prediction.nc", out / "prediction.csv"])


def adapt(
    run: Annotated[Path, typer.Argument(metavar="DIR", help="folder of a calibration")],
    recording: Annotated[str, typer.Option("--recording", help="file of observations, in the experiment's format")],
    out: Annotated[Path, typer.Option("--out", help="folder to write to")],
    commands: Annotated[
        str | None,
        typer.Option("--commands", help="file of the recording's commands, if the format has a separate file"),
    ] = None,
    episode: Episode = None,
    seconds: Annotated[float | None, typer.Option(help="seconds from the start that are used; all by default")] = None,
    group: Group = None,
    overwrite: Overwrite = False,
    overrides: Overrides = None,
) -> None:
    """Adapt a calibration to another session. One short recording updates the parameters that vary between sessions;
    the body keeps its posterior.
    """
    see_calibration(run, "DIR")
    check_folder(out, "adapt", overwrite=overwrite)
    from rfdropo_bayes.data import RecordingEntry
    from rfdropo_bayes.results.calibrated import Calibration
    from rfdropo_bayes.verbs.adapt import adapt as adapt_fit
    from rfdropo_bayes.verbs.adapt import fitted_model

    entry = RecordingEntry(
        observations=_from_here(recording),
        commands=None if commands is None else _from_here(commands),
        episodes=None if episode is None else [episode],
    )
    result = adapt_fit(
        Calibration.of_posterior(run, fitted_model(run, overrides)),
        entry,
        out=out,
        seconds=seconds,
        group=group,
        overwrite=overwrite,
    )
    show_calibration(result)


def _from_here(name: str) -> str:
    """A path that counts from the current folder, if the file exists; otherwise relative to the experiment."""
    return str(Path(name).resolve()) if Path(name).exists() else name
