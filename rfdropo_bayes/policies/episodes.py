"""Many episodes of a task at once, each lane with its own parameters, goal, commands and age.

Gymnasium and Stable-Baselines3 use different interfaces of an environment; `gym_env` and `vec_env` provide them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.policies.randomisation import Randomisation, fitting
from rfdropo_bayes.policies.tasks import (
    EPISODE,
    FLOOR,
    MOVING,
    Actions,
    Observed,
    Task,
    distance_to,
    layout_of,
    parts_seen,
    resting_height,
    reward,
    shown_of,
)
from rfdropo_bayes.runtime import refuse_lost_threads
from rfdropo_bayes.simulators.control_session import Session
from rfdropo_bayes.simulators.parameters import check_names, check_value
from rfdropo_bayes.simulators.protocol import Observation, Result

REDRAWS = 200
"""Number of redraws for a lane whose initial state was not found. Under the uniform ranges of the virtual trunk one
draw in eight hangs clear of the cube, so one reset in 10^11 fails.
"""
LEVER = 0.0175
"""Half a side of the paper's cube [m]: distance from the centre of the points from which motion capture measures the
cube's rotation.
"""


class EpisodeStep(NamedTuple):
    """Result of an action in every lane."""

    observation: Float[np.ndarray, "lane size"]
    reward: Float[np.ndarray, " lane"]
    terminated: Bool[np.ndarray, " lane"]
    truncated: Bool[np.ndarray, " lane"]
    distance: Float[np.ndarray, " lane"]  # [m]; of the last good state if the simulation failed
    diverged: Bool[np.ndarray, " lane"]
    tension: Float[np.ndarray, " lane"]  # largest of any cable at the action's time steps [N]; NaN if unknown
    stopped: Bool[np.ndarray, " lane"]  # by the limit on tension


@dataclass(frozen=True)
class Settings:
    """Settings of a task."""

    # actions, observed, period, step: see `layout_of`
    actions: Actions = "discrete"
    observed: Observed = "paper"
    period: float = 0.05
    step: float | Sequence[float] | None = None
    # standard deviation of white noise on the observed positions of markers and cube [m]. A marker's displacement is
    # the difference of two observations, as on a robot.
    noise: float = 0.0
    # an episode ends within this distance of the goal [m]; None never, with the reward of staying there
    near: float | None = None
    # an episode ends once a cable pulls more [N], as drives stop then; None lets it pull
    tension_limit: float | None = None


class Episodes:
    """Lanes of a task.

    Args:
        simulator: simulator whose parameters are drawn, with or without mechanisms.
        task: goal and reward.
        lanes: number of episodes simulated at once.
        randomisation: source of the parameters.
        settings: settings of the task.

    Attributes:
        layout: layout of observations and actions.
        redrawn: number of parameter sets redrawn because no initial state was found.
        goal: goal of every lane [m].
        parameters: drawn or given parameters of every lane.

    Raises:
        InputError: a randomisation that does not fit the simulator, a task that does not fit the robot, or a limit on
            tensions that is not positive, or a limit without tensions in the observation.
    """

    def __init__(
        self, simulator: Any, task: Task, lanes: int, randomisation: Randomisation, settings: Settings
    ) -> None:
        self.task, self.settings, self.lanes = task, settings, lanes
        self.simulator, self.robot = simulator, simulator.robot
        limit = settings.tension_limit
        if limit is not None and not 0.0 < limit < np.inf:
            raise InputError(
                f"tension_limit = {limit:g} is not positive and finite",
                where=task.name,
                remedy="give a positive number [N]",
            )
        if limit is not None and not simulator.cable_names:
            raise _without_tensions(self.robot.name, "name its cables, see docs/your_simulator.md, or leave it out")
        self.layout = layout_of(task, self.robot, settings.actions, settings.observed, settings.period, settings.step)
        self.shown = shown_of(self.layout, self.robot)
        self._specs = {spec.name: spec for spec in simulator.parameters}
        self.randomisation = fitting(randomisation, simulator.parameters)
        self.session = Session(simulator, lanes, settings.period)
        self.redrawn, self._compared = 0, limit is None
        self.generators = [np.random.default_rng(child) for child in np.random.SeedSequence().spawn(lanes)]
        self.parameters: list[dict[str, float]] = [{} for _ in range(lanes)]
        markers = len(self.robot.marker_names)
        self.goal, self.commands = np.zeros((lanes, 3)), np.zeros((lanes, len(self.layout.channels)))
        self.age = np.zeros(lanes, dtype=int)
        self.first, self.worst = np.ones(lanes), np.full(lanes, FLOOR)
        self.marker = np.zeros((lanes, markers, 3))
        self.pose = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (lanes, 1)) if task.push else None
        self.seen, self.seen_before, self.seen_pose = self.marker, self.marker, self.pose

    def seed(self, lane: int, seed: int | np.random.SeedSequence) -> None:
        """Let a lane draw from a generator with this seed from now on; unseeded lanes draw fresh entropy."""
        self.generators[lane] = np.random.default_rng(seed)

    def reset(
        self, rows: Sequence[int] | Int[np.ndarray, " row"], options: Sequence[Mapping[str, Any]] | None = None
    ) -> Float[np.ndarray, "row size"]:
        """Begin an episode in some lanes; the others continue.

        Args:
            rows: lanes.
            options: values that replace draws, for each row: ``parameters`` by name, and ``goal`` [m].

        Returns:
            The first observations of these rows.

        Raises:
            InputError: an unknown option or parameter, values outside their bounds, no initial state after `REDRAWS`
                draws, or a limit on tension below the tension of every lane without an action.
        """
        refuse_lost_threads()
        rows = np.asarray(rows, dtype=int)
        given = [dict(option) for option in options] if options else [{} for _ in rows]
        for option in given:
            _check_options(option)
        for row, option in zip(rows, given, strict=True):
            low, high = np.array(self.task.goal_low), np.array(self.task.goal_high)
            drawn = self.generators[row].uniform(low, high)
            self.goal[row] = np.asarray(option.get("goal", drawn), dtype=float)
        waiting = {int(row): option.get("parameters") for row, option in zip(rows, given, strict=True)}
        for attempt in range(REDRAWS + 1):
            observation = self._begin(waiting)
            good = np.asarray(observation.status) == int(Result.OK)
            self._take(np.array(list(waiting))[good], _rows_of(observation, good))
            failed = [row for row, well in zip(waiting, good, strict=True) if not well]
            if not failed:
                self._compare_at_rest(rows)
                return self._observe(rows)
            fixed = [row for row in failed if waiting[row] is not None]
            if fixed or attempt == REDRAWS:
                row, code = failed[0], Result(int(np.asarray(observation.status)[~good][0]))
                raise InputError(
                    f"no initial state for {_brief(self.parameters[row])} ({code.name.lower().replace('_', ' ')})",
                    where=f"{self.task.name}, lane {row}",
                    remedy=code.remedy,
                )
            self.redrawn += len(failed)
            waiting = dict.fromkeys(failed)
        raise AssertionError("unreachable")

    def act(self, actions: np.ndarray) -> EpisodeStep:
        """One action in every lane.

        Raises:
            InputError: actions that are not finite, or no action of the layout; or JAX cannot compute in this process.
        """
        refuse_lost_threads()
        actions = np.asarray(actions)
        if not np.all(np.isfinite(actions)):
            raise InputError(
                f"{int(np.sum(~np.isfinite(actions)))} numbers of the actions are not finite",
                where=self.task.name,
                remedy="look for NaN in the policy",
            )
        change = self.layout.change(actions.reshape(self.lanes, *actions.shape[1:]))
        before = self.commands
        self.commands = np.clip(before + change, self.layout.low, self.layout.high)
        moved = np.mean(((self.commands - before) / np.max(self.layout.moves, axis=0)) ** 2, axis=1)
        observation = self.session.act(self.commands)
        good = (np.asarray(observation.status) == int(Result.OK)) & np.isfinite(observation.position).all(axis=(1, 2))
        self.marker = np.where(good[:, None, None], observation.position, self.marker)
        if self.pose is not None:
            self.pose = np.where(good[:, None], np.asarray(observation.object_pose), self.pose)
        self.age += 1
        self.seen_before = self.seen
        self._look(np.arange(self.lanes))
        distance = self.distance()
        gained = np.where(good, reward(distance, self.first) - MOVING * moved, FLOOR * (EPISODE - self.age + 1))
        ended = ~good if self.settings.near is None else ~good | (distance <= self.settings.near)
        tension, limit = self._largest_tension(observation, good), self.settings.tension_limit
        stopped = np.zeros(self.lanes, dtype=bool) if limit is None else good & (tension > limit)
        # Who holds still keeps the reward of the place: at the worst that was met, a stop is never worth more.
        self.worst = np.minimum(self.worst, gained)
        gained = np.where(stopped, self.worst * (EPISODE - self.age + 1), gained)
        ended |= stopped
        late = (self.age >= EPISODE) & ~ended
        return EpisodeStep(self._observe(np.arange(self.lanes)), gained, ended, late, distance, ~good, tension, stopped)

    def distance(self) -> Float[np.ndarray, " lane"]:
        """Distance of the tip, or of the cube, to the goal [m]."""
        place = self.marker[:, -1] if self.pose is None else self.pose[:, :3]
        return distance_to(self.task, place, self.goal)

    def begun_with(self, lane: int) -> dict[str, Any]:
        """Parameters and goal of a lane's episode, as options of `reset` that start it again."""
        return {"parameters": dict(self.parameters[lane]), "goal": self.goal[lane].tolist()}

    def _largest_tension(self, observation: Observation, good: Bool[np.ndarray, " lane"]) -> Float[np.ndarray, " lane"]:
        """Largest tension of any cable since the last action [N]; NaN if the simulator reports none, which is an error
        in ``good`` lanes under a limit.
        """
        tension = np.full(self.lanes, np.nan)
        if observation.peak is not None and self.simulator.cable_names:
            tension = np.asarray(observation.peak, dtype=float).max(axis=1)
        if self.settings.tension_limit is not None and not np.isfinite(tension[good]).all():
            raise _without_tensions(self.robot.name, "let its lanes return finite Motion.peak, or leave it out")
        return tension

    def _compare_at_rest(self, rows: Int[np.ndarray, " row"]) -> None:
        """Raise if a period without an action passes the limit in every lane; runs once, after a reset of all lanes.

        A session's first observation does not contain the tension of an arm that begins at rest.
        """
        if self._compared or len(rows) < self.lanes:
            return
        self._compared, before = True, self.session.save()
        observation = self.session.act(self.commands)
        self.session.restore(before)
        good = np.asarray(observation.status) == int(Result.OK)
        least, limit = (
            np.min(self._largest_tension(observation, good)[good], initial=np.inf),
            self.settings.tension_limit,
        )
        if limit is not None and limit < least < np.inf:
            raise InputError(
                f"cables of {self.robot.name} pull at least {least:.3g} N before any action, "
                f"above the limit of {limit:g} N",
                where="tension_limit",
                remedy="raise it, or leave it out",
            )

    def _begin(self, waiting: Mapping[int, Mapping[str, float] | None]) -> Observation:
        """Start lanes, with the parameters that are given or with draws."""
        rows = list(waiting)
        for row, values in waiting.items():
            drawn = self.randomisation.draw(self.generators[row]) if values is None else dict(values)
            check_names(drawn, self._specs.values(), where=self.task.name)
            for name, value in drawn.items():
                check_value(self._specs[name], value, where=self.task.name)
            self.parameters[row] = {name: float(value) for name, value in drawn.items()}
        names = list(dict.fromkeys(name for row in rows for name in self.parameters[row]))
        values_of = {
            name: np.array([self.parameters[row].get(name, self._specs[name].nominal) for row in rows])
            for name in names
        }
        if self.task.push:
            side = values_of.get("cube_side", np.full(len(rows), self._specs["cube_side"].nominal))
            up = int(np.argmax(np.abs(self.robot.gravity)))
            values_of[f"cube_{'xyz'[up]}"] = resting_height(self.robot, side)
        return self.session.reset(np.array(rows), values_of)

    def _take(self, rows: Int[np.ndarray, " row"], observation: Observation) -> None:
        """Set the state of lanes from an observation, at the start of an episode."""
        if not len(rows):
            return
        self.marker = self.marker.copy()
        self.marker[rows] = observation.position
        if self.pose is not None:
            self.pose = self.pose.copy()
            self.pose[rows] = observation.object_pose
        self.commands[rows], self.age[rows], self.worst[rows] = 0.0, 0, FLOOR
        self.first[rows] = self.distance()[rows]
        self._look(rows)
        self.seen_before = self.seen_before.copy()
        self.seen_before[rows] = self.seen[rows]

    def _look(self, rows: Int[np.ndarray, " row"]) -> None:
        """Observe some lanes, with the errors of motion capture."""
        noise, count = self.settings.noise, self.marker[0].size
        if not noise:
            self.seen, self.seen_pose = self.marker, self.pose
            return
        own = [self.generators[row] for row in rows]
        errors = noise * np.stack([rng.normal(size=count + (0 if self.pose is None else 6)) for rng in own])
        self.seen = self.seen.copy()
        self.seen[rows] = self.marker[rows] + errors[:, :count].reshape(-1, *self.marker.shape[1:])
        if self.pose is not None:
            assert self.seen_pose is not None
            self.seen_pose = self.seen_pose.copy()
            self.seen_pose[rows] = pose_with_errors(self.pose[rows], errors[:, count:])

    def _observe(self, rows: Int[np.ndarray, " row"]) -> Float[np.ndarray, "row size"]:
        seen, before = self.seen[rows], self.seen_before[rows]
        pose = None if self.seen_pose is None else self.seen_pose[rows]
        parts = parts_seen(self.shown, seen, before, self.goal[rows], self.commands[rows], pose)
        return self.layout.assemble(parts)


def pose_with_errors(
    pose: Float[np.ndarray, "row 7"], errors: Float[np.ndarray, "row 6"]
) -> Float[np.ndarray, "row 7"]:
    """Poses of a cube [m, quaternion x, y, z, w] with errors of motion capture [m]: of the centre, and of points at the
    distance `LEVER`, which rotate the cube.
    """
    turn = Rotation.from_rotvec(errors[:, 3:] / LEVER) * Rotation.from_quat(pose[:, 3:])
    return np.concatenate([pose[:, :3] + errors[:, :3], turn.as_quat()], axis=1)


def _rows_of(observation: Observation, chosen: Bool[np.ndarray, " row"]) -> Observation:
    """Some rows of an observation."""
    parts: list[Any] = [None if part is None else np.asarray(part)[chosen] for part in observation]
    return Observation(*parts)


def _without_tensions(name: str, remedy: str) -> InputError:
    return InputError(f"{name} gives no cable tensions between two actions", where="tension_limit", remedy=remedy)


def _check_options(option: Mapping[str, Any]) -> None:
    unknown = set(option) - {"parameters", "goal"}
    if unknown:
        raise InputError(f"unknown option {sorted(unknown)[0]!r}", where="reset", remedy="use parameters and goal")
    goal = option.get("goal")
    if goal is not None and (np.shape(goal) != (3,) or not np.all(np.isfinite(np.asarray(goal, dtype=float)))):
        raise InputError(f"goal = {goal!r} is not a point", where="reset", remedy="give three finite numbers in metres")


def _brief(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name} = {value:.4g}" for name, value in values.items()) or "nominal parameters"
