"""Sessions of the compiled engine: lanes that go on from where they stand, bit for bit as whole rollouts."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes import fem
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.native.rod_session import RodSession
from rfdropo_bayes.fem.section_loads import SectionLoads
from tests.fem.native_cases import BATCH, STEPS, all_effects, displacements, engine, materials, rows_of, rubbing

PERIOD, LANES = 2, 11
PLAIN = fem.BodyEffects()


def samples(effects: fem.BodyEffects) -> tuple[fem.Material, np.ndarray]:
    """Materials with effects, and commands [m]."""
    return materials(5)._replace(effects=effects), displacements(6)


@pytest.mark.parametrize("integrator", ["euler", "sdirk2", "quasi-static"])
@pytest.mark.parametrize("effects", [PLAIN, all_effects(7), rubbing(8)], ids=["plain", "effects", "friction"])
def test_periods_with_partial_resets_are_whole_rollouts(integrator, effects):
    """Lanes that start at different times from equilibrium, more than one block of them, on two threads."""
    run = engine(integrator, threads=2)
    material, displacement = samples(effects)
    start = 2.0 * displacement[:, 0]
    whole = run.rollout(material, displacement, start=start)
    session = RodSession(run, LANES)
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
    assert np.ptp(whole.position, axis=1).max() > 1e-5, "nothing moved"


def test_a_state_that_was_saved_goes_on_elsewhere_with_the_same_bits():
    run = engine()
    material, displacement = samples(all_effects(7))
    first, second = RodSession(run, BATCH), RodSession(run, 2 * BATCH)
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
    run = engine()
    material, displacement = samples(PLAIN)
    session = RodSession(run, BATCH)
    first = session.reset(np.arange(BATCH), material, start=displacement[:, 0])
    monkeypatch.setattr(run, "run_block", lambda *_: pytest.fail("computed again"))
    again = session.reset(
        np.arange(BATCH)[::-1], rows_of(material, np.arange(BATCH)[::-1]), start=displacement[::-1, 0]
    )
    np.testing.assert_array_equal(again.position, first.position[::-1])


def test_what_does_not_fit_is_refused():
    session = RodSession(engine(), BATCH)
    material, displacement = samples(PLAIN)
    with pytest.raises(InputError, match="not started"):
        session.advance(displacement)
    session.reset(np.arange(BATCH), material)
    with pytest.raises(InputError, match="other body effects"):
        session.reset(np.arange(BATCH), material._replace(effects=all_effects(7)))
    with pytest.raises(InputError, match="drive has shape"):
        session.advance(displacement[:2])
    with pytest.raises(InputError, match="values in float32"):
        session.restore(np.arange(1), session.save()[:1].astype(np.float32))
    with pytest.raises(InputError, match="the number of lanes is 0"):
        RodSession(engine(), 0)


def test_loads_act_as_in_whole_rollouts():
    """Forces, gravity and factors on stiffness and damping, in two calls as in one."""
    run, (material, displacement) = engine("sdirk2"), samples(all_effects(7))
    random = np.random.default_rng(3)
    loads = SectionLoads(
        random.normal(size=(BATCH, STEPS + 1, 2, 3)) * 0.1,
        *(random.normal(size=(BATCH, STEPS + 1)) * 0.2 for _ in range(2)),
        random.normal(size=(BATCH, STEPS + 1, 3)),
        (2, 5),
    )

    def rows(first: int, last: int) -> SectionLoads:
        return loads._replace(**{name: getattr(loads, name)[:, first:last] for name in loads._fields[:4]})

    whole = run.rollout(material, displacement, loads=loads)
    plain = run.rollout(material, displacement)
    assert np.abs(whole.position - plain.position).max() > 1e-3
    session = RodSession(run, BATCH)
    session.reset(np.arange(BATCH), material, loads=rows(0, 1))
    first = session.advance(displacement[:, :PERIOD], loads=rows(1, PERIOD + 1))
    second = session.advance(displacement[:, PERIOD:], loads=rows(PERIOD + 1, STEPS + 1))
    np.testing.assert_array_equal(first.position, whole.position[:, : PERIOD + 1])
    np.testing.assert_array_equal(second.position, whole.position[:, PERIOD:])
