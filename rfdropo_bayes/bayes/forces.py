"""What breaks the free scale of length-driven cables: measured cable tensions, and parts that were weighed.

With cables that impose a displacement, all stiffnesses and masses times one factor give the same motion. A tension
reading fixes the factor as far as its gain is known; so does a mass from a balance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

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
ABOVE_ZERO = 50.0  # larger than any logarithm of a ratio of sizes: keeps a root in `size_residuals` real


class TensionData(NamedTuple):
    """Measured tensions of all recordings, padded like their positions.

    Attributes:
        measured: [N], zero where there is none.
        valid: True where it may be used.
        cables: which of the simulator's cables were measured.
    """

    measured: Float[Any, "recording time cable"]
    valid: Bool[np.ndarray, "recording time cable"]
    cables: Int[np.ndarray, " cable"]


class Weighed(NamedTuple):
    """A parameter, or the sum of several, known from a measurement of its own.

    Attributes:
        parameters: names; their sum was measured.
        value: in their unit.
        sd: its standard deviation.
    """

    parameters: tuple[str, ...]
    value: float
    sd: float


def tension_specs(used: bool) -> tuple[ParameterSpec, ...]:
    """Parameters of the tension readings; none where they are not used."""
    return (TENSION_NOISE, TENSION_GAIN) if used else ()


def gather_tension(simulator: Simulator, trajectories: Sequence[Trajectory], length: int) -> TensionData:
    """Tensions of recordings padded to ``length`` rows.

    Raises:
        InputError: a recording without tensions, or with channels that are no cables of the robot.
    """
    names = simulator.cable_names
    measured, valid, columns = [], [], []
    for trajectory in trajectories:
        if trajectory.tension is None:
            raise InputError(
                "has no cable tensions",
                where=trajectory.name,
                remedy="leave [model] tension = true out, or record them",
            )
        unknown = [name for name in trajectory.cable_names if name not in names]
        if unknown:
            raise InputError(
                f"its tensions are of {', '.join(unknown)}, which are no cables of the robot ({', '.join(names)})",
                where=trajectory.name,
                remedy="name the columns after the robot's cables",
            )
        columns.append([names.index(name) for name in trajectory.cable_names])
        tension = np.asarray(trajectory.tension, dtype=float)
        known = np.asarray(trajectory.tension_mask)
        missing = ((0, length - len(tension)), (0, 0))
        measured.append(np.pad(np.where(known, tension, 0.0), missing))
        valid.append(np.pad(known, missing))
    if any(column != columns[0] for column in columns):
        raise InputError("the recordings measure different cables", where="[model] tension", remedy="use one set")
    return TensionData(np.stack(measured), np.stack(valid), np.array(columns[0]))


def reading_size(
    tension: Float[Any, "recording time cable"],
    known: Bool[np.ndarray, "recording time cable"],
    among: Float[Any, "recording time cable"],
) -> Float[Array, "recording time cable"]:
    """Size of each tension that its reading's relative error applies to [N]; ``among`` sets what the least one is."""
    square = jnp.sum(jnp.where(known, among, 0.0) ** 2, axis=(1, 2), keepdims=True)
    least = SMALLEST_READING * jnp.sqrt(square / np.maximum(known.sum(axis=(1, 2), keepdims=True), 1))
    return jnp.maximum(jnp.abs(tension), jnp.where(least > 0.0, least, 1.0))


def tension_residuals(
    simulated: Float[Array, "recording time all"], values: Mapping[str, Any], data: TensionData
) -> tuple[Float[Array, "recording time cable"], Float[Array, "recording time cable"]]:
    """Unit-variance residuals of the readings, zero where there is none, and the size each error is relative to [N].

    That is the size of the tension, not of what was read for it: readings that happen to be low would count more than
    high ones, and pull all forces down by twice the square of their relative error.
    """
    expected = values.get(TENSION_GAIN.name, TENSION_GAIN.nominal) * simulated[..., data.cables]
    size = reading_size(expected, data.valid, data.measured)
    white = (data.measured - expected) / (values[TENSION_NOISE.name] * size)
    return jnp.where(data.valid, white, 0.0), size


def size_residuals(
    size: Float[Array, "recording time cable"], data: TensionData
) -> Float[Array, "recording time cable"]:
    """Residuals whose squares add to twice the logarithms of the sizes, up to a constant; zero where there is none.

    With them the log likelihood is a sum of squares but for terms in the noise alone, as Gauss-Newton wants it.
    """
    ratio = size / reading_size(data.measured, data.valid, data.measured)
    return jnp.where(data.valid, jnp.sqrt(2.0 * (ABOVE_ZERO + jnp.log(ratio))), 0.0)


def tension_log_density(
    simulated: Float[Array, "recording time all"], values: Mapping[str, Any], data: TensionData
) -> Float[Array, " time"]:
    """Log density of the readings of each row, summed over recordings and cables."""
    white, size = tension_residuals(simulated, values, data)
    normaliser = 0.5 * jnp.log(2.0 * jnp.pi) + jnp.log(values[TENSION_NOISE.name] * size)
    return jnp.sum(-0.5 * white**2 - jnp.where(data.valid, normaliser, 0.0), axis=(0, 2))


def weighed_residuals(values: Mapping[str, Any], weighed: Sequence[Weighed]) -> Float[Array, " weighed"]:
    """Unit-variance residuals of the weighed parts."""
    return jnp.stack([(entry.value - sum(values[name] for name in entry.parameters)) / entry.sd for entry in weighed])


def weighed_log_density(values: Mapping[str, Any], weighed: Sequence[Weighed]) -> Float[Array, ""]:
    """Log density of the weighed parts; they are known before the first row and count with it."""
    if not weighed:
        return jnp.zeros(())
    normaliser = sum(float(np.log(entry.sd * np.sqrt(2.0 * np.pi))) for entry in weighed)
    return -0.5 * jnp.sum(weighed_residuals(values, weighed) ** 2) - normaliser


def check_weighed(weighed: Sequence[Weighed], names: Sequence[str]) -> None:
    """Raise InputError for a part that is no inferred parameter, or a deviation that is not positive."""
    for entry in weighed:
        for name in entry.parameters:
            if name not in names:
                raise InputError(
                    f"{name!r} was weighed but is not inferred",
                    where="[[model.weighed]]",
                    remedy=f"one of {', '.join(names)}",
                )
        if not (entry.sd > 0.0 and np.isfinite(entry.value)):
            raise InputError(
                "a weighed value needs a positive sd", where="[[model.weighed]]", remedy="give value and sd"
            )
