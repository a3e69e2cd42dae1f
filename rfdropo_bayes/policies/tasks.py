"""The tasks of the paper: goals, reward, observations and actions. No JAX, no simulator.

Facts of the scene and of the reward are taken from the authors' SOFA environments (RF-DROPO, section IV, and their
code). Differences, each with its reason: an episode does not end near the goal unless asked to, as that forfeits the
positive reward of staying there; and the cube starts at rest on its plate, whereas SOFA's cube first falls 23 mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.robots.policy_layout import CommandUnit, ObservationPart, PolicyLayout

Actions = Literal["discrete", "continuous"]
Observed = Literal["full", "paper", "markers"]

EPISODE = 100  # actions of an episode
PERIOD = 0.05
"""Control period [s]: five steps of SOFA's 10 ms. The authors' robot was driven at 10 Hz, a period of 0.1 s."""
STEP = 0.005  # largest movement of a cable by an action [m], by default
TRACKED_HEIGHTS = (0.0363, 0.0792, 0.1292, 0.179)
"""Heights along the axis at which motion capture tracks the physical trunk [m]."""


class Commanded(Protocol):
    """Interface that a task needs of a robot or its substitute."""

    name: str

    @property
    def marker_names(self) -> tuple[str, ...]:
        """Markers, the tip last."""

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Command channels."""

    @property
    def command_unit(self) -> CommandUnit:
        """Unit of the commands."""

    @property
    def push(self) -> Any:
        """A cube to push, and its plate; None without."""

    def command_limits(self) -> tuple[Float[np.ndarray, " channel"], Float[np.ndarray, " channel"]]:
        """Least and greatest command of each channel."""

    def command_of(self, pull: float) -> Float[np.ndarray, " channel"]:
        """Size of each channel's command that pulls a cable by ``pull`` [m]; ``pull`` itself if nothing is wound."""

    def markers_near(self, heights: Sequence[float]) -> tuple[int, ...]:
        """Indices of the markers nearest to these heights [m] of the undeformed body."""


@dataclass(frozen=True)
class Task:
    """A goal for the tip, or for a cube that the trunk pushes."""

    name: str  # name of the environment
    robot: str  # the robot it is made for
    push: bool  # whether a cube stands before the trunk; its centre must then reach the goal
    # goal_low, goal_high: corners of the box that goals are drawn from [m], in the frame of the base
    goal_low: tuple[float, float, float]
    goal_high: tuple[float, float, float]
    axes: tuple[int, ...]  # coordinates in which the distance to the goal is measured
    gamma: float  # discount factor of one action with which the task is learnt well


TASKS = {
    "TrunkReach-v0": Task(
        "TrunkReach-v0", "trunk_sofa", False, (-0.030, -0.050, 0.115), (0.030, 0.020, 0.150), (0, 1, 2), 0.95
    ),
    "TrunkPush-v0": Task(
        "TrunkPush-v0", "trunk_sofa", True, (0.100, -0.100, 0.050), (0.100, -0.100, 0.050), (0, 2), 0.98
    ),
}


def task_named(name: str) -> Task:
    """A task by the name of its environment; InputError if there is none."""
    if name not in TASKS:
        raise InputError(f"unknown task {name!r}", where="task", remedy=f"use {' or '.join(TASKS)}")
    return TASKS[name]


def potential(distance: Float[np.ndarray, " lane"]) -> Float[np.ndarray, " lane"]:
    """The potential of the authors' reward, for a distance in metres: it grows towards the goal."""
    millimetres = 1e3 * np.asarray(distance)
    return -0.006 * millimetres**2 - 500.0 * np.log(millimetres**2 + 1e-3)


def reward(
    distance: Float[np.ndarray, " lane"], first_distance: Float[np.ndarray, " lane"]
) -> Float[np.ndarray, " lane"]:
    """Reward of ending an action at a distance [m], in an episode that began at ``first_distance`` [m].

    It is -0.05 at the first distance and near 0.95 within a millimetre of the goal.
    """
    beginning = potential(np.maximum(first_distance, NEAREST))
    return (beginning - potential(distance)) / beginning - 0.05


MOVING = 0.5
"""Part of an action's reward that a policy loses if it moves every cable by the largest step.

A command is carried out over the robot's ramp. Ramps longer than the control period overlap: commands that alternate
then cancel each other, and the authors' reward does not see them. The tip leaves the goal once the policy stops.
"""
NEAREST = 0.005  # least initial distance that scales the rewards [m]: the potential goes through zero at a millimetre
FLOOR = -1.05
"""Reward for each action that is missing after a failed simulation: the reward at about twice the initial distance.
After a stop by the tension limit the episode's worst reward is used if it is lower.
"""


def distance_to(
    task: Task, place: Float[np.ndarray, "lane 3"], goal: Float[np.ndarray, "lane 3"]
) -> Float[np.ndarray, " lane"]:
    """Distance of the tip or of the cube's centre to the goal [m]."""
    axes = list(task.axes)
    return np.linalg.norm(place[:, axes] - goal[:, axes], axis=1)


def resting_height(robot: Robot, side: Float[np.ndarray, " lane"]) -> Float[np.ndarray, " lane"]:
    """Coordinate against gravity [m] of the centre of a cube that rests on the robot's plate.

    Raises:
        InputError: a robot without a plate.
    """
    if robot.push is None:
        raise InputError(f"robot {robot.name!r} has no cube to push", where="task", remedy="use a reaching task")
    return robot.push.plate_height_m + robot.push.contact_distance_m + 0.5 * np.asarray(side)


def layout_of(
    task: Task,
    robot: Commanded,
    actions: Actions,
    observed: Observed,
    period: float = PERIOD,
    step: float | Sequence[float] | None = None,
) -> PolicyLayout:
    """Observation and action of a task on a robot.

    Args:
        actions: "discrete", one channel pulled or released by ``step``, as in the paper; or "continuous", every channel
            moved by up to ``step``.
        observed: "paper", markers and goal, and the cube's pose; "full", also the commands in force and each
            marker's displacement since the last action; "markers", the same with the markers that motion capture sees.
        period: time from one action to the next [s].
        step: largest change of a channel per action, in the unit of its commands, or a value per channel; by default
            the command that pulls a cable by 5 mm, see `Commanded.command_of`.

    Raises:
        InputError: a cube for a robot that has none, or commands that nothing limits.
    """
    if task.push and robot.push is None:
        raise InputError(f"robot {robot.name!r} has no cube to push", where="task", remedy="use a reaching task")
    channels = robot.channel_names
    shown = len(robot.markers_near(TRACKED_HEIGHTS)) if observed == "markers" else len(robot.marker_names)
    parts = [ObservationPart("markers", 3 * shown, "m"), ObservationPart("goal", 3, "m")]
    parts += [ObservationPart("object", 7, "m, quaternion")] if task.push else []
    if observed != "paper":
        parts += [
            ObservationPart("commands", len(channels), robot.command_unit),
            ObservationPart("moved", 3 * shown, "m"),
        ]
    low, high = robot.command_limits()
    given = robot.command_of(STEP) if step is None else np.broadcast_to(step, len(channels))
    most = [float(f"{one:.9g}") for one in given]
    one = np.diag(most)
    moves = np.array([most]) if actions == "continuous" else np.concatenate([one, -one])
    return PolicyLayout(
        task=task.name,
        period_s=period,
        observation=tuple(parts),
        channels=channels,
        unit=robot.command_unit,
        kind=actions,
        moves=tuple(tuple(map(float, row)) for row in moves),
        low=tuple(map(float, low)),
        high=tuple(map(float, high)),
    )


def observed_of(layout: PolicyLayout, markers: int) -> Observed:
    """Kind of observation of a layout for ``markers`` markers; see `layout_of`."""
    sizes = {part.name: part.size for part in layout.observation}
    if "commands" not in sizes:
        return "paper"
    return "full" if sizes["markers"] == 3 * markers else "markers"


def shown_of(layout: PolicyLayout, robot: Commanded) -> list[int]:
    """Indices of the markers that a layout shows."""
    markers = next(part for part in layout.observation if part.name == "markers")
    every = len(robot.marker_names)
    return list(range(every)) if markers.size == 3 * every else list(robot.markers_near(TRACKED_HEIGHTS))


def parts_seen(
    shown: Sequence[int],
    marker: Float[np.ndarray, "lane marker 3"],
    before: Float[np.ndarray, "lane marker 3"],
    goal: Float[np.ndarray, "lane 3"],
    commands: Float[np.ndarray, "lane channel"],
    pose: Float[np.ndarray, "lane 7"] | None,
) -> dict[str, np.ndarray]:
    """Pieces of an observation that a layout may ask for, from the measurements now and one action ago."""
    seen, moved = marker[:, shown], (marker - before)[:, shown]
    lanes = len(goal)
    parts = {"markers": seen.reshape(lanes, -1), "goal": goal, "commands": commands, "moved": moved.reshape(lanes, -1)}
    return parts if pose is None else {**parts, "object": pose}
