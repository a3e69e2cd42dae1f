"""Effects of single drives that no mechanism of the library has, for robots that policies have never met. An experiment
file asks for one as ``studies.fresh_laws:Crosstalk``; audits do not know them."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.mechanisms.actuation import PerChannel
from rfdropo_bayes.mechanisms.default_priors import half_normal
from rfdropo_bayes.simulators.mechanisms import MemorylessActuation, SteppedActuation, Values
from rfdropo_bayes.simulators.parameters import ParameterSpec

BOUC_WEN_WAY = 1.5e-3  # m of travel over which a hysteresis builds up


class CableEffect(PerChannel):
    """Base of the laws: a size of its own for each command channel, zero at null; the scale of its prior is the law's
    usual size. For robots commanded in metres."""

    stage = "actuation"
    inside_drive = False
    cause = "test code"
    remedy = "none: a law of test code"


def _size(name: str, unit: str, high: float, usual: float, description: str) -> ParameterSpec:
    return ParameterSpec(name, unit, 0.0, high, 0.0, half_normal(usual), description)


class Crosstalk(CableEffect, MemorylessActuation):
    """A cable is pulled by so much [1/m] times the product of its own command and its neighbour's."""

    name = "fresh_crosstalk"
    size = _size(name, "1/m", 1e3, 15.0, "pull per product of a command and the next cable's")

    def reach(self, values: Values, sent: Float[Array, "*step channel"]) -> Float[Array, "*step channel"]:
        """Add the product."""
        return sent + self.sizes(values, sent.shape[-1]) * sent * jnp.roll(sent, -1, axis=-1)


class SlippingCable(CableEffect, SteppedActuation):
    """A cable loses a share of all that its drive has moved, to either side."""

    name = "fresh_slip"
    size = _size(name, "-", 1.0, 0.05, "share of the travelled way that is lost")

    def begin(self, values: Values, first: Float[Array, " channel"], interval: float) -> tuple[Array, Array]:
        """The last command, and the way so far."""
        return first, jnp.zeros_like(first)

    def advance(
        self, values: Values, memory: tuple[Array, Array], given: Float[Array, " channel"], now: float
    ) -> tuple[tuple[Array, Array], Float[Array, " channel"]]:
        """Take the lost share of the way off."""
        way = memory[1] + jnp.abs(given - memory[0])
        return (given, way), given - self.sizes(values, len(given)) * way


class HystereticCable(CableEffect, SteppedActuation):
    """A cable lags behind its drive by the hysteresis of Bouc and Wen, which saturates at the size [m]."""

    name = "fresh_hysteresis"
    size = _size(name, "m", 0.02, 8e-4, "displacement that is lost when the hysteresis is saturated")

    def begin(self, values: Values, first: Float[Array, " channel"], interval: float) -> tuple[Array, Array]:
        """The last command, and the state of the hysteresis from -1 to 1."""
        return first, jnp.zeros_like(first)

    def advance(
        self, values: Values, memory: tuple[Array, Array], given: Float[Array, " channel"], now: float
    ) -> tuple[tuple[Array, Array], Float[Array, " channel"]]:
        """Move the hysteresis on, and take it off the command."""
        last, state = memory
        move = given - last
        grown = move - 0.5 * (jnp.abs(move) * state + move * jnp.abs(state))
        state = jnp.clip(state + grown / BOUC_WEN_WAY, -1.0, 1.0)
        return (given, state), given - self.sizes(values, len(given)) * state


LAWS = (Crosstalk, SlippingCable, HystereticCable)
