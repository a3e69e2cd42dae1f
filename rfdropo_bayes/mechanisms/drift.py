"""Sizes that change linearly from the start of a recording: the same mechanisms, with a rate in the place of a size.

A size that differs between recordings needs no separate mechanism: [model.per_recording] and [model.per_group] give
each recording or group a size.
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rfdropo_bayes.mechanisms.actuation import CableGain, CommandGain, InCommandUnit
from rfdropo_bayes.mechanisms.default_priors import normal
from rfdropo_bayes.mechanisms.sensing import CameraOffset, CameraRotation, CameraScale
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.mechanisms import MemorylessActuation, SteppedActuation, Values
from rfdropo_bayes.simulators.parameters import ParameterSpec

USUAL = 10.0  # [s] in which a size of its prior's scale comes about
RATE = "_rate"


class Drift:
    """Base of drifts: a class names the mechanism whose sizes drift. Sizes start at their null values.

    Args:
        own: that mechanism, made for a robot.
    """

    kind: ClassVar[type]

    def __init__(self, own: Any = None) -> None:
        self.own: Any = self.kind() if own is None else own
        self.parameters = tuple(_rate(spec) for spec in self.own.parameters)

    @classmethod
    def for_robot(cls, robot: Robot) -> Any:
        """The drift with the parameters of the mechanism for a robot."""
        kind: Any = cls.kind
        return cls(kind.for_robot(robot) if hasattr(kind, "for_robot") else kind())

    def sizes(self, values: Values, elapsed: Float[Array, "*time"]) -> dict[str, Float[Array, "*time"]]:
        """Sizes so many seconds after the start, within their bounds."""
        return {
            spec.name: jnp.clip(spec.nominal + values[spec.name + RATE] * elapsed, spec.low, spec.high)
            for spec in self.own.parameters
        }


def _rate(spec: ParameterSpec) -> ParameterSpec:
    """The rate of a size."""
    scale = spec.prior["scale"] / USUAL
    return spec._replace(
        name=spec.name + RATE,
        unit="1/s" if spec.unit == "-" else f"{spec.unit}/s",
        low=spec.low - spec.nominal,
        high=spec.high - spec.nominal,
        nominal=0.0,
        prior=normal(scale),
        description=f"rate of the {spec.description}",
    )


class ActuationDrift(Drift, SteppedActuation):
    """Drift of a mechanism of actuation that depends on the present command."""

    stage = "actuation"
    inside_drive = False

    def begin(self, values: Values, first: Float[Array, " channel"], interval: float) -> Int[Array, ""]:
        """Number of steps."""
        return jnp.zeros((), int)

    def advance(
        self, values: Values, memory: Int[Array, ""], given: Float[Array, " channel"], now: float
    ) -> tuple[Int[Array, ""], Float[Array, " channel"]]:
        """Apply the size of the moment."""
        return memory + 1, self.own.reach(self.sizes(values, now * (memory + 1)), given)


class SensingDrift(Drift):
    """Drift of a mechanism of sensing that depends on the present markers."""

    stage = "sensing"

    def sense_over_time(
        self, values: Values, position: Float[Array, "time marker 3"], time: Float[Array, " time"]
    ) -> Float[Array, "time marker 3"]:
        """Apply the size of each row."""
        return jax.vmap(self._seen)(self.sizes(values, time - time[0]), position)

    def begin(self, values: Values, first: Float[Array, "marker 3"], interval: float) -> tuple[()]:
        """Nothing to remember."""
        return ()

    def advance(
        self, values: Values, memory: tuple[()], given: Float[Array, "marker 3"], now: Float[Array, ""]
    ) -> tuple[tuple[()], Float[Array, "marker 3"]]:
        """Apply the size of the moment."""
        return memory, self._seen(self.sizes(values, now), given)

    def _seen(self, sizes: Values, position: Float[Array, "marker 3"]) -> Float[Array, "marker 3"]:
        return self.own.sense(sizes, position[None])[0]


class CameraDrift(SensingDrift):
    """The measuring frame moves at a steady velocity from the start of the recording; none at null."""

    name = "camera_drift"
    kind = CameraOffset
    cause = "cameras or a base that move or warm up during the recording"
    remedy = "record a marker that is fixed to the base"


class CameraTurn(SensingDrift):
    """The measuring frame turns at a steady rate from the start of the recording; none at null."""

    name = "camera_turn"
    kind = CameraRotation
    cause = "cameras or a base that turn or warm up during the recording"
    remedy = "record two markers that are fixed to the base"


class CameraZoom(SensingDrift):
    """The scale of measured lengths changes at a steady rate from the start of the recording; none at null."""

    name = "camera_zoom"
    kind = CameraScale
    cause = "cameras that warm up or change their focus during the recording"
    remedy = "measure a known length at the start and at the end of a recording"


class GainDrift(ActuationDrift):
    """The gain of all commands changes at a steady rate from the start of the recording; none at null."""

    name = "gain_drift"
    kind = CommandGain
    cause = "drives that warm up, or cables that wind in layers as time goes by"
    remedy = "repeat one command at the start and at the end of a recording and compare the poses"


class CableGainDrift(ActuationDrift):
    """The gain of each command changes at a steady rate of its own; none at null."""

    name = "cable_gain_drift"
    kind = CableGain
    cause = "a drive that warms up, or a cable that stretches, unlike the others"
    remedy = "repeat one command of each cable at the start and at the end of a recording and compare the poses"


class DriveZero(InCommandUnit, MemorylessActuation):
    """The zero of all drives is shifted."""

    in_metres = (ParameterSpec("drive_zero", "m", -0.1, 0.1, 0.0, normal(0.005), "shift of the zero of every drive"),)

    def reach(self, values: Values, sent: Float[Array, "*step channel"]) -> Float[Array, "*step channel"]:
        """Shift the commands."""
        return sent + values["drive_zero"]


class DriveDrift(ActuationDrift):
    """The zero of all drives moves at a steady rate from the start of the recording; no rate at null."""

    name = "drive_drift"
    kind = DriveZero
    cause = "drives or cables that slip, or spools that wind unevenly, so that the zero wanders"
    remedy = "return to zero at the end of a recording and compare the pose with that at the start"
