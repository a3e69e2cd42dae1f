"""``rfdropo``: every command takes one experiment file, with overrides on the command line."""

from __future__ import annotations

import errno
import sys
from pathlib import Path
from typing import Annotated

import typer

from rfdropo_bayes import __version__
from rfdropo_bayes.cli import (
    audit_commands,
    check_command,
    init_command,
    listing_commands,
    motor_commands,
    policy_commands,
    prediction_commands,
    result_commands,
)
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
from rfdropo_bayes.cli.terminal_summary import show_calibration, show_simulation
from rfdropo_bayes.errors import InputError, Interrupted
from rfdropo_bayes.files import unwritten
from rfdropo_bayes.interrupts import EXIT_STATUS, NOTHING_LOST, watch_interrupts
from rfdropo_bayes.runtime import keep_compilations

INPUT_ERROR = 2
# A full or protected disk is not a fault of the program.
OF_THE_USER = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.EISDIR, errno.ENOTDIR)

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


def calibrate(
    experiment: ExperimentFile,
    out: OutFolder = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
    fit: Annotated[
        Path | None,
        typer.Option(
            "--from", help="folder of an earlier calibration or audit of this robot, at which optimisations start"
        ),
    ] = None,
    overrides: Overrides = None,
) -> None:
    """Fit the simulator to recordings. Writes posterior.nc, summary.json and report.html."""
    see_calibration(fit, "--from", audit=True)
    folder = folder_for("calibrate", experiment, out, overrides, resume=resume, overwrite=overwrite)
    from rfdropo_bayes.model.model import Model
    from rfdropo_bayes.verbs.calibrate import calibrate as run_fit

    model = Model.read(experiment, overrides)
    result = run_fit(model, out=folder, fit=fit, resume=resume, overwrite=overwrite)
    show_calibration(result, experiment)


def simulate(
    experiment: ExperimentFile, out: OutFolder = None, overwrite: Overwrite = False, overrides: Overrides = None
) -> None:
    """Simulate the commands of an experiment. Writes NetCDF and CSV, prints the error against the recordings."""
    folder = folder_for("simulate", experiment, out, overrides, overwrite=overwrite)
    from rfdropo_bayes.inference.progress import say_step
    from rfdropo_bayes.model.model import Model
    from rfdropo_bayes.verbs.simulate import simulate_all

    say_step(f"simulating the recordings of {experiment}")
    content = simulate_all(Model.read(experiment, overrides), folder, overwrite=overwrite)
    show_simulation(content)


# In the order in which they are used, which --help shows.
for command in (
    init_command.init,
    check_command.check,
    simulate,
    result_commands.view,
    calibrate,
    result_commands.report,
    audit_commands.audit,
    audit_commands.design,
    prediction_commands.predict,
    prediction_commands.adapt,
    result_commands.export,
    policy_commands.train,
    policy_commands.evaluate,
):
    app.command()(command)
motor_commands.register(app)
for listing in (
    listing_commands.robots,
    listing_commands.mechanisms,
    listing_commands.formats,
    listing_commands.methods,
):
    app.command()(listing)


def main() -> None:
    """Run the command line of the package."""
    run(app, "rfdropo")


def run(commands: typer.Typer, name: str) -> None:
    """Run a command line; bad input ends with one line on stderr and status 2, an interrupted run with status 3."""
    try:
        watch_interrupts()
        # Not commands(): Typer's own main keeps KeyboardInterrupt to itself.
        command = typer.main.get_command(commands)
        with command.make_context(name, sys.argv[1:]) as context:
            command.invoke(context)
        sys.exit(0)
    except typer.Exit as done:
        sys.exit(done.exit_code)
    except InputError as error:
        print(f"{name}: {error}", file=sys.stderr)
        sys.exit(INPUT_ERROR)
    except USAGE_ERROR as error:
        if len(sys.argv) == 1:  # no argument is a question for help
            print(error)
            sys.exit(0)
        print(f"{name}: {error}; see {name} --help", file=sys.stderr)
        sys.exit(INPUT_ERROR)
    except OSError as error:
        if error.filename is None or error.errno not in OF_THE_USER:
            raise
        print(f"{name}: {unwritten(error, Path(error.filename))}", file=sys.stderr)
        sys.exit(INPUT_ERROR)
    except (KeyboardInterrupt, typer.Abort) as stop:
        print(f"{name}: {_after(stop, name)}", file=sys.stderr)
        sys.exit(EXIT_STATUS)


def _after(stop: BaseException, name: str) -> str:
    """Next step for the user after an interrupt."""
    if isinstance(stop, Interrupted) and stop.going_on is not None:
        command = same_command(name, *stop.going_on.split())
        return f"interrupted; finished work is kept in {stop.folder}; to go on: {command}"
    if isinstance(stop, Interrupted):
        return f"interrupted; {stop.folder} holds no result; to start again: {same_command('rfdropo')}"
    return NOTHING_LOST
