"""``rfdropo``: every command takes one experiment file, with overrides on the command line."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from rfdropo_bayes import __version__
from rfdropo_bayes.cli import audit, inference, listings, pictures, prediction
from rfdropo_bayes.cli.options import ExperimentFile, OutFolder, Overrides, Resume, folder_for
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.runtime import keep_compilations

INPUT_ERROR, INTERRUPTED = 2, 3

# Typer carries its own copy of click, or uses the installed one, depending on its version.
USAGE_ERROR: type[Exception] = typer.BadParameter.__mro__[1]

app = typer.Typer(
    name="rfdropo",
    help="Probabilistic sim-to-real for soft robots: measured trajectories in, a calibrated simulator out.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


@app.callback(invoke_without_command=True)
def version(show: Annotated[bool, typer.Option("--version", help="print the version and stop")] = False) -> None:
    """Options common to all commands."""
    if show:
        typer.echo(__version__)
        raise typer.Exit
    keep_compilations()


@app.command()
def calibrate(
    experiment: ExperimentFile,
    out: OutFolder = None,
    resume: Resume = False,
    check: Annotated[
        str | None, typer.Option(help="sbc: instead of fitting, check the method on simulated data")
    ] = None,
    datasets: Annotated[int, typer.Option(help="number of data sets of a check")] = 200,
    start: Annotated[
        Path | None,
        typer.Option("--from", help="folder of an earlier calibration of this robot, to start climbs from"),
    ] = None,
    overrides: Overrides = None,
) -> None:
    """Fit the simulator to recordings: writes posterior.nc, summary.json and report.html."""
    from rfdropo_bayes.workflow.calibration import run_calibration

    folder = folder_for(experiment, out)
    if check is not None:
        if start is not None:
            raise InputError("a check has no start", where="--from", remedy="leave it out")
        inference.check(experiment, folder, check, datasets, overrides or [], resume)
        return
    report = run_calibration(experiment, folder, overrides=overrides or [], resume=resume, start=start)
    typer.echo(f"report: {report}")


@app.command()
def simulate(
    experiment: ExperimentFile,
    out: OutFolder = None,
    balance: Annotated[bool, typer.Option(help="also write base reaction, energies and work to the NetCDF")] = False,
    overrides: Overrides = None,
) -> None:
    """Simulate the experiment's commands: writes NetCDF and CSV, prints the error against the recording as JSON."""
    from rfdropo_bayes.workflow.experiment import load_experiment
    from rfdropo_bayes.workflow.simulation import run_simulation

    loaded, _ = load_experiment(experiment, overrides or [])
    report = run_simulation(loaded, experiment.resolve().parent, folder_for(experiment, out), balance)
    typer.echo(json.dumps(report, indent=2))


@app.command()
def report(folder: Annotated[Path, typer.Argument(metavar="DIR", help="what a calibration has written")]) -> None:
    """Write report.html again from the files of a run."""
    from rfdropo_bayes.report import rebuild_report

    typer.echo(f"report: {rebuild_report(folder)}")


app.command()(audit.audit)
app.command()(audit.separate)
app.command()(audit.design)
app.command()(inference.export)
app.command()(pictures.view)
app.command()(prediction.predict)
app.command()(listings.robots)
app.command()(listings.mechanisms)
app.command()(listings.formats)
app.command()(listings.methods)

benchmark = typer.Typer(help="Comparisons that take hours; each can be interrupted and resumed.", no_args_is_help=True)
benchmark.command()(inference.table1)
benchmark.command("audit")(audit.benchmark_audit)
app.add_typer(benchmark, name="benchmark")


def main() -> None:
    """Run the command line; bad input ends with one line on stderr and status 2, an interrupted run with status 3."""
    try:
        sys.exit(app(standalone_mode=False))
    except InputError as error:
        print(f"rfdropo: {error}", file=sys.stderr)
        sys.exit(INPUT_ERROR)
    except USAGE_ERROR as error:
        print(f"rfdropo: {error}; see rfdropo --help", file=sys.stderr)
        sys.exit(INPUT_ERROR)
    except (KeyboardInterrupt, typer.Abort):
        print("rfdropo: interrupted; where the command takes --resume, it goes on from here", file=sys.stderr)
        sys.exit(INTERRUPTED)
