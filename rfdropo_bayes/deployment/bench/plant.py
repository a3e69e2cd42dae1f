"""The plant that the drives pull on: the `Plant` protocol, cables as springs in closed form, a plant in its own
process.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import sys
from collections.abc import Mapping
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.deployment.clock import PLANT_PRIORITY, real_time, steady_interpreter
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Robot

START = 300.0  # [s]: a plant may compile itself first
_END = 5.0  # [s]: for the present step, and for the clean-up of its libraries


class PlantState(NamedTuple):
    """Measurable state of a plant."""

    tension: Float[np.ndarray, " channel"]  # tension of each channel's cable [N]
    position: Float[np.ndarray, "marker 3"]  # positions of the markers in the robot's base frame [m]
    # centre [m] and unit quaternion x, y, z, w of the pushed object; None without an object
    object_pose: Float[np.ndarray, "7"] | None = None


class Plant(Protocol):
    """A robot behind its drives."""

    def advance(self, length: Float[np.ndarray, " channel"], duration: float) -> PlantState:
        """Let time pass.

        Args:
            length: cable wound up by each drum at the end of that time [m], pull > 0.
            duration: time since the last call [s]; 0 at the first, which starts at rest with these lengths.

        Raises:
            InputError: the plant has no state at that time.
        """
        ...


class SpringCables:
    """Each cable a spring under pretension; markers lean towards the cables that are pulled, without inertia.

    Tension is ``max(0, pretension + stiffness x length)``. The marker at height z above the base moves across by ``lean
    x (z / z_tip)^2 x`` the sum of the pulls times the directions of their cables. Tests compute the closed forms; use a
    simulated trunk if the motion matters.

    Args:
        robot: gives channels, cables and markers.
        stiffness: stiffness of every cable [N/m].
        pretension: tension at length zero [N].
        lean: sideways motion of the tip per metre of pull [-].
    """

    def __init__(self, robot: Robot, stiffness: float = 400.0, pretension: float = 2.0, lean: float = 2.0) -> None:
        self.stiffness, self.pretension = stiffness, pretension
        azimuth = np.deg2rad([cable.azimuth_deg for cable in robot.cables])
        across = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)], axis=1)
        self._direction = np.sign(np.array(robot.channels.gain)).T @ across
        self._rest = robot.marker_points()
        height = self._rest[:, 2] / max(self._rest[:, 2].max(), 1e-9)
        self._lean = lean * height**2

    def advance(self, length: Float[np.ndarray, " channel"], duration: float) -> PlantState:
        """Tensions and markers at these lengths; the past does not matter."""
        tension = np.maximum(0.0, self.pretension + self.stiffness * np.asarray(length))
        return PlantState(tension, self._rest + self._lean[:, None] * (np.asarray(length) @ self._direction))


def build_plant(name: str, robot: Robot, settings: Mapping[str, Any] | None = None) -> Plant:
    """The plant of that name: "springs", or MODULE:CALLABLE, called with the robot and the settings.

    Raises:
        InputError: the plant does not exist, or does not take the settings.
    """
    try:
        if name == "springs":
            return SpringCables(robot, **(settings or {}))
        module, _, attribute = name.partition(":")
        return getattr(importlib.import_module(module), attribute)(robot, **(settings or {}))
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise InputError(
            f"cannot load the plant {name!r} ({error})", where="plant", remedy="give springs, or MODULE:CALLABLE"
        ) from None


class PlantHere:
    """A plant in this process.

    Args:
        plant: plant to query.
    """

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self._state: PlantState | None = None

    def request(self, length: Float[np.ndarray, " channel"], duration: float) -> None:
        """Let time pass, until the drums have reached these lengths [m]."""
        self._state = self._plant.advance(length, duration)

    def newest(self) -> PlantState:
        """State at the end of the last request."""
        assert self._state is not None
        return self._state


class PlantProcess:
    """A plant in a separate process. Drives never wait for the plant: they use the newest state that it has sent.

    A plant slower than real time lags behind; ``late`` is the delay.

    Args:
        name, robot, settings: see `build_plant`; called in the new process.
    """

    def __init__(self, name: str, robot: Robot, settings: Mapping[str, Any] | None = None) -> None:
        context = multiprocessing.get_context("spawn")  # a fork would copy the locks of whatever threads run here
        self._pipe, other = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(other, name, robot.model_dump(), dict(settings or {})), daemon=True
        )
        self._process.start()
        other.close()
        channels = len(robot.channel_names)
        self._state = PlantState(np.zeros(channels), robot.marker_points())
        self._sent, self._answered = 0.0, 0.0
        if not self._pipe.poll(START):
            self.close()
            raise InputError(
                f"did not start within {START:g} s", where=f"plant {name}", remedy="try it in this process"
            )
        self._receive()

    def request(self, length: Float[np.ndarray, " channel"], duration: float) -> None:
        """Let time pass, until the drums have reached these lengths [m]; returns at once."""
        self._sent += duration
        self._pipe.send((self._sent, np.asarray(length)))

    def newest(self) -> PlantState:
        """The newest state there is."""
        while self._pipe.poll():
            self._receive()
        return self._state

    @property
    def late(self) -> float:
        """Age [s] of the command that the newest state answers."""
        return self._sent - self._answered

    def close(self) -> None:
        """End the process, which exits by itself once requests stop, and is terminated otherwise."""
        self._pipe.close()
        self._process.join(_END)
        self._process.terminate()
        self._process.join(_END)

    def _receive(self) -> None:
        try:
            answer = self._pipe.recv()
        except (EOFError, ConnectionError):
            raise InputError(
                "the process of the plant has died", where="plant", remedy="run it in this process to see why"
            ) from None
        if isinstance(answer, str):
            raise InputError(answer, where="plant")
        self._answered, self._state = answer


def _serve(pipe: Connection, name: str, robot: dict[str, Any], settings: dict[str, Any]) -> None:
    """Body of the process: take the newest lengths, let the time in between pass, answer."""
    try:
        plant = build_plant(name, Robot.model_validate(robot), settings)
        length = np.zeros(len(robot["channels"]["names"]))
        state = plant.advance(length, 0.0)
        # Numerical libraries have threads of their own.
        threads = map(int, os.listdir("/proc/self/task")) if sys.platform == "linux" else ()
        with real_time(PLANT_PRIORITY, threads), steady_interpreter():
            pipe.send((0.0, state))
            reached = 0.0
            while True:
                instant, length = pipe.recv()
                while pipe.poll():
                    instant, length = pipe.recv()
                pipe.send((instant, plant.advance(length, instant - reached)))
                reached = instant
    except (EOFError, ConnectionError, KeyboardInterrupt):
        return
    except InputError as error:
        pipe.send(str(error))
