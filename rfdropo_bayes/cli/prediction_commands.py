"""Commands that predict, and that take a calibration to another day."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rfdropo_bayes.cli.options import Overrides, Overwrite, see_calibration
from rfdropo_bayes.cli.terminal_summary import show_calibration, show_prediction
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.experiment_file import look_through
from rfdropo_bayes.model.run_folder import check_folder

if TYPE_CHECKING:
    pass

Group = Annotated[
    str | None,
    typer.Option("--group", help="group of the commands (a session or robot); by default from [model.groups]"),
]


PredictedGroup = Annotated[
    str | None,
    typer.Option("--group", help="group (a session or robot); by default from adapt, or else from [model.groups]"),
]


Episode = Annotated[int | None, typer.Option("--episode", help="number of the episode, of a LeRobotDataset")]


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
    named = "--from" if fit else "DIR"
    if experiment.is_dir():
        fit, experiment = fit or experiment, experiment / "config.toml"
    if fit is None:
        raise InputError("no calibration was named", where="predict", remedy="add --from, or give a run's folder")
    see_calibration(fit, named)
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
