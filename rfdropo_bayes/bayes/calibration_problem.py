"""A `TrajectoryModel` as the problem that the inference methods see: named parameters in, log likelihoods out."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from rfdropo_bayes.bayes.batches import chunk_sizes, in_chunks, is_batch, padded
from rfdropo_bayes.bayes.channels import Channel, Series
from rfdropo_bayes.bayes.trajectory_model import Measured, TrajectoryModel
from rfdropo_bayes.posteriors import DrawsByOwner
from rfdropo_bayes.simulators.protocol import Observation, Result

Batch = Mapping[str, Float[Array | np.ndarray, " n"]]


@dataclass(frozen=True, eq=False)
class CalibrationProblem:
    """Posterior over the parameters of a `TrajectoryModel`, evaluated in batches of a few sizes.

    Rows are time steps: horizon ``h`` means the first ``h`` rows of every recording (eq. 3 of RF-DROPO). A batch is cut
    into chunks of at most ``chunk`` parameter sets, and the last chunk is padded to one of `chunk_sizes`: a few
    compilations suffice for every batch size. The number of simulated steps is a run-time argument, so that they
    suffice for every horizon. Problems of one model share its compiled programs.
    """

    model: TrajectoryModel  # priors, simulator and data
    chunk: int = 32  # most parameter sets in one compiled call
    # draws of the posterior of another model of the same robot, from which optimisations may start; missing parameters
    # start from their priors
    earlier: DrawsByOwner = field(default_factory=dict)
    other: Measured | None = None  # measured data in place of the model's data; None for the model's
    # factors of the log likelihood of some channels; the other factors are 1
    counted: Mapping[str, float] = field(default_factory=dict)
    # called with the number of rollouts, in full-length equivalents, after each chunk
    count_rollouts: Callable[[float], None] = lambda rollouts: None

    @property
    def names(self) -> tuple[str, ...]:
        """Labels of the inferred parameters, in sampling order."""
        return self.model.scopes.names

    @property
    def measured(self) -> Measured:
        """The data, by channel."""
        return self.model.measured if self.other is None else self.other

    @cached_property
    def shares(self) -> dict[str, float]:
        """Factor of the log likelihood of each channel."""
        return {**dict.fromkeys(self.measured, 1.0), **self.counted}

    @cached_property
    def units(self) -> dict[str, str]:
        """Unit of each parameter."""
        return {p.name: p.spec.unit for p in self.model.scopes.parameters}

    @cached_property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """Hard bounds of each parameter."""
        return {p.name: (p.spec.low, p.spec.high) for p in self.model.scopes.parameters}

    @cached_property
    def prior_ends(self) -> dict[str, tuple[float, float]]:
        """Ends of each parameter's prior."""
        return {p.name: p.ends for p in self.model.scopes.parameters}

    @property
    def n_rows(self) -> int:
        """Rows of the longest recording."""
        return self.model.recordings.time.shape[1]

    @property
    def n_recordings(self) -> int:
        """Number of recordings."""
        return len(self.model.recordings.names)

    @property
    def status_names(self) -> dict[int, str]:
        """Words for the codes of rollouts."""
        return {int(result): result.name.lower() for result in Result}

    @property
    def scales(self) -> Mapping[str, tuple[str, ...]]:
        return self.model.scopes.scales

    @property
    def typical_scales(self) -> dict[str, float]:
        return self.model.scopes.typical_scales

    @cached_property
    def physical_names(self) -> tuple[str, ...]:
        """Parameters of the simulation, and their standard deviations between groups."""
        physical = {spec.name for spec in self.model.simulator.parameters}
        every = self.model.scopes.parameters
        return tuple(p.name for p in every if p.physical in physical or p.name in self.scales)

    @cached_property
    def fingerprint(self) -> str:
        """Digest of data, parameters and simulator: a checkpoint is valid for one problem only."""
        digest = hashlib.sha256()
        recordings = self.model.recordings
        data = self.measured.values()
        for array in (*data, recordings.time, *jax.tree.leaves((recordings.line, recordings.commands))):
            digest.update(np.ascontiguousarray(array).tobytes())
        priors = [(p.name, sorted(p.table.items())) for p in self.model.scopes.parameters]
        rest = (
            priors,
            sorted(self.model.scopes.fixed.items()),
            [(channel.name, _plain(channel)) for channel in self.model.channels],
            self.model.noise,
            sorted(self.model.simulator.description.items()),
            sorted(self.shares.items()),
            *(
                (name, owner, np.asarray(draws).tobytes())
                for name, own in sorted(self.earlier.items())
                for owner, draws in sorted(own.items())
            ),
        )
        digest.update(repr(rest).encode())
        return digest.hexdigest()

    def holding(self, values: Mapping[str, float]) -> CalibrationProblem:
        """The same problem with some parameters fixed; itself if ``values`` is empty."""
        if not values:
            return self
        return replace(self, model=replace(self.model, scopes=self.model.scopes.holding(values)))

    def telling(self, spent: Callable[[float], None]) -> CalibrationProblem:
        """The same problem, which reports rollouts in full-length equivalents to ``spent``."""
        return replace(self, count_rollouts=spent)

    def counting(self, shares: Mapping[str, float]) -> CalibrationProblem:
        """The same problem with the log likelihood of some channels times a share."""
        return replace(self, counted={**self.counted, **shares})

    def scale_log_prior(self, values: Float[np.ndarray, "n scale"]) -> Float[np.ndarray, " n"]:
        """Log density of the prior of the standard deviations, in the order of ``scales``."""
        priors = [self.model.scopes[name].prior for name in self.scales]
        return np.sum([np.asarray(p.log_prob(column)) for p, column in zip(priors, values.T, strict=True)], axis=0)

    def sample_prior(self, key: PRNGKeyArray, n: int) -> dict[str, Float[Array, " n"]]:
        """Independent prior draws."""
        return self.model.scopes.sample(key, n)

    def sample_starts(self, key: PRNGKeyArray, n: int) -> dict[str, Float[Array, " n"]]:
        """Starts of optimisations: the prior, with draws of an earlier posterior for its parameters."""
        return self.model.scopes.sample_around(self.earlier, key, n)

    def to_unconstrained(self, values: Batch) -> Float[Any, "n d"]:
        """Values as points of the unconstrained space, columns in the order of ``names``."""
        columns = {name: values[name] for name in self.names}
        scopes = self.model.scopes
        compiled = self.model.programs.unconstrained
        return padded(compiled, columns) if is_batch(columns, 1) else scopes.to_unconstrained(columns)

    def from_unconstrained(self, u: Float[Any, "n d"]) -> dict[str, Float[Any, " n"]]:
        """Inverse of `to_unconstrained`."""
        return padded(self.model.programs.constrained, u) if is_batch(u, 2) else self.model.scopes.from_unconstrained(u)

    def log_prior(self, u: Float[Any, "n d"]) -> Float[Any, " n"]:
        """Log prior density in the unconstrained space."""
        scopes = self.model.scopes
        return padded(self.model.programs.log_prior, u) if is_batch(u, 2) else scopes.log_prior_unconstrained(u)

    @property
    def prior_derivatives(self) -> tuple[Callable, Callable]:
        """Gradient and Hessian of the log prior at one unconstrained point."""
        return self.model.programs.prior_derivatives

    def steps_for(self, horizon: int) -> int:
        """Number of time steps that reach the first ``horizon`` rows of every recording."""
        commands = self.model.recordings.commands
        row = np.minimum(horizon, self.model.recordings.rows) - 1
        index = np.arange(self.n_recordings), row
        last = commands.sample_step[index] + (commands.sample_fraction[index] > 0)
        return int(np.max(last))

    def row_log_likelihood(
        self, values: Batch, horizon: int
    ) -> tuple[Float[np.ndarray, "n horizon"], Int[np.ndarray, " n"]]:
        """Log density of each of the first ``horizon`` rows given the earlier rows, summed over recordings.

        Returns:
            rows, minus infinity throughout after a failed rollout, and the `Result` code of each set.
        """
        density = self.model.programs.rows
        rows, status = self._chunked(values, horizon, lambda *given: density(*given, self.measured, self.shares))
        rows = rows[:, :horizon]
        finite = np.isfinite(rows).all(axis=1)
        status = np.where((status == Result.OK) & ~finite, Result.DIVERGED, status)
        return np.where((status == Result.OK)[:, None], rows, -np.inf), status

    def rollouts(
        self, values: Batch, horizon: int
    ) -> tuple[Float[np.ndarray, "n horizon feature"], Int[np.ndarray, " n"]]:
        """Simulated features [m] of all recordings side by side, without observation noise; see `FeatureChannel`."""
        features, status = self._chunked(values, horizon, self.model.programs.features)
        return self._side_by_side(features)[:, :horizon], status

    def noise_deviation(self, values: Mapping[str, float]) -> Float[np.ndarray, " feature"]:
        """Standard deviation of the observation noise [m] of each feature, laid out like `rollouts`, at one set of
        values."""
        known = {**self.model.scopes.fixed, **values}
        return np.tile(np.concatenate([c.feature_deviation(known) for c in self.model.compared]), self.n_recordings)

    @cached_property
    def observed(self) -> Float[np.ndarray, "n_rows feature"]:
        """Measured features [m], laid out like `rollouts`."""
        features = [np.asarray(channel.features(self.measured[channel.name])) for channel in self.model.compared]
        return self._side_by_side(np.concatenate(features, axis=-1)[None])[0]

    @cached_property
    def observed_mask(self) -> np.ndarray:
        """True for usable entries of ``observed``."""
        return self._side_by_side(np.concatenate([c.feature_valid for c in self.model.compared], axis=-1)[None])[0]

    def _side_by_side(self, features: Shaped[Any, "n recording time f"]) -> Shaped[np.ndarray, "n time recording*f"]:
        return np.moveaxis(np.asarray(features), 1, 2).reshape(len(features), features.shape[2], -1)

    def residuals(self, values: Batch, horizon: int) -> Float[np.ndarray, "n residual"]:
        """Whitened residuals of the first ``horizon`` rows, zero if masked, in compiled chunks."""
        return np.asarray(self._flat(self._white(values, horizon, self.shares), horizon))

    def _white(self, values: Batch, horizon: int, shares: Mapping[str, float]) -> dict[str, np.ndarray]:
        white = self.model.programs.white
        return self._chunked(values, horizon, lambda *given: white(*given, self.measured, shares))

    def white_positions(self, values: Mapping[str, float]) -> Float[np.ndarray, "recording time marker 3"]:
        """Whitened residuals of the markers at one set of values, NaN if masked."""
        single = {name: np.array([values[name]]) for name in self.names}
        white = self._white(single, self.n_rows, dict.fromkeys(self.shares, 1.0))
        positions = white[self.model.markers.name][0]
        valid = self.model.recordings.line.valid[..., None]
        return np.where(valid, positions.reshape(*valid.shape[:3], 3), np.nan)

    @property
    def row_steps(self) -> Float[np.ndarray, " recording"]:
        """Time between rows of each recording [s]."""
        return self.model.recordings.steps

    def independent_series(
        self, residuals: Float[np.ndarray, "*batch m"]
    ) -> dict[str, tuple[Float[np.ndarray, "*batch recording time column"], Bool[np.ndarray, "recording time column"]]]:
        """Residuals of all rows, as `residuals` lays them out, by channel; and which of them were measured.

        Rows are allowed only for channels with independent noise between rows. Columns that stand for sizes are left
        out.
        """
        values = {name: jax.ShapeDtypeStruct((), float) for name in self.names}
        model = self.model
        shapes = jax.eval_shape(lambda v: model.white(model.seen(model.simulate(v), v), self.measured), values)
        names = self.model.channel_names
        ends = np.cumsum([shapes[name].size for name in names])
        parts = dict(zip(names, np.split(residuals, ends[:-1], axis=-1), strict=True))
        series = {}
        for channel in self.model.channels:
            if isinstance(channel, Series) and channel.independent:
                part = parts[channel.name].reshape(*residuals.shape[:-1], *shapes[channel.name].shape)
                series[channel.name] = part[..., : channel.valid.shape[-1]], channel.valid
        return series

    def predict(self, values: Batch) -> tuple[Float[np.ndarray, "n recording time marker 3"], Int[np.ndarray, " n"]]:
        """Simulated marker positions [m] of every recording, without observation noise."""
        position, _, status = self.predict_scene(values)
        return position, status

    def predict_scene(self, values: Batch) -> tuple[np.ndarray, np.ndarray | None, Int[np.ndarray, " n"]]:
        """As `predict`, with the poses of the object (n, recording, time, 7) in the robot's frame: position [m] and
        unit quaternion (x, y, z, w); None if the scene has none."""
        position, _, pose, status, *_ = self.observe(values)
        return np.asarray(position), None if pose is None else np.asarray(pose), np.asarray(status)

    def observe(self, values: Batch) -> Observation:
        """Simulated observations of every recording, without observation noise: fields (n, recording, time, ...),
        status (n,).
        """
        simulated = self._chunked(values, self.n_rows, lambda observation, _: observation)
        return simulated._replace(status=simulated.status.max(axis=1))

    def draw_noise(self, key: PRNGKeyArray, values: Batch) -> Float[np.ndarray, "n recording time marker 3"]:
        """A realisation of the observation noise [m] for every set of values."""
        time, draw = jnp.asarray(self.model.recordings.time), self.model.markers.draw_noise

        def of_all(key: PRNGKeyArray, values: Mapping[str, Array]) -> Array:
            known = {**self.model.scopes.fixed, **values}
            return jax.vmap(lambda k, t: draw(k, t, known))(jax.random.split(key, self.n_recordings), time)

        inferred = {name: jnp.asarray(values[name]) for name in self.names}
        count = len(next(iter(inferred.values())))
        return np.asarray(jax.vmap(of_all)(jax.random.split(key, count), inferred))

    def _chunked(self, values: Batch, horizon: int, evaluate: Callable[[Observation, Batch], Any]) -> Any:
        """Roll a batch out to a horizon chunk by chunk, see `in_chunks`, and evaluate the observations of each."""
        lanes, recordings = self.model.lanes, self.model.recordings
        steps, every = self.steps_for(horizon), np.arange(self.n_recordings)
        columns = {name: np.asarray(values[name], dtype=float) for name in self.names}

        def seen(own: Batch) -> Any:
            theta = np.asarray(self.model.programs.theta(own))
            flat, commands = theta.reshape(-1, theta.shape[-1]), recordings.commands.of(np.tile(every, len(theta)))
            fields, status = lanes.roll(flat, None, commands, steps=steps, width=len(flat))
            parts = {**dict.fromkeys(Observation._fields), **fields, "status": status}
            shaped = jax.tree.map(lambda part: part.reshape(*theta.shape[:2], *part.shape[1:]), parts)
            return evaluate(Observation(**shaped), own)

        def after(count: int) -> None:
            self.count_rollouts(count * horizon / self.n_rows)

        return in_chunks(seen, columns, chunk_sizes(self.chunk), after=after)

    def _flat(self, white: Mapping[str, Any], horizon: int) -> Any:
        """Residuals by rollout, cut to the horizon if they have a time axis, and flattened.

        Channels come in the order of the model; a dictionary that JAX returns has another order.
        """
        cut = []
        for channel in self.model.channels:
            part = white[channel.name]
            cut.append(part[:, :, :horizon] if isinstance(channel, Series) else part)
        return jnp.concatenate([part.reshape(len(part), -1) for part in cut], axis=1)


def _plain(channel: Channel) -> str:
    """Digest of a channel's settings, without its readings."""
    if isinstance(channel, Series):
        known = channel.known
        return repr(None if known is None else (known.scale, known.autocorrelation, known.correlation))
    return repr(channel)
