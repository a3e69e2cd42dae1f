"""A drive that waits at the end of its travel, and turns back from there at once."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.mechanisms.command_unit import InCommandUnit
from rfdropo_bayes.simulators.mechanisms import SteppedActuation, Values
from rfdropo_bayes.simulators.parameters import ParameterSpec

GRID = (5.0, 15.0, 30.0, 60.0, 85.0, 110.0, 150.0, 250.0, 500.0, 1000.0)


class TravelStop(InCommandUnit, SteppedActuation):
    """Commands beyond a stop are lost, not remembered: a drive at its stop moves with the next command away from it.

    In contrast to `EndStop`, which cuts off the accumulated command and has to be commanded all the way back. Travel is
    counted from the initial command. Both limits are infinite, their inverses zero, at null.
    """

    name = "travel_stop"
    stage = "actuation"
    inside_drive = True
    cause = "commands given relative to where the drive is, at a stop or at a limit of its controller"
    remedy = "record where the drives are, not what they were told; command absolute positions"
    in_metres = (
        ParameterSpec(
            "inverse_release_travel",
            "1/m",
            0.0,
            1e5,
            0.0,
            {"distribution": "HalfNormal", "scale": 200.0},
            "one over the travel from the initial command to the stop on the side of release",
            grid=GRID,
        ),
        ParameterSpec(
            "inverse_pull_travel",
            "1/m",
            0.0,
            1e5,
            0.0,
            {"distribution": "HalfNormal", "scale": 200.0},
            "one over the travel from the initial command to the stop on the side of pull",
            grid=GRID,
        ),
    )

    def begin(self, values: Values, first: Float[Array, " channel"], interval: float) -> tuple[Array, Array]:
        """What was lost at the stops, and the command that travel is counted from."""
        return jnp.zeros_like(first), first

    def advance(
        self, values: Values, memory: tuple[Array, Array], given: Float[Array, " channel"], now: float
    ) -> tuple[tuple[Array, Array], Float[Array, " channel"]]:
        """Follow the command, less all that was lost at the stops."""
        release, pull = values["inverse_release_travel"], values["inverse_pull_travel"]
        lost, start = memory
        travel = given - start - lost
        over = jnp.where(travel * pull > 1.0, travel - 1.0 / jnp.maximum(pull, 1e-12), 0.0)
        under = jnp.where(-travel * release > 1.0, travel + 1.0 / jnp.maximum(release, 1e-12), 0.0)
        lost = lost + over + under
        return (lost, start), given - lost
