"""Commands on results: their pages, parts of a posterior for other programs, and pictures."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from rfdropo_bayes.cli.options import see_calibration
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.run_folder import COMMANDS, CONFIG, PAGE, RUN, command_of, run_ended

JOURNAL, POSTERIOR = "cycles.bin", "posterior.nc"
TO_VIEW = {"predict": "prediction.nc"}


def report(folder: Annotated[Path, typer.Argument(metavar="DIR", help="folder that a run has written")]) -> None:
    """Draw the page of a calibration or a motor session again. Lists the results of other runs."""
    if not folder.is_dir():
        raise InputError("no such folder", where=str(folder), remedy="name the folder that --out gave a run")
    if (folder / JOURNAL).is_file():
        from rfdropo_bayes.verbs.session_report import write_session_page

        typer.echo(f"report: {write_session_page(folder)}")
        return
    if (folder / POSTERIOR).is_file():
        from rfdropo_bayes.report import rebuild_report

        typer.echo(f"report: {rebuild_report(folder)}")
        return
    for line in _say_results(folder):
        typer.echo(line)


def _say_results(folder: Path) -> list[str]:
    """Lines about a folder without a posterior.

    Raises:
        InputError: no run, an unfinished run, or a run whose page is gone.
    """
    command = command_of(folder)
    if command is None or command not in COMMANDS:
        raise InputError("holds no run", where=str(folder), remedy="name the folder that --out gave a run")
    kind = COMMANDS[command]
    if (folder / RUN).is_file() and not run_ended(folder):
        remedy = "go on with it by --resume" if kind.resumable else "run it again with --overwrite"
        raise InputError(f"holds a run of {command} that has not ended", where=str(folder), remedy=remedy)
    if (folder / PAGE).is_file():
        return [f"{command} draws its page once, while it runs; the page is as it was", f"report: {folder / PAGE}"]
    if PAGE in kind.results:
        again = f"rfdropo {command} {shlex.quote(str(folder / CONFIG))} --out ANOTHER_FOLDER"
        raise InputError(
            f"the page of this run of {command} is gone, and its data are not kept",
            where=str(folder),
            remedy=f"run it again: {again}" if (folder / CONFIG).is_file() else "run it again",
        )
    files = [str(folder / name) for name in kind.results if (folder / name).is_file()]
    lines = [f"{command} writes no page; its results:", *(f"  {file}" for file in files)]
    if command in TO_VIEW:
        lines.append(f"to see it: {shlex.join(['rfdropo', 'view', str(folder / TO_VIEW[command])])}")
    return lines


def view(
    source: Annotated[Path, typer.Argument(metavar="EXPERIMENT.toml|FILE.nc", help="experiment or recording to draw")],
    out: Annotated[Path, typer.Option("--out", help=".png, .svg, .pdf, .gif or .mp4")] = Path("runs/view.png"),
    recording: Annotated[
        str | None, typer.Option(help="recording to draw; the first of the experiment by default")
    ] = None,
    robot: Annotated[
        Path | None, typer.Option(help="robot file, for a NetCDF file without a robot file in its folder")
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="NAME=VALUE", help="value of a parameter or of an entry of the experiment, as in simulate"
        ),
    ] = None,
) -> None:
    """Draw a motion. Simulates an experiment, or reads a NetCDF file of simulate or predict."""
    from rfdropo_bayes.verbs.view import run_view

    run_view(source, out, overrides or [], recording, robot)
    typer.echo(out)


def export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="folder of a calibration")],
    phi: Annotated[bool, typer.Option("--phi", help="the distribution to randomise over")] = False,
    model: Annotated[
        bool, typer.Option("--model", help="write the model of another simulator (MJCF) with posterior means")
    ] = False,
    out: Annotated[Path | None, typer.Option("--out", help="folder to write to; DIR by default")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace files of an earlier export")] = False,
) -> None:
    """Write parts of a calibration for other programs. The distribution to randomise over as tables with units, or
    a calibrated model."""
    if not phi and not model:
        raise InputError("nothing to export was named", where="export", remedy="add --phi or --model")
    see_calibration(folder, "DIR")
    from rfdropo_bayes.verbs.export import export_model, export_phi

    paths = export_phi(folder, out, overwrite=overwrite) if phi else []
    if model:
        paths.append(export_model(folder, out, overwrite=overwrite))
    for path in paths:
        typer.echo(str(path))
