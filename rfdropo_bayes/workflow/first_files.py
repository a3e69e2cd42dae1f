"""``rfdropo init``: a commented robot file and experiment file, to go on from."""

from __future__ import annotations

import json
import os
from pathlib import Path

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import matching_files, output_folder
from rfdropo_bayes.robots.catalogue import load_robot
from rfdropo_bayes.robots.outline import RobotOutline, robot_text
from rfdropo_bayes.workflow.column_names import Guess, guess_columns
from rfdropo_bayes.workflow.experiment import load_experiment

PRIORS = (
    ("young_modulus", "how stiff"),
    ("trunk_mass", "how heavy: weigh it, and state it under [[model.weighed]]"),
    ("rayleigh_stiffness", "how damped"),
    ("spool_radius", "cable wound up per angle"),
)


def matching_recordings(patterns: list[str]) -> list[Path]:
    """Files that patterns stand for, in the order of the patterns.

    Raises:
        InputError: a pattern that matches no file.
    """
    files: list[Path] = []
    for pattern in patterns:
        named = Path(pattern)
        anchor = Path(named.anchor)
        below = named.relative_to(anchor) if named.is_absolute() else named
        found = [file for file in matching_files(anchor, below) if file.is_file()]
        if not found:
            raise InputError("matches no file", where=pattern, remedy="give the path of a CSV; quote patterns")
        files += [file for file in found if file not in files]
    return files


def guess_units(path: Path, command_unit: str | None, position_unit: str | None) -> Guess:
    """What the columns of a recording are; units that are given take the place of guessed ones."""
    guess = guess_columns(path)
    return guess._replace(
        command_unit=command_unit or guess.command_unit, position_unit=position_unit or guess.position_unit
    )


def write_first_files(
    folder: Path, outline: RobotOutline, recordings: list[Path], guess: Guess | None
) -> tuple[Path, Path]:
    """Write ``NAME.toml``, the robot, and ``experiment.toml``, and read both back.

    Args:
        folder: to write to; it is made.
        outline: the robot.
        recordings: files to fit; of several, the last one is for testing.
        guess: what their columns are; None without recordings, when random commands are simulated instead.

    Raises:
        InputError: files of these names are there already, or the folder cannot be written to.
    """
    folder = output_folder(folder)
    robot, experiment = folder / f"{outline.name}.toml", folder / "experiment.toml"
    for path in (robot, experiment):
        if path.exists():
            raise InputError("is there already", where=str(path), remedy="choose another folder, or move the file away")
    robot.write_text(robot_text(outline), encoding="utf-8")
    load_robot(robot)
    data = _random_commands(outline) if guess is None else _data(folder, outline, recordings, guess)
    experiment.write_text("\n".join([*_head(outline.name), *data, *_model(outline, guess)]), encoding="utf-8")
    load_experiment(experiment)
    return robot, experiment


def _head(name: str) -> list[str]:
    return [
        "# Written by rfdropo init; docs/reference/experiment.md has every key. Look it over, then: rfdropo check.",
        f'title = "{name}"',
        f'robot = "{name}.toml"',
        "seed = 0",
        "",
    ]


def _data(folder: Path, outline: RobotOutline, recordings: list[Path], guess: Guess) -> list[str]:
    names = [os.path.relpath(path, folder) for path in recordings]
    fit, test = (names, []) if len(names) == 1 else (names[:-1], names[-1:])
    optional = [
        f"{key} = {json.dumps(values)}"
        for key, values in (("tensions", guess.tensions), ("motor_angles", guess.motor_angles))
        if values
    ]
    left = [f"# not used: {', '.join(guess.left)}"] if guess.left else []
    return [
        "[data]",
        'format = "csv"',
        f"fit = {json.dumps(fit)}",
        f"test = {json.dumps(test)}  # recordings that no fit ever sees: they say how good the fit is",
        "",
        "# Guessed from the names and sizes of the columns: look them over.",
        "[data.columns]",
        f'time = "{guess.time}"' if guess.time else "sample_time = 0.05  # ASSUMED: seconds from row to row",
        *([f'time_unit = "{guess.time_unit}"'] if guess.time else []),
        f"commands = {json.dumps(guess.commands)}  # one for each of the robot's channels, in their order",
        f'command_unit = "{guess.command_unit}"',
        "positions = [",
        *(f"    {json.dumps(triple)}," for triple in guess.positions),
        "]",
        f'position_unit = "{guess.position_unit}"',
        f"markers = {json.dumps(list(outline.markers))}  # the robot's names, in the order of positions",
        "# x, y, z of the robot's base in terms of the file's axes: z runs away from the clamp.",
        'axes = ["x", "y", "z"]',
        *optional,
        *left,
        "",
    ]


def _random_commands(outline: RobotOutline) -> list[str]:
    step = 0.2 if outline.command_unit == "rad" else round(0.02 * outline.length, 4)
    return [
        "# No recording was given: simulate makes one from random commands. Put [data] in the place of this table.",
        "[commands]",
        "duration = 4.0",
        "interval = 0.2",
        f"step = {step:g}",
        f"low = {0.0 if not outline.pairs else -3 * step:g}",
        f"high = {3 * step:g}",
        "sample_time = 0.05",
        'recordings = ["try_1"]',
        "",
    ]


def _model(outline: RobotOutline, guess: Guess | None) -> list[str]:
    wanted = [(name, why) for name, why in PRIORS if name != "spool_radius" or outline.command_unit == "rad"]
    uses = []
    if guess is not None and guess.tensions:
        uses.append("tension = true          # forces are data: they fix the scale of stiffness and mass")
    if guess is not None and guess.motor_angles and outline.command_unit == "rad":
        uses.append("motor_angle = true      # so are measured motor angles")
    return [
        "[model]",
        "mechanisms = []         # effects on top of the base simulator: rfdropo mechanisms lists them",
        *uses,
        "",
        "[model.priors]          # what to infer; {} asks for the robot file's prior",
        *(f"{name} = {{}}  # {why}" for name, why in wanted),
        "",
        "[inference]",
        'method = "smc"          # rfdropo methods lists them',
        "rollouts = 20000        # the budget",
        "",
    ]
