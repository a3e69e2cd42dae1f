"""Recordings beside the nominal model: doubts of the frame, and of the order and the unit of the commands."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.data import Trajectory, shared_markers
from rfdropo_bayes.data.named_columns import CsvColumns
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.assembly import build_robot_simulator, physical_values
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.simulators.commands import stack_commands
from rfdropo_bayes.verbs.channel_order import Driven, best_order
from rfdropo_bayes.verbs.motion_direction import AGREEING, Direction, Paths, direction_doubt, direction_of
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
from rfdropo_bayes.verbs.numerical_error import longest_of, nominal_markers

MOST = 5
"""Recordings that count."""
AGREES = 0.95
"""Agreement from which on no other order of the commands is looked for."""
LEFT = 0.4
"""Another order is named if it leaves at most this share of the motion that the present order leaves unexplained."""
LITTLE, SEEN = 0.4, 1e-3
"""Agreement below which markers do not do what the commands ask, and the nominal motion [m] that it takes to say so."""
DELAYS = (0.0, 0.1, 0.2, 0.4)  # [s] of a motion after its commands
PULLED, STRETCH = 2.0, 0.02
"""How long [s] every channel is pulled by itself in a simulation, and how far, over the length of the body."""


class Reordered(NamedTuple):
    """Another order of the columns, and how well the nominal model agrees under it."""

    columns: tuple[int, ...]
    agreement: float


class Motion(NamedTuple):
    """Recordings beside the nominal model.

    Attributes:
        direction, size: of the motion.
        order: another order of the columns that explains the motion much better; None without.
        unit: another unit of the commands and the size of the motion under it; None without.
    """

    direction: Direction
    size: Size
    order: Reordered | None = None
    unit: tuple[Unit, Size] | None = None


def motion_cautions(
    motion: Motion, columns: CsvColumns | None, names: Sequence[str], command_unit: str
) -> list[Caution]:
    """What a motion says against the frame, the order and the unit of commands.

    Args:
        motion: recordings beside the nominal model.
        columns: the table by which the recordings were read; None for formats that have none.
        names: of the channels in a recording.
        command_unit: in which a recording keeps its commands.
    """
    direction, size, order, unit = motion
    said = direction_doubt(direction, None if columns is None else columns.axes)
    found = []
    if said is not None:
        other = "" if order is None else f". {_order_words(order, columns, names)} would explain it as well"
        found.append(Caution(Code.FRAME_DOUBTFUL, said + other))
    elif order is not None:
        sentence = (
            f"another order of the commands explains the motion better (agreement {order.agreement:.2f}, as they are "
            f"{direction.straight:.2f}): {_order_words(order, columns, names)}"
        )
        found.append(Caution(Code.ORDER_DOUBTFUL, sentence))
    agreement = max(direction.agreement, direction.mirrored, 0.0 if order is None else order.agreement)
    if agreement >= AGREEING and not size.within(limit_of(command_unit)):
        found.append(Caution(Code.UNIT_DOUBTFUL, size_sentence(size, columns, unit)))
    if agreement < LITTLE and size.nominal > SEEN:
        sentence = (
            f"the markers do not move as the commands ask (agreement {agreement:.2f}, in whatever frame): look at the "
            "columns of the commands, their order and their sign, and at the clocks of commands and observations"
        )
        found.append(Caution(Code.RECORDING_DOUBTFUL, sentence))
    return found


def _order_words(order: Reordered, columns: CsvColumns | None, names: Sequence[str]) -> str:
    """The line that gives commands in another order."""
    own = names if columns is None else columns.commands
    listed = ", ".join(f'"{own[k]}"' for k in order.columns)
    if columns is None:
        return f"channels in the order {listed}"
    return f"commands = [{listed}] in [data.columns]"


class Compared(NamedTuple):
    """A comparison with the nominal model in words, and what speaks against frame, order and unit of the commands."""

    words: str
    cautions: list[Caution]


def measure_motion(spec: ModelSpec, recordings: Sequence[Trajectory], columns: CsvColumns | None) -> Compared:
    """Simulate recordings with the nominal model, and compare what markers do.

    Args:
        spec: of a robot; values are nominal or fixed.
        recordings: in the frame of the base; the first `MOST` of them count.
        columns: the table by which they were read.

    Raises:
        InputError: commands that do not fit, or a rollout that did not end well under any unit of the commands.
    """
    runs = recordings[:MOST]
    units = other_units(columns, runs[0].command_unit)
    try:
        paths = [_paths(spec, run) for run in runs]
    except InputError as error:
        found = _explained(spec, runs[0], likely_units(units, None))
        if found is None:
            raise
        measured = f"the markers moved by {1e3 * found[1].measured:.3g} mm"
        words = f"{error.what} under the commands as they were read, and {measured}; {unit_words(columns, found)}"
        return Compared(error.what, [Caution(Code.UNIT_DOUBTFUL, words)])
    direction, size = direction_of(paths), size_of(paths)
    order = _order(spec, runs, direction) if direction.straight < AGREES else None
    unit = None
    if not size.within(limit_of(runs[0].command_unit)):
        run = runs[0] if order is None else commanded(runs[0], order=order.columns)
        unit = _explained(spec, run, likely_units(units, size))
    motion = Motion(direction, size, order, unit)
    in_unit = runs[0].command_unit if columns is None else f"{columns.command_unit} (command_unit)"
    words = (
        f"the markers move by {1e3 * size.measured:.3g} mm, the nominal model under commands in {in_unit} by "
        f"{1e3 * size.nominal:.3g} mm; agreement {direction.straight:.2f}"
    )
    return Compared(words, motion_cautions(motion, columns, runs[0].cable_names, runs[0].command_unit))


def commanded(run: Trajectory, factor: float = 1.0, order: Sequence[int] | None = None) -> Trajectory:
    """A recording with its commands times a factor, and its columns in another order."""
    chosen = list(range(len(run.cable_names)) if order is None else order)
    dataset = run.dataset.copy()
    dataset["command"] = run.dataset["command"].copy(data=factor * run.command[:, chosen])
    dataset["initial_command"] = run.dataset["initial_command"].copy(data=factor * run.initial_command[chosen])
    return Trajectory(dataset)


def _paths(spec: ModelSpec, recording: Trajectory) -> Paths:
    nominal = nominal_markers(spec, recording, longest_of(spec.simulator.body == "rod"))
    names = shared_markers([recording], spec.robot.marker_names)
    index, rows = [recording.marker_names.index(name) for name in names], len(nominal)
    return Paths(nominal, recording.position[:rows, index], recording.position_mask[:rows, index])


def _explained(spec: ModelSpec, run: Trajectory, units: Sequence[Unit]) -> tuple[Unit, Size] | None:
    """The first unit under which the nominal model moves as far as the markers; None if there is none."""
    for unit in units:
        try:
            size = size_of([_paths(spec, commanded(run, unit.factor))])
        except InputError:
            continue
        if size.within(EXPLAINED):
            return unit, size
    return None


def _order(spec: ModelSpec, runs: Sequence[Trajectory], direction: Direction) -> Reordered | None:
    """An order of the columns under which the nominal model leaves much less of the motion unexplained."""
    driven = [driven_by(run, spec.robot.marker_names) for run in runs]
    proposed = best_order(driven, pull_responses(spec, runs))
    if proposed.columns == tuple(range(len(proposed.columns))):
        return None
    try:
        agreement = direction_of(_paths(spec, commanded(run, order=proposed.columns)) for run in runs).straight
    except InputError:
        return None
    explains = agreement >= AGREEING and 1.0 - agreement**2 < LEFT * (1.0 - max(direction.straight, 0.0) ** 2)
    return Reordered(proposed.columns, agreement) if explains else None


def driven_by(run: Trajectory, markers: Sequence[str]) -> Driven:
    """A recording's motion across the body and the commands that it follows, at the delay that explains most of it."""
    names = shared_markers([run], markers)
    index = [run.marker_names.index(name) for name in names]
    rows = run.position_mask[:, index].all(axis=1)
    motion = run.position[rows][:, index, :2].reshape(int(rows.sum()), -1)
    motion = motion - motion.mean(axis=0)
    best, left = None, np.inf
    for delay in DELAYS:
        command = run.command_at(run.time[rows] - delay)
        command = command - command.mean(axis=0)
        weights = np.linalg.lstsq(command, motion, rcond=1e-9)[0]
        error = float(np.sum((motion - command @ weights) ** 2))
        if best is None or error < left:
            best, left = Driven(command, motion), error
    assert best is not None
    return best


def pull_responses(spec: ModelSpec, runs: Sequence[Trajectory]) -> Float[np.ndarray, "channel coordinate"]:
    """What a pull of each channel by itself moves the markers by across the body, in the nominal model.

    Raises:
        InputError: a simulation that does not end well.
    """
    simulator = build_robot_simulator(spec)
    size = _pull(spec, runs)
    time, channels = np.linspace(0.0, PULLED, 21), len(size)
    still = np.zeros(channels)
    grid = stack_commands([simulator.commands(time[:1], own[None], still, time) for own in np.diag(size)])
    values: Any = physical_values(spec, simulator)
    found = jax.jit(jax.vmap(simulator.rollout, in_axes=(None, 0)))(values, grid)
    position = np.asarray(found.position)
    if np.any(np.asarray(found.status)) or not np.isfinite(position).all():
        raise InputError("a pull of a single channel cannot be simulated", where="[simulator]")
    shared = shared_markers([runs[0]], simulator.marker_names)
    chosen = [simulator.marker_names.index(name) for name in shared]
    moved = position[:, len(time) // 2 :].mean(axis=1) - position[:, 0]
    return moved[:, chosen, :2].reshape(channels, -1) / size[:, None]


def _pull(spec: ModelSpec, runs: Sequence[Trajectory]) -> Float[np.ndarray, " channel"]:
    """How far each channel is pulled: by a share of the body's length, or as far as forces were commanded."""
    robot = build_robot_simulator(spec).robot
    if runs[0].command_unit not in ("m", "rad"):
        largest = max(float(np.abs(run.command).max()) for run in runs)
        return np.full(len(robot.channel_names), largest or 1.0)
    travel = np.abs(np.asarray(robot.channel_matrix(robot.nominal()))).max(axis=0)
    return STRETCH * robot.length / travel
