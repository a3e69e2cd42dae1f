"""What simulators of a cable-driven robot share, whatever body they compute: parameters, drives and measurement."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rfdropo_bayes.fem.balance import Balance
from rfdropo_bayes.fem.layered import PointMap
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.commands import Commands, observed_at, sample
from rfdropo_bayes.simulators.engine import Motion
from rfdropo_bayes.simulators.extended import ExtendedSimulator
from rfdropo_bayes.simulators.mechanisms import (
    Mechanism,
    code_of,
)
from rfdropo_bayes.simulators.parameters import ParameterSpec
from rfdropo_bayes.simulators.protocol import Observation, Result

Values = Mapping[str, Float[Array, ""]]

EQUILIBRIUM_TOLERANCE = 1e-3
"""Static equilibrium counts as found when the unbalanced force is below this share of the largest force."""


def every_node(count: int) -> PointMap:
    """All nodes of a body as recorded points."""
    return PointMap(np.arange(count)[:, None], np.ones((count, 1)))


def sampled(balance: Balance, commands: Commands) -> Balance:
    """The rows of the observation times."""
    return Balance(*(sample(series, commands) for series in balance))


class Wound(NamedTuple):
    """Drives between two steps."""

    level: Float[Array, " cable"]  # displacement of the cables at their drives, without pretension [m]
    sent: Float[Array, " channel"]  # last command that reached them [m or rad]


class RobotSimulator(ExtendedSimulator):
    """Base of simulators that move a robot's body by cables; mechanisms act before, in and after the body.

    Attributes:
        robot: what is simulated.
        mechanisms: extensions, applied in the order given within each stage.
        time_step: of the simulation [s].
    """

    robot: Robot
    mechanisms: Sequence[Mechanism]
    time_step: float

    @property
    def lanes(self) -> int:
        """How many rollouts the simulator likes to be given at once."""
        raise NotImplementedError

    @property
    def description(self) -> dict[str, object]:
        """Engine, precision and discretisation, for the record."""
        raise NotImplementedError

    def commands(
        self,
        time: Float[np.ndarray, " command"],
        value: Float[np.ndarray, "command channel"],
        initial: Float[np.ndarray, " channel"],
        observation_time: Float[np.ndarray, " time"],
    ) -> Commands:
        """Recorded commands on the simulator's clock."""
        raise NotImplementedError

    def taken(
        self, recording: str, initial: Float[np.ndarray, " channel"], value: Float[np.ndarray, "command channel"]
    ) -> Float[np.ndarray, "command channel"]:
        """See `ExtendedSimulator.taken`; what happens to commands beyond the travel is stated by the robot.

        Raises:
            InputError: what is stated of the drives does not fit the recording; see `robots.travel_in`.
        """
        travel = self.robot.travel(recording, initial)
        return value if travel is None else travel.follow(initial, value)

    def rollout(self, parameters: Values, commands: Commands, steps: Int[Array, ""] | None = None) -> Observation:
        """Simulate from the initial state to the last observation, or ``steps`` time steps."""
        raise NotImplementedError

    def balance(self, parameters: Values, commands: Commands) -> Balance:
        """Forces on the body, energies, work and losses of a rollout at the observation times; see `fem.balance`.

        Always in double precision. Mechanisms of sensing have no part in it; a rollout that diverged says so only in
        `rollout`.

        Raises:
            InputError: a name that is not a parameter of this simulator, or cables with friction.
        """
        raise NotImplementedError

    def observation(self, values: Values, commands: Commands, motion: Motion, unsolved: Result) -> Observation:
        """What a motion shows; ``unsolved`` says how a rollout ended whose constraints were not all solved."""
        cases = (
            (motion.diverged, Result.DIVERGED),
            (motion.imbalance > EQUILIBRIUM_TOLERANCE, Result.NOT_IN_EQUILIBRIUM),
            (~motion.converged, unsolved),
        )
        status = jnp.select([case for case, _ in cases], [int(code) for _, code in cases], int(Result.OK))
        position = self.measured(values, sample(motion.position, commands), observed_at(commands, self.time_step))
        pose = None
        if motion.pose is not None:
            pose = sample(motion.pose, commands)
            pose = pose.at[:, 3:].divide(jnp.linalg.norm(pose[:, 3:], axis=1, keepdims=True))
        angle = self.driven(values, commands, self.time_step)
        return Observation(position, sample(motion.tension, commands), pose, status, angle)

    @cached_property
    def parameters(self) -> tuple[ParameterSpec, ...]:
        """Parameters of the robot, then those of the mechanisms."""
        base = tuple(
            ParameterSpec(name, p.unit, p.low, p.high, p.nominal, p.prior, p.description)
            for name, p in self.robot.parameter_table().items()
        )
        return base + tuple(spec for mechanism in self.mechanisms for spec in mechanism.parameters)

    @cached_property
    def content_sha256(self) -> str:
        """Digest of the robot's description and of the mechanisms' code: what their names do not tell."""
        return hashlib.sha256(self.robot.model_dump_json().encode() + code_of(self.mechanisms)).hexdigest()

    @property
    def command_unit(self) -> str:
        """Unit of the robot's commands: "m" of cable, or "rad" of a motor."""
        return self.robot.command.unit

    @property
    def marker_names(self) -> tuple[str, ...]:
        """Markers of the robot."""
        return self.robot.marker_names

    @property
    def cable_names(self) -> tuple[str, ...]:
        """Cables of the robot."""
        return self.robot.cable_names

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Command channels of the robot."""
        return self.robot.channel_names

    def pretension(self, values: Values) -> Float[Array, " cable"]:
        """Cable displacements at zero command [m]."""
        return jnp.stack([values[name] for name in self.robot.initial_displacement_names])

    def wound(
        self, values: Values, commands: Commands, time_step: float
    ) -> tuple[Float[Array, " cable"], Float[Array, "step cable"]]:
        """Cable displacements [m] before the first step and at the end of every step, by drives with end stops."""
        initial, command = self.actuated(values, commands, time_step)
        start = self.unwound(values, initial)
        levels = jax.lax.scan(lambda drives, sent: self.wind(values, drives, sent), start, command)[1]
        return start.level + self.pretension(values), levels

    def unwound(self, values: Values, initial: Float[Array, " channel"]) -> Wound:
        """The drives before the first step, where this command [m or rad] has reached them."""
        limits = self.robot.displacement_limits()
        level = self.robot.channel_matrix(values) @ initial
        return Wound(jnp.clip(level, limits[:, 0], limits[:, 1]), jnp.asarray(initial, float))

    def wind(
        self, values: Values, drives: Wound, sent: Float[Array, " channel"]
    ) -> tuple[Wound, Float[Array, " cable"]]:
        """The drives at the end of a step, and the cables' displacements [m], given the command that reached them."""
        limits = jnp.asarray(self.robot.displacement_limits())
        move = jnp.asarray(self.robot.channel_matrix(values)) @ (sent - drives.sent)
        # A drive at its limit ignores further pulls, and answers the first release at once.
        level = jnp.clip(drives.level + move, limits[:, 0], limits[:, 1])
        return Wound(level, sent), level + self.pretension(values)

    def marker_points(self) -> Float[np.ndarray, "marker 3"]:
        """Markers of the undeformed robot [m]."""
        return self.robot.marker_points()

    def measured(
        self,
        values: Values,
        position: Float[Array, "time marker 3"],
        time: Float[Array, " time"],
    ) -> Float[Array, "time marker 3"]:
        """See `ExtendedSimulator.measured`; the offset of the measuring frame is added last."""
        position = super().measured(values, position, time)
        return position + jnp.stack([values["offset_x"], values["offset_y"], values["offset_z"]])
