"""Arguments and options that several commands share."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import typer

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.experiment_file import look_through
from rfdropo_bayes.model.run_folder import check_folder

ExperimentFile = Annotated[Path, typer.Argument(metavar="EXPERIMENT.toml", help="the experiment file")]
OutFolder = Annotated[
    Path | None,
    typer.Option(
        "--out",
        help="folder to write to  [default: runs/NAME_COMMAND, for calibrate runs/NAME; NAME is the name of the "
        "file, or of the folder of experiment.toml]",
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="value of a parameter in SI units, or table.key=value of the experiment file; may be repeated",
    ),
]
Resume = Annotated[bool, typer.Option("--resume", help="go on from the checkpoint of an interrupted run")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="start anew, whatever the folder holds")]
WRITTEN = ("experiment", "config", "extended")  # names of the experiment files that init, runs and audits write


def folder_for(
    command: str,
    experiment: Path,
    out: Path | None,
    overrides: Sequence[str] | None = None,
    *,
    resume: bool = False,
    overwrite: bool = False,
) -> Path:
    """The folder that was asked for, or one named after the experiment and, for all but calibrations, the command.

    Whether the experiment's files are there and the folder is free is seen here, before anything heavy is imported.

    Raises:
        InputError: a file is missing, or the folder holds a run that is not to be replaced.
    """
    look_through(experiment, overrides or [])
    title = experiment_name(experiment)
    name = title if command == "calibrate" else f"{title}_{command.split()[0]}"
    folder = out or Path("runs") / name
    check_folder(folder, command, resume=resume, overwrite=overwrite)
    return folder


def experiment_name(experiment: Path) -> str:
    """Name of default folders: the name of the experiment file, or of its folder if the file has a default name."""
    folder = experiment.resolve().parent.name
    if not folder or experiment.stem not in WRITTEN:
        return experiment.stem
    return folder if experiment.stem == "experiment" else f"{folder}_{experiment.stem}"


def see_calibration(folder: Path | None, option: str, *, audit: bool = False) -> None:
    """See that a folder holds a finished calibration, or an ``audit`` if that will do, before anything heavy is
    imported.

    Raises:
        InputError: it does not.
    """
    wanted = ("posterior.nc", *(["audit.json"] if audit else []))
    if folder is not None and not any((folder / name).is_file() for name in wanted):
        raise InputError(
            f"{folder} holds no posterior.nc", where=option, remedy="name the folder of a finished rfdropo calibrate"
        )


def same_command(name: str, *further: str) -> str:
    """The command line that the program ``name`` was called with, and further options; ``--set KEY=`` among them
    replaces an earlier value of the key."""
    arguments = sys.argv[1:]
    keys = tuple(f"{option.split('=')[0]}=" for option in further if "=" in option)
    again = {k for k, (one, two) in enumerate(pairwise(arguments)) if one == "--set" and two.startswith(keys)}
    dropped = {k for k, argument in enumerate(arguments) if argument in ("--resume", "--overwrite")}
    dropped |= again | {k + 1 for k in again}
    kept = [argument for k, argument in enumerate(arguments) if k not in dropped]
    return shlex.join([*name.split(), *kept, *further])
