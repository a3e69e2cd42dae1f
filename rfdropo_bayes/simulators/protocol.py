"""The interface of every simulator: parameters and commands in, an observation and a result code out."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Float, Int

from rfdropo_bayes.simulators.commands import Commands
from rfdropo_bayes.simulators.parameters import ParameterSpec


class Result(IntEnum):
    """Result code of a rollout. Everything but OK is counted and reported, and gets no weight in any inference."""

    OK = 0
    DIVERGED = 1
    CABLE_LIMIT = 2
    CONTACT_NOT_CONVERGED = 3
    NOT_IN_EQUILIBRIUM = 4

    @property
    def remedy(self) -> str:
        """Remedy for the user."""
        return _REMEDIES[self]


_REMEDIES = {
    Result.OK: "",
    Result.DIVERGED: "shorten the time step or narrow the priors of stiffness, mass and damping",
    Result.CABLE_LIMIT: "the cables could not reach their commanded lengths, or the body bears no equilibrium under "
    "their forces: check limits and initial displacements, and state a larger young_modulus",
    Result.CONTACT_NOT_CONVERGED: "shorten the time step: the contacts of a step were not solved",
    Result.NOT_IN_EQUILIBRIUM: "the initial pose was not found, or overlaps the cube: check gravity, stiffness, "
    "initial displacements and the cube's position",
}


class Observation(NamedTuple):
    """Observation of a rollout at the observation times, in the frame of the robot's base."""

    position: Float[Array, "time marker 3"]  # marker positions [m]
    tension: Float[Array, "time cable"]  # cable tensions [N]
    # position [m] and unit quaternion (x, y, z, w) of the object; None if the scene has none
    object_pose: Float[Array, "time 7"] | None
    status: Int[Array, ""]  # a `Result` value
    # drive positions: the command after all effects inside the drives, such as delay and lag, before the transmission
    # to the cables, in the unit of the commands [rad or m]; None if unknown
    motor_angle: Float[Array, "time channel"] | None = None
    # largest tension of each cable at the time steps of a session's last control period [N]; None if unknown. In 64
    # pushes of models/policies/push it was up to 3.3 times the tension at the periods' ends.
    peak: Float[Array, " cable"] | None = None
    # orientations of the robot's `orientations`, unit quaternions (x, y, z, w) from the base's axes to the section's;
    # None if unknown
    orientation: Float[Array, "time section 4"] | None = None


@runtime_checkable
class Simulator(Protocol):
    """Anything that turns named parameters and commands into an observation.

    ``rollout`` replays the whole command sequence from the initial state, without resets (RF-DROPO, eq. 2). A batch of
    rollouts is ``jax.vmap`` over the parameters.
    """

    @property
    def parameters(self) -> tuple[ParameterSpec, ...]:
        """Every parameter that may be given to ``rollout``; missing parameters take their nominal value."""

    @property
    def marker_names(self) -> tuple[str, ...]:
        """Names of the markers, in the order of ``Observation.position``."""

    @property
    def cable_names(self) -> tuple[str, ...]:
        """Names of the cables, in the order of ``Observation.tension``."""

    @property
    def description(self) -> dict[str, object]:
        """Engine, precision and discretisation, for the record."""

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the command channels, in the order of ``Commands.step``."""

    @property
    def lanes(self) -> int:
        """Preferred number of rollouts per call."""

    def commands(
        self,
        time: Float[np.ndarray, " command"],
        value: Float[np.ndarray, "command channel"],
        initial: Float[np.ndarray, " channel"],
        observation_time: Float[np.ndarray, " time"],
    ) -> Commands:
        """Convert a recorded command sequence to the simulator's own clock (see `commands_on_grid`)."""

    def rollout(
        self, parameters: Mapping[str, Float[Array, ""]], commands: Commands, steps: Int[Array, ""] | None = None
    ) -> Observation:
        """Simulate from the initial state to the last observation, or ``steps`` time steps only (rows beyond hold no
        meaning)."""
