"""The command in force before the first row, which many files do not hold.

It is given, or measured, or recognised from how the recording begins. Measured motor angles show the first command.
Without them, either the first command was in force already, so that the robot rests until commands change, or no
command was, and the robot starts from its rest pose. A linear robot with a dead time and a lag is fitted for both
cases; the case with the smaller error in the first rows is taken. If that does not decide, a robot that moves while the
first command is held was not at rest under it. Other recordings begin as those of their experiment that decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.data.recorded import FIRST_COMMAND
from rfdropo_bayes.errors import InputError

if TYPE_CHECKING:
    from rfdropo_bayes.data.trajectory import Trajectory

Rule = Literal["first", "zero"] | Sequence[float]

DEAD_TIMES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4)  # [s]
LAGS = (0.01, 0.05, 0.1, 0.2, 0.4, 0.8)  # [s]
LOOKED_AT = 20.0  # [s] of a recording, at most
FEWEST_ROWS = 4  # at the beginning, to compare on
RANK = 1e-9  # singular values below this share of the largest are rounding: channels that move together
# Ratio of two errors below which the smaller decides, and share of the later error that they must differ by in
# quadrature: of 160 starts none fell on the wrong side. Starts that are told have 1 or more of the later error, servos
# far from zero .24.
CLEARLY = 0.7
STILL = 0.1  # quantile of the distances from row to row, which show the noise if the robot rests in some rows
MOVES = 11.0  # such distances beyond which a robot moves: 5 deviations of a step of white noise
PART = 0.1  # share of the way of the markers by which it moves then; more than creep under a held command
AWAY = 0.5
"""Least distance of a channel's commands from zero, over their range, if its drive has a zero of its own: 1.8 to 13 of
servos in three files, 0 of cables that are pulled in."""
MEMORY = "memory"  # the format of recordings from arrays
UNTOLD = ("asl-csv", "csv", "motive-csv", "rosbag", "lerobot", MEMORY)
"""Formats that do not state the command before their first row."""

UNDECIDED: Literal["undecided"] = "undecided"  # the first command is then taken to have been in force
MEASURED = {"rule": "measured", "why": "the motors' angles in the first row"}


def begun_from(trajectory: Trajectory, rule: Rule | None) -> Trajectory:
    """The recording with the command before its first row: from a rule, its file, its motors, or its first rows.

    Args:
        trajectory: a whole recording.
        rule: "first", "zero", or one value per channel [m or rad].

    Raises:
        InputError: another number of values than channels, or a rule for a recording of poses at rest.
    """
    settled = bool(trajectory.settings.get("settled_poses"))
    if rule is None:
        if settled or trajectory.dataset.attrs["format"] not in UNTOLD:
            return trajectory
        angle = angle_at_first(trajectory)
        if angle is not None:
            return trajectory.with_initial_command(angle, MEASURED)
        found = recognised(trajectory)
        return trajectory.with_initial_command(_command(trajectory, found.rule), found._asdict())
    if settled:
        raise InputError(
            "initial_command is set, but every row is the pose at rest under its own command",
            where=f"[data] initial_command, {trajectory.name}",
            remedy="leave initial_command out for it",
        )
    why = "initial_command in [data]"
    if not isinstance(rule, str):
        channels = trajectory.cable_names
        if len(rule) != len(channels):
            raise InputError(
                f"initial_command has {len(rule)} values for {len(channels)} command channels",
                where=f"[data], {trajectory.name}",
                remedy=f"give one for each of {', '.join(channels)}",
            )
        return trajectory.with_initial_command(np.asarray(rule, dtype=float), {"rule": "given", "why": why})
    return trajectory.with_initial_command(_command(trajectory, rule), {"rule": rule, "why": why})


def angle_at_first(trajectory: Trajectory) -> Float[np.ndarray, " channel"] | None:
    """Motor angles [rad] in the first row, if all were measured and commands are angles; None otherwise.

    A reading of a slower loop that is a few rows old also counts, since the robot is at rest.
    """
    angle, mask = trajectory.motor_angle, trajectory.motor_angle_mask
    if angle is None or trajectory.command_unit != "rad":
        return None
    held = trajectory.settings.get("motor_angle_hold", 0.0) > 0.0
    return np.asarray(angle[0]) if held or mask is None or mask[0].all() else None


def common_beginning(trajectories: Sequence[Trajectory]) -> Literal["first", "zero"] | None:
    """The rule by which all of some recordings begin that decide; None if none does, they differ or need no rule."""
    rules = {_rule(trajectory) for trajectory in trajectories} - {UNDECIDED}
    return "first" if rules == {"first"} else "zero" if rules == {"zero"} else None


def begun_alike(trajectories: Sequence[Trajectory], others: Sequence[Trajectory] = ()) -> list[Trajectory]:
    """Recordings of one experiment; if they do not decide how they begin, they begin as all that do, if these agree."""
    rule = common_beginning([*trajectories, *others])
    if rule is None:
        return list(trajectories)
    alike = {"rule": rule, "why": "as the other recordings begin; its own first rows do not decide"}
    return [
        trajectory.with_initial_command(_command(trajectory, rule), alike) if undecided(trajectory) else trajectory
        for trajectory in trajectories
    ]


def undecided(trajectory: Trajectory) -> bool:
    """Whether the command before the first row matters and was assumed."""
    return _rule(trajectory) == UNDECIDED and bool(np.any(trajectory.command[0]))


def _rule(trajectory: Trajectory) -> str | None:
    """How the command before the first row is known; None if the file has it."""
    rule = trajectory.settings.get(FIRST_COMMAND, {}).get("rule")
    return None if rule is None else str(rule)


def _command(trajectory: Trajectory, rule: str) -> Float[np.ndarray, " channel"]:
    """The command before the first row by a rule."""
    return (0.0 if rule == "zero" else 1.0) * trajectory.command[0]


class Beginning(NamedTuple):
    """Which command was in force before the first row, "first", "zero" or `UNDECIDED`, and how that is known."""

    rule: Literal["first", "zero", "undecided"]
    why: str


def recognised(trajectory: Trajectory) -> Beginning:
    """Which command was in force before the first row, from the motion in the first rows."""
    if not np.any(trajectory.command[0]):
        return Beginning(UNDECIDED, "the first command is zero")
    errors = beginning_errors(trajectory)
    if errors is None:
        return Beginning(UNDECIDED, "assumed: the first rows do not decide")
    (first, first_later), (zero, zero_later) = (1e3 * np.array(errors[rule]) for rule in ("first", "zero"))
    evidence = (
        f"the first rows differ by {first:.2g} mm from a start at the first command, by {zero:.2g} mm from one at zero"
    )
    if _decides(zero, first, zero_later):
        return Beginning("zero", f"recognised: {evidence}")
    if _decides(first, zero, first_later):
        return Beginning("first", f"recognised: {evidence}")
    moved = None if far_from_zero(trajectory.command) else moved_while_held(trajectory)
    if moved is not None:
        return Beginning("zero", f"recognised: it moves by {1e3 * moved:.2g} mm while the first command is held")
    return Beginning(UNDECIDED, f"assumed: {evidence}, which does not decide")


def _decides(smaller: float, larger: float, later: float) -> bool:
    """Whether the larger of two errors in the first rows shows a wrong start, beside a linear robot's in later rows."""
    return smaller < CLEARLY * larger and larger**2 - smaller**2 > (CLEARLY * later) ** 2


def far_from_zero(command: Float[np.ndarray, "command channel"]) -> bool:
    """Whether commands that change never come near zero in any channel: drives have a zero of their own, as servos that
    rest at 2048 counts.
    """
    ranges = np.ptp(command, axis=0)
    return bool(ranges.any() and (np.abs(command).min(axis=0) > AWAY * ranges).all())


def moved_while_held(trajectory: Trajectory) -> float | None:
    """Distance [m] that a marker moves before commands change; None if it is noise, or a small part of its way."""
    seen = np.where(trajectory.position_mask[..., None], trajectory.position, np.nan)
    steps = np.linalg.norm(np.diff(seen, axis=0), axis=-1)
    changes = np.flatnonzero((trajectory.command != trajectory.command[0]).any(axis=1))
    held = trajectory.time <= (trajectory.command_time[changes[0]] if len(changes) else np.inf)
    whole = np.isfinite(seen[held]).all(axis=(1, 2))
    if whole.sum() < 2 or not np.isfinite(steps).any():
        return None
    first, last = seen[held][whole][[0, -1]]
    way = np.sqrt(np.nanmean(np.sum((seen - np.nanmean(seen, axis=0)) ** 2, axis=-1)))
    moved = float(np.linalg.norm(last - first, axis=-1).max())
    return moved if moved > max(MOVES * np.nanquantile(steps, STILL), PART * way) else None


def beginning_errors(trajectory: Trajectory) -> dict[str, tuple[float, float]] | None:
    """Root mean square errors [m] in the first rows, and in later rows, of a linear robot that starts at the first
    command, and at zero.

    For each start, the dead time and lag are chosen for the least error of a regression over the rows used. None if
    there are fewer rows than unknowns, or if the data cannot distinguish the cases.
    """
    time = trajectory.time[trajectory.time <= LOOKED_AT]
    mask = trajectory.position_mask[: len(time)]
    seen = mask[:, mask.mean(axis=0) > 0.5]
    rows = np.flatnonzero(seen.all(axis=1)) if seen.shape[1] else np.zeros(0, int)
    channels = trajectory.command.shape[1]
    if len(rows) < channels + 1 + FEWEST_ROWS:
        return None
    position = trajectory.position[rows][:, mask.mean(axis=0) > 0.5].reshape(len(rows), -1)
    time = time[rows]
    if not _changes(trajectory) and not _sets_out(position):
        return None  # a decaying motion under a single command may have begun anywhere
    scale = np.abs(trajectory.command).max()
    best: dict[str, tuple[float, float, np.ndarray]] = {}
    for lag in LAGS:
        state = _states(trajectory, lag)
        for dead_time in DEAD_TIMES:
            followed, remaining = _followed(trajectory, time - dead_time, lag, state)
            for rule, drive in (("first", followed), ("zero", followed - remaining[:, None] * trajectory.command[0])):
                design = np.column_stack([np.ones(len(time)), drive / scale])
                weights = np.linalg.pinv(design.T @ design, RANK, hermitian=True) @ (design.T @ position)
                square = ((position - design @ weights) ** 2).sum(axis=1)
                if rule not in best or square.sum() < best[rule][0]:
                    best[rule] = (float(square.sum()), dead_time + 3.0 * lag, square)
    end = max(*(settled for _, settled, _ in best.values()), time[FEWEST_ROWS - 1])
    early = time <= end
    points = position.shape[1] / 3.0

    def size(square: Float[np.ndarray, " few"]) -> float:
        return float(np.sqrt(square.mean() / points)) if len(square) else 0.0

    return {rule: (size(square[early]), size(square[~early])) for rule, (_, _, square) in best.items()}


def _changes(trajectory: Trajectory) -> bool:
    """Whether any examined command differs from the first."""
    return bool(np.any(trajectory.command[trajectory.command_time <= LOOKED_AT] != trajectory.command[0]))


def _sets_out(position: Float[np.ndarray, "rows coordinate"]) -> bool:
    """Whether a motion gathers speed after the first row, as one from rest does."""
    speed = np.linalg.norm(np.diff(position, axis=0), axis=1)
    return bool(speed[0] < CLEARLY * speed.max())


def _states(trajectory: Trajectory, lag: float) -> Float[np.ndarray, "command channel"]:
    """State of a first-order lag at the time of each command, started at the first command."""
    command = trajectory.command
    kept = np.exp(-np.diff(trajectory.command_time) / lag)
    state = np.empty_like(command)
    state[0] = command[0]
    for row in range(1, int(np.searchsorted(trajectory.command_time, LOOKED_AT))):
        state[row] = command[row - 1] + kept[row - 1] * (state[row - 1] - command[row - 1])
    return state


def _followed(
    trajectory: Trajectory, time: Float[np.ndarray, " n"], lag: float, state: Float[np.ndarray, "command channel"]
) -> tuple[Float[np.ndarray, "n channel"], Float[np.ndarray, " n"]]:
    """Commands after the lag at these times, and the remaining share of the state before the first command."""
    row = np.maximum(np.searchsorted(trajectory.command_time, time + 1e-9, side="right") - 1, 0)
    elapsed = np.maximum(time - trajectory.command_time[row], 0.0)
    kept = np.exp(-elapsed / lag)[:, None]
    followed = trajectory.command[row] + kept * (state[row] - trajectory.command[row])
    return followed, np.exp(-np.maximum(time - trajectory.command_time[0], 0.0) / lag)
