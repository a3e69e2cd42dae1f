"""Parts of a posterior for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rfdropo_bayes.cli.options import see_calibration
from rfdropo_bayes.errors import InputError


def export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="folder of a calibration")],
    phi: Annotated[bool, typer.Option("--phi", help="the distribution to randomise over")] = False,
    posterior: Annotated[bool, typer.Option("--posterior", help="a posterior.nc without its predictions")] = False,
    model: Annotated[
        bool, typer.Option("--model", help="the model of another simulator (MJCF), with posterior means in it")
    ] = False,
    out: Annotated[Path | None, typer.Option("--out", help="folder to write to; DIR by default")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace files of an earlier export")] = False,
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
