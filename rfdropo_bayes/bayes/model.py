"""A simulator, its inferred parameters, a noise model and recordings, joined into one numpyro model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import Array, Float, Int, PRNGKeyArray

from rfdropo_bayes.bayes.angles import AngleData, angle_log_density, angle_residuals
from rfdropo_bayes.bayes.forces import (
    TensionData,
    Weighed,
    size_residuals,
    tension_log_density,
    tension_residuals,
    weighed_log_density,
    weighed_residuals,
)
from rfdropo_bayes.bayes.noise import Noise, Timeline, draw_noise, noise_values, row_log_density, timeline, whiten
from rfdropo_bayes.bayes.objects import ObjectData, Placing, object_log_density, object_residuals, offset_of
from rfdropo_bayes.bayes.space import SEPARATOR, ParameterSpace
from rfdropo_bayes.data import Trajectory, check_channels, shared_markers
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.commands import Commands, stack_commands
from rfdropo_bayes.simulators.protocol import Observation, Simulator

Values = Mapping[str, Float[Array, "..."]]


class Measured(NamedTuple):
    """The numbers that were measured, apart from when and where: another set of them is another data set.

    Attributes:
        position: marker positions [m]; zero where masked.
        tension: cable tensions [N]; or None.
        motor_angle: motor angles [rad]; or None.
        weighed: values of the weighed parts.
        object_pose: poses of the pushed body [m, quaternion]; or None.
    """

    position: Float[Any, "recording time marker 3"]
    tension: Float[Any, "recording time cable"] | None
    motor_angle: Float[Any, "recording time channel"] | None
    weighed: Float[Any, " weighed"]
    object_pose: Float[Any, "recording time 7"] | None = None


class TrajectoryNoise(dist.Distribution):
    """Measured marker positions of one recording, given the simulated ones; `noise.row_log_density` over all rows."""

    support = dist.constraints.independent(dist.constraints.real, 3)

    def __init__(
        self,
        position: Float[Array, "time marker 3"],
        noise: Noise,
        time: Float[Array, " time"],
        line: Timeline,
        *,
        validate_args: bool | None = None,
    ) -> None:
        self.position, self.noise, self.time, self.line = position, noise, time, line
        super().__init__((), position.shape, validate_args=validate_args)

    def sample(self, key: PRNGKeyArray, sample_shape: tuple[int, ...] = ()) -> Array:
        """Simulated positions plus one realisation of the noise."""
        count = int(np.prod(sample_shape))
        draw = partial(draw_noise, time=self.time, markers=self.position.shape[1], noise=self.noise)
        noise = jax.vmap(draw)(jax.random.split(key, count)).reshape(sample_shape + self.position.shape)
        return self.position + noise

    def log_prob(self, value: Float[Array, "time marker 3"]) -> Float[Array, ""]:
        """Log density of all valid rows."""
        return jnp.sum(row_log_density(value - self.position, self.noise, self.line))


@dataclass(frozen=True)
class RecordingSet:
    """Recordings as the arrays a likelihood needs, padded to a common length (padding is not valid).

    Attributes:
        names: one per recording.
        markers: the markers that all recordings have.
        marker_index: where these are among the simulator's.
        time: observation times, from zero [s].
        rows: number of rows of each recording.
        position: measured marker positions [m]; zero where masked.
        commands: commands on the simulator's clock.
    """

    names: tuple[str, ...]
    markers: tuple[str, ...]
    marker_index: Int[np.ndarray, " marker"]
    time: Float[np.ndarray, "recording time"]
    rows: Int[np.ndarray, " recording"]
    position: Float[np.ndarray, "recording time marker 3"]
    line: Timeline
    commands: Commands


def gather_recordings(simulator: Simulator, trajectories: Sequence[Trajectory]) -> RecordingSet:
    """Bring trajectories onto the simulator's clock and markers: those of the robot's that every recording has.

    Raises:
        InputError: no trajectory, two of one name, no marker in common, or another number of channels.
    """
    if not trajectories:
        raise InputError("no recordings", where="[data] fit", remedy="name at least one recording")
    names = tuple(trajectory.name for trajectory in trajectories)
    if len(set(names)) < len(names):
        raise InputError(f"two recordings share a name: {', '.join(names)}", where="[data]", remedy="list each once")
    length = max(len(trajectory.time) for trajectory in trajectories)
    markers = shared_markers(trajectories, simulator.marker_names)
    times, positions, valid, commands = [], [], [], []
    for trajectory in trajectories:
        chosen = [trajectory.marker_names.index(name) for name in markers]
        mask = np.asarray(trajectory.position_mask)[:, chosen]
        position = np.where(mask[:, :, None], np.asarray(trajectory.position)[:, chosen], 0.0)
        missing = length - len(trajectory.time)
        tail = trajectory.time[-1] + trajectory.dataset.attrs["sample_time"] * np.arange(1, missing + 1)
        times.append(np.concatenate([trajectory.time, tail]) - trajectory.time[0])
        positions.append(np.pad(position, ((0, missing), (0, 0), (0, 0))))
        valid.append(np.pad(mask, ((0, missing), (0, 0))))
        commands.append(_commands(simulator, trajectory))
    lines = [timeline(time, ok) for time, ok in zip(times, valid, strict=True)]
    return RecordingSet(
        names,
        markers,
        np.array([simulator.marker_names.index(name) for name in markers]),
        np.stack(times),
        np.array([len(trajectory.time) for trajectory in trajectories]),
        np.stack(positions),
        Timeline(*(np.stack(part) for part in zip(*lines, strict=True))),
        stack_commands(commands),
    )


def _commands(simulator: Simulator, trajectory: Trajectory) -> Commands:
    unit = getattr(simulator, "command_unit", trajectory.command_unit)
    check_channels(trajectory, simulator.channel_names, unit)
    return simulator.commands(trajectory.command_time, trajectory.command, trajectory.initial_command, trajectory.time)


@dataclass(frozen=True)
class TrajectoryModel:
    """The probabilistic program: priors, rollouts of the simulator, observation noise.

    Attributes:
        simulator: anything that satisfies `Simulator`, mechanisms included.
        space: inferred parameters, those of the noise among them.
        fixed: values of parameters that are not inferred and differ from their nominal value; of all recordings, or of
            one (``name@recording``).
        noise: name of the noise model, one of `NOISE_MODELS`.
        recordings: data.
        tension: measured cable tensions; None where they are not used.
        weighed: parameters known from measurements of their own.
        motor_angle: measured motor angles; None where they are not used.
        object_pose: measured poses of the pushed body, which then starts at the first of them; None where they are not
            used.
    """

    simulator: Simulator
    space: ParameterSpace
    fixed: Mapping[str, float]
    noise: str
    recordings: RecordingSet
    tension: TensionData | None = None
    weighed: tuple[Weighed, ...] = ()
    motor_angle: AngleData | None = None
    object_pose: ObjectData | None = None

    def noise_of(self, values: Mapping[str, Any]) -> Noise:
        """Values of the noise of the positions among a set of values."""
        return noise_values(self.noise, {**self.fixed, **values})

    @cached_property
    def _physical(self) -> frozenset[str]:
        return frozenset(spec.name for spec in self.simulator.parameters)

    @cached_property
    def _absent(self) -> dict[str, float]:
        """Nominal values of parameters that belong to some recordings only: the others have these."""
        own = {parameter.spec.name for parameter in self.space.parameters if parameter.recording}
        own |= {name.partition(SEPARATOR)[0] for name in self.fixed if SEPARATOR in name}
        return {spec.name: spec.nominal for spec in self.simulator.parameters if spec.name in own}

    def rollout_values(self, values: Values, recording: str) -> dict[str, Array]:
        """What the simulator is given for one recording: fixed and inferred physical parameters."""
        parts = ((name.partition(SEPARATOR), value) for name, value in self.fixed.items())
        fixed = {name: value for (name, _, owner), value in parts if owner in ("", recording)}
        chosen = {**self._absent, **fixed, **self.space.for_recording(values, recording)}
        physical = {name: jnp.asarray(value) for name, value in chosen.items() if name in self._physical}
        if self.object_pose is None:
            return physical
        assert isinstance(self.simulator, Placing)
        start = self.object_pose.measured[self.recordings.names.index(recording), 0]
        return self.simulator.with_object_at(physical, start)

    def simulate(self, values: Values, steps: Int[Array, ""] | None = None) -> Observation:
        """Roll out every recording under one set of values.

        Args:
            values: inferred parameters, scalars.
            steps: simulate only this many time steps (rows beyond hold no meaning); None for all, differentiable in
                reverse mode.

        Returns:
            observations with a leading axis over recordings, and the recordings' markers.
        """
        per_recording = [self.rollout_values(values, name) for name in self.recordings.names]
        stacked = {name: jnp.stack([row[name] for row in per_recording]) for name in per_recording[0]}
        observed = jax.vmap(lambda v, c: self.simulator.rollout(v, c, steps))(stacked, self.recordings.commands)
        return observed._replace(position=observed.position[:, :, self.recordings.marker_index])

    @cached_property
    def measured(self) -> Measured:
        """What was measured."""
        tension = None if self.tension is None else self.tension.measured
        angle = None if self.motor_angle is None else self.motor_angle.measured
        weighed = np.array([entry.value for entry in self.weighed])
        pose = None if self.object_pose is None else self.object_pose.measured
        return Measured(np.asarray(self.recordings.position), tension, angle, weighed, pose)

    def row_log_likelihood(
        self, values: Values, steps: Int[Array, ""] | None = None, measured: Measured | None = None
    ) -> tuple[Float[Array, " time"], Int[Array, ""]]:
        """Log density of each row given those before it, summed over recordings, and the worst result code.

        ``measured`` puts other data in the place of the model's own.
        """
        data = self.measured if measured is None else measured
        observation = self.simulate(values, steps)
        noise = self.noise_of(values)
        residual = data.position - observation.position
        density = jax.vmap(lambda r, line: row_log_density(r, noise, line))(residual, self.recordings.line)
        weighed = [entry._replace(value=value) for entry, value in zip(self.weighed, data.weighed, strict=True)]
        rows = jnp.sum(density, axis=0).at[0].add(weighed_log_density(values, weighed))
        if self.tension is not None:
            pulls = self.tension._replace(measured=data.tension)
            rows += tension_log_density(observation.tension, {**self.fixed, **values}, pulls)
        if self.motor_angle is not None:
            angles = self.motor_angle._replace(measured=data.motor_angle)
            rows += angle_log_density(observation.motor_angle, {**self.fixed, **values}, angles)
        if self.object_pose is not None:
            rows += object_log_density(*self._objects(values, observation, data))
        return rows, jnp.max(observation.status)

    def residuals(
        self, values: Values, steps: Int[Array, ""], measured: Measured | None = None
    ) -> tuple[Array, Array | None, Array | None, Array | None, Array | None]:
        """Whitened residuals, zero where masked: positions (recording, time, marker, 3), tensions and their sizes
        (recording, time, 2 cables), motor angles (recording, time, channel), poses of the body (recording, time, 1, 6),
        weighed parts; None for what there is not."""
        data = self.measured if measured is None else measured
        observation = self.simulate(values, steps)
        noise = self.noise_of(values)
        white = jax.vmap(lambda r, line: whiten(r, noise, line)[0])(
            data.position - observation.position, self.recordings.line
        )
        pulled = turned = moved = weighed = None
        if self.tension is not None:
            pulls = self.tension._replace(measured=data.tension)
            read, size = tension_residuals(observation.tension, {**self.fixed, **values}, pulls)
            pulled = jnp.concatenate([read, size_residuals(size, pulls)], axis=-1)
        if self.motor_angle is not None:
            angles = self.motor_angle._replace(measured=data.motor_angle)
            turned = angle_residuals(observation.motor_angle, {**self.fixed, **values}, angles)
        if self.object_pose is not None:
            moved, _ = object_residuals(*self._objects(values, observation, data))
        if self.weighed:
            entries = [entry._replace(value=value) for entry, value in zip(self.weighed, data.weighed, strict=True)]
            weighed = weighed_residuals(values, entries)
        return white, pulled, turned, moved, weighed

    def _objects(
        self, values: Values, observation: Observation, data: Measured
    ) -> tuple[Array, Array, dict[str, Any], ObjectData]:
        """Simulated poses of the body, offset of the measuring frame, values of the noise, and what was measured."""
        assert self.object_pose is not None
        assert observation.object_pose is not None
        known: dict[str, Any] = {**self.fixed, **values}
        offset = jnp.stack([offset_of(self.rollout_values(values, name)) for name in self.recordings.names])
        return observation.object_pose, offset, known, self.object_pose._replace(measured=data.object_pose)

    def __call__(self, observe: bool = True) -> None:
        """The numpyro model; ``observe=False`` leaves the positions free, for predictive draws."""
        values = {p.name: numpyro.sample(p.name, p.prior) for p in self.space.parameters}
        observation = self.simulate(values)
        noise = self.noise_of(values)
        numpyro.deterministic("status", observation.status)
        for index, name in enumerate(self.recordings.names):
            rows = int(self.recordings.rows[index])
            line = Timeline(*(part[index, :rows] for part in self.recordings.line))
            seen = TrajectoryNoise(
                observation.position[index, :rows], noise, jnp.asarray(self.recordings.time[index, :rows]), line
            )
            measured = jnp.asarray(self.recordings.position[index, :rows]) if observe else None
            numpyro.sample(f"position@{name}", seen, obs=measured)
        if observe and self.tension is not None:
            numpyro.factor("tension", tension_log_density(observation.tension, {**self.fixed, **values}, self.tension))
        if observe and self.motor_angle is not None:
            turned = angle_log_density(observation.motor_angle, {**self.fixed, **values}, self.motor_angle)
            numpyro.factor("motor_angle", turned)
        if observe and self.object_pose is not None:
            pushed = object_log_density(*self._objects(values, observation, self.measured))
            numpyro.factor("object_pose", pushed)
        if observe and self.weighed:
            numpyro.factor("weighed", weighed_log_density(values, self.weighed))
