"""Commands that draw."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def view(
    source: Annotated[Path, typer.Argument(metavar="EXPERIMENT.toml|FILE.nc", help="experiment or recording to draw")],
    out: Annotated[
        Path, typer.Option("--out", help=".png, .svg, .pdf, .gif, .mp4; NAME.vtk for surfaces; a folder for frames")
    ] = Path("runs/view.png"),
    recording: Annotated[
        str | None, typer.Option(help="recording of the experiment to draw; the first by default")
    ] = None,
    robot: Annotated[Path | None, typer.Option(help="file of the robot, if a NetCDF file has none beside it")] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="NAME=VALUE", help="value of a parameter or of an entry of the experiment, as in simulate"
        ),
    ] = None,
) -> None:
    """Draw a motion. Simulates an experiment, or reads a NetCDF file of simulate or predict."""
    from rfdropo_bayes.verbs.view import run_view

    written = run_view(source, out, overrides or [], recording, robot)
    typer.echo(f"{written[0]}" + (f" and {len(written) - 1} more" if len(written) > 1 else ""))
