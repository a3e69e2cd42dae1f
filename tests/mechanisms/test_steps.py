"""Every mechanism of actuation and sensing step by step: what it does to a whole rollout.

XLA contracts a product and a sum into one rounding as it sees fit, program by program: both agree to their last digit.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.mechanisms import REGISTRY
from rfdropo_bayes.simulators.mechanisms import SteppedMechanism

STEP, PERIOD, LANES, STEPS = 0.01, 5, 3, 60
ACTUATION = tuple(  # but for one that needs the geometry of a robot, and looks at the moment alone
    name for name, kind in REGISTRY.items() if kind.stage == "actuation" and name != "guide_azimuth"
)
SENSING = tuple(name for name, kind in REGISTRY.items() if kind.stage == "sensing")
RNG = np.random.default_rng(4)
COMMAND = jnp.asarray(0.004 * RNG.normal(size=(LANES, STEPS, 2)).cumsum(axis=1))
START = jnp.asarray(0.002 * RNG.normal(size=(LANES, 2)))
POSITION = jnp.asarray(1e-3 * RNG.normal(size=(LANES, STEPS, 4, 3)).cumsum(axis=1))
TIME = 0.05 * jnp.arange(STEPS)
LAST = 4 * np.spacing(0.01)


def drawn(mechanism, seed: int):
    """Values off null, one per lane: from the grid, or of the prior's size."""
    random = np.random.default_rng(seed)
    values = {}
    for spec in mechanism.parameters:
        if spec.grid:
            chosen = random.choice(spec.grid, LANES)
        else:
            size = next(spec.prior[key] for key in ("scale", "median") if key in spec.prior)
            chosen = spec.nominal + size * random.normal(size=LANES)
            chosen = np.abs(chosen) if spec.low == spec.nominal or spec.name == "clock_offset" else chosen
        values[spec.name] = jnp.asarray(chosen)
    return values


def in_periods(mechanism, values, first, given, now, interval):
    """A period at a time, as a session does."""
    memory = jax.jit(jax.vmap(lambda v, f: mechanism.begin(v, f, interval)))(values, first)

    @jax.jit
    @jax.vmap
    def act(values, memory, rows, clock):
        def one(kept, row):
            return mechanism.advance(values, kept, row[0], STEP if now is None else row[1])

        return jax.lax.scan(one, memory, (rows, clock))

    shown = []
    for start in range(0, STEPS, PERIOD):
        clock = jnp.zeros(PERIOD) if now is None else now[start : start + PERIOD]
        memory, seen = act(values, memory, given[:, start : start + PERIOD], jnp.tile(clock, (LANES, 1)))
        shown.append(seen)
    return jnp.concatenate(shown, axis=1)


@pytest.mark.parametrize("name", ACTUATION)
def test_a_drive_goes_by_steps_as_in_a_rollout(name):
    mechanism = REGISTRY[name]()
    values = drawn(mechanism, 1)
    whole = jax.jit(jax.vmap(lambda v, c, f: mechanism.actuate(v, c, f, STEP)))(values, COMMAND, START)
    assert np.abs(whole - COMMAND).max() > 1e-5, "it does nothing"
    np.testing.assert_allclose(in_periods(mechanism, values, START, COMMAND, None, STEP), whole, rtol=0.0, atol=LAST)


@pytest.mark.parametrize("name", SENSING)
def test_a_camera_sees_by_steps_what_it_sees_in_a_rollout(name):
    mechanism = REGISTRY[name]()
    values = drawn(mechanism, 2)
    if isinstance(mechanism, SteppedMechanism):
        seen = in_periods(mechanism, values, POSITION[:, 0], POSITION, TIME, 0.05)
    else:  # a mechanism without memory needs no other form
        row_by_row = jax.vmap(lambda v, row: mechanism.sense(v, row[None])[0], in_axes=(None, 0))
        seen = jax.jit(jax.vmap(row_by_row))(values, POSITION)
    whole = (
        jax.jit(jax.vmap(mechanism.sense))(values, POSITION)
        if hasattr(mechanism, "sense")
        else jax.jit(jax.vmap(lambda v, p: mechanism.sense_over_time(v, p, TIME)))(values, POSITION)
    )
    assert np.abs(whole - POSITION).max() > 1e-5, "it does nothing"
    np.testing.assert_allclose(seen, whole, rtol=0.0, atol=LAST)
