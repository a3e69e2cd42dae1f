"""Measured cable tensions, which break the free scale of length-driven cables.

With cables that impose a displacement, all stiffnesses and masses times one factor give the same motion. A tension
reading fixes the factor as far as its gain is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from rfdropo_bayes.bayes.channels.channel import Seen, WhiteSeries, padded_readings
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.parameters import ParameterSpec
from rfdropo_bayes.simulators.protocol import Simulator

TENSION_NOISE = ParameterSpec(
    "tension_noise",
    "-",
    1e-5,
    1.0,
    0.01,
    {"distribution": "LogNormal", "median": 0.02, "sigma": 1.0},
    "standard deviation of a tension reading as a share of the reading, independent from sample to sample",
)
TENSION_GAIN = ParameterSpec(
    "tension_gain",
    "-",
    0.01,
    100.0,
    1.0,
    {"distribution": "LogNormal", "median": 1.0, "sigma": 0.1},
    "tension read per true tension; known (1) unless it has a prior, which leaves the scale of forces free again",
)
# A slack cable reads nothing: below this share of the recording's root mean square the error no longer shrinks.
SMALLEST_READING = 0.05


@dataclass(frozen=True, kw_only=True)
class Tension(WhiteSeries):
    """Cable tensions [N]; an error is relative to the size of the tension.

    This is the size of the true tension, not of its reading. Otherwise low readings would count more than high
    readings, and bias all forces down by twice the square of the relative error.
    """

    name: ClassVar[str] = "tension"
    linear: ClassVar[bool] = False
    size: ClassVar[ParameterSpec] = TENSION_NOISE
    cables: Int[np.ndarray, " cable"]  # indices of the measured cables

    @classmethod
    def gather(
        cls, simulator: Simulator, trajectories: Sequence[Trajectory], length: int, needed: int | None = None
    ) -> Tension:
        """Tensions of recordings padded to ``length`` rows; only the first ``needed`` recordings must have them.

        Raises:
            InputError: a recording without tensions, or with columns that are no cables of the robot.
        """
        names = simulator.cable_names
        columns = []

        def read(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray] | None:
            if trajectory.tension is None:
                return None
            unknown = [name for name in trajectory.cable_names if name not in names]
            if unknown:
                raise InputError(
                    f"its tensions are of {', '.join(unknown)}, which are not cables of the robot ({', '.join(names)})",
                    where=trajectory.name,
                    remedy="name the columns after the robot's cables",
                )
            columns.append([names.index(name) for name in trajectory.cable_names])
            known = np.asarray(trajectory.tension_mask)
            return np.where(known, np.asarray(trajectory.tension, dtype=float), 0.0), known

        readings, valid = padded_readings(trajectories, length, needed, read, cls.name, "cable tensions")
        if any(column != columns[0] for column in columns):
            raise InputError(
                "the recordings have tensions of different cables", where="[model] tension", remedy="use one set"
            )
        return cls(readings, valid, cables=np.array(columns[0]))

    @property
    def gain_specs(self) -> tuple[ParameterSpec, ...]:
        return (TENSION_GAIN,)

    def expected(self, seen: Seen) -> Float[Any, "recording time cable"]:
        gain = seen.values.get(TENSION_GAIN.name, TENSION_GAIN.nominal)
        return gain * seen.observation.tension[..., self.cables]

    def deviation(
        self, measured: Float[Any, "recording time cable"], about: Float[Any, "recording time cable"]
    ) -> Float[Any, "recording time cable"]:
        """See `Series.deviation`: relative to the size of the tensions that readings are compared with."""
        return (measured - about) / reading_size(about, self.valid, measured)

    def log_size(
        self, about: Float[Any, "recording time cable"], measured: Float[Any, "recording time cable"]
    ) -> Float[Any, "recording time cable"]:
        return jnp.log(reading_size(about, self.valid, measured))


def reading_size(
    tension: Float[Any, "recording time cable"],
    known: Bool[np.ndarray, "recording time cable"],
    among: Float[Any, "recording time cable"],
) -> Float[Any, "recording time cable"]:
    """Size of each tension that its reading's relative error applies to [N]; ``among`` sets the least size."""
    square = jnp.sum(jnp.where(known, among, 0.0) ** 2, axis=(1, 2), keepdims=True)
    least = SMALLEST_READING * jnp.sqrt(square / np.maximum(known.sum(axis=(1, 2), keepdims=True), 1))
    return jnp.maximum(jnp.abs(tension), jnp.where(least > 0.0, least, 1.0))
