"""Recordings beside the robot at rest: doubts of the frame, and of the order, the sign and the unit of the commands."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.data import Trajectory, shared_markers
from rfdropo_bayes.data.named_columns import CsvColumns
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.verbs.arrangement import Arrangement, as_written
from rfdropo_bayes.verbs.at_rest import RestingRobot, Rows, resting, rows_of, spread_rows
from rfdropo_bayes.verbs.command_lag import best_delay
from rfdropo_bayes.verbs.motion_direction import (
    AGREEING,
    Direction,
    Paths,
    axes_of_mirror,
    direction_doubt,
    direction_of,
)
from rfdropo_bayes.verbs.motion_size import (
    EXPLAINED,
    Size,
    Unit,
    likely_units,
    limit_of,
    other_units,
    size_of,
    size_sentence,
    unit_words,
)
from rfdropo_bayes.verbs.order_finder import ROWS, Finding, arranged, find_arrangement, order_lines

MOST = 5  # recordings that count
UNEXPLAINED = 0.4
"""Another arrangement is named if it leaves at most this share of the motion that the present one leaves."""
LITTLE, SEEN = 0.4, 1e-3
"""Agreement below which markers do not follow the commands, and the least nominal motion [m] for this statement."""
SOLVED = 0.5  # least share of the rows in which the rod must have an equilibrium for a comparison


class Proposal(NamedTuple):
    """Another arrangement of the commands: agreement, lines for the experiment file, and alternatives in words."""

    agreement: float
    lines: tuple[str, ...]
    alternatives: tuple[str, ...] = ()
    mirrored: bool = False


class Motion(NamedTuple):
    """Recordings beside the nominal model."""

    # direction, size: direction and size of the motion
    direction: Direction
    size: Size
    # another arrangement of the commands that explains the motion much better; None without
    proposal: Proposal | None = None
    # another unit of the commands and the size of the motion under it; None without
    unit: tuple[Unit, Size] | None = None


def motion_cautions(motion: Motion, columns: CsvColumns | None, command_unit: str) -> list[Caution]:
    """Cautions of a motion on the frame, the order and the unit of commands.

    Args:
        motion: recordings beside the nominal model.
        columns: table used to read the recordings; None for formats that have none.
        command_unit: unit of the recordings' commands.
    """
    direction, size, proposal, unit = motion
    axes = None if columns is None else columns.axes
    cautions = []
    if proposal is not None:
        cautions.append(_proposed(direction, proposal, axes))
    elif (said := direction_doubt(direction, axes)) is not None:
        cautions.append(Caution(Code.FRAME_DOUBTFUL, said))
    agreement = max(direction.agreement, direction.mirrored, 0.0 if proposal is None else proposal.agreement)
    if agreement >= AGREEING and not size.within(limit_of(command_unit)):
        cautions.append(Caution(Code.UNIT_DOUBTFUL, size_sentence(size, columns, unit)))
    if agreement < LITTLE and size.nominal > SEEN:
        sentence = (
            f"the markers do not move as the commands ask (agreement {agreement:.2f}, in whatever frame and order): "
            "look at the columns of the commands and of the positions, at the unit of the commands, and at the clocks "
            "of both"
        )
        cautions.append(Caution(Code.RECORDING_DOUBTFUL, sentence))
    return cautions


def _proposed(direction: Direction, proposal: Proposal, axes: tuple[str, str, str] | None) -> Caution:
    """Another arrangement in words, with alternatives that explain the motion equally well."""
    lines = "; ".join(proposal.lines)
    others = list(proposal.alternatives)
    if proposal.mirrored:
        others.append(f"a left-handed frame: {axes_of_mirror(direction.mirror_turn, axes)}")
    better = f"explains the motion better (agreement {proposal.agreement:.2f}, as they are {direction.straight:.2f})"
    if not others:
        sentence = f"another arrangement of the commands {better}: {lines}"
        return Caution(Code.ORDER_DOUBTFUL, sentence)
    alternatives = "; or ".join([lines, *others])
    sentence = f"more than one arrangement {better}, and these recordings do not distinguish them: {alternatives}"
    return Caution(Code.FRAME_DOUBTFUL if proposal.mirrored else Code.ORDER_DOUBTFUL, sentence)


class Compared(NamedTuple):
    """Comparison with the robot at rest."""

    words: str  # summary
    agreement: float  # of the directions of motion, as the recordings were read; 0 without equilibria
    cautions: list[Caution]  # cautions on frame, order and unit of the commands
    arrangement: Arrangement | None  # best arrangement of the commands; None without equilibria under them


def measure_motion(spec: ModelSpec, recordings: Sequence[Trajectory], columns: CsvColumns | None) -> Compared:
    """Compare the motion of markers with the robot at rest under the same commands, and search a better arrangement.

    Args:
        spec: model of a robot; values are nominal or fixed.
        recordings: recordings in the base's frame; the first `MOST` are used.
        columns: table that maps the recordings' columns.

    Raises:
        InputError: no common marker of robot and recordings.
    """
    runs = recordings[:MOST]
    robot, late = resting(spec), best_delay(runs)
    rows = rows_of(runs, robot.simulator.marker_names, late)
    rows = rows.of(spread_rows(rows, ROWS))
    robot = robot.showing(shared_markers(runs, robot.simulator.marker_names))
    unit, measured = runs[0].command_unit, size_of([_paths(robot, rows, 0.0)]).measured
    units = other_units(columns, unit)
    here = _paths(robot, rows)
    if here.mask.any(axis=1).mean() < SOLVED * _paths(robot, rows, 0.0).mask.any(axis=1).mean():
        smaller = _explained(robot, rows, likely_units(units, None))
        said = "the robot has no equilibrium under most of the commands as they were read"
        words = f"{said}, and the markers moved by {1e3 * measured:.3g} mm; {unit_words(columns, smaller)}"
        return Compared(said, 0.0, [Caution(Code.UNIT_DOUBTFUL, words)], None)
    direction, finding = direction_of([here]), find_arrangement(robot, rows)
    proposal = _proposal(finding, robot.simulator.robot, columns, runs[0].cable_names)
    if proposal is not None:
        sent = rows._replace(command=finding.arrangement.commands(rows.command))
        size = size_of([_paths(arranged(robot, finding.arrangement), sent)])
    else:
        sent, size = rows, size_of([here])
    other = None if size.within(limit_of(unit)) else _explained(robot, sent, likely_units(units, size))
    in_unit = unit if columns is None else f"{columns.command_unit} (command_unit)"
    words = (
        f"the markers move by {1e3 * size.measured:.3g} mm, the robot at rest under commands in {in_unit} by "
        f"{1e3 * size.nominal:.3g} mm; agreement {finding.written.straight:.2f}"
    )
    cautions = motion_cautions(Motion(direction, size, proposal, other), columns, unit)
    written = as_written(len(rows.command[0]), len(finding.arrangement.turns))
    return Compared(words, finding.written.straight, cautions, finding.arrangement if cautions else written)


def _paths(robot: RestingRobot, rows: Rows, factor: float = 1.0) -> Paths:
    """Rows beside the robot at rest, under commands times a factor; rows without an equilibrium are masked."""
    nominal = robot.markers(factor * rows.command)[0]
    seen = np.isfinite(nominal).all(axis=2) & np.isfinite(rows.position).all(axis=2)
    return Paths(np.nan_to_num(nominal), np.nan_to_num(rows.position), seen)


def _explained(robot: RestingRobot, rows: Rows, units: Sequence[Unit]) -> tuple[Unit, Size] | None:
    """The first unit under which the robot at rest moves as far as the markers; None if there is none."""
    for unit in units:
        paths = _paths(robot, rows, unit.factor)
        size = size_of([paths])
        if paths.mask.any(axis=1).mean() >= SOLVED and size.within(EXPLAINED):
            return unit, size
    return None


def _proposal(finding: Finding, robot: Robot, columns: CsvColumns | None, names: Sequence[str]) -> Proposal | None:
    """The found arrangement, if it has another order, another sign or rotated sections, and is clearly better.

    A turn of the whole is reported as a turn of the frame, see `direction_doubt`.
    """
    changed = finding.arrangement[:2] != (tuple(range(len(names))), (1,) * len(names))
    if not (changed or finding.sections_differ) or finding.agreement < AGREEING or finding.unexplained > UNEXPLAINED:
        return None
    own = names if columns is None else columns.commands
    key = "channels in the order {}" if columns is None else "commands = [{}] in [data.columns]"
    also = [] if columns is None else [name for name in ("tensions", "motor_angles") if getattr(columns, name)]
    key += f", and {' and '.join(also)} in the same order" if also else ""
    lines, *others = (
        tuple(order_lines(each, robot, own, key))
        for each in (finding.arrangement, *(each for each, _ in finding.alternatives))
    )
    return Proposal(finding.agreement, lines, tuple("; ".join(each) for each in others), finding.mirrored)
