"""``rfdropo init``: a commented robot file and experiment file, to go on from."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rfdropo_bayes.data import Trajectory, group_repeats, lerobot, load_recordings, motive_csv, rosbag
from rfdropo_bayes.data.counters import Column, Motion, quoted_key, read_on, turns_of, wraps_of
from rfdropo_bayes.data.mapped_formats import recognised_format
from rfdropo_bayes.data.named_columns import COUNTS, METRES, ROWS
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import matching_files, output_folder
from rfdropo_bayes.model.experiment import Experiment, load_experiment
from rfdropo_bayes.model.model_spec import spec_of
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.robots.outline import RobotOutline, outlined_tables, robot_text
from rfdropo_bayes.tables import parse_table
from rfdropo_bayes.verbs.column_names import Guess, lost_positions, names_of
from rfdropo_bayes.verbs.column_units import SHORT_PRESSURE, Unit, pressure_unit, unit_of_places
from rfdropo_bayes.verbs.command_lag import errors_by_row
from rfdropo_bayes.verbs.days import Piece, days_of, group_lines, last_third, pieces_of
from rfdropo_bayes.verbs.installation import DriveZero, installed_mechanisms, installed_priors, zero_of_drives
from rfdropo_bayes.verbs.placement import frame_lines, moved_frame
from rfdropo_bayes.verbs.registration import Frame, register
from rfdropo_bayes.verbs.slow_motion import slow_motion
from rfdropo_bayes.verbs.unit_by_motion import bends_too_far, lengths_for_angles, spread, unit_of_motion

NO_TIMES = "no column was recognised as times; give --sample-time if rows are evenly spaced in time"
NO_MOTION = "rows have no times, so each is taken for a robot at rest"
READ = "the commands are readings of the drives, taken with the pose of their row"
NAMED = re.compile(r"motor|servo|joint|theta|angle|enc|pull|cable|tendon|length|travel|displ|pos|wire", re.IGNORECASE)
"""Names of commands that are lengths of cable or angles of motors."""
CAPTURED = (motive_csv.FORMAT, rosbag.FORMAT)  # formats that come from motion capture, which loses markers now and then
FORCES = (0.2, 2.5)  # least and largest force of a command over an assumed force
FAR_ORIGIN = 0.1  # share of the body's length: a frame whose origin lies farther from the base is moved there
AXES = {"+z": ["x", "z", "-y"], "-z": ["x", "-z", "y"]}
"""The base's axes in terms of Motive's, whose y axis points up: of a robot that hangs, and of one that stands."""


ROLES: tuple[Literal["fit", "test"], ...] = ("fit", "test")


def quoted(value: object) -> str:
    """Text, numbers or lists of them as TOML; letters of every alphabet stay as they are."""
    return json.dumps(value, ensure_ascii=False)


def matching_recordings(patterns: list[str]) -> list[Path]:
    """Files and folders of recordings that patterns stand for, in the order of the patterns.

    Raises:
        InputError: a pattern that matches nothing, or files of several formats.
    """
    files: list[Path] = []
    for pattern in patterns:
        named = Path(pattern)
        anchor = Path(named.anchor)
        below = named.relative_to(anchor) if named.is_absolute() else named
        matching = matching_files(anchor, below)
        if not matching:
            raise InputError("matches no file", where=pattern, remedy="give the path of a recording; quote patterns")
        files += [file for file in matching if file not in files]
    formats = {recognised_format(file): file for file in files}
    if len(formats) > 1:
        said = ", ".join(f"{format} ({file.name})" for format, file in formats.items())
        raise InputError(f"recordings of several formats: {said}", where="--recording", remedy="give those of one")
    return files


def matching_commands(patterns: list[str], recordings: list[Path]) -> list[Path]:
    """Files of commands that patterns stand for, one for each recording, or none.

    Raises:
        InputError: a pattern that matches nothing, or another number of files.
    """
    files = matching_recordings(patterns)
    if files and len(files) != len(recordings):
        raise InputError(
            f"{len(files)} files of commands for {len(recordings)} recordings",
            where="--commands",
            remedy="give one for each, in the same order",
        )
    return files


def with_given(guess: Guess, **given: Any) -> Guess:
    """A guess with given values in place of guessed values: units, and the time from row to row [s]."""
    given = {key: value for key, value in given.items() if value is not None}
    settled = {*given, *(("time", "time_unit") if "sample_time" in given else ())}
    evidence = {key: words for key, words in guess.evidence.items() if key not in settled}
    of_others = {"command_unit": guess.commands, "position_unit": names_of(guess.positions)}
    same = [name for key, names in of_others.items() if key in given for name in names]
    units = {name: unit for name, unit in guess.units.items() if name not in same}
    return guess._replace(**given, evidence=evidence, units=units)


def with_counts(guess: Guess, counts: float | None, unit_given: bool) -> Guess:
    """A guess with the counts of one turn; whoever gives them, and no unit (``unit_given``), has commands in counts.

    Raises:
        InputError: counts of one turn are not positive, or commands are in another unit than counts.
    """
    if counts is None:
        return guess
    if counts <= 0.0:
        raise InputError(f"{counts:g} counts in one turn", where="--counts-per-turn", remedy="give a positive number")
    if not guess.counts and unit_given:
        remedy = "leave it out, or give --command-unit counts"
        raise InputError(f"commands are in {guess.command_unit}", where="--counts-per-turn", remedy=remedy)
    unit = guess.command_unit if guess.counts else COUNTS
    return guess._replace(counts_per_turn=counts, command_unit=unit)


def with_turns(guess: Guess) -> Guess:
    """A guess whose counters are read on across their turns, if they jump by a known turn and no marker follows."""
    rows = np.arange(len(guess.sent), dtype=float)
    if len(guess.seen) != len(rows):
        return guess
    turns = turns_of(guess.command_unit, guess.counts_per_turn, guess.sent)
    columns = [Column(name, own, turns) for name, own in zip(guess.commands, guess.sent.T, strict=True)]
    wraps = wraps_of(columns, Motion(rows, rows, guess.seen.reshape(len(rows), -1)))
    unwrap = {name: each.turn for name, each in wraps.items() if each.known}
    return guess._replace(unwrap=unwrap, sent=read_on(guess.sent, guess.commands, unwrap))


def from_the_tip(guess: Guess) -> bool:
    """Whether the columns of the markers go from the tip to the base: each moves less than the one before."""
    motion = [spread(guess.seen[:, [number]]) for number in range(len(guess.markers))]
    return len(motion) > 1 and bool(np.all(np.diff(motion) < 0.0))


def of_robot(guess: Guess, outline: RobotOutline) -> Guess:
    """A guess with units that suit the robot, and without tensions of motors with two cables."""
    if outline.pairs and guess.tensions:
        guess = guess._replace(tensions=[], unused=[*guess.unused, *guess.tensions])
    if "markers" in outline.assumed:
        return guess
    unit = unit_of_places(guess.start, outline.markers) if "position_unit" in guess.evidence else None
    if unit is not None:
        guess = guess._replace(position_unit=unit.unit, evidence={**guess.evidence, "position_unit": unit.evidence})
    return _moved(guess, outline) if "command_unit" in guess.evidence and not guess.units else guess


def _moved(guess: Guess, outline: RobotOutline) -> Guess:
    """A guess with the unit of the commands that bends the robot as far as its markers moved."""
    robot = parse_table(Robot, outlined_tables(outline), where="outline")
    if len(guess.commands) != len(robot.channel_names) or len(guess.positions) != len(outline.markers):
        return guess
    seen = METRES[guess.position_unit] * guess.seen
    guessed = Unit(guess.command_unit, evidence=guess.evidence["command_unit"])
    unit = unit_of_motion(robot, guess.sent, seen, outline.markers, guessed)
    return guess._replace(command_unit=unit.unit, evidence={**guess.evidence, "command_unit": unit.evidence})


def with_drives(guess: Guess, outline: RobotOutline) -> tuple[Guess, RobotOutline]:
    """A guess and a robot with drives of another kind, if the motion shows that no unit of the guessed kind is right.

    Angles that no body bends by, of spools of unknown size, are millimetres of cable if these explain the motion.
    Lengths that no name says are inputs of drives of unknown force if they would bend the robot much farther than its
    markers moved, even in millimetres. If their names are p1, p2, ..., they are pressures then.
    """
    evidence = guess.evidence.get("command_unit", "")
    robot = parse_table(Robot, outlined_tables(outline), where="outline")
    fits = len(guess.commands) == len(robot.channel_names) and len(guess.positions) == len(outline.markers)
    if not evidence or guess.units or not fits or "markers" in outline.assumed:
        return guess, outline
    seen, heights = METRES[guess.position_unit] * guess.seen, list(outline.markers.values())
    if guess.command_unit in ("rad", "deg") and "spool_radius" in outline.assumed:
        lengths = replace(outline, command_unit="m", assumed=outline.assumed - {"spool_radius"})
        pulled = parse_table(Robot, outlined_tables(lengths), where="outline")
        words = lengths_for_angles(robot, pulled, guess.sent, seen, heights)
        if words is not None:
            said = {**guess.evidence, "command_unit": f"{evidence}, {words}"}
            return guess._replace(command_unit="mm", evidence=said), lengths
    named = any(NAMED.search(name) for name in guess.commands)
    if named or outline.pairs or outline.command_unit != "m":
        return guess, outline
    words = bends_too_far(robot, METRES["mm"] * guess.sent, seen, heights)
    if words is None:
        return guess, outline
    if all(SHORT_PRESSURE.fullmatch(name) for name in guess.commands):
        unit, meant = pressure_unit(float(np.nanmax(np.abs(guess.sent)))), "pressures, not lengths"
        assumed = outline.assumed | ({"area"} if outline.area is None else set())
        driven = replace(outline, command_unit="Pa", assumed=assumed)
    else:
        unit, meant = "-", "forces of unknown size that pull; --command-unit kPa makes them pressures that push"
        driven = replace(outline, command_unit="-")
    said = {**guess.evidence, "command_unit": f"{evidence}; {words}: {meant}"}
    return guess._replace(command_unit=unit, evidence=said), driven


def write_first_files(
    folder: Path,
    outline: RobotOutline,
    recordings: list[Path],
    commands: list[Path],
    guess: Guess | None,
    kept: int = 0,
) -> tuple[Path, Path, str]:
    """Write ``NAME.toml``, the robot, and ``experiment.toml``, and read both back.

    Returns both, and why no recording can be read, in words: frame, size and order of cables are then not found.

    Args:
        folder: folder to create and write to.
        outline: the robot.
        recordings: files to fit; without ``kept`` the last third is for testing: of several recordings, of the
            episodes of a dataset, and of the rows of a single recording.
        commands: files of commands, one for each recording, if separate.
        guess: guess of the recordings' columns, see `of_robot`; None without recordings, if random commands are
            simulated.
        kept: number of recordings for testing, the last of all.

    Raises:
        InputError: the files exist already, or the folder cannot be written to.
    """
    folder = output_folder(folder)
    robot, experiment = folder / f"{outline.name}.toml", folder / "experiment.toml"
    for path in (robot, experiment):
        if path.exists():
            raise InputError("is there already", where=str(path), remedy="choose another folder, or move the file away")
    robot.write_text(robot_text(outline), encoding="utf-8")
    made = Robot.load(robot)

    def write(
        data: list[str],
        slow: str | None = None,
        first: Trajectory | None = None,
        seen: Frame | None = None,
        gain: float = 1.0,
    ) -> Experiment:
        model = _model(made, outline, guess, first, seen, gain, zero, rests=slow is not None)
        lines = [*_head(outline.name), *data, *_simulator(slow), *model, *group_lines(days)]
        experiment.write_text("\n".join(lines), encoding="utf-8")
        return load_experiment(experiment)[0]

    days, zero = days_of(recordings), None  # type: tuple[Any, DriveZero | None]
    if guess is None:
        write(_random_commands(outline))
        return robot, experiment, ""
    known: dict[str, Any] = {"gravity": outline.gravity, "cables": outline.cable_names(), "kept": kept}
    tables = partial(data_tables, folder, outline.markers, recordings, commands, guess=guess, **known)
    plain = write(tables())
    runs, unread = read_back(plain, folder)
    if not runs:
        return robot, experiment, unread
    first = runs[0]
    if first.command_unit in ("m", "rad"):
        zero = zero_of_drives(runs, wraps=bool(guess.reads_drives and guess.unwrap))
    sent = np.vstack([first.initial_command, first.command])
    usual = float(np.max(np.abs(sent if zero is None else sent - zero.command)))
    outline = replace(outline, usual_command=usual or None)
    robot.write_text(robot_text(outline), encoding="utf-8")
    made = Robot.load(robot)
    timed = guess.time is not None or guess.sample_time is not None
    frame = [f"{line}  # ASSUMED: found from the first row" for line in _frame(plain, made, guess)]
    slow = slow_motion(made, first) if timed else NO_MOTION
    counts = [len(run.time) for run in runs]
    pieces = (
        pieces_of(counts, days, group_repeats(runs), rests=slow is not None, timed=timed, kept=kept)
        if len(runs) == len(recordings)
        else None
    )
    poses = READ if guess.reads_drives else None if slow is None else _of_poses(first, timed)
    poses = None if guess.command_time is not None else poses
    tables = partial(tables, pieces=pieces, poses=poses)
    placed = write(tables(frame=frame), slow, first)
    runs, unread = read_back(placed, folder)
    columns = None if placed.data is None else placed.data.columns
    if not runs or columns is None or not usual:
        return robot, experiment, unread
    seen = runs[0]
    bends = outline.sets_bend is not None
    scaled, stiff = ("length" in outline.assumed), ("young_modulus" in outline.assumed)
    straight = None if zero is None else zero.command
    registration = register(spec_of(placed, folder), seen, scaled=scaled, bends=bends, stiff=stiff, zero=straight)
    ordered, order = guess, None
    if registration.arrangement is not None:
        turns = np.degrees(registration.arrangement.turns)
        azimuths = tuple(round(float(a + t), 1) % 360.0 for a, t in zip(outline.first_azimuths(), turns, strict=True))
        evidence = registration.evidence if any(registration.arrangement.turns) else ""
        outline = replace(outline, segment_azimuths=azimuths, azimuth_evidence=evidence)
        beside: dict[str, Any] = {
            key: [names[column] for column in registration.arrangement.columns]
            for key in ("commands", "tensions", "motor_angles")
            if (names := getattr(guess, key))
        }
        ordered = guess._replace(**beside)
        order = registration.evidence if ordered.commands != guess.commands else None
    explained = (
        None
        if registration.frame is None
        else f"a rod at rest explains {100 * registration.frame.explained:.3g} % of the motion"
    )
    if registration.frame is not None:
        sizes = (registration.frame.scale, registration.bend, registration.softness)
        outline = outline if sizes == (1.0, 1.0, 1.0) else outline.resized(*sizes, f"{explained} with them")
    robot.write_text(robot_text(outline), encoding="utf-8")
    made = Robot.load(robot)
    if registration.frame is not None:
        turned = registration.frame.quarter.T
        if not np.allclose(turned, np.eye(3)) or np.linalg.norm(registration.frame.shift) > FAR_ORIGIN * made.length:
            lines = moved_frame(columns, turned, -turned @ registration.frame.shift)
            frame = [f"{line}  # ASSUMED: {explained} in this frame" for line in lines]
            registration = registration._replace(frame=registration.frame._replace(shift=np.zeros(3)))
    force = 1.0 if outline.sets_bend == "area" else registration.bend / registration.softness
    gain = float(np.clip(force, *FORCES))
    write(tables(guess=ordered, frame=frame, order=order), slow, first, registration.frame, gain)
    return robot, experiment, unread


def _of_poses(first: Trajectory, timed: bool) -> str | None:
    """Reason to take the command of a row for the command of its pose; None if the pose follows the row before."""
    if not timed:
        return NO_MOTION
    own, before = errors_by_row([first], (0, 1))
    if own.error > before.error:
        return None
    errors = f"{1e3 * own.error:.3g} mm, of the row before {1e3 * before.error:.3g} mm"
    return f"a quadratic map of the commands of a pose's own row leaves {errors}"


def read_back(experiment: Experiment, folder: Path) -> tuple[list[Trajectory], str]:
    """The recordings of fit and test; if one cannot be read, none, and the reason."""
    if experiment.data is None:
        return [], ""
    try:
        return [run for role in ROLES for run in load_recordings(experiment.data, folder, role)], ""
    except InputError as error:
        return [], str(error)


def _frame(experiment: Experiment, robot: Robot, guess: Guess) -> list[str]:
    """Lines of [data.columns] that bring the first row to the robot; empty if it is there already, or if no frame fits.

    Motive's y axis points up: with the direction of gravity its axes are known, and only the origin is searched.
    """
    if experiment.data is None or experiment.data.columns is None:
        return []
    columns = experiment.data.columns
    lines = frame_lines(robot, guess.start, columns)
    turned = lines and lines[0] != f"axes = {quoted(columns.axes)}"
    return [] if turned and guess.format == motive_csv.FORMAT else lines


def _head(name: str) -> list[str]:
    return [
        "# Written by rfdropo init; docs/reference/experiment.md has every key. Look it over, then: rfdropo check.",
        f'title = "{name}"',
        f'robot = "{name}.toml"',
        "seed = 0",
        "",
    ]


def _entries(
    folder: Path, recordings: list[Path], commands: list[Path], guess: Guess, pieces: Sequence[Piece] | None, kept: int
) -> tuple[list[str], list[str]]:
    """The entries of fit and of test; without pieces the last ``kept`` recordings, or the last third, are the test."""
    entries: list[dict[str, Any]] = [{"observations": os.path.relpath(path, folder)} for path in recordings]
    if commands:
        sent = [os.path.relpath(path, folder) for path in commands]
        entries = [{**entry, "commands": file} for entry, file in zip(entries, sent, strict=True)]
    elif guess.format == lerobot.FORMAT and len(entries) == 1:
        episodes = lerobot.episode_numbers(recordings[0])
        unseen = last_third(episodes)
        shares = [episodes[: len(episodes) - len(unseen)], unseen] if unseen else [episodes]
        entries = [{**entries[0], "episodes": share} for share in shares]
        pieces = None
    tested = range(len(entries))[-kept:] if kept else last_third(range(len(entries)))
    chosen = pieces or [Piece(number, {}, number in tested) for number in range(len(entries))]
    said: tuple[list[str], list[str]] = ([], [])
    for piece in chosen:
        entry = {**entries[piece.file], **piece.rows}
        text = ", ".join(f"{key} = {quoted(value)}" for key, value in entry.items())
        said[piece.tested].append(quoted(entry["observations"]) if len(entry) == 1 else f"{{{text}}}")
    return said


def assumed_of_columns(guess: Guess) -> list[str]:
    """Assumptions and omissions of `data_tables` that no recording can settle; a sentence each."""
    said = [f"{key} = {quoted(getattr(guess, key))}: {words}" for key, words in guess.evidence.items()]
    if guess.time is None and guess.sample_time is None:
        said.append(f'time = "{ROWS}": {NO_TIMES}')
    if guess.command_time is not None:
        said.append("command_offset = 0.0: the clocks of commands and observations begin together")
    if guess.unused:
        said.append(f"columns that are not used: {', '.join(guess.unused)}")
    return said


def data_tables(
    folder: Path,
    markers: Iterable[str],
    recordings: list[Path],
    commands: list[Path],
    guess: Guess,
    gravity: str = "",
    frame: Sequence[str] = (),
    cables: Sequence[str] = (),
    pieces: Sequence[Piece] | None = None,
    poses: str | None = None,
    order: str | None = None,
    kept: int = 0,
) -> list[str]:
    """The tables [data] and [data.columns] of a first experiment, as lines; ``gravity`` as `RobotOutline` has it, and
    ``kept`` as `write_first_files`.

    ``frame`` are the lines of axes and origin with their evidence, if a recording determines them; ``cables`` the
    robot's, one for each command, if tensions of them were measured; ``pieces`` see `pieces_of`; ``poses`` the reason
    to take each command for that of the pose in its row; ``order`` the reason for another order of the commands than
    the file's.
    """
    fit, test = _entries(folder, recordings, commands, guess, pieces, kept)
    lost = lost_positions(recordings, guess)
    counted = f" ({', '.join(f'{name}: {count} empty cells' for name, count in lost.items())})" if lost else ""
    masked = [f'missing = "mask"  # positions that motion capture lost are left out{counted}']
    masked = masked if lost or guess.format in CAPTURED else []
    axes, assumed = ["x", "y", "z"], ""
    if guess.format == motive_csv.FORMAT:
        axes, assumed = AXES.get(gravity, axes), "  # ASSUMED: Motive's y axis points up"
    optional = [f"tensions = {quoted(guess.tensions)}"] if guess.tensions else []
    optional = [f"cables = {quoted(list(cables))}"] * bool(optional and cables) + optional
    if guess.motor_angles:
        optional += [f"motor_angles = {quoted(guess.motor_angles)}", _guessed_line(guess, "motor_angle_unit")]
    counts = [] if guess.counts_per_turn is None else [f"counts_per_turn = {guess.counts_per_turn:.9g}  # of the spool"]
    wraps = ", ".join(f"{quoted_key(name)} = {turn:.10g}" for name, turn in guess.unwrap.items())
    if wraps:
        counts.append(f"unwrap = {{{wraps}}}  # ASSUMED: the columns jump by this turn, and no marker follows")
    unused = [f"# not used: {', '.join(guess.unused)}"] if guess.unused else []
    return [
        "[data]",
        f'format = "{guess.format}"',
        f"fit = [{', '.join(fit)}]",
        f"test = [{', '.join(test)}]"
        + ("" if kept or not test else "  # ASSUMED: kept from the fit; --test names others"),
        *masked,
        "",
        "# Guessed from the names and sizes of the columns: look them over.",
        "[data.columns]",
        *([] if guess.names is None else [f"names = {quoted(guess.names)}  # of all columns: the file has none"]),
        *([] if guess.command_names is None else [f"command_names = {quoted(guess.command_names)}"]),
        *_clock(guess),
        f"commands = {quoted(guess.commands)}  # one for each of the robot's channels, in their order"
        + (f"; ASSUMED: {order}" if order else ""),
        _guessed_line(guess, "command_unit"),
        *counts,
        *_other_units(guess),
        *_command_clock(guess),
        *([f"commands_with_poses = true  # ASSUMED: {poses}"] if poses else []),
        "positions = [",
        *(f"    {quoted(triple)}," for triple in guess.positions),
        "]",
        _guessed_line(guess, "position_unit"),
        f"markers = {quoted(list(markers))}  # the robot's names, in the order of positions",
        "# x, y, z of the robot's base in terms of the file's axes: z runs away from the clamp.",
        *(frame or [f"axes = {quoted(axes)}{assumed}"]),
        *optional,
        *unused,
        "",
    ]


def _guessed_line(guess: Guess, key: str) -> str:
    """The line of a unit or column, with the evidence of one that was guessed."""
    evidence = guess.evidence.get(key)
    return f"{key} = {quoted(getattr(guess, key))}" + (f"  # ASSUMED: {evidence}" if evidence else "")


def _other_units(guess: Guess) -> list[str]:
    if not guess.units:
        return []
    listed = ", ".join(f"{quoted(name)} = {quoted(unit)}" for name, unit in guess.units.items())
    return [f"units = {{{listed}}}  # of columns in other units than command_unit or position_unit"]


def _clock(guess: Guess) -> list[str]:
    """The times of the observations."""
    if guess.sample_time is not None:
        stated = "sample_time" in guess.evidence
        given = f"sample_time = {guess.sample_time:g}  # seconds from row to row"
        return [_guessed_line(guess, "sample_time") if stated else given]
    if guess.time is None:
        return [f'time = "{ROWS}"  # ASSUMED: {NO_TIMES}']
    if guess.format == rosbag.FORMAT:
        return ['time = "header"  # stamps if messages have them; "log": the times at which they were received']
    return [_guessed_line(guess, "time"), _guessed_line(guess, "time_unit")]


def _command_clock(guess: Guess) -> list[str]:
    """The times of commands in a separate file."""
    if guess.command_time is None:
        return []
    return [
        f"command_time = {quoted(guess.command_time)}",
        _guessed_line(guess, "command_time_unit"),
        "# ASSUMED: both clocks begin together. Else: reading of the observations' clock [s] when the "
        "commands' clock shows zero.",
        "command_offset = 0.0",
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


def _simulator(slow: str | None) -> list[str]:
    """The table [simulator] for rows that are slow, given why."""
    if slow is None:
        return []
    return [
        "[simulator]",
        f"# ASSUMED: {slow}. rfdropo check compares",
        '# both motions on these commands. "dynamic" has damping, time steps, and a mass that its motion shows.',
        'motion = "quasi-static"  # every row is an equilibrium',
        "",
    ]


def _model(
    robot: Robot,
    outline: RobotOutline,
    guess: Guess | None,
    first: Trajectory | None,
    seen: Frame | None,
    gain: float,
    zero: DriveZero | None,
    *,
    rests: bool,
) -> list[str]:
    """The tables [model] and [inference]; ``seen`` is the frame in which a rod at rest explains the recording."""
    mechanisms, tensions = installed_mechanisms(robot, outline.assumed), guess is not None and bool(guess.tensions)
    wanted = ["young_modulus = {}  # over the body's weight: how stiff it is"]
    if tensions or robot.command_unit in ("N", "N m"):
        wanted.append("trunk_mass = {}  # weigh it, and state it under [[model.weighed]]")
    if robot.command_unit == "rad":
        wanted.append("spool_radius = {}  # cable wound up per angle")
    if not rests:
        wanted.append("rayleigh_stiffness = {}  # damping")
    uses = ["tension = true          # forces are data: they fix the scale of stiffness and mass"] if tensions else []
    if guess is not None and guess.motor_angles and robot.command_unit == "rad":
        uses.append("motor_angle = true      # so are measured motor angles")
    return [
        "[model]",
        "# The measuring frame and the drives as they are installed; rfdropo mechanisms lists further effects.",
        f"mechanisms = {quoted(mechanisms)}",
        'noise = "white"         # laplace finds how many rows an error lasts, and counts rows by it',
        *uses,
        "",
        "[model.priors]          # inferred parameters; {} asks for the prior of the robot file or of the mechanism",
        *wanted,
        *installed_priors(robot, first, seen, outline.assumed, gain, zero),
        "",
        "[inference]",
        'method = "laplace"      # rfdropo methods lists them',
        *(["blocks = 1              # rows at rest do not depend on the rows before them"] if rests else []),
        "minutes = 3             # time limit of calibrate on its machine, report included",
        "",
    ]
