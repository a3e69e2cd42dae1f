"""Sessions of the compiled engine: bit for bit a whole rollout, whatever the other lanes do."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from rfdropo_bayes import fem
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.effects import BodyEffects
from rfdropo_bayes.fem.native.layered_session import LayeredSession
from tests.fem.test_native_effects import BATCH, STEPS, case, native, random_effects

PERIOD = 5
LANES = 11
PLAIN, RUBBING = BodyEffects(), BodyEffects(coulomb_friction=np.full(BATCH, 0.05), capstan_friction=np.full(BATCH, 0.2))


def rows_of(tree, rows):
    return jax.tree.map(lambda value: np.asarray(value)[rows], tree)


def samples(effects: BodyEffects) -> tuple[fem.Material, np.ndarray]:
    """Materials with effects, and commands [m]."""
    material, displacement = case(5)
    return material._replace(effects=effects), displacement


@pytest.mark.parametrize("precision", [pytest.param("float64", marks=pytest.mark.slow), "float32"])
@pytest.mark.parametrize(
    "effects",
    [PLAIN, random_effects(7), pytest.param(RUBBING, marks=pytest.mark.slow)],
    ids=["plain", "effects", "friction"],
)
def test_periods_with_partial_resets_are_whole_rollouts(precision, effects):
    """Lanes that start at different times from equilibrium, more than one block of them, on two threads."""
    engine = native(precision, threads=2)
    material, displacement = samples(effects)
    start = 2.0 * displacement[:, 0]
    whole = engine.rollout(material, displacement, start=start)
    session = LayeredSession(engine, LANES)
    which = np.arange(LANES) % BATCH
    born = np.arange(LANES) % 3  # period in which a lane starts anew; it has run other commands before
    session.reset(np.arange(LANES), rows_of(material, which[::-1]), start=start[which[::-1]])
    for period in range(STEPS // PERIOD):
        rows = np.flatnonzero(born == period)
        if len(rows):
            first = session.reset(rows, rows_of(material, which[rows]), start=start[which[rows]])
            np.testing.assert_array_equal(first.position[:, 0], whole.position[which[rows], 0])
            np.testing.assert_array_equal(first.imbalance, whole.imbalance[which[rows]])
        age = PERIOD * np.maximum(period - born, 0)
        moves = np.stack([displacement[w, a : a + PERIOD] for w, a in zip(which, age, strict=True)])
        seen = session.advance(moves)
        running = np.flatnonzero(born <= period)
        for lane in running:
            rows = slice(age[lane], age[lane] + PERIOD + 1)
            np.testing.assert_array_equal(seen.position[lane], whole.position[which[lane], rows])
            np.testing.assert_array_equal(seen.tension[lane], whole.tension[which[lane], rows])
    assert np.ptp(whole.position, axis=1).max() > 1e-3, "nothing moved"


def test_a_state_that_was_saved_goes_on_elsewhere_with_the_same_bits():
    engine = native("float32")
    material, displacement = samples(random_effects(7))
    first, second = LayeredSession(engine, BATCH), LayeredSession(engine, 2 * BATCH)
    first.reset(np.arange(BATCH), material)
    second.reset(np.arange(2 * BATCH), rows_of(material, np.zeros(2 * BATCH, int)))
    first.advance(displacement[:, :PERIOD])
    kept = first.save()
    again = first.advance(displacement[:, PERIOD:])
    second.restore(np.arange(BATCH) + BATCH, kept)
    other = second.advance(np.concatenate([displacement, displacement])[:, PERIOD:])
    np.testing.assert_array_equal(other.position[BATCH:], again.position)
    first.restore(np.arange(BATCH), kept)
    np.testing.assert_array_equal(first.advance(displacement[:, PERIOD:]).tension, again.tension)


def test_an_equilibrium_is_found_once(monkeypatch):
    engine = native("float64")
    material, displacement = samples(PLAIN)
    session = LayeredSession(engine, BATCH)
    first = session.reset(np.arange(BATCH), material, start=displacement[:, 0])
    monkeypatch.setattr(engine, "run_block", lambda *_: pytest.fail("computed again"))
    again = session.reset(
        np.arange(BATCH)[::-1], rows_of(material, np.arange(BATCH)[::-1]), start=displacement[::-1, 0]
    )
    np.testing.assert_array_equal(again.position, first.position[::-1])


def test_what_does_not_fit_is_refused():
    session = LayeredSession(native("float64"), BATCH)
    material, displacement = samples(PLAIN)
    with pytest.raises(InputError, match="not started"):
        session.advance(displacement)
    session.reset(np.arange(BATCH), material)
    with pytest.raises(InputError, match="other effects"):
        session.reset(np.arange(BATCH), material._replace(effects=random_effects(7)))
    with pytest.raises(InputError, match="displacement has shape"):
        session.advance(displacement[:2])
    with pytest.raises(InputError, match="values in float32"):
        session.restore(np.arange(1), session.save()[:1].astype(np.float32))
    with pytest.raises(InputError, match="0 lanes"):
        LayeredSession(native("float64"), 0)
