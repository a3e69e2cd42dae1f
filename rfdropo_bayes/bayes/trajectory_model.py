"""A simulator, its inferred parameters, recordings and the channels measured in them, as one numpyro model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import Array, Float, Int

from rfdropo_bayes.bayes.channels import Channel, FeatureChannel, Markers, ObjectPose, Seen
from rfdropo_bayes.bayes.channels.markers import noise_of_markers
from rfdropo_bayes.bayes.channels.object_pose import Placing, offset_of
from rfdropo_bayes.bayes.lanes import Lanes, lanes_of
from rfdropo_bayes.bayes.noise import Autoregression
from rfdropo_bayes.bayes.recordings import RecordingSet, gather_recordings
from rfdropo_bayes.bayes.scopes import Scopes
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.posteriors import label
from rfdropo_bayes.simulators.protocol import Observation, Simulator

Values = Mapping[str, Float[Array, "..."]]
Measured = Mapping[str, Float[Any, "..."]]
"""Measured arrays by channel, without times and places: other numbers are another data set."""


@dataclass(frozen=True)
class TrajectoryModel:
    """The probabilistic program: priors, rollouts of the simulator, channels of measurements."""

    simulator: Simulator  # anything that satisfies `Simulator`, mechanisms included
    scopes: Scopes  # inferred and fixed parameters, including the channels'
    recordings: RecordingSet  # commands and times of observation
    channels: tuple[Channel, ...]  # measurement channels, `Markers` first

    @classmethod
    def of_positions(
        cls,
        simulator: Simulator,
        scopes: Scopes,
        trajectories: Sequence[Trajectory],
        noise: str,
        known: Autoregression | None = None,
        markers: Sequence[str] = (),
    ) -> TrajectoryModel:
        """The model of marker positions alone.

        Args:
            simulator: see above; scopes: scopes of the simulator's parameters.
            trajectories: the recordings.
            noise: name of the noise of the positions.
            known: noise of ``markers``; None for inferred noise.

        Raises:
            InputError: a marker whose noise is not known, or see `gather_recordings`.
        """
        recordings = gather_recordings(simulator, trajectories)
        if known is not None:
            known = noise_of_markers(known, markers, recordings).at(recordings.steps)
        return cls(simulator, scopes, recordings, (Markers.gather(recordings, noise, known),))

    @property
    def markers(self) -> Markers:
        """The positions of the markers."""
        assert isinstance(self.channels[0], Markers)
        return self.channels[0]

    @property
    def noise(self) -> str:
        """Name of the noise of the positions."""
        return self.markers.model

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the measurement channels."""
        return tuple(channel.name for channel in self.channels)

    @cached_property
    def measured(self) -> Measured:
        """Measured arrays by channel."""
        return {channel.name: channel.measured for channel in self.channels}

    @cached_property
    def _poses(self) -> ObjectPose | None:
        return next((channel for channel in self.channels if isinstance(channel, ObjectPose)), None)

    @cached_property
    def _physical(self) -> frozenset[str]:
        return frozenset(spec.name for spec in self.simulator.parameters)

    @cached_property
    def compared(self) -> tuple[FeatureChannel, ...]:
        """Channels that have features."""
        return tuple(channel for channel in self.channels if isinstance(channel, FeatureChannel))

    @cached_property
    def lanes(self) -> Lanes:
        """The simulator's compiled rollouts, as a function of the parameters that this model gives it."""
        zeros, first = dict.fromkeys(self.scopes.names, jnp.zeros(())), self.recordings.names[0]
        given = jax.eval_shape(lambda: self.rollout_values(zeros, first))
        physical = tuple(spec.name for spec in self.simulator.parameters if spec.name in given)
        return lanes_of(self.simulator, self.recordings.marker_index, physical)

    @cached_property
    def programs(self) -> Programs:
        """Compiled functions of the model."""
        return Programs(self)

    def rollout_values(self, values: Values, recording: str) -> dict[str, Array]:
        """Parameters of the simulator for one recording.

        A body whose poses are measured starts at the first of them.
        """
        chosen = self.scopes.values_in(recording, values)
        physical = {name: jnp.asarray(value) for name, value in chosen.items() if name in self._physical}
        if self._poses is None:
            return physical
        assert isinstance(self.simulator, Placing)
        return self.simulator.with_object_at(physical, self._poses.measured[self.recordings.names.index(recording), 0])

    def simulate(self, values: Values) -> Observation:
        """Roll out every recording under a set of values, scalars: observations of the recordings' markers, with a
        leading axis over recordings.
        """
        per_recording = [self.rollout_values(values, name) for name in self.recordings.names]
        stacked = {name: jnp.stack([row[name] for row in per_recording]) for name in per_recording[0]}
        observed = jax.vmap(lambda v, c: self.simulator.rollout(v, c))(stacked, self.recordings.commands)
        return observed._replace(position=observed.position[:, :, self.recordings.marker_index])

    def seen(self, observation: Observation, values: Values) -> Seen:
        """An observation as channels want it, with the values that it was simulated under."""
        offset = jnp.stack([offset_of(self.rollout_values(values, name)) for name in self.recordings.names])
        return Seen(observation, {**self.scopes.fixed, **values}, offset)

    def row_density(
        self, seen: Seen, measured: Measured | None = None, shares: Mapping[str, Any] | None = None
    ) -> tuple[Float[Array, " time"], Int[Array, ""]]:
        """Log density of each row given the earlier rows, summed over recordings, and the worst result code.

        ``measured`` replaces the model's own data; ``shares`` are the weights of channels.
        """
        data = self.measured if measured is None else measured
        rows = jnp.zeros(self.recordings.time.shape[1])
        for channel in self.channels:
            density = channel.row_log_density(seen, data[channel.name])
            density = density if shares is None else shares[channel.name] * density
            rows = rows.at[: len(density)].add(density)
        return rows, jnp.max(seen.observation.status)

    def white(
        self, seen: Seen, measured: Measured | None = None, shares: Mapping[str, Any] | None = None
    ) -> dict[str, Float[Array, "..."]]:
        """Whitened residuals of an observation by channel, zero if masked; see `Channel.residuals` and
        `row_density`.
        """
        data = self.measured if measured is None else measured
        white = {channel.name: channel.residuals(seen, data[channel.name]) for channel in self.channels}
        return white if shares is None else {name: jnp.sqrt(shares[name]) * part for name, part in white.items()}

    def __call__(self, observe: bool = True) -> None:
        """The numpyro model; ``observe=False`` leaves the positions free, for predictive draws."""
        values: dict[str, Array] = {}
        for p in self.scopes.parameters:
            scale = p.scope.scaled_by
            prior = dist.Normal(0.0, values[scale]) if scale else p.prior
            values[p.name] = numpyro.sample(p.name, prior)
        seen = self.seen(self.simulate(values), values)
        numpyro.deterministic("status", seen.observation.status)
        for index, name in enumerate(self.recordings.names):
            rows = int(self.recordings.rows[index])
            measured = jnp.asarray(self.recordings.position[index, :rows]) if observe else None
            numpyro.sample(label("position", name), self.markers.distribution(seen, index), obs=measured)
        for channel in self.channels[1:] if observe else ():
            numpyro.factor(channel.name, channel.row_log_density(seen, channel.measured))


class Programs:
    """Functions of a model that are compiled beside its rollouts, for batches; each when it is first called."""

    def __init__(self, model: TrajectoryModel) -> None:
        physical, scopes = model.lanes.physical, model.scopes

        def theta(values: Values) -> Float[Array, "recording physical"]:
            rows = [model.rollout_values(values, name) for name in model.recordings.names]
            return jnp.stack([jnp.stack([jnp.asarray(row[name], float) for name in physical]) for row in rows])

        def features(seen: Seen) -> tuple[Array, Array]:
            columns = [c.features(c.expected(seen)) for c in model.compared]
            return jnp.concatenate(columns, axis=-1), jnp.max(seen.observation.status)

        def of_seen(function: Callable, *axes: None) -> Callable:
            """A function of what is seen, compiled for batches of observations and of the values behind them."""

            def one(observation: Observation, values: Values, *rest: Any) -> Any:
                return function(model.seen(observation, values), *rest)

            return jax.jit(jax.vmap(one, in_axes=(0, 0, *axes)))

        self.theta = jax.jit(jax.vmap(theta))
        self.unconstrained = jax.jit(scopes.to_unconstrained)
        self.constrained = jax.jit(scopes.from_unconstrained)
        self.log_prior = jax.jit(scopes.log_prior_unconstrained)
        self.rows, self.white = of_seen(model.row_density, None, None), of_seen(model.white, None, None)
        self.features = of_seen(features)
        gradient = jax.jit(jax.vmap(jax.grad(lambda u: scopes.log_prior_unconstrained(u[None])[0])))

        def hessian(u: Float[np.ndarray, " d"]) -> Float[np.ndarray, "d d"]:
            # Differences of exact gradients: a Hessian takes XLA several times as long to compile.
            steps = np.diag(1e-5 * np.maximum(1.0, np.abs(u)))
            above, below = np.split(np.asarray(gradient(np.concatenate([u + steps, u - steps]))), 2)
            matrix = (above - below) / (2.0 * np.diag(steps)[:, None])
            return 0.5 * (matrix + matrix.T)

        self.prior_derivatives = (lambda u: gradient(u[None])[0]), hessian
