"""Base of simulators with mechanisms: drives before the moving body, and measurement after it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rfdropo_bayes.robots import Travel
from rfdropo_bayes.runtime import refuse_lost_threads
from rfdropo_bayes.simulators.commands import Commands, observed_at, sample
from rfdropo_bayes.simulators.mechanisms import (
    ActuationMechanism,
    CommandedSensingMechanism,
    Meanwhile,
    Mechanism,
    SensingMechanism,
    TimedSensingMechanism,
    Values,
    inside_drive,
    settled,
)
from rfdropo_bayes.simulators.parameters import ParameterSpec, check_names
from rfdropo_bayes.simulators.port_signals import reached
from rfdropo_bayes.simulators.protocol import Result


class Wound(NamedTuple):
    """Drives between two steps."""

    level: Float[Array, " drive"]  # of cables at their drives, without pretension [m] or [N]; of chambers [Pa]
    sent: Float[Array, " channel"]  # last command that reached them [m or rad]


class ExtendedSimulator:
    """Base of simulators whose mechanisms act on the commands before the motion and on its measurement."""

    robot: Any  # moving robot; it names markers, cables and command channels
    mechanisms: Sequence[Mechanism]  # extensions, applied in the given order within each stage
    time_step: float  # time step of the simulation [s]

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

    @property
    def parameters(self) -> tuple[ParameterSpec, ...]:
        """Every parameter that may be given to ``rollout``, the mechanisms' last."""
        raise NotImplementedError

    def marker_points(self) -> Float[np.ndarray, "marker 3"]:
        """Any place that the markers can have [m]."""
        raise NotImplementedError

    def taken(
        self, recording: str, initial: Float[np.ndarray, " channel"], value: Float[np.ndarray, "command channel"]
    ) -> Float[np.ndarray, "command channel"]:
        """Commands of a recording after the drives' limits, from sent commands [m or rad]."""
        return value

    @property
    def integrator(self) -> str | None:
        """Integrator of time steps; None for a simulator without a choice of integrators."""
        return None

    @property
    def command_timing(self) -> tuple[float, float]:
        """Duration and delay of a command's change [s]."""
        return 0.0, 0.0

    def travel(self, recording: str, command: Float[np.ndarray, " channel"]) -> Travel | None:
        """Limits of the drives for commands that begin with ``command`` in a recording; None without limits."""
        return None

    def unwound(self, values: Values, initial: Float[Array, " channel"]) -> Wound:
        """The drives before the first step, settled at this command."""
        return Wound(initial, initial)

    def wind(self, values: Values, drives: Wound, sent: Float[Array, " channel"]) -> tuple[Wound, Float[Array, " in"]]:
        """The drives at the end of a step, and the resulting input of the body, from the command that reached the
        drives.
        """
        return Wound(sent, sent), sent

    def lane_start(self, values: Values, drives: Wound) -> Any:
        """Start of a lane of a session; see `body_lanes.LaneStart`."""
        raise NotImplementedError

    def begin_lanes(self, count: int) -> Any:
        """Bodies that continue from their state; see `body_lanes.BodyLanes`."""
        raise NotImplementedError

    @property
    def unsolved(self) -> Result:
        """Result code of a rollout with unsolved constraints."""
        return Result.DIVERGED

    def in_measuring_frame(self, values: Values, position: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
        """Measured positions [m], from positions in the base frame."""
        return position

    def complete(self, parameters: Values) -> dict[str, Array]:
        """All values by name; missing values are nominal.

        Raises:
            InputError: a name that is not a parameter of this simulator, or a process in which JAX cannot compute.
        """
        refuse_lost_threads()
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
        if commands.signals is not None and not drives_only:
            return reached(commands.signals, initial, command, time_step)
        return initial, command

    def driven(self, values: Values, commands: Commands, time_step: float) -> Float[Array, "time channel"]:
        """Positions of the drives at the observation times, in the unit of the commands.

        Limits of cable displacements are not included. Unused results cost nothing under ``jit``.
        """
        initial, command = self.actuated(values, commands, time_step, drives_only=True)
        return sample(jnp.concatenate([initial[None], command]), commands)

    def steps_seen(
        self, values: Values, commands: Commands, time_step: float, steps: Int[Array, ""] | None
    ) -> Int[Array, ""] | None:
        """Time steps to simulate so that all rows within the first ``steps`` are measured as in a whole rollout.

        Mechanisms of sensing may use later rows, e.g. cameras with a late clock. The look-ahead is found from
        their response to positions that are NaN from some row on.
        """
        ahead = TimedSensingMechanism | CommandedSensingMechanism
        if steps is None or not any(isinstance(mechanism, ahead) for mechanism in self.mechanisms):
            return steps
        values = {name: jax.lax.stop_gradient(value) for name, value in values.items()}
        end = jnp.asarray(commands.sample_step + (commands.sample_fraction > 0))
        time, rows = observed_at(commands, time_step), len(end)
        wanted = end <= steps
        place = jnp.asarray(self.marker_points())
        meanwhile = self.meanwhile(values, commands)

        def suffices(later: Array) -> Array:
            known = jnp.arange(rows) < wanted.sum() + later
            position = jnp.where(known[:, None, None], place, jnp.nan)
            seen = jnp.isfinite(self.measured(values, position, time, meanwhile)).all(axis=(1, 2))
            return jnp.all(seen | ~wanted)

        def doubled(tried: tuple[Array, Array]) -> tuple[Array, Array]:
            later = jnp.maximum(2 * tried[0], 1)
            return later, suffices(later)

        # Almost always no later row is needed: a loop asks once, all distances at once would take most of a rollout.
        none = jnp.asarray(0)
        later, enough = jax.lax.while_loop(lambda tried: ~tried[1] & (tried[0] < rows), doubled, (none, suffices(none)))
        found = jnp.where(enough, later, rows)
        last = jnp.clip(wanted.sum() + found - 1, 0, rows - 1)
        return jnp.where(found > 0, jnp.maximum(steps, end[last]), steps)

    def meanwhile(self, values: Values, commands: Commands) -> Meanwhile | None:
        """Commands at the cables, if a mechanism of sensing needs them."""
        if not any(isinstance(mechanism, CommandedSensingMechanism) for mechanism in self.mechanisms):
            return None
        initial, command = self.actuated(values, commands, self.time_step)
        return Meanwhile(jnp.concatenate([initial[None], command]), commands, self.time_step)

    def measured(
        self,
        values: Values,
        position: Float[Array, "time marker 3"],
        time: Float[Array, " time"],
        meanwhile: Meanwhile | None = None,
    ) -> Float[Array, "time marker 3"]:
        """Measured marker positions [m], from true positions, times of observation [s], and the result of
        `meanwhile`.
        """
        for mechanism in self.mechanisms:
            if isinstance(mechanism, SensingMechanism):
                position = mechanism.sense(values, position)
            elif isinstance(mechanism, TimedSensingMechanism):
                position = mechanism.sense_over_time(values, position, time)
            elif isinstance(mechanism, CommandedSensingMechanism):
                assert meanwhile is not None
                position = mechanism.sense_with_commands(values, position, time, meanwhile)
        return position
