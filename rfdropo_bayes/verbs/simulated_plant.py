"""A simulated robot behind simulated drives: the plant of ``rfdropo deploy --mode dry-run`` and ``rfdropo drives``.

The deployment file names it: ``plant = "rfdropo_bayes.verbs.simulated_plant:trunk"``, with ``own_process = true``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from jaxtyping import Float

from rfdropo_bayes.deployment.bench.plant import PlantState
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.assembly import build_robot_simulator, physical_values, robot_of
from rfdropo_bayes.model.experiment import Experiment, load_experiment
from rfdropo_bayes.model.experiment_file import override
from rfdropo_bayes.model.model_spec import spec_of
from rfdropo_bayes.policies.episodes import pose_with_errors
from rfdropo_bayes.policies.tasks import resting_height
from rfdropo_bayes.robots import OBJECT, Robot
from rfdropo_bayes.robots.robot import CommandTiming
from rfdropo_bayes.simulators.control_session import Session
from rfdropo_bayes.simulators.protocol import Observation, Result
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator
from rfdropo_bayes.tables import changed

PERIOD = 0.01  # [s]: drums turn steadily between two states this far apart


def trunk(
    robot: Robot, experiment: str = "", marker_noise: float = 0.0, seed: int = 0, **changes: float | str | bool
) -> SimulatedTrunk:
    """The trunk that an experiment file describes, or the robot itself.

    Args:
        robot: deployed robot with motors.
        experiment: file whose robot, [simulator], mechanisms and [model.fixed] are the truth; by default ``robot``.
        marker_noise: standard deviation of white noise on every coordinate of a marker, and on points of a cube [m].
        seed: seed of the noise.
        changes: entries that replace the experiment's, as ``--set`` takes them: a parameter's name, or ``"table.key"``.

    Raises:
        InputError: a bad experiment, or a robot with other channels or markers than the deployed robot.
    """
    simulator, values = true_simulator(robot, experiment, changes)
    command = simulator.robot.command
    # Drums turn steadily from one state to the next. Ramps and delays of commands act before the plant.
    period = simulator.time_step * max(1, round(PERIOD / simulator.time_step))
    timing = CommandTiming(unit=command.unit, ramp_s=period, dead_time_s=0.0)
    base = simulator.robot.with_changes(command=timing)
    simulator, values = true_simulator(robot, experiment, changes, base)
    specs = {spec.name: spec for spec in simulator.parameters}
    if "cube_side" in specs:  # as an episode of a task begins
        up, side = int(np.argmax(np.abs(base.gravity))), values.get("cube_side", specs["cube_side"].nominal)
        height = f"cube_{'xyz'[up]}"
        if height in values:
            remedy = f"leave {height} out: the cube begins at rest on its plate"
            raise InputError(f"{height} = {values[height]:g} is given", where="[simulation.settings]", remedy=remedy)
        values |= {height: float(resting_height(base, np.array(side)))}
    return SimulatedTrunk(robot, simulator, period, values, marker_noise, seed)


def true_simulator(
    robot: Robot, experiment: str, changes: Mapping[str, float | str | bool], base: Robot | None = None
) -> tuple[RobotSimulator, dict[str, float]]:
    """The simulator behind `trunk` and the values of its parameters, with the commands' own timing.

    Args:
        robot, experiment, changes: see `trunk`.
        base: instead of the experiment's robot.

    Raises:
        InputError: channels, markers or the unit of commands differ from the robot's.
    """
    overrides = [f"{name}={tomli_w.dumps({'x': value})[4:].strip()}" for name, value in changes.items()]
    if experiment:
        described, folder = load_experiment(Path(experiment), overrides)[0], Path(experiment).resolve().parent
    else:
        tables: dict[str, Any] = {"robot": robot.name}
        for assignment in overrides:
            override(tables, assignment, Experiment.model_fields)
        described, folder, base = Experiment.model_validate(tables), Path(), base or robot
    spec = spec_of(described, folder, base)
    base = robot_of(spec)
    for what, given, wanted in (
        ("channels", base.channel_names, robot.channel_names),
        ("markers", base.marker_names, robot.marker_names),
        ("unit of commands", base.command_unit, robot.command_unit),
    ):
        if given != wanted:
            raise InputError(
                f"its {what} are {given}, those of {robot.name} {wanted}",
                where=f"plant {base.name}",
                remedy="deploy a robot with the same values",
            )
    table = spec.simulator
    fixed = {name: value for name, value in spec.fixed.items() if table.push or name not in OBJECT}
    alone = changed(table, where="[simulator]", drives="robot", threads=table.threads or 1)
    spec = replace(spec, fixed=fixed, simulator=alone)
    simulator = build_robot_simulator(spec)
    return simulator, physical_values(spec, simulator)


class SimulatedTrunk:
    """A session of one lane as a `deployment.Plant`.

    Args:
        robot: robot whose motors wind the cables.
        simulator: simulator of the same channels and markers, whose commands ramp over a period.
        period: control period of the session [s].
        values: values of the simulator's parameters.
        marker_noise: see `trunk` [m].
        seed: seed of the noise.
    """

    def __init__(
        self,
        robot: Robot,
        simulator: RobotSimulator,
        period: float,
        values: dict[str, float],
        marker_noise: float = 0.0,
        seed: int = 0,
    ) -> None:
        self._session, self._values, self._period = Session(simulator, 1, period), values, period
        self._noise, self._random = marker_noise, np.random.default_rng(seed)
        self._matrix = np.asarray(simulator.robot.channel_matrix(values), dtype=float)
        radius = np.array([motor.drum_radius_m for motor in robot.motors])
        self._scale = radius if robot.command_unit == "rad" else np.ones(len(robot.motors))  # command unit -> m
        self._waiting, self._length, self._begun = 0.0, np.zeros(len(robot.motors)), False
        self._start(self._length)
        self._step(self._length)  # compiles; the first call starts anew

    def advance(self, length: Float[np.ndarray, " channel"], duration: float) -> PlantState:
        """See `deployment.Plant`. Whole periods are simulated; the rest waits for the next call.

        Raises:
            InputError: if the simulation diverges.
        """
        length = np.asarray(length, dtype=float)
        if not self._begun and duration == 0.0:
            self._start(length)
            return self._seen()
        self._begun = True
        self._waiting += duration
        periods = round(self._waiting / self._period)
        self._waiting -= periods * self._period
        for reached in np.linspace(self._length, length, periods + 1)[1:]:
            self._step(reached)
        return self._seen()

    def _start(self, length: Float[np.ndarray, " channel"]) -> None:
        self._length = length
        state = self._session.reset(np.array([0]), self._values, command=(length / self._scale)[None])
        self._take(state)

    def _step(self, length: Float[np.ndarray, " channel"]) -> None:
        self._length = length
        self._take(self._session.act((length / self._scale)[None]))

    def _take(self, state: Observation) -> None:
        status = Result(int(np.asarray(state.status)[0]))
        if status in (Result.DIVERGED, Result.NOT_IN_EQUILIBRIUM):
            raise InputError(
                f"the simulation ends ({status.name.lower().replace('_', ' ')})", where="plant", remedy=status.remedy
            )
        self._state = state

    def _seen(self) -> PlantState:
        # By virtual work: a drum holds its cables' tensions, each times its displacement per command, at the drum's
        # radius.
        tension = self._matrix.T @ np.asarray(self._state.tension, dtype=float)[0] / self._scale
        position = np.asarray(self._state.position, dtype=float)[0]
        position = position + self._noise * self._random.standard_normal(position.shape)
        if self._state.object_pose is None:
            return PlantState(tension, position)
        errors = self._noise * self._random.standard_normal((1, 6))
        return PlantState(tension, position, pose_with_errors(np.asarray(self._state.object_pose), errors)[0])
