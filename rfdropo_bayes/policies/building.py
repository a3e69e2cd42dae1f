"""Environments from a few names: task, mechanisms, randomisation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.mechanisms import mechanisms_named
from rfdropo_bayes.policies.episodes import Episodes, Settings
from rfdropo_bayes.policies.randomisation import Point, Randomisation
from rfdropo_bayes.policies.tasks import task_named
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.body_engine import Backend, Engine, Integrator
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator
from rfdropo_bayes.simulators.trunk import Discretisation, TrunkSimulator, assemble


def trunk_simulator(
    robot: Robot,
    *,
    push: bool = False,
    mechanisms: Sequence[str] = (),
    precision: Literal["float32", "float64"] = "float64",
    threads: int | None = None,
    time_step: float | None = None,
    integrator: Integrator | None = None,
    folder: Path = Path(),
) -> RobotSimulator:
    """The rod on the compiled engine, as episodes want it.

    Args:
        push: whether the robot's cube and plate are simulated.
        mechanisms: extensions by name, or of a file relative to ``folder``.
        precision: precision of the body's motion, as in an experiment file; single precision is up to twice as fast and
            moves the
            tip by 0.01 mm.
        threads: number of threads of the engine; all processors by default.
        time_step: [s]; the robot's own by default.
        integrator: scheme of a time step; the robot's by default.
    """
    discretisation = Discretisation(time_step or robot.time_step_s)
    assembly = assemble(robot, discretisation)
    backend = Backend("numba", precision, threads)
    settled = robot.initial_state == "equilibrium"
    engine = Engine(assembly, discretisation.time_step, backend, settled, integrator=integrator or robot.integrator)
    effects = mechanisms_named(list(mechanisms), robot, folder=folder)
    trunk = TrunkSimulator(robot, engine, assembly, discretisation, effects)
    return trunk.pushing() if push else trunk


def make_episodes(
    task: str,
    lanes: int,
    *,
    simulator: RobotSimulator | None = None,
    robot: str | Robot | None = None,
    mechanisms: Sequence[str] = (),
    parameters: Mapping[str, float] | None = None,
    randomisation: Randomisation | None = None,
    precision: Literal["float32", "float64"] = "float64",
    threads: int | None = None,
    integrator: Integrator | None = None,
    **settings: Any,
) -> Episodes:
    """Lanes of a task.

    Args:
        task: name of the environment.
        lanes: number of episodes simulated at once.
        simulator: simulator to use unchanged; made from the next arguments by default.
        robot: name, file or description; the task's own by default.
        mechanisms, precision, threads, integrator: see `trunk_simulator`.
        parameters: fixed values; the others are nominal.
        randomisation: randomisation of parameters; instead of ``parameters``.
        settings: see `Settings`.

    Raises:
        InputError: unknown names, or settings that do not fit the robot.
    """
    chosen = task_named(task)
    if simulator is None:
        described = robot if isinstance(robot, Robot) else Robot.load(robot or chosen.robot)
        options: dict[str, Any] = {"precision": precision, "threads": threads, "integrator": integrator}
        simulator = trunk_simulator(described, push=chosen.push, mechanisms=mechanisms, **options)
    if randomisation is not None and parameters:
        raise InputError(
            "both fixed parameters and a randomisation are given", where=task, remedy="give one of the two"
        )
    known = set(Settings.__dataclass_fields__)
    for name in settings:
        if name not in known:
            raise InputError(f"unknown setting {name!r}", where=task, remedy=f"use one of {', '.join(sorted(known))}")
    return Episodes(simulator, chosen, lanes, randomisation or Point(parameters or {}), Settings(**settings))
