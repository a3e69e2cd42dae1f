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
from rfdropo_bayes.simulators.mechanisms import (
    ActuationMechanism,
    Mechanism,
    SensingMechanism,
    TimedSensingMechanism,
    code_of,
    inside_drive,
    settled,
)
from rfdropo_bayes.simulators.parameters import ParameterSpec, check_names
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


class RobotSimulator:
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

    def complete(self, parameters: Values) -> dict[str, Array]:
        """All values by name; those left out are nominal.

        Raises:
            InputError: a name that is not a parameter of this simulator.
        """
        check_names(parameters, self.parameters, where="rollout")
        return {spec.name: jnp.asarray(spec.nominal) for spec in self.parameters} | dict(parameters)

    def actuated(
        self, values: Values, commands: Commands, time_step: float, *, drives_only: bool = False
    ) -> tuple[Float[Array, " channel"], Float[Array, "step channel"]]:
        """Commands that reach the cables before the first step and at the end of every step; or the drives, before the
        transmission."""
        command = jnp.asarray(commands.step)
        initial = jnp.asarray(commands.initial, command.dtype)
        for mechanism in self.mechanisms:
            if isinstance(mechanism, ActuationMechanism) and (inside_drive(mechanism) or not drives_only):
                command = mechanism.actuate(values, command, initial, time_step)
                initial = settled(mechanism, values, initial)
        return initial, command

    def driven(self, values: Values, commands: Commands, time_step: float) -> Float[Array, "time channel"]:
        """Where the drives stand at the observation times, in the unit of the commands.

        Limits of the cables' displacements are no part of it. Whoever does not look at it pays nothing under ``jit``.
        """
        initial, command = self.actuated(values, commands, time_step, drives_only=True)
        return sample(jnp.concatenate([initial[None], command]), commands)

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

    def steps_seen(
        self, values: Values, commands: Commands, time_step: float, steps: Int[Array, ""] | None
    ) -> Int[Array, ""] | None:
        """Time steps to simulate so that all rows within the first ``steps`` are measured as in a whole rollout.

        Mechanisms of sensing may look at later rows, as cameras on a clock that is late do. How far is found from what
        they make of positions that are unknown from some row on.
        """
        if steps is None or not any(isinstance(mechanism, TimedSensingMechanism) for mechanism in self.mechanisms):
            return steps
        values = {name: jax.lax.stop_gradient(value) for name, value in values.items()}
        end = jnp.asarray(commands.sample_step + (commands.sample_fraction > 0))
        time, rows = observed_at(commands, time_step), len(end)
        wanted = end <= steps
        place = jnp.asarray(self.robot.marker_points())

        def suffices(later: Array) -> Array:
            known = jnp.arange(rows) < wanted.sum() + later
            position = jnp.where(known[:, None, None], place, jnp.nan)
            seen = jnp.isfinite(self.measured(values, position, time)).all(axis=(1, 2))
            return jnp.all(seen | ~wanted)

        later = jnp.concatenate([jnp.zeros(1, int), 2 ** jnp.arange(max(rows - 1, 1).bit_length() + 1)])
        enough = jax.vmap(suffices)(later)
        found = jnp.where(enough.any(), later[jnp.argmax(enough)], rows)
        last = jnp.clip(wanted.sum() + found - 1, 0, rows - 1)
        return jnp.where(found > 0, jnp.maximum(steps, end[last]), steps)

    def measured(
        self,
        values: Values,
        position: Float[Array, "time marker 3"],
        time: Float[Array, " time"],
    ) -> Float[Array, "time marker 3"]:
        """Marker positions as they are measured [m], given the true ones and when they are seen [s]."""
        for mechanism in self.mechanisms:
            if isinstance(mechanism, SensingMechanism):
                position = mechanism.sense(values, position)
            elif isinstance(mechanism, TimedSensingMechanism):
                position = mechanism.sense_over_time(values, position, time)
        return position + jnp.stack([values["offset_x"], values["offset_y"], values["offset_z"]])
