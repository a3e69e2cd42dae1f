"""Sizes that change linearly from the start of a recording: `drift_of` makes the drift of a mechanism, with a rate in
place of each size.

A size that differs between recordings needs no separate mechanism: [model.per_recording] and [model.per_group] give
each recording or group a size.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rfdropo_bayes.mechanisms.actuation import InCommandUnit
from rfdropo_bayes.mechanisms.default_priors import normal
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.mechanisms import MemorylessActuation, SteppedActuation, Values
from rfdropo_bayes.simulators.parameters import ParameterSpec

USUAL = 10.0  # duration [s] of the recordings that default priors are given for, see `rates_over`
RATE = "_rate"


class Drift:
    """Base of drifts. Sizes start at their null values.

    Args:
        own: the mechanism whose sizes drift, made for a robot.
    """

    kind: ClassVar[type]

    def __init__(self, own: Any = None) -> None:
        self.own: Any = self.kind() if own is None else own
        self.parameters = tuple(
            spec._replace(
                name=spec.name + RATE,
                unit="1/s" if spec.unit == "-" else f"{spec.unit}/s",
                low=spec.low - spec.nominal,
                high=spec.high - spec.nominal,
                nominal=0.0,
                prior={**spec.prior, "scale": spec.prior["scale"] / USUAL},
                description=f"rate of the {spec.description}",
            )
            for spec in self.own.parameters
        )

    @classmethod
    def for_robot(cls, robot: Robot) -> Any:
        """The drift with the parameters of the mechanism for a robot."""
        kind: Any = cls.kind
        return cls(kind.for_robot(robot) if hasattr(kind, "for_robot") else kind())

    def sizes(self, values: Values, elapsed: Float[Array, "*time"]) -> dict[str, Float[Array, "*time"]]:
        """Sizes so many seconds after the start, within their bounds."""
        # Not a clip, whose derivative at a bound, at which some sizes start, would be halved.
        sizes = {}
        for spec in self.own.parameters:
            size = spec.nominal + values[spec.name + RATE] * elapsed
            sizes[spec.name] = jnp.where(size < spec.low, spec.low, jnp.where(size > spec.high, spec.high, size))
        return sizes


def rates_over(duration: float, specs: Iterable[ParameterSpec], mechanisms: Iterable[Any]) -> tuple[ParameterSpec, ...]:
    """Parameters of a model with priors of rates by which sizes change, over a duration [s], by the scale of their own
    prior.
    """
    rates = {spec.name for each in mechanisms if isinstance(each, Drift) for spec in each.parameters}
    share = USUAL / duration
    return tuple(
        spec._replace(prior={**spec.prior, "scale": share * spec.prior["scale"]}) if spec.name in rates else spec
        for spec in specs
    )


class ActuationDrift(Drift, SteppedActuation):
    """Drift of a mechanism of actuation that depends on the present command."""

    stage = "actuation"
    inside_drive = False
    origin = "drives that warm up, or cables that stretch, slip or wind unevenly"
    remedy = "repeat each command at the start and at the end of a recording and compare the poses"

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
    origin = "cameras or a base that move or warm up"
    remedy = "record two markers that are fixed to the base"

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


def drift_of(kind: Any) -> type:
    """The mechanism ``<name>_drift``: the sizes of another mechanism change linearly in time.

    Args:
        kind: class of a mechanism that depends on the present command (`MemorylessActuation`), or on the present
            markers (a method ``sense``), and has no memory.
    """
    base: Any = ActuationDrift if issubclass(kind, MemorylessActuation) else SensingDrift
    return type(
        f"{kind.__name__}Drift",
        (base,),
        {
            "__doc__": f"`{kind.name}` changes at a steady rate from the start of the recording; no rate at null.",
            "__module__": __name__,
            "name": f"{kind.name}_drift",
            "kind": kind,
            "cause": f"{base.origin}: `{kind.name}` changes during the recording",
        },
    )


class DriveZero(InCommandUnit, MemorylessActuation):
    """The zero of all drives is shifted, of which a drift is made: the zeros of cables are parameters of a robot."""

    name = "drive_zero"
    in_metres = (ParameterSpec("drive_zero", "m", -0.1, 0.1, 0.0, normal(0.005), "shift of the zero of every drive"),)

    def reach(self, values: Values, sent: Float[Array, "*step channel"]) -> Float[Array, "*step channel"]:
        """Shift the commands."""
        return sent + values["drive_zero"]
