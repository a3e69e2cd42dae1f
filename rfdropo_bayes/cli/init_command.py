"""The command that writes a first robot file and experiment file."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rfdropo_bayes.errors import InputError

if TYPE_CHECKING:
    from rfdropo_bayes.robots.outline import RobotOutline

ANGLES = ("deg", "rad", "counts")
PASCALS = ("Pa", "kPa", "MPa", "mbar", "bar", "psi")
FORCES = ("N", "N m", "V", "A", "%", "-")
UNITS = ("mm", "cm", "m", "in", *ANGLES, *PASCALS, *FORCES)
FOUND = (
    "test = ",
    "axes = ",
    "origin = ",
    "commands = ",
    "commands_with_poses = ",
    "unwrap = ",
    "[model.groups]",
    "# ASSUMED: drives",
)
"""Lines of an experiment file whose values `init` may find from a recording."""
MODELS = (".xml", ".urdf")  # suffixes of models of other simulators, see `simulators.adapters`
MILLIMETRES = 1e-3
LENGTHS = ("length", "radius", "tip_radius", "inner_radius", "cable_radius", "spool_radius")
FACTORS = {**dict.fromkeys(LENGTHS, MILLIMETRES), "mass": 1e-3, "young_modulus": 1e6, "area": 1e-6}
"""From the units of options to SI."""


class Questions:
    """Answers from options, else from the person at the terminal, else defaults, which are then marked as assumed."""

    def __init__(self, ask: bool) -> None:
        self.ask, self.assumed = ask, set[str]()

    def answer(self, key: str, given: Any, question: str, default: Any) -> Any:
        """The answer that an option gave, or the reply to a question."""
        if given is not None:
            return given
        reply = typer.prompt(question, default=default) if self.ask else default
        if reply == default:
            self.assumed.add(key)
        return reply

    def names(self, file: Path, given: str | None, commands: int | None, markers: str | None) -> list[str] | None:
        """Names of the columns of a CSV without names; None if it has names."""
        from rfdropo_bayes.data.csv_table import unnamed_rows
        from rfdropo_bayes.data.mapped_formats import recognised_format
        from rfdropo_bayes.verbs.column_names import suggested_names

        if given is not None or recognised_format(file) != "csv":
            return _listed(given)
        rows = unnamed_rows(file)
        if rows is None:
            return None
        heights = [part.partition("=")[0].strip() for part in (markers or "").split(",") if part.strip()]
        likely = ",".join(suggested_names(rows, commands, heights) or [])
        shown = [", ".join(row) for row in rows]
        if self.ask:
            typer.echo("\n".join([f"{file} has no names of columns. Its first rows:", *shown]))
            return _listed(typer.prompt(f"Names of the {len(rows[0])} columns", default=likely or None))
        raise InputError(
            f"the first line holds values, not the names of its {len(rows[0])} columns: {'; '.join(shown[:2])}",
            where=str(file),
            remedy=f'if they are in this order, write {likely} above it, or give --names "{likely}"'
            if likely
            else 'write a line of names above it, or give --names "t,c1,c2,c3,c4,tip_x,tip_y,tip_z" with all of them',
        )

    def counts(self, guess: Any, given: float | None) -> float | None:
        """Counts in one turn of the spool; None if nothing is in counts. They have no default: gears differ."""
        if given is not None or not guess.counts:
            return given
        if not self.ask:
            remedy = "give --counts-per-turn: counts in one turn of the spool, gear included; or --command-unit"
            raise InputError("holds commands or angles in counts", where="--recording", remedy=remedy)
        return typer.prompt("Counts in one turn of the spool, gear included", type=float)


Recordings = Annotated[
    list[str] | None,
    typer.Option(
        "--recording",
        metavar="FILE",
        help="CSV, Motive export, ROS bag, MCAP file or LeRobotDataset to fit, or a quoted pattern; may be repeated",
    ),
]
Tests = Annotated[
    list[str] | None,
    typer.Option(
        "--test",
        metavar="FILE",
        help="recording that no fit sees, to score fits and audits, or a quoted pattern; by default the last third",
    ),
]
Commands = Annotated[
    list[str] | None,
    typer.Option(
        "--commands",
        metavar="FILE",
        help="CSV with the commands of each recording, if the recording has none, or a quoted pattern; may be repeated",
    ),
]
Shape = Annotated[str | None, typer.Option(help="cylinder, cone, tube, or disks (on a backbone)")]
Length = Annotated[float | None, typer.Option("--length-mm", help="length of the body [mm]")]
Radius = Annotated[float | None, typer.Option("--radius-mm", help="outer radius of the body at the base [mm]")]
TipRadius = Annotated[
    float | None, typer.Option("--tip-radius-mm", help="outer radius of a cone or tube at the tip [mm]")
]
InnerRadius = Annotated[
    float | None,
    typer.Option("--inner-radius-mm", help="radius of the hollow of a tube, or of the backbone of disks [mm]"),
]
NumberOfDisks = Annotated[
    int | None, typer.Option("--disks", help="number of disks; 10 by default, or the next multiple of the segments")
]
Segments = Annotated[int | None, typer.Option(help="number of segments, each with its own cables")]
SegmentLengths = Annotated[
    str | None, typer.Option("--segment-lengths-mm", help='lengths of the segments, base to tip: "60,62.5,64"')
]
Cables = Annotated[int | None, typer.Option(help="number of cables of each segment")]
CableRadius = Annotated[
    float | None, typer.Option("--cable-radius-mm", help="distance of the cables from the axis, at the base [mm]")
]
Pairs = Annotated[bool | None, typer.Option(help="opposite cables share a motor")]
CommandUnit = Annotated[
    str | None,
    typer.Option(
        help="mm, cm, m or in of cable; deg, rad or counts of a motor; N, N m, V, A or % of a drive; kPa, bar, psi, "
        "... of chambers; guessed from a recording"
    ),
]
CountsPerTurn = Annotated[
    float | None,
    typer.Option(help="counts of an encoder, or steps of a drive, in one turn of the spool, gear included"),
]
Names = Annotated[
    str | None,
    typer.Option(help='names of all columns of a CSV without a line of names: "t,c1,c2,c3,c4,tip_x,tip_y,tip_z"'),
]
CommandNames = Annotated[str | None, typer.Option("--command-names", help="the same for the CSV that --commands names")]
SampleTime = Annotated[
    float | None, typer.Option("--sample-time", help="seconds from row to row, if no column holds times")
]
PositionUnit = Annotated[str | None, typer.Option(help="mm, cm, m or in; guessed from a recording")]
SpoolRadius = Annotated[float | None, typer.Option("--spool-radius-mm", help="radius of the motors' spools [mm]")]
Gravity = Annotated[
    str | None,
    typer.Option(help="direction of gravity: +z for a robot that hangs, -z for a robot that stands, -y, ..."),
]
ChamberArea = Annotated[
    float | None, typer.Option("--chamber-area-mm2", help="area of a chamber across the axis, for pressures [mm2]")
]
Mass = Annotated[float | None, typer.Option("--mass-g", help="mass of the body [g]; silicone by default")]
Modulus = Annotated[float | None, typer.Option("--modulus-mpa", help="Young's modulus of the body [MPa]")]
Markers = Annotated[
    str | None,
    typer.Option(help='heights of the markers in mm, in the order of the columns: "low=66,middle=133,tip=200"'),
]
Target = Annotated[
    Path,
    typer.Argument(
        metavar="FOLDER",
        help="folder to write to, also the name of the robot; or a MuJoCo model (.xml, .urdf), whose name the folder "
        "gets",
    ),
]
Defaults = Annotated[bool, typer.Option("--defaults", help="ask nothing; take defaults, marked ASSUMED")]


def init(
    folder: Target,
    recording: Recordings = None,
    test: Tests = None,
    commands: Commands = None,
    shape: Shape = None,
    length: Length = None,
    radius: Radius = None,
    tip_radius: TipRadius = None,
    inner_radius: InnerRadius = None,
    disks: NumberOfDisks = None,
    segments: Segments = None,
    segment_lengths: SegmentLengths = None,
    cables: Cables = None,
    cable_radius: CableRadius = None,
    pairs: Pairs = None,
    command_unit: CommandUnit = None,
    counts_per_turn: CountsPerTurn = None,
    position_unit: PositionUnit = None,
    names: Names = None,
    command_names: CommandNames = None,
    sample_time: SampleTime = None,
    spool_radius: SpoolRadius = None,
    chamber_area: ChamberArea = None,
    gravity: Gravity = None,
    mass: Mass = None,
    modulus: Modulus = None,
    markers: Markers = None,
    defaults: Defaults = False,
) -> None:
    """Write a first robot file and experiment file. Asks for facts that are neither in options nor in recordings."""
    from rfdropo_bayes.data.named_columns import FORMAT
    from rfdropo_bayes.verbs.column_names import guess_columns
    from rfdropo_bayes.verbs.init import (
        assumed_of_columns,
        matching_commands,
        matching_recordings,
        of_robot,
        with_counts,
        with_drives,
        with_given,
        with_turns,
        write_first_files,
    )
    from rfdropo_bayes.verbs.split_files import split_files

    ask = Questions(sys.stdin.isatty() and not defaults)
    tested = matching_recordings(test or [])
    files = [file for file in matching_recordings([*(recording or []), *(test or [])]) if file not in tested]
    if tested and not files:
        raise InputError("no recording is left to fit", where="--test", remedy="give others with --recording")
    files += tested
    sent = matching_commands(commands or [], files)
    guess = None
    if files:
        columns = ask.names(files[0], names, None if cables is None else cables * (segments or 1), markers)
        guess = guess_columns(files[0], sent[0] if sent else None, columns, _listed(command_names), command_unit)
        guess = with_given(guess, command_unit=command_unit, position_unit=position_unit, sample_time=sample_time)
        guess = with_turns(with_counts(guess, ask.counts(guess, counts_per_turn), command_unit is not None))
    if folder.suffix in MODELS:
        _init_model(folder, files, sent, guess, len(tested))
        return
    split, kept = dict[Path, str](), len(tested)
    if guess is not None and guess.format == FORMAT and not sent:
        unseen = split_files(folder, tested, guess)
        split, kept = split_files(folder, files[: len(files) - len(tested)], guess) | unseen, len(unseen)
    files = list(split) or files
    unit = guess.command_unit if guess else ask.answer("command_unit", command_unit, "Commands in", "mm")
    if unit not in UNITS:
        raise InputError(
            f"the unit {unit!r} is unknown", where="--command-unit", remedy=f"use one of {', '.join(UNITS)}"
        )
    answers = _body(ask, shape, length, radius, tip_radius, cable_radius)
    answers["inner_radius"] = inner_radius
    answers["segments"] = ask.answer("segments", segments, "Segments with their own cables", 1)
    if segment_lengths is None and answers["segments"] > 1:
        ask.assumed.add("segment_lengths")
    answers["segment_lengths"] = _lengths(segment_lengths)
    answers["cables"], answers["pairs"] = _cables(ask, guess, answers["segments"], cables, pairs)
    if unit in (*ANGLES, "N m"):
        answers["spool_radius"] = ask.answer("spool_radius", spool_radius, "Radius of the spools [mm]", 10.0)
    if unit in PASCALS or chamber_area is not None:
        words = "Area of a chamber across the axis [mm2]; 0 if unknown"
        answers["area"] = ask.answer("area", chamber_area, words, 0.0) or None
    answers["gravity"] = ask.answer("gravity", gravity, "Things fall along (+z: hangs, -z: stands, -y: level)", "+z")
    if answers["segments"] > 1 or not answers["gravity"].endswith("z"):
        ask.assumed.add("segment_azimuths")
    answers["mass"] = ask.answer("mass", mass, "Mass of the body [g]; 0 for silicone", 0.0) or None
    answers["young_modulus"] = ask.answer("young_modulus", modulus, "Young's modulus [MPa]", 1.0)
    answers["markers"] = _markers(ask, guess, markers, answers["length"])
    outline = _outline(_name(folder.resolve().name, "robot"), disks, unit, answers, ask.assumed)
    if guess is not None:
        guess, outline = with_drives(of_robot(guess, outline), outline)
    robot, experiment, unread = write_first_files(folder, outline, files, sent, guess, kept)
    typer.echo(f"wrote {robot}\nwrote {experiment}")
    if outline.assumed:
        typer.echo(f"assumed, and marked ASSUMED in the robot file: {', '.join(sorted(outline.assumed))}")
    told = [words for words in split.values() if words]
    for line in [*told, *assumed_of_columns(guess), *_found_lines(robot, experiment)] if guess else []:
        typer.echo(f"look over: {line}")
    if unread:
        typer.echo(f"not read: {unread}\nnext: repair it, and run init again in another folder, to find the frame")
        return
    typer.echo(f"next: {shlex.join(['rfdropo', 'check', str(folder / 'experiment.toml')])}")


def _found_lines(robot: Path, experiment: Path) -> list[str]:
    """Frame, order, zeros and azimuths that were found from a recording, each with its evidence."""
    lines = [line for line in experiment.read_text(encoding="utf-8").splitlines() if line.startswith(FOUND)]
    lines += [line for line in robot.read_text(encoding="utf-8").splitlines() if line.startswith("# ASSUMED azimuths")]
    return [line for line in lines if "ASSUMED" in line]


def _listed(names: str | None) -> list[str] | None:
    return None if names is None else [name.strip() for name in names.split(",")]


def _init_model(model: Path, files: list[Path], sent: list[Path], guess: Any, kept: int) -> None:
    """Write an experiment for a model of another simulator."""
    from rfdropo_bayes.verbs.init_model import write_model_experiment

    path, assumed = write_model_experiment(model, Path(model.stem), files, sent, guess, kept)
    typer.echo(f"wrote {path}")
    for line in assumed:
        typer.echo(f"assumed: {line}")
    typer.echo(f"next: {shlex.join(['rfdropo', 'check', str(path)])}")


def _body(
    ask: Questions,
    shape: str | None,
    length: float | None,
    radius: float | None,
    tip: float | None,
    cables: float | None,
) -> dict[str, Any]:
    """Shape and size of the body, and distance of the cables from its axis at the base [mm]."""
    from rfdropo_bayes.robots.outline import CABLES_AT

    form = ask.answer("shape", shape, "Shape: cylinder, cone, tube or disks", "cylinder")
    long = ask.answer("length", length, "Length of the body [mm]", 200.0)
    wide = ask.answer("radius", radius, "Radius at the base [mm]", 12.0)
    if form == "cone":
        tip = ask.answer("tip_radius", tip, "Radius at the tip [mm]", 0.6 * wide)
    words = "Distance of the cables from the axis at the base [mm]"
    apart = ask.answer("cable_radius", cables, words, round(CABLES_AT * wide, 3))
    return {"shape": form, "length": long, "radius": wide, "tip_radius": tip, "cable_radius": apart}


def _outline(name: str, disks: int | None, unit: str, answers: dict[str, Any], assumed: set[str]) -> RobotOutline:
    """The robot, in SI units."""
    from rfdropo_bayes.robots.outline import RobotOutline

    given = {key: value for key, value in answers.items() if value is not None}
    for key, factor in FACTORS.items():
        if key in given:
            given[key] = factor * given[key]
    given["markers"] = {marker: MILLIMETRES * height for marker, height in given["markers"].items()}
    kinds = {**dict.fromkeys(ANGLES, "rad"), **dict.fromkeys(PASCALS, "Pa"), **dict.fromkeys(FORCES, "-")}
    kind: Any = (kinds | {"N": "N", "N m": "N m"}).get(unit, "m")
    assumed |= {"disks"} if given["shape"] == "disks" and disks is None else set()
    return RobotOutline(name, disks=disks, command_unit=kind, assumed=frozenset(assumed), **given)


def _lengths(text: str | None) -> tuple[float, ...] | None:
    """Lengths of segments [m]."""
    if text is None:
        return None
    try:
        return tuple(MILLIMETRES * float(part) for part in text.split(","))
    except ValueError:
        where = "--segment-lengths-mm"
        raise InputError(f"{text!r} is not a list of lengths", where=where, remedy='e.g. "60,62.5,64"') from None


def _name(text: str, kind: str) -> str:
    """A name for robot files, of lower-case letters, digits and underscores, from any text."""
    letters = "".join(c if c.isascii() and c.isalnum() else "_" for c in text.lower()).strip("_")
    return letters if letters[:1].isalpha() else f"{kind}_{letters}".rstrip("_")


def _cables(ask: Questions, guess: Any, parts: int, cables: int | None, pairs: bool | None) -> tuple[int, bool]:
    """Cables of a segment, and whether opposite cables share a motor; both must match the number of commands."""
    if guess is None:
        return ask.answer("cables", cables, "Cables of each segment", 4), bool(pairs)
    commands = len(guess.commands)
    paired = commands != parts * cables if pairs is None and cables is not None else bool(pairs)
    number = cables if cables is not None else commands * (2 if paired else 1) // parts
    if parts * number != commands * (2 if paired else 1):
        raise InputError(
            f"{commands} commands ({', '.join(guess.commands)}) do not fit {parts} segments of {number} cables",
            where="--recording",
            remedy="give --segments and --cables, and --pairs if opposite cables share a motor",
        )
    return number, paired


def _markers(ask: Questions, guess: Any, given: str | None, length: float) -> dict[str, float]:
    """Heights [mm] of the markers by name, in the order of the columns.

    Evenly spaced if they are not given, in this order, or from the tip on if each moves less than the one before.
    """
    from rfdropo_bayes.verbs.init import from_the_tip

    names = guess.markers if guess is not None else ["m1", "m2", "m3"]
    steps = list(range(1, len(names) + 1))
    if guess is not None and from_the_tip(guess):
        steps.reverse()
    spaced = ",".join(f"{name}={length * k / len(names):.4g}" for k, name in zip(steps, names, strict=True))
    text = ask.answer("markers", given, "Markers and their heights [mm]", spaced)
    heights: dict[str, float] = {}
    for part in text.split(","):
        name, equals, height = part.partition("=")
        try:
            heights[_name(name.strip(), "marker")] = float(height)
        except ValueError:
            equals = ""
        if not equals or not name.strip():
            raise InputError(f"{part!r} is not NAME=HEIGHT", where="--markers", remedy="e.g. low=66,middle=133,tip=200")
    if guess is not None and len(heights) != len(guess.positions):
        raise InputError(
            f"{len(heights)} markers are named; the recording has {len(guess.positions)} ({', '.join(guess.markers)})",
            where="--markers",
            remedy="name one for each, in the order of the columns",
        )
    named = {name.casefold(): name for name in heights}
    columns = [] if guess is None else [name.casefold() for name in guess.markers]
    if set(columns) == set(named):  # the columns' own names, in whatever order
        return {named[name]: heights[named[name]] for name in columns}
    return heights
