"""``rfdropo init MODEL``: an experiment file for a model of another simulator, from its file and a recording."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.data import DataSpec, group_repeats, load_recordings
from rfdropo_bayes.data.named_columns import METRES, ROWS
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import output_folder
from rfdropo_bayes.model.experiment import Experiment, load_experiment
from rfdropo_bayes.model.model_spec import find_robot
from rfdropo_bayes.simulators.adapters import first_tables
from rfdropo_bayes.tables import parse_table
from rfdropo_bayes.verbs.column_names import Guess
from rfdropo_bayes.verbs.column_units import ANGLES
from rfdropo_bayes.verbs.days import days_of, pieces_of
from rfdropo_bayes.verbs.init import data_tables, quoted, read_back, with_given

OF_CABLE = {"m": tuple(METRES), "rad": ANGLES}  # units of commands in recordings, for each unit of a simulator


def write_model_experiment(
    model: Path, folder: Path, recordings: list[Path], commands: list[Path], guess: Guess | None, kept: int = 0
) -> tuple[Path, list[str]]:
    """Write ``experiment.toml`` for a model's file, and read it back.

    Args:
        model: file of the model, which is not moved.
        folder: folder to create and write to.
        recordings: files to fit; a third, without repeats of fitted commands, or the last ``kept`` are for testing.
        commands: files of commands, one for each recording, if separate.
        guess: guess of the recordings' columns; None without recordings.

    Returns:
        the file, and its assumptions.

    Raises:
        InputError: a model that cannot be read, more markers or commands than it has, or a file that is there already.
    """
    if not model.is_file():
        raise InputError("no such file", where=str(model), remedy="give the path of the model")
    experiment = output_folder(folder) / "experiment.toml"
    if experiment.exists():
        raise InputError(
            "is there already", where=str(experiment), remedy="choose another folder, or move the file away"
        )
    names = [] if guess is None else guess.commands
    tables, assumed = first_tables(model, {} if guess is None else _first_seen(guess, recordings, commands), names)
    name = os.path.relpath(model, folder)
    box: Any = find_robot(name, folder, tables)
    if guess is not None and guess.command_unit not in OF_CABLE.get(box.command_unit, ()):
        guess = with_given(guess, command_unit=box.command_unit)

    def write(data: list[str]) -> Experiment:
        head = [
            "# Written by rfdropo init; docs/reference/experiment.md has every key. Look it over, then: rfdropo check.",
            f"title = {quoted(model.stem)}",
            f"robot = {quoted(name)}",
            "seed = 0",
            "",
        ]
        lines = [*head, *_adapter(tables, assumed), *data, *_inferred(tables)]
        experiment.write_text("\n".join(lines), encoding="utf-8")
        return load_experiment(experiment)[0]

    if guess is None:
        write(_random(box))
        return experiment, assumed
    columns = partial(data_tables, folder, list(tables["markers"]), recordings, commands, guess, kept=kept)
    runs, unread = read_back(write(columns()), folder)
    if len(runs) == len(recordings):
        timed, counts = guess.time is not None or guess.sample_time is not None, [len(run.time) for run in runs]
        write(columns(pieces=pieces_of(counts, days_of(recordings), group_repeats(runs), timed=timed, kept=kept)))
    told = [f"the last third is the test, since a recording was not read: {unread}"] if unread else []
    return experiment, [*assumed, *told]


def _first_seen(guess: Guess, recordings: list[Path], commands: list[Path]) -> dict[str, Float[np.ndarray, "3"] | None]:
    """First seen position of each marker of the first recording."""
    columns: dict[str, Any] = {
        "commands": guess.commands,
        "command_unit": guess.command_unit,
        "positions": guess.positions,
        "position_unit": guess.position_unit,
        "markers": guess.markers,
    }
    columns |= {} if guess.counts_per_turn is None else {"counts_per_turn": guess.counts_per_turn}
    columns |= {"units": dict(guess.units), "names": guess.names, "command_names": guess.command_names}
    if guess.sample_time is None:
        columns |= {"time": guess.time or ROWS, "time_unit": guess.time_unit}
    else:
        columns["sample_time"] = guess.sample_time
    entry = str(recordings[0]) if not commands else {"observations": str(recordings[0]), "commands": str(commands[0])}
    table = {"format": guess.format, "fit": [entry], "columns": columns, "missing": "mask"}
    try:
        run = load_recordings(parse_table(DataSpec, table, where="--recording"), Path(), role="fit")[0]
    except InputError:  # check, the user's next command, reports the fault
        return dict.fromkeys(guess.markers)
    return {marker: run.position[0, k] for k, marker in enumerate(run.marker_names)}


def _adapter(tables: dict[str, Any], assumed: list[str]) -> list[str]:
    """The table [adapter] and its tables."""
    lines = [
        "[adapter]",
        'start = "rest"           # or "settled" under the first command, or the name of a keyframe',
        "",
    ]
    said = {
        "markers": "# Element of each marker: site/NAME, body/NAME or geom/NAME.",
        "channels": "# The actuator of each command, by name, or by number from 0.",
        "parameters": "# Parameters that may be inferred: kind/name/attribute, or * for a factor on all.",
    }
    for key, words in said.items():
        lines += [words, f"[adapter.{key}]"]
        lines += [f"{quoted(name)} = {quoted(value)}" for name, value in tables[key].items()]
        lines.append("")
    return [*(f"# ASSUMED: {line}" for line in assumed), *lines]


def _random(box: Any) -> list[str]:
    step = 0.2 * (box.usual_command or 1.0)
    return [
        "# No recording was given: simulate makes one from random commands. Put [data] in the place of this table.",
        "[commands]",
        "duration = 4.0",
        "interval = 0.2",
        f"step = {step:g}",
        f"low = {-3 * step:g}",
        f"high = {3 * step:g}",
        "sample_time = 0.05",
        'recordings = ["try_1"]',
        "",
    ]


def _inferred(tables: dict[str, Any]) -> list[str]:
    return [
        "[model]",
        "mechanisms = []         # effects of drives and cameras on top: rfdropo mechanisms lists them",
        "",
        "[model.priors]          # parameters to infer; {} asks for the default prior of its kind",
        *(f"{quoted(name)} = {{}}" for name in tables["parameters"]),
        "",
        "[inference]",
        'method = "smc"          # rfdropo methods lists them',
        "rollouts = 20000        # the budget",
        "",
    ]
